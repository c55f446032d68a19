"""Where the time of a training run goes: one JSON line.

    python -m benchmarks.train [task=bullet/inverted_pendulum] [preset=cpu] [P=1]

Runs a real run in a temporary folder from its start to its second evaluation. All is compiled by
the first; the shares are of the time from there on, a whole period of the schedule: phases and
their updates, a checkpoint, an evaluation. They are those in updates, in simulators (a tick of all
of them, from its request to its last reply), waiting for batches, in policies and the bridge to
the simulators, and in the rest (checkpoints, metrics, videos).
"""

import contextlib
import dataclasses
import io
import json
import sys
import tempfile
import time
from pathlib import Path

import jax

from benchmarks.update import read_arguments
from dreamer_jax.config import preset
from dreamer_jax.host_memory import keep_freed_memory
from experiments.runs.run import RunSpec, make_run

DEFAULTS = {"task": "bullet/inverted_pendulum", "preset": "cpu", "P": 1}


class Stopwatch:
    """Adds up the seconds spent in functions."""

    def __init__(self):
        self.seconds = 0.0

    def timed(self, function):
        def call(*arguments, **options):
            started = time.perf_counter()
            try:
                return function(*arguments, **options)
            finally:
                self.seconds += time.perf_counter() - started

        return call


def shares(spec: RunSpec, directory: Path) -> dict:
    """Seconds from a run's first evaluation to its second by what they went to."""
    run = make_run(spec, directory)
    simulators, waiting = Stopwatch(), Stopwatch()
    replay, writer = run.replay, run.writer
    if (pool := getattr(run.env, "_pool", None)) is not None:
        pool.reset, pool.step = simulators.timed(pool.reset), simulators.timed(pool.step)
    batches, write_timing = replay.batches, writer.write_timing
    rows, moments = [], []

    @contextlib.contextmanager
    def timed_batches(*arguments, **options):
        with batches(*arguments, **options) as prefetcher:
            following = waiting.timed(prefetcher.__next__)
            yield (following() for _ in arguments[1])

    def watched_timing(row):
        write_timing(row)
        rows.append(row)
        if row["kind"] == "evaluate":
            moments.append((time.perf_counter(), simulators.seconds, waiting.seconds, len(rows)))

    replay.batches, writer.write_timing = timed_batches, watched_timing
    try:
        with contextlib.redirect_stdout(io.StringIO()):
            run.train()
    finally:
        run.close()
        run.env.close()
    first, second = moments[:2]
    total, in_simulators, waited = (b - a for a, b in zip(first[:3], second[:3], strict=True))
    rows = rows[first[3] : second[3]]
    updates = sum(row["seconds"] for row in rows if row["kind"] == "update") - waited
    phases = sum(row["seconds"] for row in rows if row["kind"] != "update")
    return {
        "total": total,
        "updates": updates,
        "simulators": in_simulators,
        "waiting for batches": waited,
        "policies and bridge": phases - in_simulators,
        "rest": total - updates - waited - phases,
    }


def main():
    a = read_arguments(sys.argv[1:], DEFAULTS)
    # As the command line does.
    keep_freed_memory()
    config = preset(a["preset"])
    schedule = dataclasses.replace(
        config.schedule, environment_steps=2 * config.schedule.evaluate_every
    )
    spec = RunSpec(
        tasks=(a["task"],),
        seeds=tuple(range(a["P"])),
        config=dataclasses.replace(config, schedule=schedule),
    )
    with tempfile.TemporaryDirectory() as directory:
        seconds = shares(spec, Path(directory) / "run")
    total = seconds.pop("total")
    result = {
        "benchmark": "train",
        "jax": jax.__version__,
        "seconds": round(total, 2),
        "shares": {name: round(spent / total, 4) for name, spent in seconds.items()},
        "neither": round(1 - (seconds["updates"] + seconds["simulators"]) / total, 4),
        **a,
    }
    print(json.dumps(result))


if __name__ == "__main__":
    main()
