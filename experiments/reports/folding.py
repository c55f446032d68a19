"""Tables without what was not run, which is named in a line."""

import itertools
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

from experiments.reports.sheet import Box, Sheet


@dataclass(frozen=True)
class Shown:
    """A table as the page shows it: without the rows and columns of which nothing was run.

    Attributes:
      name: such as "table-3".
      sheet: the whole of it.
      header, rows: what is shown; each box with the number of columns that it spans.
      notes: the sheet's, and what is not shown.
    """

    name: str
    sheet: Sheet
    header: tuple[str, ...]
    rows: tuple[tuple[str, tuple[tuple[Box | None, int], ...]], ...]
    notes: tuple[str, ...]


def folded(name: str, sheet: Sheet) -> Shown:
    """A table without the rows and columns of which nothing was run; these are named in a note.

    Agents from scratch alone keep no row of a table of several targets. In a table of one target
    they have a row of their own, whose one box spans all columns.
    """

    def begun(box: Box | None) -> bool:
        return box is not None and box.begun and not box.baseline

    alone = [row for row in sheet.rows if all(box is None or box.baseline for box in row[1])]
    others = [row for row in sheet.rows if row not in alone]
    kept = [row for row in others if any(map(begun, row[1]))]
    columns = [
        column
        for column in range(len(sheet.header) - 1)
        if any(begun(box) or (box and box.baseline) for box in (row[1][column] for row in kept))
    ]
    rows = [
        (title, tuple((_shortened(boxes[column]), 1) for column in columns))
        for title, boxes in kept
    ]
    rows += [(title, ((boxes[0], max(1, len(columns))),)) for title, boxes in alone]
    header = (sheet.header[0], *(sheet.header[column + 1] for column in columns))
    names = {title for title, _ in kept}
    left_out = [title for title, _ in others if title not in names]
    words = [f"{sheet.header[0]} {', '.join(left_out)}".strip()] if left_out else []
    words += [text for text in sheet.header[1:] if text not in header]
    notes = (*sheet.notes, *([f"Not run: {'; '.join(words)}."] if words else []))
    return Shown(name, sheet, header, tuple(rows), notes)


def _shortened(box: Box | None) -> Box | None:
    """A box of which nothing was run says so with a dash."""
    if box is None or box.begun:
        return box
    return Box("–", box.published, False, begun=False)


def not_run(names: Iterable[str]) -> str:
    """Names of tables and figures in one line, neighbours joined; "" without any."""
    found: dict[str, list[int]] = {}
    for name in names:
        kind, _, number = name.partition("-")
        found.setdefault(kind, []).append(int(number))
    words = [f"{kind}s {_ranges(numbers)}" for kind, numbers in found.items()]
    return f"Not run: {'; '.join(words)}." if words else ""


def _ranges(numbers: Sequence[int]) -> str:
    """Ascending numbers as "1 to 3, 5"."""
    found = []
    for _, group in itertools.groupby(enumerate(numbers), lambda pair: pair[1] - pair[0]):
        first, *rest = [number for _, number in group]
        found.append(
            f"{first} to {rest[-1]}" if len(rest) > 1 else ", ".join(map(str, [first, *rest]))
        )
    return ", ".join(found)
