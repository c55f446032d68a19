"""Tables and figures of the thesis, ours beside the published numbers, as text and files.

A run that is not complete is shown as such, with the count of its evaluations, and never as a
number. Figures are drawn by `experiments.reports.figures`.
"""

import csv
import io
import textwrap
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from experiments.reports import comparison, figures, statistics
from experiments.reports.comparison import Entry
from experiments.reports.outcomes import Outcome, read_classification, read_outcomes
from experiments.reports.statistics import Estimate, Verdict
from experiments.runs.text import aligned
from experiments.thesis import grid, published
from experiments.thesis.graph import changed_settings
from experiments.thesis.grid import Cell, Figure, Table

COLOURS = {"positive": "#d6efd8", "neutral": "#eeeeee", "negative": "#f9d9d6"}
"""Behind the words for a transfer."""


@dataclass(frozen=True)
class Box:
    """One place of a table.

    Attributes:
      ours: our value, or how far it has come.
      published: the thesis's value, or "-" where it has none.
      complete: whether our value is one.
      verdict: on the transfer.
    """

    ours: str
    published: str
    complete: bool
    verdict: Verdict | None = None

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


def write_table(table: Table, root: str | Path, seeds: Sequence[int], folder: str | Path) -> str:
    """Writes a table as NAME.txt, .csv, .png and .svg.

    Args:
      table: which one.
      root: the folder of results folders, named after their preset.
      seeds: of targets and baselines; the first one is the sources'.
      folder: where to.

    Returns:
      The text, for a terminal.
    """
    root, folder = Path(root), Path(folder)
    seeds = tuple(seeds)
    sheet = read_sheet(table, root, seeds)
    text = as_text(sheet)
    folder.mkdir(parents=True, exist_ok=True)
    (folder / f"{table.name}.txt").write_text(text + "\n", encoding="utf-8")
    (folder / f"{table.name}.csv").write_text(as_csv(sheet), encoding="utf-8")
    rows = [
        [name, *(None if box is None else (str(box), box.verdict) for box in boxes)]
        for name, boxes in sheet.rows
    ]
    size = size_note(root)
    title = sheet.title + ("" if size is None else f" ({size})")
    figures.draw_table(title, sheet.header, rows, COLOURS, folder / table.name)
    return text


def write_figure(
    figure: Figure, root: str | Path, seeds: Sequence[int], folder: str | Path
) -> list[Path]:
    """Writes a figure as NAME.png and .svg; the arguments are those of `write_table`.

    Raises:
      ModuleNotFoundError: pictures of the tasks need a simulator that is not installed.
    """
    root, folder, seeds = Path(root), Path(folder), tuple(seeds)
    folder.mkdir(parents=True, exist_ok=True)
    if figure.kind == "tasks":
        return figures.draw_tasks(figure, folder / figure.name)
    outcomes = read_outcomes(root, grid.shown(figure, seeds))
    return figures.draw_curves(figure, outcomes, seeds, size_note(root), folder / figure.name)


def read_sheet(table: Table, root: Path, seeds: tuple[int, ...]) -> Sheet:
    """A table from the results folders under a root."""
    if table.kind == "ltc":
        found = read_classification(root, table, seeds)
        return classification_sheet(table, found, size_note(root))
    outcomes = read_outcomes(root, grid.shown(table, seeds))
    return returns_sheet(table, outcomes, seeds, size_note(root))


def size_note(root: Path) -> str | None:
    """A plain word on results that are not of the thesis's sizes, and on settings overridden."""
    changed = changed_settings(root)
    if root.name == "thesis" and not changed:
        return None
    told = [f"{one.path.rpartition('.')[2]} {one.one}" for one in changed]
    return f"preset {', '.join([root.name, *told])}: not comparable in size"


def _title(table: Table) -> str:
    return table.name.replace("-", " ").capitalize()


def _common_notes(table: Table, size: str | None) -> list[str]:
    notes = [] if size is None else [f"Ours are of {size} with the published numbers."]
    if table.backend != "bullet":
        notes.append("Ours are on Brax, the published ones on PyBullet: other tasks.")
    return notes


# --- returns --------------------------------------------------------------------------------------


def returns_sheet(
    table: Table, outcomes: Mapping[Cell, Outcome], seeds: Sequence[int], size: str | None
) -> Sheet:
    """Tables 1 to 12, 16 and 17, and the demo's."""
    entries = comparison.compare(table, outcomes, seeds)
    columns = tuple(f"{count} Tasks" for count in table.counts)
    if table.kind == "ftl":
        (target,) = table.targets
        title = f"{_title(table)}: {target}, {table.metric} return"
        header = ("ω", *columns)
        rows = [
            (f"{omega:.1f}", tuple(_box(entries[target, n, omega]) for n in table.counts))
            for omega in table.omegas
        ]
        empty = (None,) * (len(table.counts) - 1)
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
    notes = _common_notes(table, size)
    if len(seeds) != len(grid.SEEDS):
        notes.append(f"Ours are of {len(seeds)} seeds, the published ones of {len(grid.SEEDS)}.")
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
        _statistics(table, entries.values()),
        tuple(notes),
        tuple(_record(table, entry) for entry in entries.values()),
    )


def _box(entry: Entry) -> Box:
    told = "-"
    if (known := entry.published) is not None:
        told = f"{known.mean:.0f} ± {known.std:.0f}{'*' if known.copied else ''}"
    if entry.ours is None:
        return Box(progress(entry), told, complete=False)
    verdict = None if entry.transfer is None else entry.transfer.verdict
    return Box(f"{entry.ours[0]:z.0f} ± {entry.ours[1]:.0f}", told, True, verdict)


def progress(entry: Entry) -> str:
    """How far an entry that is not complete has come."""
    return f"{entry.done} of {entry.planned} evaluations" if entry.done else "not run"


def interval(estimate: Estimate | None, digits: int = 0) -> str:
    """A value with its interval, "-" if there is none."""
    if estimate is None:
        return "-"
    if estimate.low is None:
        return f"{estimate.value:z.{digits}f}"
    return f"{estimate.value:z.{digits}f} [{estimate.low:z.{digits}f}, {estimate.high:z.{digits}f}]"


def _statistics(table: Table, entries) -> tuple[tuple[str, ...], ...]:
    header = (
        "",
        "less baseline",
        "transfer",
        "IQM",
        "P(improvement)",
        "jumpstart",
        "steps to reach",
    )
    rows = [header]
    for entry in entries:
        name = entry.name if len(table.targets) == 1 else f"{entry.target}, {entry.name}"
        if not entry.complete:
            rows.append((name, progress(entry), *["-"] * 5))
            continue
        words = ["-", "-", interval(entry.average), "-", "-", "-"]
        if (transfer := entry.transfer) is not None:
            words[0] = interval(transfer.difference)
            words[1] = transfer.verdict or "no interval"
            words[3] = interval(transfer.improvement, 2)
            words[4] = f"{transfer.jumpstart:+z.0f}"
        elif entry.sources is not None:
            words[1] = "baseline incomplete"
        if entry.threshold is not None:
            steps = entry.threshold.env_steps
            reached = "never" if steps is None else f"{steps:,}"
            words[5] = f"{reached} ({entry.threshold.value:z.0f})"
        rows.append((name, *words))
    return tuple(rows)


def _record(table: Table, entry: Entry) -> dict[str, object]:
    record: dict[str, object] = {
        "table": table.name,
        "target": entry.target,
        "sources": entry.sources,
        "omega": entry.omega,
        "metric": table.metric,
        "complete": entry.complete,
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
        values = (None,) * 3 if estimate is None else estimate
        record |= dict(zip((name, f"{name}_low", f"{name}_high"), values, strict=True))
    return record | {
        "verdict": transfer and transfer.verdict,
        "jumpstart": transfer and transfer.jumpstart,
        "threshold": threshold and threshold.value,
        "steps_to_threshold": threshold and threshold.env_steps,
    }


# --- latent task classification -------------------------------------------------------------------


def classification_sheet(table: Table, found, size: str | None) -> Sheet:
    """Tables 13 to 15.

    Args:
      table: which one.
      found: the `outcomes.Classification`; None if it has not been made.
      size: from `size_note`.
    """
    tasks, number = (*table.targets, *table.known), published.number(table)
    shares = {} if found is None else {(s.threshold, s.task): s for s in found.shares}
    suggested = [share for share in shares.values() if share.threshold is None]
    rows, records = [], []
    for threshold in (*grid.THRESHOLDS, *([None] if suggested else [])):
        boxes = []
        for task in tasks:
            known, share = task in table.known, shares.get((threshold, task))
            told = None if threshold is None else published.classification(number, task, threshold)
            boxes.append(
                Box(
                    "not run" if share is None else _shares(known, *_left_and_right(share)),
                    "-" if told is None else _shares(known, told.mean, told.correct),
                    share is not None,
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
        f"{_title(table)}: latent task classification, novel tasks {' and '.join(table.targets)}",
        "Novel tasks: share of samples taken for novel. Previous tasks: share not taken for novel "
        "/ share taken for the right task.",
        ("Threshold", *(f"{task}, novel" for task in table.targets), *table.known),
        tuple(rows),
        (),
        tuple(notes),
        tuple(records),
    )


def _left_and_right(share) -> tuple[float, float | None]:
    """What the thesis's form shows of a share: one number of a novel task, two of a known one."""
    return (share.not_novel, share.right_task) if share.known else (share.correct, None)


def _shares(known: bool, left: float, right: float | None) -> str:
    return f"{left:.2f}/{right:.2f}" if known else f"{left:.2f}"


# --- files ----------------------------------------------------------------------------------------

STATISTICS_CAPTION = (
    "Of the runs' mean returns, with 95% bootstrap intervals in brackets; positive or negative is "
    "a transfer whose difference to the baseline has an interval without 0. Jumpstart: mean of "
    "the first twentieth of the evaluations, less the baseline's. Steps to reach: environment "
    "steps when the mean curve of the seeds reaches the return in parentheses, which lies "
    f"{statistics.REACHED_SHARE:.0%} of the way from the baseline's first to its final returns."
)


def as_text(sheet: Sheet) -> str:
    """A table for a terminal."""
    rows = [
        [name, *("" if box is None else str(box) for box in boxes)] for name, boxes in sheet.rows
    ]
    parts = [
        f"{sheet.title}\n{_wrapped(sheet.caption + ' Ours | published.')}",
        aligned(sheet.header, rows),
    ]
    if sheet.statistics:
        header, *body = sheet.statistics
        parts += [aligned(header, body), _wrapped(STATISTICS_CAPTION)]
    if sheet.notes:
        parts.append("\n".join(map(_wrapped, sheet.notes)))
    return "\n\n".join(parts)


def _wrapped(text: str) -> str:
    return textwrap.fill(text, 100)


def as_csv(sheet: Sheet) -> str:
    """A line for each entry; what is not known is empty."""
    file = io.StringIO()
    writer = csv.DictWriter(file, list(sheet.records[0]), lineterminator="\n")
    writer.writeheader()
    writer.writerows(sheet.records)
    return file.getvalue()
