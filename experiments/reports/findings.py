"""What the comparisons with agents from scratch say: a sentence for each method, and their forest
plot."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from experiments.reports import comparison, curves, verdicts
from experiments.reports.comparison import Entry, Transfer
from experiments.reports.outcomes import Outcome
from experiments.reports.sheet import interval, verdict_word
from experiments.thesis.grid import Cell, Metric, ReturnsTable

METHODS = {"ftl": "Fractional transfer", "meta": "Reward meta-models"}
"""What the own methods of tables are called, by their kinds."""
COLOURS = {"positive": "#1a7f37", "negative": "#c62828"}
"""Of differences that are decided; others are grey."""
UNDECIDED = "#6b7280"


@dataclass(frozen=True)
class Comparison:
    """One comparison of a method with agents from scratch.

    Attributes:
      metric: of the returns.
      entry: the agents that transferred.
      baseline: the agents from scratch on the same task.
      transfer: what came of comparing both.
    """

    metric: Metric
    entry: Entry
    baseline: Entry
    transfer: Transfer

    @property
    def seeds(self) -> str:
        """How many seeds stand against how many."""
        ours, base = len(self.entry.scores), len(self.baseline.scores)
        return str(ours) if ours == base else f"{ours} / {base}"

    @property
    def word(self) -> str:
        """What is said of it."""
        return verdict_word(self.entry)


@dataclass(frozen=True)
class Finding:
    """What there is on one method.

    Attributes:
      kind: of its tables, or the name of a method that is compared with theirs.
      method: what it is called.
      sentence: what its comparisons say.
      comparisons: all of them, by metric and then by target, as the tables have them.
    """

    kind: str
    method: str
    sentence: str
    comparisons: Mapping[Metric, Mapping[str, Sequence[Comparison]]]


def findings(
    tables: Iterable[ReturnsTable], outcomes: Mapping[Cell, Outcome], seeds: Sequence[int]
) -> list[Finding]:
    """What there is on each method of which anything was run.

    Args:
      tables: of which comparisons are taken.
      outcomes: of all cells that they show.
      seeds: of targets and baselines; the first one is the sources'.
    """
    begun: set[tuple[str, str]] = set()
    found: dict[tuple[str, str], dict[Metric, dict[str, list[Comparison]]]] = {}
    for table in tables:
        entries = comparison.compare(table, outcomes, seeds)
        for entry in entries.values():
            if entry.sources is None:
                continue
            # Methods that are compared with a table's own have sentences of their own.
            own = (table.kind, METHODS[table.kind])
            key = own if entry.method is None else (entry.method, entry.method.capitalize())
            by_metric = found.setdefault(key, {})
            if entry.begun:
                begun.add(key)
            if entry.transfer is not None:
                group = by_metric.setdefault(table.metric, {}).setdefault(entry.target, [])
                base = entries[entry.target, None, None]
                group.append(Comparison(table.metric, entry, base, entry.transfer))
    told = []
    for (kind, method), by_metric in found.items():
        if (kind, method) not in begun:
            continue
        groups = [group for targets in by_metric.values() for group in targets.values()]
        for group in groups:
            group.sort(key=lambda one: (one.entry.sources or 0, one.entry.omega or 0.0))
        words = sentence(method, [one for group in groups for one in group])
        told.append(Finding(kind, method, words, by_metric))
    return told


def sentence(method: str, comparisons: Sequence[Comparison]) -> str:
    """What the comparisons of one method say, in one sentence."""
    if not comparisons:
        return f"{method}: no comparison with agents from scratch can be made yet."
    targets = ", ".join(dict.fromkeys(c.entry.target for c in comparisons))
    metrics = " and ".join(dict.fromkeys(c.metric for c in comparisons))
    count = len(comparisons)
    there = (
        f"{count} comparison{'s' if count > 1 else ''} with agents from scratch ({targets}; "
        f"{metrics} return)"
    )
    judged = [(c.transfer.chance, c) for c in comparisons if c.transfer.chance is not None]
    least = verdicts.LEAST_SEEDS
    if not judged:
        return (
            f"{method}: nothing can be said yet, for a verdict takes {least} seeds on both sides, "
            f"and none of {there} has them."
        )
    positive, negative = (
        sum(c.transfer.verdict == verdict for _, c in judged)
        for verdict in ("positive", "negative")
    )
    undecided, few = len(judged) - positive - negative, count - len(judged)
    _, best = min(judged, key=lambda pair: pair[0])
    told = (
        f"{best.entry.full_name}, {best.metric} return: "
        f"{interval(best.transfer.difference, sign='+')}, better in "
        f"{best.transfer.improvement.value:.0%} of pairs of runs, {best.seeds} seeds"
    )
    rest = f" ({few} more have too few seeds)" if few else ""
    if positive + negative == 0:
        return (
            f"{method}: no difference is seen, none of {there} is decided{rest}; the nearest to it "
            f"is {told}."
        )
    return (
        f"{method}: of {there}, {positive or 'none'} {'is' if positive <= 1 else 'are'} positive, "
        f"{negative or 'none'} {'is' if negative <= 1 else 'are'} negative and "
        f"{undecided or 'none'} {'is' if undecided <= 1 else 'are'} undecided{rest}; the best "
        f"supported is {told}."
    )


@dataclass(frozen=True)
class Scale:
    """The axis of differences that the comparisons of one target share.

    Attributes:
      low, high: its ends; 0 lies between them.
    """

    low: float
    high: float

    def place(self, value: float) -> float:
        """Where a difference lies, from 0 at the low end to 1 at the high one, no further."""
        return min(1.0, max(0.0, (value - self.low) / (self.high - self.low)))


def scale(comparisons: Iterable[Comparison]) -> Scale:
    """An axis that holds all differences and the intervals of those that have enough seeds.

    Intervals of two or three seeds are so wide that they would press the others together: the axis
    reaches at most twice as far as the other ends.
    """
    ends, wide = [0.0], list[float]()
    for one in comparisons:
        value, low, high = one.transfer.difference
        enough = one.transfer.chance is not None
        ends.append(value)
        (ends if enough else wide).extend(end for end in (low, high) if end is not None)
    reach = 2 * max(map(abs, ends)) or 1.0
    ends += [max(-reach, min(reach, end)) for end in wide]
    low, high = min(ends), max(ends)
    margin = 0.05 * (high - low) or 1.0
    return Scale(low - margin, high + margin)


def draw_forest(finding: Finding, stem: Path, size: str | None = None) -> list[Path]:
    """Draws the forest plot of one method: a column for each metric, axes for each target.

    Args:
      finding: with at least one comparison.
      stem: where to, without suffix.
      size: what to say of results that are not of the thesis's sizes.

    Returns:
      The files written, PNG and SVG.
    """
    pyplot = curves.pyplot_without_display()
    metrics = list(finding.comparisons)
    targets = list(
        dict.fromkeys(t for by_target in finding.comparisons.values() for t in by_target)
    )
    heights = [
        1.2 + max(len(finding.comparisons[m].get(target, ())) for m in metrics)
        for target in targets
    ]
    width = 6.2 * len(metrics)
    picture, axes = pyplot.subplots(
        len(targets),
        len(metrics),
        figsize=(width, 0.3 * sum(heights) + 0.45 * len(targets) + 0.8),
        height_ratios=heights,
        squeeze=False,
        layout="constrained",
    )
    for row, target in zip(axes, targets, strict=True):
        for axis, metric in zip(row, metrics, strict=True):
            comparisons = finding.comparisons[metric].get(target, ())
            _draw_target(axis, f"{target}, {metric} return", comparisons)
    title = f"{finding.method}: difference to agents from scratch, 95 % intervals"
    title += "" if size is None else f"\n({size})"
    picture.suptitle(curves.wrapped(title, width))
    return curves.save(picture, stem)


def _draw_target(axis, title: str, comparisons: Sequence[Comparison]) -> None:
    if not comparisons:
        axis.set_axis_off()
        return
    extent = scale(comparisons)
    axis.axvline(0, color="black", linewidth=0.8)
    for number, one in enumerate(comparisons):
        value, low, high = one.transfer.difference
        colour = COLOURS.get(one.word, UNDECIDED)
        decided = one.word in COLOURS
        if low is not None:
            axis.plot([low, high], [number, number], color=colour, linewidth=1.6)
        axis.plot(
            value, number, "o", color=colour, markerfacecolor=colour if decided else "white", ms=6
        )
        better = interval(one.transfer.improvement, 2)
        axis.annotate(
            f"{one.seeds:>7}   {better}",
            (1.02, number),
            xycoords=("axes fraction", "data"),
            va="center",
            fontsize="small",
            family="monospace",
        )
    axis.annotate(
        "      n   P(improvement)",
        (1.02, 1.0),
        xycoords="axes fraction",
        va="bottom",
        fontsize="small",
        family="monospace",
    )
    axis.set_xlim(extent.low, extent.high)
    axis.set_ylim(len(comparisons) - 0.5, -0.7)
    axis.set_yticks(range(len(comparisons)), [one.entry.name for one in comparisons])
    axis.set_title(title, fontsize="medium", loc="left")
    axis.tick_params(left=False)
    for side in ("top", "right", "left"):
        axis.spines[side].set_visible(False)
