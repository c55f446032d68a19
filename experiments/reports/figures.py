"""Pictures: learning curves as in Figures 12 to 39, the tasks as in 10 and 11, and tables.

Curves are the mean over seeds of an evaluation's return, with their standard deviation shaded.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import gymnasium

import envs
from experiments.reports import comparison
from experiments.reports.levels import draw_levels
from experiments.reports.outcomes import Outcome
from experiments.thesis import grid
from experiments.thesis.grid import Cell, Figure
from experiments.thesis.populations import task_name

TRANSFER, BASELINE = "tab:blue", "tab:green"
"""The thesis's colours."""
FORMATS = (".png", ".svg")
PICTURE_SIZE = 256
DOTS_PER_INCH = 110


@dataclass(frozen=True)
class Curve:
    """One line of a panel.

    Attributes:
      label: what it is.
      colour: of the line and its shade.
      cells: one per seed.
    """

    label: str
    colour: str
    cells: tuple[Cell, ...]


@dataclass(frozen=True)
class Panel:
    """One set of axes.

    Attributes:
      title: what sets it apart from the others.
      task: title of the task whose returns are drawn.
      curves: the lines.
    """

    title: str
    task: str
    curves: tuple[Curve, ...]


def panels(figure: Figure, seeds: Sequence[int]) -> tuple[Panel, ...]:
    """What a figure of learning curves shows: one panel per fraction, number of sources or task."""
    backend, source = figure.backend, seeds[0]

    def baseline(task):
        cells = tuple(grid.baseline(backend, task, seed) for seed in seeds)
        return Curve("baseline", BASELINE, cells)

    if figure.kind == "baselines":
        return tuple(Panel(task, task, (baseline(task),)) for task in figure.tasks)
    if figure.kind == "multitask":
        agent = Curve(
            "multi-task agent", TRANSFER, (grid.multitask(backend, figure.tasks, source),)
        )
        return tuple(Panel(task, task, (agent, baseline(task))) for task in figure.tasks)
    (task,) = figure.tasks
    if figure.kind == "ftl":
        (count,) = figure.counts
        transfers = {
            f"ω = {omega:.1f}": tuple(
                grid.fractional(backend, task, count, omega, seed, source) for seed in seeds
            )
            for omega in figure.omegas
        }
    else:
        transfers = {
            f"{count} source tasks": tuple(
                grid.meta(backend, task, count, seed, source) for seed in seeds
            )
            for count in figure.counts
        }
    return tuple(
        Panel(title, task, (Curve("transfer", TRANSFER, cells), baseline(task)))
        for title, cells in transfers.items()
    )


def caption(figure: Figure) -> str:
    """What a figure shows, in one sentence."""
    name = figure.name.replace("-", " ").capitalize()
    if figure.kind == "tasks":
        return f"{name}: the tasks as the agents' camera sees them"
    if figure.kind == "baselines":
        return f"{name}: agents from scratch on each task"
    if figure.kind == "multitask":
        return f"{name}: one agent on {_joined(figure.tasks)}, beside agents of one task"
    (task,) = figure.tasks
    if figure.kind == "meta":
        return f"{name}: {task} with a reward meta-model over {_joined(grid.SOURCES[task])}"
    sources = grid.SOURCES[task][: figure.counts[0]]
    return f"{name}: fractional transfer from {_joined(sources)} to {task}"


def _joined(names: Sequence[str]) -> str:
    *first, last = names
    return f"{', '.join(first)} and {last}"


def draw_curves(
    figure: Figure,
    outcomes: Mapping[Cell, Outcome],
    seeds: Sequence[int],
    size: str | None,
    stem: Path,
    formats: Sequence[str] = FORMATS,
) -> list[Path]:
    """Draws learning curves; those of incomplete runs as far as they go, labelled with counts.

    Args:
      figure: any but the pictures of the tasks.
      outcomes: of all cells that it shows.
      seeds: see `grid.shown`.
      size: what to say of results that are not of the thesis's sizes.
      stem: where to, without suffix.
      formats: suffixes of the files.

    Returns:
      The files written.
    """
    pyplot = _pyplot()
    shown = panels(figure, seeds)
    columns = 2 if len(shown) == 4 else min(3, len(shown))
    rows = -(-len(shown) // columns)
    one_task = len({panel.task for panel in shown}) == 1
    picture, axes = pyplot.subplots(
        rows,
        columns,
        figsize=(4.2 * columns, 3.2 * rows + 0.5),
        squeeze=False,
        sharey=one_task,
        layout="constrained",
    )
    for axis, panel in zip(axes.flat, shown, strict=False):
        for curve in panel.curves:
            _draw_curve(axis, curve, panel.task, [outcomes[cell] for cell in curve.cells])
        draw_levels(axis, [task_name(figure.backend, panel.task)])
        axis.set_title(panel.title)
        axis.grid(alpha=0.3)
        axis.legend(frameon=False, fontsize="small")
        axis.xaxis.set_major_formatter("{x:,.0f}")
        axis.xaxis.set_major_locator(pyplot.MaxNLocator(4))
    picture.suptitle(caption(figure) + ("" if size is None else f"\n({size})"))
    picture.supxlabel("environment steps")
    picture.supylabel("return of an evaluation episode")
    return _save(pyplot, picture, stem, formats)


def _draw_curve(axis, curve: Curve, task: str, outcomes: Sequence[Outcome]) -> None:
    label = curve.label + state(outcomes)
    steps, returns = comparison.curves(outcomes, task)
    if not len(steps):
        axis.plot([], [], color=curve.colour, linestyle=":", label=label)
        return
    complete = all(outcome.state == "complete" for outcome in outcomes)
    mean, deviation = returns.mean(0), returns.std(0)
    style = {"color": curve.colour, "linestyle": "-" if complete else "--"}
    # A single evaluation is no line yet.
    axis.plot(steps, mean, label=label, marker="o" if len(steps) == 1 else None, **style)
    axis.fill_between(
        steps, mean - deviation, mean + deviation, color=curve.colour, alpha=0.2, linewidth=0
    )


def state(outcomes: Sequence[Outcome]) -> str:
    """What a label adds for runs that are not complete."""
    if all(outcome.state == "complete" for outcome in outcomes):
        return ""
    done = sum(len(outcome.env_steps) for outcome in outcomes)
    planned = max(outcome.planned for outcome in outcomes) * len(outcomes)
    return f", incomplete: {done} of {planned} evaluations" if done else ", not run"


def draw_tasks(
    figure: Figure, stem: Path, size: int = PICTURE_SIZE, formats: Sequence[str] = FORMATS
) -> list[Path]:
    """Draws the tasks of a figure at the start of an episode, each under its title.

    Args:
      figure: of kind "tasks".
      stem: where to, without suffix.
      size: height and width of each picture; the agents' own are smaller.
      formats: suffixes of the files.

    Returns:
      The files written.

    Raises:
      ModuleNotFoundError: the simulator is not installed.
    """
    pyplot = _pyplot()
    count = len(figure.tasks)
    picture, axes = pyplot.subplots(
        1, count, figsize=(3.0 * count, 3.5), squeeze=False, layout="constrained"
    )
    for axis, title in zip(axes.flat, figure.tasks, strict=True):
        id = envs.spec(task_name(figure.backend, title)).gymnasium_id
        env = gymnasium.make(id, image_size=size)
        try:
            image, _ = env.reset(seed=0)
        finally:
            env.close()
        axis.imshow(image)
        axis.set_title(title)
        # The frame stays: the background of some is as white as the page.
        axis.set_xticks([])
        axis.set_yticks([])
    return _save(pyplot, picture, stem, formats)


def draw_table(
    title: str,
    header: Sequence[str],
    rows: Sequence[Sequence],
    colours: Mapping[str, str],
    stem: Path,
) -> list[Path]:
    """Draws a table.

    Args:
      title: above it.
      header: names of the columns.
      rows: for each the name and then, for each column, None or a text and a verdict or None.
      colours: behind places with a verdict, whose word is written too.
      stem: where to, without suffix.

    Returns:
      The files written, PNG and SVG.
    """
    pyplot = _pyplot()
    texts, shades = [], []
    for name, *places in rows:
        places = [place or ("", None) for place in places]
        texts.append([name, *(f"{text}\n{word}" if word else text for text, word in places)])
        shades.append(["white", *(colours.get(word, "white") for _, word in places)])
    columns = list(zip(header, *texts, strict=True))
    widths = [max(len(line) for text in column for line in text.split("\n")) for column in columns]
    height = 0.42 * (len(rows) + 1)
    picture = pyplot.figure(figsize=(0.085 * sum(widths) + 0.25 * len(widths), height + 0.5))
    axis = picture.add_axes((0.01, 0.01, 0.98, height / (height + 0.5)))
    axis.set_axis_off()
    drawn = axis.table(
        cellText=texts,
        cellColours=shades,
        colLabels=list(header),
        colWidths=[width / sum(widths) for width in widths],
        cellLoc="center",
        bbox=(0, 0, 1, 1),
    )
    drawn.auto_set_font_size(False)
    drawn.set_fontsize(9)
    for (row, _), place in drawn.get_celld().items():
        place.set_edgecolor("#bbbbbb")
        place.set_text_props(weight="bold" if row == 0 else "normal")
    picture.suptitle(title, fontsize=11)
    return _save(pyplot, picture, stem, FORMATS)


def _pyplot():
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    return pyplot


def _save(pyplot, picture, stem: Path, formats: Sequence[str]) -> list[Path]:
    # Not with_suffix, which would take what follows a point in the name for one.
    paths = [stem.with_name(stem.name + suffix) for suffix in formats]
    for path in paths:
        picture.savefig(path, dpi=DOTS_PER_INCH)
    pyplot.close(picture)
    return paths
