"""Tables and figures of the thesis as files: text, .csv and pictures."""

import csv
import io
import textwrap
from collections.abc import Sequence
from pathlib import Path

from experiments.reports import figures
from experiments.reports.findings import draw_forest, findings
from experiments.reports.outcomes import read_outcomes
from experiments.reports.sheet import STATISTICS_CAPTION, Sheet, read_sheet, size_note
from experiments.runs.folder import folders
from experiments.runs.text import aligned
from experiments.thesis import grid
from experiments.thesis.grid import Backend, Figure, ReturnsTable, Table


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
    figures.draw_table(title, sheet.header, rows, folder / table.name)
    return text


def write_figure(
    figure: Figure, root: str | Path, seeds: Sequence[int], folder: str | Path
) -> list[Path]:
    """Writes a figure as NAME.png and .svg; the arguments are those of `write_table`.

    Returns:
      The files; none if nothing of the figure was run.

    Raises:
      ModuleNotFoundError: pictures of the tasks need a simulator that is not installed.
    """
    root, folder, seeds = Path(root), Path(folder), tuple(seeds)
    folder.mkdir(parents=True, exist_ok=True)
    if figure.kind == "tasks":
        return figures.draw_tasks(figure, folder / figure.name)
    outcomes = read_outcomes(root, grid.shown(figure, seeds))
    return figures.draw_curves(figure, outcomes, seeds, size_note(root), folder / figure.name)


def write_forests(
    root: str | Path, seeds: Sequence[int], backend: Backend, folder: str | Path
) -> list[Path]:
    """Writes the forest plot of each method of which anything can be compared, as .png and .svg.

    Args:
      root: the folder of results folders.
      seeds: of targets and baselines; the first one is the sources'.
      backend: the simulator.
      folder: where to; pictures are named forest-ftl, forest-meta, and after the methods that
        tables compare beside their own.

    Returns:
      The files written.
    """
    root, seeds, held = Path(root), tuple(seeds), folders(root)
    tables = [
        grid.with_compared(grid.on_backend(table, backend), held, seeds)
        for table in grid.TABLES.values()
        if isinstance(table, ReturnsTable)
    ]
    outcomes = read_outcomes(root, [cell for table in tables for cell in grid.shown(table, seeds)])
    size, written = size_note(root), []
    for finding in findings(tables, outcomes, seeds):
        if finding.comparisons:
            written += draw_forest(finding, Path(folder) / f"forest-{finding.kind}", size)
    return written


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
