"""Carries out planned runs on an engine: what was cut goes on, what fails is named, the rest goes
on. Those that need what failed are left for the next time."""

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

from experiments.runs.folder import folders
from experiments.thesis.engines import Engine, Resources, Task
from experiments.thesis.engines.local import in_turn, one_by_one
from experiments.thesis.graph import DamagedRun, Graph, PlannedRun, due, inspect_run
from experiments.thesis.jobs import (
    PLAIN,
    POLL_SECONDS,
    Ending,
    Job,
    Means,
    Say,
    Train,
    set_aside_damaged,
)
from experiments.thesis.reservations import at_work, reservations


@dataclass
class Progress:
    """What became of planned runs.

    Attributes:
      finished: names of the runs that were trained to their end.
      shared: those that another process has finished meanwhile.
      failed: those that were not, and why.
      skipped: those that need one of these, and which.
      stopped: whether Ctrl-C ended it.
      left: whether what is not done is with a queue that goes on by itself.
    """

    finished: list[str] = field(default_factory=list)
    shared: list[str] = field(default_factory=list)
    failed: dict[str, str] = field(default_factory=dict)
    skipped: dict[str, str] = field(default_factory=dict)
    stopped: bool = False
    left: bool = False

    @property
    def complete(self) -> bool:
        """Whether nothing failed and nothing is left."""
        return not (self.failed or self.skipped or self.stopped)

    def add(self, ending: Ending) -> None:
        """Notes what became of a run."""
        self.failed |= ending.damaged
        match ending.kind:
            case "finished":
                self.finished.append(ending.name)
            case "there":
                self.shared.append(ending.name)
            case "failed":
                self.failed[ending.name] = ending.message
            case "skipped":
                self.skipped[ending.name] = ending.message
            case "stopped" | "left":
                self.stopped = True
                self.left |= ending.kind == "left"


def carry_out_runs(
    runs: Graph,
    root: str | Path,
    *,
    engine: Engine = one_by_one,
    means: Means = PLAIN,
    resources: Callable[[PlannedRun], Resources] = lambda run: Resources(),
    say: Say = print,
) -> Progress:
    """Trains what is missing and goes on with what was cut, each run after those it needs.

    Args:
      runs: from `reservations.planned`, whose context lasts.
      root: the folder of all results.
      engine: where they are trained; by default here, in the order given.
      means: how each is trained there.
      resources: what a run gets.
      say: where messages go.
    """
    root, progress = Path(root).absolute(), Progress()

    for run in runs:
        if isinstance(run, DamagedRun) and (ending := set_aside_damaged(root, run.name)):
            progress.add(ending)
    left = due(runs)
    names = {run.name for run in left}
    tasks = [
        Task(
            Job(root, run.name, means),
            run,
            tuple(name for name in run.needs if name in names),
            resources(run),
            f"run {number} of {len(left)}, {run.name}",
        )
        for number, run in enumerate(left, start=1)
    ]
    for ending in engine(tasks, say):
        progress.add(ending)
    return progress


def work(
    root: str | Path,
    *,
    means: Means = PLAIN,
    train: Train | None = None,
    say: Say = print,
    poll: float = POLL_SECONDS,
) -> Progress:
    """Trains what is planned under a root by whomever, and what was cut there, beside others who
    do the same, until nothing is left.

    Args:
      root: the folder of all results.
      means: how each is trained.
      train: what trains one run.
      say: where messages go.
      poll: seconds between looks at what others do.
    """
    root, progress = Path(root).absolute(), Progress()

    def tasks() -> list[Task]:
        planned = reservations(root)
        # Of copies that hold the same agents, that which plans take.
        names = {folder for folder, _ in folders(root).values()}
        runs = {folder.name: inspect_run(folder) for folder in sorted(names)}
        return [
            Task(Job(root, run.name, means), run, run.needs)
            for run in due(list({**planned, **runs}.values()))
        ]

    with at_work(root):
        for ending in in_turn(tasks, say, train=train, poll=poll):
            progress.add(ending)
    return progress
