"""Where the time of a training run goes: one JSON line.

    python -m benchmarks.train [task=bullet/inverted_pendulum] [preset=cpu] [P=1] [phases=3]

Runs prefill and `phases` rounds of a real run in a temporary folder, twice: the first run
compiles. The shares of the second run's time are those in updates, in simulators (a tick of all of
them, from its request to its last reply), waiting for batches, in policies and the bridge to the
simulators, and in the rest (checkpoints, metrics, videos).
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
from experiments.run import RunSpec, make_run

DEFAULTS = {"task": "bullet/inverted_pendulum", "preset": "cpu", "P": 1, "phases": 3}


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
    """Seconds of a whole run by what they went to."""
    run = make_run(spec, directory)
    simulators, waiting = Stopwatch(), Stopwatch()
    pool, replay = run.env._pool, run.replay
    pool.reset, pool.step = simulators.timed(pool.reset), simulators.timed(pool.step)
    batches = replay.batches

    @contextlib.contextmanager
    def timed_batches(*arguments, **options):
        with batches(*arguments, **options) as prefetcher:
            following = waiting.timed(prefetcher.__next__)
            yield (following() for _ in arguments[1])

    replay.batches = timed_batches
    started = time.perf_counter()
    try:
        with contextlib.redirect_stdout(io.StringIO()):
            run.train()
        total = time.perf_counter() - started
    finally:
        run.close()
        run.env.close()
    rows = [json.loads(row) for row in (directory / "timings.jsonl").read_text().splitlines()]
    updates = sum(row["seconds"] for row in rows if row["kind"] == "update") - waiting.seconds
    phases = sum(row["seconds"] for row in rows if row["kind"] != "update")
    return {
        "total": total,
        "updates": updates,
        "simulators": simulators.seconds,
        "waiting for batches": waiting.seconds,
        "policies and bridge": phases - simulators.seconds,
        "rest": total - updates - waiting.seconds - phases,
    }


def main():
    a = read_arguments(sys.argv[1:], DEFAULTS)
    # As the command line does.
    keep_freed_memory()
    config = preset(a["preset"])
    steps = config.schedule.phase_environment_steps
    schedule = dataclasses.replace(
        config.schedule,
        environment_steps=(config.schedule.prefill_phases + a["phases"]) * steps,
        evaluate_every=2 * a["phases"] * steps,
    )
    spec = RunSpec(
        tasks=(a["task"],),
        seeds=tuple(range(a["P"])),
        config=dataclasses.replace(config, schedule=schedule),
    )
    with tempfile.TemporaryDirectory() as directory:
        for name in ("compiling", "measured"):
            seconds = shares(spec, Path(directory) / name)
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
