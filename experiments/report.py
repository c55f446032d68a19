"""Tables and pictures of results folders.

Returns are those of the evaluations (section 4.2.3): "overall" is the mean over all evaluations
of a run, "final" over those in the last tenth of its environment steps. The deviation is that of
all these returns, of all seeds together, as in the thesis (see `statistics.mean_and_deviation`).
"""

import re
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

import envs
from dreamer_jax.logs import read_metrics
from dreamer_jax.schedule import Schedule
from experiments.spec import BASELINE, RunSpec, read_spec
from experiments.statistics import FINAL_SHARE, mean_and_deviation


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


def titles(tasks: Iterable[str]) -> dict[str, str]:
    """What each of some tasks is called beside the others: its title, or its name where another
    simulator's has the same."""
    found = {task: envs.spec(task).title for task in tasks}
    count = Counter(found.values())
    return {task: title if count[title] == 1 else task for task, title in found.items()}


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


def aligned(header: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """A table as text: the first column to the left, the others to the right."""
    lines = [list(header), *(list(row) for row in rows)]
    widths = [max(len(line[i]) for line in lines) for i in range(len(header))]
    lines.insert(1, ["-" * width for width in widths])
    return "\n".join(
        "  ".join(
            cell.ljust(width) if i == 0 else cell.rjust(width)
            for i, (cell, width) in enumerate(zip(line, widths, strict=True))
        ).rstrip()
        for line in lines
    )


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
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    directory = Path(directory)
    spec, rows = read_spec(directory), evaluations(directory)
    if not rows:
        raise ValueError(f"{directory} has no evaluations to draw yet")
    stem = Path(path) if path is not None else directory / "curves"
    columns = len(spec.tasks)
    figure, axes = pyplot.subplots(
        1, columns, figsize=(6.4 * columns, 4.2), squeeze=False, layout="constrained"
    )
    names, called = labels(spec), titles(spec.tasks)
    shades = pyplot.get_cmap("viridis")(np.linspace(0.0, 0.85, max(1, len(names))))
    for axis, task in zip(axes[0], spec.tasks, strict=True):
        for name, shade in zip(names, shades, strict=True):
            chosen = [row for row in rows if row["label"] == name and row["task"] == task]
            steps = sorted({row["env_steps"] for row in chosen})
            returns = [[r["return"] for r in chosen if r["env_steps"] == step] for step in steps]
            mean = np.array([np.mean(values) for values in returns])
            deviation = np.array([np.std(values) for values in returns])
            baseline = name == BASELINE and len(names) > 1
            text = re.sub(r"^omega=", "ω = ", name)
            style = {"color": "black", "linestyle": "--"} if baseline else {"color": shade}
            axis.plot(steps, mean, label=text, marker="o", markersize=3, **style)
            axis.fill_between(
                steps, mean - deviation, mean + deviation, color=style["color"], alpha=0.15, lw=0
            )
        axis.set_title(called[task])
        axis.set_xlabel("environment steps")
        axis.set_ylabel("return of an evaluation episode")
        axis.grid(alpha=0.3)
        if len(names) > 1:
            axis.legend(frameon=False)
    paths = [stem.with_suffix(suffix) for suffix in (".png", ".svg")]
    for file in paths:
        figure.savefig(file, dpi=150)
    pyplot.close(figure)
    return paths
