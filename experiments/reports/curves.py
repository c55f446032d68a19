"""The one drawer of learning curves: the mean over seeds of an evaluation's return, its deviation.

Agents that failed are left out of a curve and counted in its name; those that were cut are drawn as
far as the slowest has come.
"""

import math
import textwrap
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from experiments.reports.levels import draw_levels
from experiments.reports.outcomes import Outcome, curves, states

FORMATS = (".png", ".svg")
DOTS_PER_INCH = 110
LINES_INSIDE = 4
"""Legends of more lines stand beside their panel."""
_PANEL = (4.4, 3.3)
_LEGEND = 2.2
_LETTERS_PER_INCH = 12


@dataclass(frozen=True)
class Curve:
    """One line of a panel.

    Attributes:
      text: what the legend calls it.
      outcomes: of its seeds.
      task: under which its returns are in these.
      style: keywords of matplotlib's `plot`; a colour at least.
    """

    text: str
    outcomes: Sequence[Outcome]
    task: str
    style: Mapping[str, Any] = field(default_factory=dict)


@dataclass(frozen=True)
class Panel:
    """One set of axes.

    Attributes:
      title: what sets it apart from the others.
      tasks: names of the tasks whose known levels are drawn.
      curves: its lines.
    """

    title: str
    tasks: Sequence[str]
    curves: Sequence[Curve]


def draw_panels(
    panels: Sequence[Panel],
    stem: Path,
    *,
    title: str | None = None,
    share_returns: bool = False,
    formats: Sequence[str] = FORMATS,
) -> list[Path]:
    """Draws learning curves.

    Args:
      panels: one or more.
      stem: where to, without suffix; its folder is made if absent.
      title: above all of them; wrapped to the width of the picture.
      share_returns: whether all panels have one scale of returns.
      formats: suffixes of the files.

    Returns:
      The files written.
    """
    pyplot = pyplot_without_display()
    count = len(panels)
    columns = 2 if count == 4 else min(3, count)
    rows = math.ceil(count / columns)
    beside = any(len(panel.curves) > LINES_INSIDE for panel in panels)
    # A panel alone is drawn larger, the width of a page's text.
    width, height = (6.4, 4.2) if count == 1 else _PANEL
    width += _LEGEND * beside
    picture, axes = pyplot.subplots(
        rows,
        columns,
        figsize=(width * columns, height * rows + 0.4),
        squeeze=False,
        sharey=share_returns,
        layout="constrained",
    )
    for axis, panel in zip(axes.flat, panels, strict=False):
        for curve in panel.curves:
            draw_curve(axis, curve)
        draw_levels(axis, panel.tasks)
        axis.set_title(panel.title, fontsize="medium")
        axis.grid(alpha=0.3)
        axis.xaxis.set_major_formatter("{x:,.0f}")
        axis.xaxis.set_major_locator(pyplot.MaxNLocator(4))
        place = {"loc": "center left", "bbox_to_anchor": (1.02, 0.5)} if beside else {}
        axis.legend(frameon=False, fontsize="small", **place)
    for axis in axes.flat[count:]:
        axis.set_visible(False)
    if title is not None:
        picture.suptitle(wrapped(title, width * columns))
    picture.supxlabel("environment steps", fontsize="medium")
    picture.supylabel("return of an evaluation episode", fontsize="medium")
    return save(picture, stem, formats)


def wrapped(text: str, inches: float) -> str:
    """A title in lines that a picture of so many inches holds."""
    width = max(20, int(_LETTERS_PER_INCH * inches * 0.9))
    return "\n".join(textwrap.fill(line, width) for line in text.splitlines())


def draw_curve(axis, curve: Curve) -> None:
    """Draws one curve on matplotlib's axes: mean over seeds, and their deviation shaded."""
    text = curve.text + standing(curve.outcomes)
    steps, returns = curves(curve.outcomes, curve.task)
    if not len(steps):
        axis.plot([], [], label=text, **{**curve.style, "linestyle": ":"})
        return
    mean, deviation = returns.mean(0), returns.std(0)
    dots = {"marker": "o", "markersize": 3} if len(steps) <= 40 else {}
    (line,) = axis.plot(steps, mean, label=text, **dots, **curve.style)
    axis.fill_between(
        steps, mean - deviation, mean + deviation, color=line.get_color(), alpha=0.15, linewidth=0
    )


def standing(outcomes: Sequence[Outcome]) -> str:
    """What a name adds: the number of seeds, and what is not done of them."""
    count = states(outcomes)
    drawn = [outcome for outcome in outcomes if outcome.state in ("cut", "done")]
    words = [f"{len(drawn)} seed" + "s" * (len(drawn) > 1)] if drawn else []
    if count["cut"]:
        done = sum(len(outcome.env_steps) for outcome in drawn)
        words.append(f"cut: {done} of {sum(o.planned for o in drawn)} evaluations")
    if count["failed"]:
        words.append(f"{count['failed']} failed")
    return ", " + ", ".join(words or ["not run"])


def save(picture, stem: Path, formats: Sequence[str] = FORMATS) -> list[Path]:
    """Writes a matplotlib picture in several formats and closes it."""
    # Not with_suffix, which would take what follows a point in the name for one.
    paths = [stem.with_name(stem.name + suffix) for suffix in formats]
    stem.parent.mkdir(parents=True, exist_ok=True)
    for path in paths:
        # Without its date an .svg is the same whenever it is written.
        metadata = {"Date": None} if path.suffix == ".svg" else None
        picture.savefig(path, dpi=DOTS_PER_INCH, metadata=metadata)
    pyplot_without_display().close(picture)
    return paths


def pyplot_without_display():
    """Matplotlib's pyplot, drawing to files alone, with the same names in every .svg."""
    import matplotlib

    matplotlib.use("Agg")
    matplotlib.rcParams["svg.hashsalt"] = "dreamer-transfer"
    from matplotlib import pyplot

    return pyplot
