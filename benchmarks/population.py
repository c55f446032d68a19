"""Seconds per update and member, for populations and ways to map them: one JSON line.

    python -m benchmarks.population P=1,3,8 mapping=chunks,vmap [depth=8] ... [n=5]

Sizes are those of the preset `cpu` by default. All are compiled first and then take turns;
`ratio` is the median, over the turns, of the time per member over that of the first population.
"""

import json
import statistics
import sys

import jax

from benchmarks.update import SIZES, prepare, read_arguments
from dreamer_jax.config import preset
from dreamer_jax.host_memory import keep_freed_memory


def defaults() -> dict:
    config = preset("cpu")
    network, learning = config.network, config.learning
    return {
        **SIZES,
        "depth": network.encoder_depth,
        "deter": network.deterministic_size,
        "stoch": network.stochastic_size,
        "units": network.head_units,
        "image": network.image_size,
        "B": learning.batch_size,
        "L": learning.sequence_length,
        "H": learning.horizon,
        "A": 1,
        "starts": learning.imagination_starts or 0,
        "P": "1,3,8",
        "mapping": "chunks,vmap",
        "n": 5,
    }


def main():
    a = read_arguments(sys.argv[1:], defaults())
    # As the command line does.
    keep_freed_memory()
    steps = {}
    for mapping in a["mapping"].split(","):
        for members in map(int, a["P"].split(",")):
            if members == 1 and steps:
                continue
            step = prepare({**a, "P": members, "mapping": mapping, "chunk": 1})
            step()
            steps[mapping, members] = step
    times = {case: [] for case in steps}
    for _ in range(a["n"]):
        for (mapping, members), step in steps.items():
            times[mapping, members].append(step() / members)
    base = next(iter(times.values()))
    results = [
        {
            "mapping": mapping,
            "P": members,
            "s_per_member": round(statistics.median(taken), 4),
            "ratio": round(statistics.median(x / y for x, y in zip(taken, base, strict=True)), 3),
        }
        for (mapping, members), taken in times.items()
    ]
    print(json.dumps({"benchmark": "population", "jax": jax.__version__, "results": results, **a}))


if __name__ == "__main__":
    main()
