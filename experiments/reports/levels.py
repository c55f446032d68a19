"""Known levels of return in a picture: what doing nothing, acting at random or solving is worth."""

from collections.abc import Iterable

import envs


def draw_levels(axis, tasks: Iterable[str]) -> None:
    """Draws the known levels of tasks as dotted lines with their names, behind the curves.

    Those further from all curves than these spread are left out: they are of episodes of another
    length, or would press the curves into a line.

    Args:
      axis: of matplotlib, with the curves on it; its vertical range grows as is needed.
      tasks: names; levels of several that share a name and a value are drawn once.
    """
    low, high = axis.dataLim.intervaly
    spread = high - low
    found = {level for task in tasks for level in envs.described(task).levels}
    levels = sorted(
        (value, name) for name, value in found if low - spread <= value <= high + spread
    )
    for place, (value, name) in enumerate(levels):
        # Under its line where the next one is too near for the text to stand above it.
        crowded = place + 1 < len(levels) and levels[place + 1][0] - value < 0.06 * spread
        axis.axhline(value, color="grey", linestyle=":", linewidth=0.8, zorder=0)
        axis.annotate(
            f"{name} ({value:g})",
            (1.0, value),
            xycoords=("axes fraction", "data"),
            xytext=(-2, -1 if crowded else 1),
            textcoords="offset points",
            ha="right",
            va="top" if crowded else "bottom",
            fontsize="xx-small",
            color="grey",
        )
