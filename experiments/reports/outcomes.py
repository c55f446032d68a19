"""What is known of the grid's cells: the results folders under one root, read.

A folder that cannot be read is warned of, and its cells count as missing.
"""

import warnings
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

import envs
from dreamer_jax.files import read_json
from dreamer_jax.logs import read_metrics
from dreamer_jax.schedule import Schedule
from experiments.runs.folder import folders, latents_folder
from experiments.runs.spec import RunSpec, read_spec
from experiments.thesis.grid import SEEDS, THRESHOLDS, Cell, Table


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


@dataclass(frozen=True)
class Share:
    """How well latent states of one task were told, at one threshold (section 4.3.3).

    Attributes:
      threshold: ξ of the thesis, for 230 features; None for the one suggested by the samples.
      scaled: what was applied, ξ · M / 230.
      task: title.
      known: whether the classifier was fitted on the task.
      not_novel: share of the samples that were not taken for novel.
      correct: of a novel task, the share taken for novel; of a known one, the share that was
        neither taken for novel nor for another task.
      right_task: share whose neighbours vote for the right task; 0 for a novel one.
    """

    threshold: float | None
    scaled: float
    task: str
    known: bool
    not_novel: float
    correct: float
    right_task: float


@dataclass(frozen=True)
class Classification:
    """What a table of latent task classification shows.

    Attributes:
      table: which one.
      samples: of each task that the classifier was tested on, and fitted on.
      feature_size: M.
      shares: for each threshold, the suggested one last, and each task, novel ones first.
    """

    table: Table
    samples: int
    feature_size: int
    shares: tuple[Share, ...]


def read_outcomes(root: str | Path, cells: Iterable[Cell]) -> dict[Cell, Outcome]:
    """The outcome of each cell, those that have not begun included."""
    places = folders(root)
    read: dict[Path, tuple[RunSpec, list[dict]] | None] = {}
    outcomes = {}
    for cell in cells:
        folder, member = places.get(cell.name, (None, 0))
        if folder is not None and folder not in read:
            read[folder] = _read_run(folder)
        if folder is None or read[folder] is None:
            outcomes[cell] = Outcome(cell)
            continue
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


def _read_run(folder: Path) -> tuple[RunSpec, list[dict]] | None:
    """A run's spec and the rows of its evaluations; a warning and nothing if it cannot be read."""
    try:
        rows = read_metrics(folder) if (folder / "metrics.jsonl").exists() else []
        return read_spec(folder), [row for row in rows if row["kind"] == "evaluation"]
    except (ValueError, KeyError, TypeError) as error:
        warnings.warn(
            f"{folder} cannot be read ({error}): its cells count as missing", stacklevel=3
        )
        return None


def read_classification(
    root: str | Path, table: Table, seeds: tuple[int, ...] = SEEDS
) -> Classification | None:
    """What a table of latent task classification shows; None if that is not done yet."""
    path = latents_folder(root, table.backend, seeds[0]) / f"{table.name}.json"
    if not path.exists():
        return None
    try:
        found = read_json(path)
        rows = {
            (row["threshold"], envs.spec(row["task"]).title): row for row in found["accuracies"]
        }
        scaled = dict.fromkeys(row["threshold"] for row in found["accuracies"])
        shares = tuple(
            Share(
                threshold=threshold,
                scaled=applied,
                task=task,
                known=task in table.known,
                not_novel=rows[applied, task]["not_novel"],
                correct=rows[applied, task]["correct"],
                right_task=rows[applied, task]["right_task"],
            )
            for threshold, applied in zip((*THRESHOLDS, None), scaled, strict=True)
            for task in (*table.targets, *table.known)
        )
    except (ValueError, KeyError, TypeError) as error:
        warnings.warn(f"{path} cannot be read ({error}): delete it to make it anew", stacklevel=2)
        return None
    return Classification(table, found["samples"], found["feature_size"], shares)
