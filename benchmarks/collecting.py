"""Seconds of a round with its phase collected before updates and beside them: one JSON line.

    python -m benchmarks.collecting [task=bullet/inverted_pendulum] [preset=cpu] [P=1] [rounds=3]
                                    [turns=3] [phase=1000] [updates=0] [workers=1] [wait_ms=0]

Real runs in temporary folders, of either kind in turns; `before` and `beside` are a round's mean
seconds of each turn, from the first phase with a trained policy on, and `ratio` the median over
turns of beside over before. Where all shares one core there is nothing to gain but what
simulators wait: `wait_ms` are milliseconds that each tick of all simulators sleeps, in place of
simulators on cores of their own. `phase` has so many environment steps; `updates` are those of a
round, by default the preset's.
"""

import contextlib
import dataclasses
import io
import json
import signal
import statistics
import sys
import tempfile
import time
from pathlib import Path

import jax

from benchmarks.update import read_arguments
from dreamer_jax.config import preset
from dreamer_jax.host_memory import keep_freed_memory
from experiments.runs.run import RunSpec, make_run

DEFAULTS = {
    "task": "bullet/inverted_pendulum",
    "preset": "cpu",
    "P": 1,
    "rounds": 3,
    "turns": 3,
    "phase": 1000,
    "updates": 0,
    "workers": 1,
    "wait_ms": 0.0,
}
WARM = 1
"""Rounds with a trained policy before the first that counts; it is alike in both kinds."""


def seconds_of_a_round(a: dict, collect: str, directory: Path) -> float:
    """The mean over a run's last rounds, from a phase's records written to the next's."""
    config = preset(a["preset"])
    schedule = dataclasses.replace(
        config.schedule,
        environment_steps=(1 + WARM + a["rounds"]) * a["phase"],
        phase_environment_steps=a["phase"],
        prefill_phases=1,
        updates_per_phase=a["updates"] or config.schedule.updates_per_phase,
        evaluate_every=10**9,
        checkpoint_every=10**9,
        collect=collect,
    )
    config = dataclasses.replace(config, schedule=schedule)
    run = make_run(
        RunSpec((a["task"],), tuple(range(a["P"])), config), directory, workers=a["workers"]
    )
    append, step, written = run.replay.append, run.env._pool.step, []

    def noting(records):
        append(records)
        written.append(time.perf_counter())
        if len(written) == 1 + WARM + a["rounds"]:
            signal.raise_signal(signal.SIGINT)  # nothing after it counts

    def waiting(*arguments):
        time.sleep(a["wait_ms"] / 1000)
        return step(*arguments)

    run.replay.append, run.env._pool.step = noting, waiting
    try:
        with contextlib.redirect_stdout(io.StringIO()):
            run.train()
    finally:
        run.close()
        run.env.close()
    if len(written) < 1 + WARM + a["rounds"]:
        sys.exit("error: the run was stopped before its last round")
    return (written[-1] - written[-1 - a["rounds"]]) / a["rounds"]


def main():
    a = read_arguments(sys.argv[1:], DEFAULTS)
    keep_freed_memory()  # as the command line does
    turns = []
    for _ in range(a["turns"]):
        with tempfile.TemporaryDirectory() as directory:
            kinds = ("before", "beside")
            turns.append([seconds_of_a_round(a, kind, Path(directory) / kind) for kind in kinds])
    before, beside = ([round(x, 3) for x in values] for values in zip(*turns, strict=True))
    result = {
        "benchmark": "collecting",
        "jax": jax.__version__,
        "before": before,
        "beside": beside,
        "ratio": round(statistics.median(two / one for one, two in turns), 3),
        **a,
    }
    print(json.dumps(result))


if __name__ == "__main__":
    main()
