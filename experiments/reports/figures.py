"""Pictures: learning curves as in Figures 12 to 39, the tasks as in 10 and 11, and tables."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import gymnasium

import envs
from experiments.reports import curves
from experiments.reports.curves import FORMATS
from experiments.reports.outcomes import Outcome
from experiments.thesis import grid
from experiments.thesis.grid import Cell, Figure
from experiments.thesis.populations import task_name

TRANSFER, BASELINE = "tab:blue", "tab:green"
"""The thesis's colours."""
VERDICTS = {"positive": "#d6efd8", "undecided": "#eeeeee", "negative": "#f9d9d6"}
"""Behind the words for a transfer."""
PICTURE_SIZE = 256


@dataclass(frozen=True)
class Line:
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
      lines: its curves.
    """

    title: str
    task: str
    lines: tuple[Line, ...]


def panels(figure: Figure, seeds: Sequence[int]) -> tuple[Panel, ...]:
    """What a figure of learning curves shows: one panel per fraction, number of sources or task."""
    agent = "multi-task agent" if figure.kind == "multitask" else "transfer"
    found = []
    for (task, value), (*first, baselines) in grid.panels(figure, seeds).items():
        lines = [Line(agent, TRANSFER, cells) for cells in first]
        lines.append(Line("baseline", BASELINE, baselines))
        title = task if value is None else _titled(figure, value)
        found.append(Panel(title, task, tuple(lines)))
    return tuple(found)


def _titled(figure: Figure, value: float) -> str:
    return f"ω = {value:.1f}" if figure.kind == "ftl" else f"{value} source tasks"


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


def begun(
    figure: Figure, outcomes: Mapping[Cell, Outcome], seeds: Sequence[int]
) -> tuple[Panel, ...]:
    """The panels of a figure that show something: not those of a baseline beside nothing."""
    return tuple(
        panel
        for panel in panels(figure, seeds)
        if any(outcomes[cell].env_steps for cell in panel.lines[0].cells)
    )


def draw_curves(
    figure: Figure,
    outcomes: Mapping[Cell, Outcome],
    seeds: Sequence[int],
    size: str | None,
    stem: Path,
    formats: Sequence[str] = FORMATS,
) -> list[Path]:
    """Draws learning curves; those of runs that were cut as far as they go, labelled with counts.

    Panels of which nothing was run are left out and named below the title.

    Args:
      figure: any but the pictures of the tasks.
      outcomes: of all cells that it shows.
      seeds: see `grid.shown`.
      size: what to say of results that are not of the thesis's sizes.
      stem: where to, without suffix.
      formats: suffixes of the files.

    Returns:
      The files written; none if nothing of the figure was run.
    """
    shown = begun(figure, outcomes, seeds)
    if not shown:
        return []
    left_out = [p.title for p in panels(figure, seeds) if p.title not in {s.title for s in shown}]
    title = caption(figure) + ("" if size is None else f"\n({size})")
    title += f"\nnot run: {', '.join(left_out)}" if left_out else ""
    drawn = [
        curves.Panel(
            panel.title,
            [task_name(figure.backend, panel.task)],
            [
                curves.Curve(
                    line.label,
                    [outcomes[cell] for cell in line.cells],
                    panel.task,
                    {"color": line.colour},
                )
                for line in panel.lines
            ],
        )
        for panel in shown
    ]
    one_task = len({panel.task for panel in shown}) == 1
    return curves.draw_panels(drawn, stem, title=title, share_returns=one_task, formats=formats)


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
    pyplot = curves.pyplot_without_display()
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
    return curves.save(picture, stem, formats)


def draw_table(
    title: str,
    header: Sequence[str],
    rows: Sequence[Sequence],
    stem: Path,
) -> list[Path]:
    """Draws a table.

    Args:
      title: above it.
      header: names of the columns.
      rows: for each the name and then, for each column, None or a text and a verdict or None,
        which is written below it.
      stem: where to, without suffix.

    Returns:
      The files written, PNG and SVG.
    """
    pyplot = curves.pyplot_without_display()
    texts, shades = [], []
    for name, *places in rows:
        places = [place or ("", None) for place in places]
        texts.append([name, *(f"{text}\n{word}" if word else text for text, word in places)])
        shades.append(["white", *(VERDICTS.get(word, "white") for _, word in places)])
    columns = list(zip(header, *texts, strict=True))
    widths = [max(len(line) for text in column for line in text.split("\n")) for column in columns]
    # Two lines of a place need more than one.
    height = 0.24 * sum(max(text.count("\n") + 2 for text in row) for row in [header, *texts])
    width = max(5.0, 0.085 * sum(widths) + 0.25 * len(widths))
    title = curves.wrapped(title, width)
    top = 0.25 * (title.count("\n") + 1) + 0.1
    picture = pyplot.figure(figsize=(width, height + top))
    axis = picture.add_axes((0.01, 0.01, 0.98, height / (height + top)))
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
    return curves.save(picture, stem)
