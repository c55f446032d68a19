"""What a table of latent task classification shows: the file of its accuracies, read."""

import warnings
from dataclasses import dataclass
from pathlib import Path

import envs
from dreamer_jax.files import read_json
from experiments.runs.folder import latents_folder
from experiments.thesis.grid import SEEDS, THRESHOLDS, LatentTable


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

    table: LatentTable
    samples: int
    feature_size: int
    shares: tuple[Share, ...]


def read_classification(
    root: str | Path, table: LatentTable, seeds: tuple[int, ...] = SEEDS
) -> Classification | None:
    """What a table of latent task classification shows; None if that is not done yet."""
    path = latents_folder(root, table.backend, seeds[0]) / f"{table.name}.json"
    if not path.exists():
        return None
    try:
        found = read_json(path)
        rows = {
            (row["threshold"], envs.described(row["task"]).title): row
            for row in found["accuracies"]
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
            for task in table.tasks
        )
    except (ValueError, KeyError, TypeError) as error:
        warnings.warn(f"{path} cannot be read ({error}): delete it to make it anew", stacklevel=2)
        return None
    return Classification(table, found["samples"], found["feature_size"], shares)
