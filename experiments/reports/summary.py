"""Tables and pictures of results folders.

Returns are those of the evaluations (section 4.2.3): "overall" is the mean over all evaluations
of a run, "final" over those in the last tenth of its environment steps. The deviation is that of
all these returns, of all seeds together, as in the thesis (see `statistics.mean_and_deviation`).
"""

import re
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

import envs
from dreamer_jax.logs import read_metrics
from dreamer_jax.schedule import Schedule
from experiments.reports.levels import draw_levels
from experiments.reports.statistics import FINAL_SHARE, mean_and_deviation
from experiments.runs.spec import BASELINE, RunSpec, read_spec
from experiments.runs.text import aligned, titles


@dataclass(frozen=True)
class Summary:
    """The evaluations of one label and task.

    Attributes:
      label: a fraction or the baseline.
      task: the task's name.
      seeds: how many seeds there are.
      done, planned: evaluations made and planned, summed over seeds.
      overall, final: mean and standard deviation of the returns; None if there are none.
    """

    label: str
    task: str
    seeds: int
    done: int
    planned: int
    overall: tuple[float, float] | None
    final: tuple[float, float] | None


def evaluations(directory: str | Path) -> list[dict[str, Any]]:
    """The evaluation rows of a results folder's metrics."""
    return [row for row in read_metrics(directory) if row["kind"] == "evaluation"]


def _statistics(rows: Sequence[dict[str, Any]]) -> tuple[float, float] | None:
    return mean_and_deviation([row["return"] for row in rows]) if rows else None


def labels(spec: RunSpec) -> list[str]:
    """The labels of a run's members, each once, the baseline last."""
    return list(dict.fromkeys(member.label for member in spec.members))


def summarise(directory: str | Path) -> list[Summary]:
    """One summary per label and task of a results folder."""
    spec = read_spec(directory)
    schedule = Schedule(spec.config.schedule, len(spec.tasks))
    total = schedule.environment_steps(schedule.rounds)
    rows = evaluations(directory)
    summaries = []
    for label in labels(spec):
        for task in spec.tasks:
            chosen = [row for row in rows if row["label"] == label and row["task"] == task]
            late = [row for row in chosen if row["env_steps"] > (1 - FINAL_SHARE) * total]
            seeds = len({member.seed for member in spec.members if member.label == label})
            summaries.append(
                Summary(
                    label=label,
                    task=task,
                    seeds=seeds,
                    done=len(chosen),
                    planned=seeds * schedule.evaluations,
                    overall=_statistics(chosen),
                    final=_statistics(late),
                )
            )
    return summaries


def table(summaries: Sequence[Summary]) -> str:
    """Overall and final return per label and task; incomplete runs are shown as such."""

    def cell(statistics):
        return "-" if statistics is None else f"{statistics[0]:.0f} ± {statistics[1]:.0f}"

    called = titles(summary.task for summary in summaries)
    rows = []
    for summary in summaries:
        name = summary.label + (f"  {called[summary.task]}" if len(called) > 1 else "")
        count = f"{summary.done}"
        if summary.done < summary.planned:
            count += f" of {summary.planned}, incomplete"
        rows.append([name, cell(summary.overall), cell(summary.final), str(summary.seeds), count])
    return aligned(["", "overall", "final", "seeds", "evaluations"], rows)


@dataclass(frozen=True)
class Curve:
    """One line of a picture.

    Attributes:
      text: what the legend calls it.
      rows: its evaluations, of all seeds.
      style: keywords of matplotlib's `plot`.
    """

    text: str
    rows: Sequence[dict[str, Any]]
    style: Mapping[str, Any]


def _of_folder(name: str, label: str, several: bool) -> str:
    """What a label of a folder is called beside other folders': by the folder's name alone, unless
    it has several labels."""
    return f"{name}, {label}" if several else name


def _curves(directory: str | Path, name: str | None = None) -> dict[str, list[Curve]]:
    """The curves of a results folder by task, without colours.

    Args:
      directory: a results folder.
      name: what the folder is called, where others are drawn with it.

    Raises:
      ValueError: the folder holds no run, or nothing has been evaluated yet.
    """
    spec, rows = read_spec(directory), evaluations(directory)
    if not rows:
        raise ValueError(f"{directory} has no evaluations to draw yet")
    several, found = len(labels(spec)) > 1, {}
    for task in spec.tasks:
        found[task] = []
        for label in labels(spec):
            chosen = [row for row in rows if row["label"] == label and row["task"] == task]
            text = re.sub(r"^omega=", "ω = ", label)
            text = text if name is None else _of_folder(name, text, several)
            style = {"linestyle": "--"} if label == BASELINE and several else {}
            found[task].append(Curve(text, chosen, style))
    return found


def _draw(panels: Mapping[str, Sequence[Curve]], stem: Path) -> list[Path]:
    """Draws panels side by side: mean and standard deviation over seeds against time.

    Returns:
      The files written, PNG and SVG.
    """
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    columns = len(panels)
    # Legends of many lines stand beside the panels.
    width = 9.0 if any(len(curves) > 4 for curves in panels.values()) else 6.4
    figure, axes = pyplot.subplots(
        1, columns, figsize=(width * columns, 4.2), squeeze=False, layout="constrained"
    )
    for axis, (title, curves) in zip(axes[0], panels.items(), strict=True):
        for curve in curves:
            steps = sorted({row["env_steps"] for row in curve.rows})
            returns = [[r["return"] for r in curve.rows if r["env_steps"] == x] for x in steps]
            mean = np.array([np.mean(values) for values in returns])
            deviation = np.array([np.std(values) for values in returns])
            axis.plot(steps, mean, label=curve.text, marker="o", markersize=3, **curve.style)
            axis.fill_between(
                steps,
                mean - deviation,
                mean + deviation,
                color=curve.style["color"],
                alpha=0.15,
                lw=0,
            )
        draw_levels(axis, {row["task"] for curve in curves for row in curve.rows})
        axis.set_title(title)
        axis.set_xlabel("environment steps")
        axis.set_ylabel("return of an evaluation episode")
        axis.grid(alpha=0.3)
        if len(curves) > 4:
            axis.legend(frameon=False, loc="upper left", bbox_to_anchor=(1, 1))
        elif len(curves) > 1:
            axis.legend(frameon=False)
    stem.parent.mkdir(parents=True, exist_ok=True)
    paths = [stem.with_suffix(suffix) for suffix in (".png", ".svg")]
    for file in paths:
        figure.savefig(file, dpi=150)
    pyplot.close(figure)
    return paths


def _coloured(curves: Sequence[Curve], baseline: str | None = None) -> list[Curve]:
    """The curves in the colours of a scale, dashed ones in `baseline` if it is given."""
    from matplotlib import colormaps

    shades = colormaps["viridis"](np.linspace(0.0, 0.85, max(1, len(curves))))
    return [
        replace(
            curve, style={"color": baseline if curve.style and baseline else shade} | curve.style
        )
        for curve, shade in zip(curves, shades, strict=True)
    ]


def plot_curves(directory: str | Path, path: str | Path | None = None) -> list[Path]:
    """Draws the learning curves: mean and standard deviation over seeds, one line per label.

    Args:
      directory: a results folder.
      path: where to, without suffix; by default "curves" in the folder.

    Returns:
      The files written, PNG and SVG.

    Raises:
      ValueError: nothing has been evaluated yet.
    """
    found = _curves(directory)
    called = titles(found)
    panels = {called[task]: _coloured(curves, "black") for task, curves in found.items()}
    return _draw(panels, Path(path) if path is not None else Path(directory) / "curves")


def folder_names(directories: Sequence[Path]) -> list[str]:
    """What each of some folders is called: its name, or its path where others have the same."""
    names = [directory.resolve().name for directory in directories]
    count = Counter(names)
    return [
        name if count[name] == 1 else str(directory)
        for name, directory in zip(names, directories, strict=True)
    ]


def compare(directories: Sequence[Path]) -> list[Summary]:
    """One summary per folder, label and task; labels begin with the folder's name."""
    summaries = []
    for name, directory in zip(folder_names(directories), directories, strict=True):
        found = summarise(directory)
        several = len({summary.label for summary in found}) > 1
        summaries += [
            replace(summary, label=_of_folder(name, summary.label, several)) for summary in found
        ]
    return summaries


def plot_comparison(directories: Sequence[Path], path: str | Path) -> list[Path]:
    """Draws the learning curves of several folders at equal environment steps: a panel for each
    of the tasks' titles, whichever the simulator, and a line per folder and label.

    Args:
      directories: results folders.
      path: where to, without suffix.

    Returns:
      The files written, PNG and SVG.

    Raises:
      ValueError: a folder holds no run, or nothing has been evaluated in it yet.
    """
    panels: dict[str, list[Curve]] = {}
    for name, directory in zip(folder_names(directories), directories, strict=True):
        found = _curves(directory, name)
        called = titles(found)
        for task, curves in found.items():
            title = envs.spec(task).title
            if called[task] != title:
                curves = [replace(curve, text=f"{curve.text}, {task}") for curve in curves]
            panels.setdefault(title, []).extend(curves)
    return _draw({title: _coloured(curves) for title, curves in panels.items()}, Path(path))
