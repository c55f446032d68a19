"""What is known of the grid's cells: the results folders under one root, read.

A run's folder holds cells.json beside what `experiments.run` writes: the names of its cells, in
the order of its members. Nothing else says where a cell is, so that folders may be copied to
another machine and read there.
"""

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

import envs
from dreamer_jax.files import read_json
from dreamer_jax.logs import read_metrics
from dreamer_jax.schedule import Schedule
from experiments.grid import Cell
from experiments.spec import read_spec

CELLS = "cells.json"


@dataclass(frozen=True)
class Outcome:
    """The evaluations of one cell so far.

    Attributes:
      cell: the agent.
      env_steps: environment steps at each evaluation, ascending.
      returns: by title of task, the return of each evaluation.
      planned: evaluations of the whole run.
      total_env_steps: environment steps of the whole run; 0 if it has not begun.
    """

    cell: Cell
    env_steps: tuple[int, ...] = ()
    returns: dict[str, tuple[float, ...]] | None = None
    planned: int = 0
    total_env_steps: int = 0

    @property
    def state(self) -> str:
        """ "missing", "incomplete" or "complete"."""
        if not self.env_steps:
            return "missing"
        return "complete" if len(self.env_steps) >= self.planned else "incomplete"


def folders(root: str | Path) -> dict[str, tuple[Path, int]]:
    """Where each cell is: its name -> (results folder, member)."""
    found = {}
    for path in sorted(Path(root).glob(f"*/{CELLS}")):
        for member, name in enumerate(read_json(path)):
            found.setdefault(name, (path.parent, member))
    return found


def read_outcomes(root: str | Path, cells: Iterable[Cell]) -> dict[Cell, Outcome]:
    """The outcome of each cell, those that have not begun included."""
    places, read = folders(root), {}
    outcomes = {}
    for cell in cells:
        if cell.name not in places:
            outcomes[cell] = Outcome(cell)
            continue
        folder, member = places[cell.name]
        if folder not in read:
            read[folder] = (
                read_spec(folder),
                [row for row in read_metrics(folder) if row["kind"] == "evaluation"],
            )
        spec, rows = read[folder]
        schedule = Schedule(spec.config.schedule, len(spec.tasks))
        returns: dict[str, list[float]] = {}
        env_steps: dict[int, None] = {}
        for row in rows:
            if row["member"] == member:
                env_steps.setdefault(row["env_steps"])
                returns.setdefault(envs.spec(row["task"]).title, []).append(row["return"])
        outcomes[cell] = Outcome(
            cell,
            tuple(env_steps),
            {task: tuple(values) for task, values in returns.items()},
            schedule.evaluations,
            schedule.environment_steps(schedule.rounds),
        )
    return outcomes
