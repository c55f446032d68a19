"""Commands on results: report, seeds. Their options, and what they do.

What takes long to import is imported where it is used, so that bad input is told at once.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import tyro

from dreamer_jax.ranges import setting
from experiments.cli.exits import UsageError, usage_errors
from experiments.cli.options import DEFAULT_PRESET, Compared, Preset
from experiments.cli.selection import chosen
from experiments.thesis import grid
from experiments.thesis.grid import Backend, Figure, LatentTable, ReturnsTable, Table


@dataclass(frozen=True)
class Report:
    """Print the table of a results folder and draw its learning curves.

    Of several folders: of all of them beside each other. Of a folder of all results of a preset
    (results/cpu): write all tables, figures, the page, and results.csv with all evaluations.
    """

    directories: tyro.conf.Positional[tuple[Path, ...]]
    """The results folder, or several."""
    out: Path = Path("comparison.png")
    """Of several folders: the picture to draw; an .svg is written beside it."""
    seeds: tuple[int, ...] = setting((), 0, 2**31 - 1)
    """Of all results: the seeds that tables and figures show, the first one being that of the
    sources; by default all that there are."""
    backend: Backend = "bullet"
    """Of all results: the simulators."""


@dataclass(frozen=True)
class Seeds:
    """Say which seeds the comparisons of tables still need.

    Runs are looked at after every group of seeds. A comparison that is decided needs no more; one
    that is not needs the next group, up to the most. The probability that any comparison of a table
    is decided although there is no effect is at most 5 %, over all looks. Trains nothing.
    """

    names: tyro.conf.Positional[tuple[str, ...]]
    """Numbers of tables of returns (1 to 12, 16, 17)."""
    preset: Preset = DEFAULT_PRESET
    """Whose results."""
    group: int = setting(5, 1, 10_000)
    """Seeds between two looks."""
    most: int = setting(20, 1, 10_000)
    """Seeds at the last look."""
    omegas: tuple[float, ...] = setting(grid.OMEGAS, 0, 1)
    """The fractions that are to be compared; the fewer, the fewer seeds they need."""
    counts: tuple[int, ...] = setting(grid.COUNTS, 1, 100)
    """The numbers of source tasks that are to be compared."""
    compared: tuple[Compared, ...] = ()
    """Further methods that are to be compared, see `table`."""
    backend: Backend = "bullet"
    """The simulators."""
    results: Path = Path("results")
    """The folder of all results."""


def report(command: Report) -> int:
    """Shows a run, several beside each other, or all results under a folder."""
    from experiments.reports import summary, tidy
    from experiments.reports.outcomes import read_run
    from experiments.runs.folder import run_folders

    if not command.directories:
        raise UsageError("nothing to report: name a results folder, or several")
    if len(command.directories) > 1:
        with usage_errors():
            runs = [read_run(directory) for directory in command.directories]
            print(summary.table(summary.compare(runs)))
            picture, _ = summary.plot_comparison(runs, command.out)
        print(f"learning curves: {picture}")
        return 0
    (directory,) = command.directories
    if not (directory / "run.json").exists() and run_folders(directory):
        return report_all(directory, command.seeds, command.backend)
    with usage_errors():
        run = read_run(directory)
    print(summary.table(summary.summarise(run)))
    if run.evaluations:
        picture, _ = summary.plot_curves(run)
        print(f"learning curves: {picture}")
        print(f"all evaluations: {tidy.write_evaluations([run], directory / 'results.csv')}")
    return 0


def report_all(root: Path, seeds: tuple[int, ...], backend: Backend) -> int:
    """Writes all tables and figures of which there is something, and the page. Trains nothing."""
    from experiments.reports import comparison, figures
    from experiments.reports.classification import read_classification
    from experiments.reports.outcomes import read_outcomes, seeds_on_disk

    entries = _on_backend(backend)
    seeds = seeds or seeds_on_disk(root, entries, backend) or grid.SEEDS
    outcomes = read_outcomes(root, [cell for one in entries for cell in grid.shown(one, seeds)])

    def begun(entry: Table | Figure) -> bool:
        if isinstance(entry, LatentTable):
            return read_classification(root, entry, seeds) is not None
        if isinstance(entry, ReturnsTable):
            return comparison.transferred(entry, outcomes, seeds)
        return entry.kind != "tasks" and bool(figures.begun(entry, outcomes, seeds))

    _write([entry for entry in entries if begun(entry)], root, seeds, backend)
    return 0


def _on_backend(backend: Backend) -> list[Table | Figure]:
    """All tables and figures on a simulator."""
    everything: tuple[Table | Figure, ...] = (*grid.TABLES.values(), *grid.FIGURES.values())
    return [grid.on_backend(entry, backend) for entry in everything]


def write_reports(
    entries: Sequence[Table | Figure], root: Path, backend: Backend, seeds: tuple[int, ...]
) -> None:
    """Writes tables, figures, the page of all results under a root, and all evaluations.

    Args:
      entries: tables and figures.
      root: the folder of results folders.
      backend: the simulator.
      seeds: that were asked for, the first one the sources'; all others on disk are shown too.
    """
    from experiments.reports.outcomes import seeds_on_disk

    _write(entries, root, seeds_on_disk(root, _on_backend(backend), backend, seeds), backend)


def _write(
    entries: Sequence[Table | Figure], root: Path, seeds: tuple[int, ...], backend: Backend
) -> None:
    from experiments.reports import page, publication, tidy
    from experiments.reports.outcomes import read_runs
    from experiments.runs.folder import folders, report_folder

    folder, held = report_folder(root, backend), folders(root)
    entries = [grid.with_compared(entry, held, seeds) for entry in entries]
    folder.mkdir(parents=True, exist_ok=True)
    for entry in entries:
        if isinstance(entry, Table):
            print(publication.write_table(entry, root, seeds, folder) + "\n")
            print(f"wrote {folder / entry.name}.txt, .csv, .png and .svg\n")
            continue
        paths = publication.write_figure(entry, root, seeds, folder)
        for path in paths:
            print(f"wrote {path}")
        if not paths:
            print(f"nothing of {entry.name} has been run")
    for path in publication.write_forests(root, seeds, backend, folder):
        print(f"wrote {path}")
    print(f"wrote {tidy.write_evaluations(read_runs(root).values(), folder / 'results.csv')}")
    print(f"wrote {page.write_page(root, seeds, backend, folder / 'index.html')}")


def seeds(command: Seeds) -> int:
    """Says what each comparison needs."""
    from experiments.reports import needed
    from experiments.reports.outcomes import read_outcomes, seeds_on_disk
    from experiments.reports.sequential import looks

    with usage_errors():
        steps = looks(command.group, command.most)
        tables = []
        for table in chosen(grid.TABLES, command.names, command.backend):
            if isinstance(table, LatentTable):
                raise ValueError(f"{table.name} compares no returns: choose of 1 to 12, 16 and 17")
            table = grid.restricted(table, command.omegas, command.counts)
            tables.append(grid.beside(table, command.compared))
    root = command.results / command.preset
    on_disk = seeds_on_disk(root, _on_backend(command.backend), command.backend)
    open_seeds: set[int] = set()
    asked = on_disk or (0,)
    for table in tables:
        outcomes = read_outcomes(root, grid.shown(table, asked))
        with usage_errors():
            needs = needed.needed(table, outcomes, asked, command.group, command.most)
        for need in needs:
            open_seeds |= {*need.ours, *need.base}
        count = len(needs)
        print(f"{table.name.replace('-', ' ').capitalize()}, {table.metric} return, {root}\n")
        print(needed.as_text(needs) + "\n")
        print(
            f"Looks at {', '.join(map(str, steps))} seeds. The probability of any false decision "
            f"among\nthe {count} comparisons above, over all looks, is at most 5 %.\n"
        )
    if open_seeds:
        numbers = sorted({*on_disk, *open_seeds})
        ordered = [*on_disk[:1], *(seed for seed in numbers if seed not in on_disk[:1])]
        print(
            f"next: python -m experiments table {' '.join(command.names)} --preset "
            f"{command.preset} --seeds {' '.join(map(str, ordered))}" + _other_options(command)
        )
    return 0


def _other_options(command: Seeds) -> str:
    """The options of a table that are not its defaults, as they are typed."""
    words = ""
    for name in ("omegas", "counts", "compared"):
        values = getattr(command, name)
        if values != getattr(Seeds, name):
            words += f" --{name} {' '.join(map(str, values))}"
    words += f" --backend {command.backend}" if command.backend != "bullet" else ""
    return words + (f" --results {command.results}" if command.results != Path("results") else "")
