"""Seconds to carry out a whole transfer plan on agents of thesis sizes: one JSON line.

    python -m benchmarks.transfer [P=1,54] [depth=32] [deter=200] [stoch=30] [units=400] [n=5]

For each P, `apply` is fractional transfer with its report, from one source to P targets that
each have a fraction of their own; `copy` makes a copy of as many bytes, which is the least that a
pure function can do. Both are medians of n, in turn; `ratio` is the median of their quotients.
"""

import json
import statistics
import sys
import time

import jax
import jax.numpy as jnp

import transfer
from benchmarks.update import read_arguments, settings
from dreamer_jax.agent import Agent
from dreamer_jax.host_memory import keep_freed_memory
from transfer.recipes import fractional_transfer

DEFAULTS = {"P": "1,54", "depth": 32, "deter": 200, "stoch": 30, "units": 400, "A": 6, "n": 5}


def seconds(function):
    started = time.perf_counter()
    result = jax.block_until_ready(function())
    return time.perf_counter() - started, result


def measure(agent: Agent, members: int, n: int) -> dict:
    source = agent.init_params(jax.random.key(0))
    keys = jax.random.split(jax.random.key(1), members)
    targets = jax.jit(jax.vmap(agent.init_params))(keys)
    omegas = jnp.linspace(0.0, 0.5, members)
    copy = jax.jit(lambda tree: jax.tree.map(jnp.copy, tree))

    def apply():
        plan = fractional_transfer()
        new, report = transfer.apply(plan, targets, source, omega=omegas, population=True)
        return new, report.records()

    times = {"apply": [], "copy": []}
    for repetition in range(n + 1):
        for name, function in (("apply", apply), ("copy", lambda: copy(targets))):
            elapsed, _ = seconds(function)
            # The first time compiles.
            if repetition:
                times[name].append(elapsed)
    return {
        "P": members,
        "bytes": sum(leaf.nbytes for leaf in jax.tree.leaves(targets)),
        **{f"{name}_s": round(statistics.median(taken), 4) for name, taken in times.items()},
        "ratio": round(
            statistics.median(a / b for a, b in zip(times["apply"], times["copy"], strict=True)), 2
        ),
    }


def main():
    a = read_arguments(sys.argv[1:], DEFAULTS)
    # As the command line does.
    keep_freed_memory()
    agent = Agent(settings(a), a["A"])
    results = [measure(agent, int(members), a["n"]) for members in a["P"].split(",")]
    print(json.dumps({"benchmark": "transfer", "jax": jax.__version__, "results": results, **a}))


if __name__ == "__main__":
    main()
