"""Videos of runs, with what is to be seen in each of their tiles."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path

import envs
from dreamer_jax.run_rows import MAXIMUM_VIDEO_MEMBERS
from experiments.reports.outcomes import Run
from experiments.runs.evaluate import SHOWN_MEMBERS
from experiments.runs.spec import RunSpec


@dataclass(frozen=True)
class Film:
    """A video whose frames are tiles side by side.

    Attributes:
      path: of the file.
      caption: what it shows, and where it is from.
      columns: what each column of tiles shows.
      rows: what each row shows; one of no name where there is one only.
    """

    path: Path
    caption: str
    columns: tuple[str, ...]
    rows: tuple[str, ...] = ("",)


def films(runs: Mapping[Path, Run]) -> list[Film]:
    """The newest evaluation of each run, its episodes of each task, and its predictions."""
    found = []
    for folder, run in runs.items():
        videos = folder / "videos"
        spec, title = run.spec, folder.name
        # Their names end in environment steps.
        for path in sorted(videos.glob("evaluation_*.mp4"))[-1:]:
            steps = int(path.stem.partition("_")[2])
            columns = _columns(spec, MAXIMUM_VIDEO_MEMBERS, spec.tasks)
            found.append(Film(path, f"{title}: evaluation after {steps:,} steps", columns))
        for path in sorted(videos.glob("evaluate_*.mp4")):
            columns = _columns(spec, SHOWN_MEMBERS, ("",))
            task = path.stem.partition("_")[2]
            found.append(Film(path, f"{title}: an episode, {task}", columns))
        for path in sorted(videos.glob("prediction_*.mp4")):
            columns = _columns(spec, SHOWN_MEMBERS, ("",))
            task = path.stem.partition("_")[2]
            caption = (
                f"{title}: {task}; from above the truth, the model, which after 5 frames predicts "
                "from the actions alone, and half their difference around grey"
            )
            found.append(Film(path, caption, columns, ("truth", "model", "error")))
    return found


def _columns(spec: RunSpec, most: int, tasks: Iterable[str]) -> tuple[str, ...]:
    """The members of a video and, where each has several tiles, their tasks."""
    tasks = tuple(tasks)
    return tuple(
        f"{member.label}, seed {member.seed}"
        + (f", {envs.described(task).title}" if len(tasks) > 1 else "")
        for member in spec.members[:most]
        for task in tasks
    )
