"""What came of runs: the one reader of their metrics.

An agent is *missing* (nothing was evaluated), *cut* (some evaluations), *done* (all of them) or
*failed*: its losses were not finite any more, and it was frozen. Only agents that are done give
scores; failed ones are named. A folder that cannot be read is warned of, and its cells count as
missing.

Axis letters: E evaluations.
"""

import dataclasses
import warnings
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import numpy as np

import envs
from dreamer_jax.logs import read_metrics
from dreamer_jax.schedule import Schedule
from dreamer_jax.schema import EVALUATION_ROW, check_shape
from experiments.reports import statistics
from experiments.runs.folder import folders, run_folders, sound
from experiments.runs.spec import RunSpec, read_spec
from experiments.thesis.grid import Backend, Cell, Figure, Metric, Table, shown

State = Literal["missing", "cut", "done", "failed"]


@dataclass(frozen=True)
class Outcome:
    """The evaluations of one agent so far.

    Attributes:
      env_steps: environment steps [E] at each evaluation, ascending.
      returns: by task, the return of each evaluation [E]: by its title where the outcome is a
        cell's, by its name where it is a member's.
      planned: evaluations of the whole run.
      total_env_steps: environment steps of the whole run; 0 if it has not begun.
      failed_at: environment steps at which it was first seen to have failed, if it has.
    """

    env_steps: tuple[int, ...] = ()
    returns: Mapping[str, tuple[float, ...]] = field(default_factory=dict)
    planned: int = 0
    total_env_steps: int = 0
    failed_at: int | None = None

    @property
    def state(self) -> State:
        """How far it has come."""
        if self.failed_at is not None:
            return "failed"
        if not self.env_steps:
            return "missing"
        return "done" if len(self.env_steps) >= self.planned else "cut"

    def chosen(self, task: str, metric: Metric) -> np.ndarray:
        """The returns of a task that a metric takes (section 4.2.3), so far."""
        returns = np.asarray(self.returns.get(task, ()), float)
        if metric == "overall":
            return returns
        return statistics.final(self.env_steps, returns, self.total_env_steps, self.planned)

    def score(self, task: str, metric: Metric) -> float:
        """The mean of these returns, of an agent that is done: what it counts for in statistics."""
        return float(self.chosen(task, metric).mean())


@dataclass(frozen=True)
class Run:
    """A results folder, read.

    Attributes:
      folder: where it is.
      spec: what it is a run of.
      outcomes: one for each member, its returns by names of tasks.
      evaluations: the rows of its evaluations, as they were written.
    """

    folder: Path
    spec: RunSpec
    outcomes: tuple[Outcome, ...]
    evaluations: tuple[Mapping[str, Any], ...]


def read_run(folder: str | Path) -> Run:
    """A results folder; without evaluations if it has none yet.

    Raises:
      ValueError: the folder holds no run, or one that is damaged.
    """
    folder = Path(folder)
    spec = read_spec(folder)
    rows = read_metrics(folder) if (folder / "metrics.jsonl").exists() else []
    by_member: list[list[Mapping[str, Any]]] = [[] for _ in spec.members]
    try:
        for row in rows:
            if row["kind"] == "evaluation":
                check_shape(row, EVALUATION_ROW, folder / "metrics.jsonl")
            by_member[row["member"]].append(row)
        outcomes = tuple(_outcome(spec, chosen) for chosen in by_member)
    except (KeyError, IndexError, TypeError) as error:
        raise ValueError(
            f"{folder / 'metrics.jsonl'} does not belong to its run.json of {len(spec.members)} "
            f"members: {error!r}"
        ) from error
    return Run(folder, spec, outcomes, tuple(row for row in rows if row["kind"] == "evaluation"))


def _outcome(spec: RunSpec, rows: Iterable[Mapping[str, Any]]) -> Outcome:
    """What came of one member, from its rows."""
    schedule = Schedule(spec.config.schedule, len(spec.tasks))
    found: dict[int, dict[str, float]] = {}
    failed_at = None
    for row in rows:
        if not sound(row) and failed_at is None:
            failed_at = row["env_steps"]
        if row["kind"] == "evaluation":
            found.setdefault(row["env_steps"], {})[row["task"]] = row["return"]
    # A run that was killed may have evaluated some of its tasks only.
    whole = {steps: each for steps, each in sorted(found.items()) if len(each) == len(spec.tasks)}
    return Outcome(
        tuple(whole),
        {task: tuple(each[task] for each in whole.values()) for task in spec.tasks},
        schedule.evaluations,
        schedule.environment_steps(schedule.rounds),
        failed_at,
    )


def read_runs(root: str | Path) -> dict[Path, Run]:
    """The runs of cells under a root by their folders; what cannot be read is warned of."""
    return _read(run_folders(root))


def read_outcomes(root: str | Path, cells: Iterable[Cell]) -> dict[Cell, Outcome]:
    """The outcome of each cell, those that have not begun included."""
    cells, places = tuple(cells), folders(root)
    runs = _read({places[cell.name][0]: None for cell in cells if cell.name in places})
    outcomes = {}
    for cell in cells:
        outcomes[cell] = Outcome()
        if cell.name not in places:
            continue
        folder, member = places[cell.name]
        run = runs.get(folder)
        if run is None or member >= len(run.outcomes):
            continue
        one = run.outcomes[member]
        by_title = {envs.described(task).title: returns for task, returns in one.returns.items()}
        outcomes[cell] = dataclasses.replace(one, returns=by_title)
    return outcomes


def _read(chosen: Iterable[Path]) -> dict[Path, Run]:
    found = {}
    for folder in chosen:
        try:
            found[folder] = read_run(folder)
        except (ValueError, KeyError, TypeError) as error:
            warnings.warn(
                f"{folder} cannot be read ({error}): its cells count as missing", stacklevel=3
            )
    return found


def curves(outcomes: Sequence[Outcome], task: str) -> tuple[np.ndarray, np.ndarray]:
    """Returns on a task over environment steps, as far as all runs that have begun have come.

    Agents that failed are left out.

    Returns:
      environment steps [E] and returns [N, E]; N is 0 if no run has begun.
    """
    begun = [outcome for outcome in outcomes if outcome.state in ("cut", "done")]
    if not begun:
        return np.zeros(0, int), np.zeros((0, 0))
    length = min(len(outcome.returns.get(task, ())) for outcome in begun)
    steps = np.array(begun[0].env_steps[:length], int)
    return steps, np.array([outcome.returns[task][:length] for outcome in begun], float)


def states(outcomes: Iterable[Outcome]) -> Counter[State]:
    """How many agents are in each state."""
    return Counter(outcome.state for outcome in outcomes)


def seeds_on_disk(
    root: str | Path,
    entries: Iterable[Table | Figure],
    backend: Backend,
    asked: Sequence[int] = (),
) -> tuple[int, ...]:
    """All seeds that runs under a root have, for tables and figures to show.

    The first is that of the source agents: the first that was asked for, or else the one of which
    most agents are there. The others ascend.

    Args:
      root: the folder of results folders.
      entries: tables and figures, to tell which seed the source agents have.
      backend: the simulator of the entries.
      asked: seeds that are shown in any case.
    """
    found = set(asked)
    for folder in run_folders(root):
        try:
            spec = read_spec(folder)
        except (ValueError, KeyError, TypeError):
            continue  # `read_outcomes` warns of it
        if any(task.partition("/")[0] == backend for task in spec.tasks):
            found |= set(spec.seeds)
    ordered, held, entries = sorted(found), folders(root), tuple(entries)

    def there(source: int) -> set[Cell]:
        seeds = (source, *(seed for seed in ordered if seed != source))
        cells = {cell for entry in entries for cell in shown(entry, seeds)}
        return {cell for cell in cells if cell.name in held}

    if not ordered:
        return ()
    source = asked[0] if asked else max(ordered, key=lambda seed: len(there(seed)))
    others = {cell.seed for cell in there(source)} | set(asked)
    return (source, *sorted(others - {source}))
