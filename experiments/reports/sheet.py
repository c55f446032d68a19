"""Tables of the thesis as they are shown, ours beside the published numbers, whatever they are
shown on.

A number is that of the seeds that are done; an entry without any is shown as such, with the count
of its evaluations. Agents that failed are named.
"""

from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from experiments.reports import comparison, statistics
from experiments.reports.classification import Classification, Share, read_classification
from experiments.reports.comparison import Entry
from experiments.reports.outcomes import Outcome, read_outcomes
from experiments.reports.statistics import Estimate
from experiments.reports.verdicts import LEAST_SEEDS, Verdict
from experiments.thesis import grid, published
from experiments.thesis.graph import changed_settings
from experiments.thesis.grid import Cell, LatentTable, ReturnsTable, Table


@dataclass(frozen=True)
class Box:
    """One place of a table.

    Attributes:
      ours: our value, or how far it has come.
      published: the thesis's value, or "-" where it has none.
      complete: whether our value is one.
      verdict: on the transfer.
      seeds: how many our value is of; None of shares.
      begun: whether anything of it was evaluated.
      baseline: whether it is of agents from scratch.
    """

    ours: str
    published: str
    complete: bool
    verdict: Verdict | None = None
    seeds: int | None = None
    begun: bool = True
    baseline: bool = False

    def __str__(self) -> str:
        return f"{self.ours} | {self.published}"


@dataclass(frozen=True)
class Sheet:
    """A table as it is shown, whatever it is shown on.

    Attributes:
      title: such as "Table 1: HalfCheetah, overall return".
      caption: what its values are.
      header: names of the columns, the first of which names the rows.
      rows: the name of each row and its boxes, None where the thesis has no entry.
      statistics: header and rows of the table of statistics; no rows for latent task
        classification.
      notes: what to bear in mind.
      records: the same as plain values, one mapping for each entry.
    """

    title: str
    caption: str
    header: tuple[str, ...]
    rows: tuple[tuple[str, tuple[Box | None, ...]], ...]
    statistics: tuple[tuple[str, ...], ...]
    notes: tuple[str, ...]
    records: tuple[Mapping[str, object], ...]


def read_sheet(table: Table, root: Path, seeds: tuple[int, ...]) -> Sheet:
    """A table from the results folders under a root."""
    if isinstance(table, LatentTable):
        found = read_classification(root, table, seeds)
        return classification_sheet(table, found, size_note(root))
    outcomes = read_outcomes(root, grid.shown(table, seeds))
    return returns_sheet(table, outcomes, seeds, size_note(root))


MOST_NAMED = 3
"""Settings that are named where there is little room; of more their number is told."""


def size_note(root: Path) -> str | None:
    """A plain word on results that are not of the thesis's sizes, and on settings overridden."""
    changed = settings_changed(root)
    if root.name == "thesis" and not changed:
        return None
    if len(changed) > MOST_NAMED:
        changed = [f"{len(changed)} settings changed"]
    return f"preset {', '.join([root.name, *changed])}: not comparable in size"


def settings_changed(root: Path) -> list[str]:
    """Settings that are not those of the preset, such as "environment_steps 30000"."""
    return [f"{one.path.rpartition('.')[2]} {one.one}" for one in changed_settings(root)]


def _title(table: Table) -> str:
    return table.name.replace("-", " ").capitalize()


def _common_notes(table: Table, size: str | None) -> list[str]:
    notes = [] if size is None else [f"Ours are of {size} with the published numbers."]
    if table.backend != "bullet":
        notes.append("Ours are on Brax, the published ones on PyBullet: other tasks.")
    return notes


# --- returns --------------------------------------------------------------------------------------


def returns_sheet(
    table: ReturnsTable, outcomes: Mapping[Cell, Outcome], seeds: Sequence[int], size: str | None
) -> Sheet:
    """Tables 1 to 12, 16 and 17, and the demo's."""
    entries = comparison.compare(table, outcomes, seeds)
    columns = tuple(f"{count} Tasks" for count in table.counts)
    if table.kind == "ftl":
        (target,) = table.targets
        title = f"{_title(table)}: {target}, {table.metric} return"
        header = ("ω", *columns)
        rows: list[tuple[str, tuple[Box | None, ...]]] = [
            (f"{omega:.1f}", tuple(_box(entries[target, n, omega]) for n in table.counts))
            for omega in table.omegas
        ]
        rows += [
            (
                method.capitalize(),
                tuple(_box(entries[target, n, method]) for n in table.counts),
            )
            for method in table.compared
        ]
        empty = [None] * (len(table.counts) - 1)
        rows.append(("Baseline", (_box(entries[target, None, None]), *empty)))
    else:
        title = f"{_title(table)}: reward meta-models, {table.metric} return"
        header = ("", *columns, "Baseline")
        rows = [
            (target, tuple(_box(entries[target, n, None]) for n in (*table.counts, None)))
            for target in table.targets
        ]
    over = {"overall": "all evaluations", "final": "the evaluations in the last tenth of a run"}
    caption = f"Mean ± deviation of the returns of {over[table.metric]}."
    notes = _common_notes(table, size) + _seed_notes(entries.values())
    if any(e.published is not None and e.published.copied for e in entries.values()):
        notes.append("* A deviation that the thesis copied from the table before this one.")
    if table.kind == "meta":
        notes.append(
            "Dynamics are drawn anew for each agent, as in the author's runs: only the encoder is "
            "universal, and stored reward models read features of another dynamics model than "
            "their own."
        )
    return Sheet(
        title,
        caption,
        header,
        tuple(rows),
        _statistics(entries.values()),
        tuple(notes),
        tuple(_record(table, entry) for entry in entries.values()),
    )


def _seed_notes(entries: Collection[Entry]) -> list[str]:
    """How many seeds there are, and which of them give no number, and why."""
    notes = []
    counts = sorted({len(entry.scores) for entry in entries if entry.scores})
    if counts and counts != [len(grid.SEEDS)]:
        told = " to ".join(map(str, dict.fromkeys((counts[0], counts[-1]))))
        plural = "s" if counts != [1] else ""
        notes.append(f"Ours are of {told} seed{plural}, the published ones of {len(grid.SEEDS)}.")
    for state, told in (
        ("failed", "Failed (losses that are not finite) and left out"),
        ("cut", "Not done yet and left out"),
    ):
        chosen = [(entry.full_name, getattr(entry, state)) for entry in entries]
        words = [
            f"{name}: seed{'s' if len(seeds) > 1 else ''} {', '.join(map(str, seeds))}"
            for name, seeds in chosen
            if seeds
        ]
        if words:
            notes.append(f"{told}: {'; '.join(words)}.")
    return notes


def _box(entry: Entry) -> Box:
    told = "-"
    if (known := entry.published) is not None:
        told = f"{known.mean:.0f} ± {known.std:.0f}{'*' if known.copied else ''}"
    if entry.ours is None:
        return Box(progress(entry), told, False, begun=entry.begun, baseline=entry.sources is None)
    verdict = None if entry.transfer is None else entry.transfer.verdict
    ours = f"{entry.ours[0]:z.0f} ± {entry.ours[1]:.0f}"
    return Box(ours, told, True, verdict, seeds=len(entry.scores), baseline=entry.sources is None)


def progress(entry: Entry) -> str:
    """How far an entry without a seed that is done has come."""
    if entry.done:
        return f"{entry.done} of {entry.planned} evaluations"
    return "failed" if entry.failed else "not run"


def interval(estimate: Estimate | None, digits: int = 0, sign: str = "") -> str:
    """A value with its interval, "-" if there is none; `sign` "+" gives all numbers theirs."""
    if estimate is None:
        return "-"
    form = f"{sign}z.{digits}f"
    if estimate.low is None:
        return f"{estimate.value:{form}}"
    return f"{estimate.value:{form}} [{estimate.low:{form}}, {estimate.high:{form}}]"


def verdict_word(entry: Entry) -> str:
    """What is said of an entry's transfer, or why nothing is."""
    if entry.sources is None:
        return "-"
    if entry.transfer is None:
        return "no baseline yet"
    return entry.transfer.verdict or "too few seeds"


def chance(value: float | None) -> str:
    """A probability in words of at most five characters."""
    return "-" if value is None else "<.001" if value < 0.001 else f"{value:.3f}"


def _statistics(entries: Iterable[Entry]) -> tuple[tuple[str, ...], ...]:
    """Header and rows of those entries that have begun; none if no entry has."""
    header = (
        "",
        "n",
        "less baseline",
        "p",
        "transfer",
        "IQM",
        "P(improvement)",
        "jumpstart",
        "steps to reach",
    )
    rows = []
    for entry in entries:
        if not entry.begun:
            continue
        if not entry.scores:
            rows.append((entry.full_name, "0", progress(entry), *["-"] * 6))
            continue
        words = ["-", "-", verdict_word(entry), interval(entry.average), "-", "-", "-"]
        if (transfer := entry.transfer) is not None:
            words[0] = interval(transfer.difference, sign="+")
            words[1] = chance(transfer.chance)
            words[4] = interval(transfer.improvement, 2)
            words[5] = f"{transfer.jumpstart:+z.0f}"
        if entry.threshold is not None:
            steps = entry.threshold.env_steps
            reached = "never" if steps is None else f"{steps:,}"
            words[6] = f"{reached} ({entry.threshold.value:z.0f})"
        rows.append((entry.full_name, str(len(entry.scores)), *words))
    return (header, *rows) if rows else ()


def _record(table: ReturnsTable, entry: Entry) -> dict[str, object]:
    record: dict[str, object] = {
        "table": table.name,
        "target": entry.target,
        "sources": entry.sources,
        "omega": entry.omega,
        "method": entry.method,
        "metric": table.metric,
        "seeds": len(entry.scores),
        "failed": len(entry.failed),
        "evaluations": entry.done,
        "planned": entry.planned,
        "ours_mean": entry.ours and entry.ours[0],
        "ours_std": entry.ours and entry.ours[1],
        "published_mean": entry.published and entry.published.mean,
        "published_std": entry.published and entry.published.std,
    }
    transfer, threshold = entry.transfer, entry.threshold
    estimates = {
        "iqm": entry.average,
        "difference": transfer and transfer.difference,
        "improvement": transfer and transfer.improvement,
    }
    for name, estimate in estimates.items():
        record |= {
            name: estimate and estimate.value,
            f"{name}_low": estimate and estimate.low,
            f"{name}_high": estimate and estimate.high,
        }
    return record | {
        "chance": transfer and transfer.chance,
        "verdict": transfer and transfer.verdict,
        "jumpstart": transfer and transfer.jumpstart,
        "threshold": threshold and threshold.value,
        "steps_to_threshold": threshold and threshold.env_steps,
    }


# --- latent task classification -------------------------------------------------------------------


def classification_sheet(
    table: LatentTable, found: Classification | None, size: str | None
) -> Sheet:
    """Tables 13 to 15.

    Args:
      table: which one.
      found: the `outcomes.Classification`; None if it has not been made.
      size: from `size_note`.
    """
    number = published.number(table)
    shares = {} if found is None else {(s.threshold, s.task): s for s in found.shares}
    suggested = [share for share in shares.values() if share.threshold is None]
    rows, records = [], []
    for threshold in (*grid.THRESHOLDS, *([None] if suggested else [])):
        boxes = []
        for task in table.tasks:
            known, share = task in table.known, shares.get((threshold, task))
            told = None if threshold is None else published.classification(number, task, threshold)
            boxes.append(
                Box(
                    "not run" if share is None else _shares(known, *_left_and_right(share)),
                    "-" if told is None else _shares(known, told.mean, told.correct),
                    share is not None,
                    begun=share is not None,
                )
            )
            ours = (None, None) if share is None else _left_and_right(share)
            records.append(
                {
                    "table": table.name,
                    "threshold": "suggested" if threshold is None else threshold,
                    "applied": share and share.scaled,
                    "task": task,
                    "kind": "known" if known else "novel",
                    "ours": ours[0],
                    "ours_correct": ours[1],
                    "published": told and told.mean,
                    "published_correct": told and told.correct,
                }
            )
        name = f"suggested: {suggested[0].scaled:.4g}" if threshold is None else f"{threshold:.0f}"
        rows.append((name, tuple(boxes)))
    notes = _common_notes(table, size)
    if found is not None:
        notes.append(
            f"Ours are of {found.samples} samples of each task and {found.feature_size} features; "
            f"thresholds were scaled by {found.feature_size} / 230."
        )
    return Sheet(
        f"{_title(table)}: latent task classification, novel tasks {' and '.join(table.novel)}",
        "Novel tasks: share of samples taken for novel. Previous tasks: share not taken for novel "
        "/ share taken for the right task.",
        ("Threshold", *(f"{task}, novel" for task in table.novel), *table.known),
        tuple(rows),
        (),
        tuple(notes),
        tuple(records),
    )


def _left_and_right(share: Share) -> tuple[float, float | None]:
    """What the thesis's form shows of a share: one number of a novel task, two of a known one."""
    return (share.not_novel, share.right_task) if share.known else (share.correct, None)


def _shares(known: bool, left: float, right: float | None) -> str:
    return f"{left:.2f}/{right:.2f}" if known else f"{left:.2f}"


STATISTICS_CAPTION = (
    "Of the mean returns of n seeds, with 95% intervals in brackets: of the difference Welch's, or "
    "that of a spread pooled over the target's groups where it is wider; of P(improvement), the "
    "probability that a run beats one of the baseline, Newcombe's; of the interquartile mean (IQM) "
    "the bootstrap's, short for few seeds. p: probability of such a difference without an effect, "
    "after Holm for all comparisons of the table that have "
    f"{LEAST_SEEDS} seeds on both sides: up to 0.05 the transfer is positive or negative, beyond "
    "undecided. Jumpstart: mean of the first twentieth of the evaluations, less the baseline's. "
    "Steps to reach: environment steps when the mean curve reaches the return in parentheses, "
    f"{statistics.REACHED_SHARE:.0%} of the way from the baseline's first to its final returns."
)
