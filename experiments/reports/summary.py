"""Tables and pictures of results folders.

Returns are those of the evaluations (section 4.2.3): "overall" is the mean over all evaluations
of a run, "final" over those in the last tenth of its environment steps. The deviation is that of
all these returns, of all seeds together, as in the thesis (see `statistics.mean_and_deviation`).
Members that failed are named and left out.
"""

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

import envs
from dreamer_jax.population import Member
from experiments.methods import BASELINE
from experiments.reports.curves import Curve, Panel, draw_panels
from experiments.reports.outcomes import Outcome, Run
from experiments.reports.statistics import mean_and_deviation
from experiments.runs.text import aligned, titles


@dataclass(frozen=True)
class Summary:
    """The evaluations of one label and task.

    Attributes:
      label: a fraction or the baseline.
      task: the task's name.
      seeds: how many seeds there are, those that failed left out.
      done, planned: evaluations made and planned, summed over these seeds.
      overall, final: mean and standard deviation of the returns; None if there are none.
      failed: the seeds that failed.
    """

    label: str
    task: str
    seeds: int
    done: int
    planned: int
    overall: tuple[float, float] | None
    final: tuple[float, float] | None
    failed: tuple[int, ...] = ()


def by_label(run: Run) -> dict[str, list[tuple[Member, Outcome]]]:
    """A run's members and what came of them by their labels, the baseline last."""
    found: dict[str, list[tuple[Member, Outcome]]] = {}
    for member, outcome in zip(run.spec.members, run.outcomes, strict=True):
        found.setdefault(member.label, []).append((member, outcome))
    return found


def summarise(run: Run) -> list[Summary]:
    """One summary per label and task of a results folder."""
    summaries = []
    for label, members in by_label(run).items():
        sound = [outcome for _, outcome in members if outcome.state != "failed"]
        failed = tuple(member.seed for member, outcome in members if outcome.state == "failed")
        for task in run.spec.tasks:
            overall, final = (
                np.concatenate([[], *(outcome.chosen(task, metric) for outcome in sound)])
                for metric in ("overall", "final")
            )
            summaries.append(
                Summary(
                    label=label,
                    task=task,
                    seeds=len(sound),
                    done=len(overall),
                    planned=sum(outcome.planned for outcome in sound),
                    overall=mean_and_deviation(overall) if len(overall) else None,
                    final=mean_and_deviation(final) if len(final) else None,
                    failed=failed,
                )
            )
    return summaries


def table(summaries: Sequence[Summary]) -> str:
    """Overall and final return per label and task; incomplete runs are shown as such."""

    def cell(statistics):
        return "-" if statistics is None else f"{statistics[0]:.0f} ± {statistics[1]:.0f}"

    called = titles(summary.task for summary in summaries)
    rows: list[list[str]] = []
    notes: dict[str, None] = {}
    for summary in summaries:
        name = summary.label + (f"  {called[summary.task]}" if len(called) > 1 else "")
        count = f"{summary.done}"
        if summary.done < summary.planned:
            count += f" of {summary.planned}, incomplete"
        rows.append([name, cell(summary.overall), cell(summary.final), str(summary.seeds), count])
        if summary.failed:
            seeds = ", ".join(map(str, summary.failed))
            notes[f"Failed and left out: {summary.label}, seed {seeds}."] = None
    text = aligned(["", "overall", "final", "seeds", "evaluations"], rows)
    return "\n\n".join([text, *(["\n".join(notes)] if notes else [])])


def _of_folder(name: str, label: str, several: bool) -> str:
    """What a label of a folder is called beside other folders': by the folder's name alone, unless
    it has several labels."""
    return f"{name}, {label}" if several else name


def _called(member: Member) -> str:
    """What a member's curve is called."""
    if "omega" not in member.tags:
        return member.label
    source = f" from {member.tags['source']}" if "source" in member.tags else ""
    return f"ω = {member.tags['omega']:g}{source}"


def _curves(run: Run, name: str | None = None) -> dict[str, list[Curve]]:
    """The curves of a results folder by task, without colours.

    Args:
      run: the folder.
      name: what the folder is called, where others are drawn with it.

    Raises:
      ValueError: nothing has been evaluated yet.
    """
    if not run.evaluations:
        raise ValueError(f"{run.folder} has no evaluations to draw yet")
    groups = by_label(run)
    several = len(groups) > 1
    found: dict[str, list[Curve]] = {task: [] for task in run.spec.tasks}
    for task in run.spec.tasks:
        for label, members in groups.items():
            text = _called(members[0][0])
            text = text if name is None else _of_folder(name, text, several)
            style = {"linestyle": "--"} if label == BASELINE and several else {}
            found[task].append(Curve(text, [outcome for _, outcome in members], task, style))
    return found


def _coloured(curves: Sequence[Curve], baseline: str | None = None) -> list[Curve]:
    """The curves in the colours of a scale, dashed ones in `baseline` if it is given."""
    from matplotlib import colormaps

    shades = colormaps["viridis"](np.linspace(0.0, 0.85, max(1, len(curves))))
    return [
        replace(
            curve, style={"color": baseline if curve.style and baseline else shade, **curve.style}
        )
        for curve, shade in zip(curves, shades, strict=True)
    ]


def panels(run: Run) -> list[Panel]:
    """The learning curves of a results folder: a panel per task, a line per label.

    Raises:
      ValueError: nothing has been evaluated yet.
    """
    found = _curves(run)
    called = titles(found)
    return [
        Panel(called[task], [task], _coloured(curves, "black")) for task, curves in found.items()
    ]


def plot_curves(run: Run, path: str | Path | None = None) -> list[Path]:
    """Draws the learning curves: mean and standard deviation over seeds, one line per label.

    Args:
      run: a results folder.
      path: where to, without suffix; by default "curves" in the folder.

    Returns:
      The files written, PNG and SVG.

    Raises:
      ValueError: nothing has been evaluated yet.
    """
    return draw_panels(panels(run), run.folder / "curves" if path is None else Path(path))


def folder_names(directories: Sequence[Path]) -> list[str]:
    """What each of some folders is called: its name, or its path where others have the same."""
    names = [directory.resolve().name for directory in directories]
    count = Counter(names)
    return [
        name if count[name] == 1 else str(directory)
        for name, directory in zip(names, directories, strict=True)
    ]


def compare(runs: Sequence[Run]) -> list[Summary]:
    """One summary per folder, label and task; labels begin with the folder's name."""
    summaries = []
    for name, run in zip(folder_names([run.folder for run in runs]), runs, strict=True):
        found = summarise(run)
        several = len({summary.label for summary in found}) > 1
        summaries += [
            replace(summary, label=_of_folder(name, summary.label, several)) for summary in found
        ]
    return summaries


def compared_panels(runs: Sequence[Run]) -> list[Panel]:
    """The learning curves of several folders at equal environment steps: a panel for each of the
    tasks' titles, whichever the simulator, and a line per folder and label.

    Raises:
      ValueError: nothing has been evaluated in a folder yet.
    """
    by_title: dict[str, list[Curve]] = {}
    tasks: dict[str, dict[str, None]] = {}
    for name, run in zip(folder_names([run.folder for run in runs]), runs, strict=True):
        found = _curves(run, name)
        called = titles(found)
        for task, curves in found.items():
            title = envs.described(task).title
            if called[task] != title:
                curves = [replace(curve, text=f"{curve.text}, {task}") for curve in curves]
            by_title.setdefault(title, []).extend(curves)
            tasks.setdefault(title, {})[task] = None
    return [
        Panel(title, list(tasks[title]), _coloured(curves)) for title, curves in by_title.items()
    ]


def plot_comparison(runs: Sequence[Run], path: str | Path) -> list[Path]:
    """Draws what `compared_panels` gives.

    Args:
      runs: results folders.
      path: where to; a suffix of a picture is left out.

    Returns:
      The files written, PNG and SVG.

    Raises:
      ValueError: nothing has been evaluated in a folder yet.
    """
    path = Path(path)
    stem = path.with_suffix("") if path.suffix in (".png", ".svg") else path
    return draw_panels(compared_panels(runs), stem)
