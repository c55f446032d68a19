"""What each run gets: what is asked for, or else what the plan's kept measurement tells."""

import dataclasses
import multiprocessing
from collections.abc import Callable, Mapping
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path

from dreamer_jax.devices import Choice
from experiments.thesis import estimate
from experiments.thesis.engines import Resources
from experiments.thesis.estimate import Estimate
from experiments.thesis.graph import Graph, PlannedRun, due
from experiments.thesis.speeds import cache_folder, kept

PROGRAM_GIB = 3.0
"""What a process takes beside its agents: the interpreter, its libraries, compiled programs."""


def demands(
    runs: Graph, asked: Resources, folder: Path | None = None
) -> Callable[[PlannedRun], Resources]:
    """What each run gets: memory and hours that are not asked for are estimated where `plan` has
    measured this machine, and left open elsewhere.

    Args:
      runs: from `graph.plan_runs`.
      asked: for all of them.
      folder: where measurements are kept; by default the usual one.
    """
    folder = folder or cache_folder()
    found: Mapping[str, Estimate] = {}
    if None in (asked.memory, asked.hours) and any(folder.glob("*.json")):
        # In a process of its own, which ends: asking what device this is takes one into possession.
        spawn = multiprocessing.get_context("spawn")
        with ProcessPoolExecutor(1, mp_context=spawn) as processes:
            devices: Choice = "all" if asked.gpus is not None and asked.gpus > 1 else 1
            found = processes.submit(estimates, tuple(runs), folder, devices).result()

    def demand(run: PlannedRun) -> Resources:
        one = found.get(run.name)
        if one is None:
            return asked
        memory = PROGRAM_GIB + one.memory / 2**30 if asked.memory is None else asked.memory
        hours = estimate.SLACK * one.seconds / 3600 if asked.hours is None else asked.hours
        return dataclasses.replace(asked, memory=memory, hours=hours)

    return demand


def estimates(runs: Graph, folder: Path, devices: Choice) -> dict[str, Estimate]:
    """What each run that is due still takes, by name; nothing if this machine is not measured."""
    left = due(runs)
    known = kept([run.spec for run in left], folder) if left else None
    if known is None:
        return {}
    return {run.name: estimate.estimate(run, known.speed, devices) for run in left}
