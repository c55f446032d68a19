"""Commands that train the thesis's grid: table, figure, sweep. Their options, and what they do.

What takes long to import is imported where it is used, so that bad input is told at once.
"""

import contextlib
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import tyro

from experiments.cli.engines import (
    Execution,
    check_execution,
    chosen_run,
    engine_options,
    tell_problems,
)
from experiments.cli.exits import STOPPED, usage_errors
from experiments.cli.options import Base
from experiments.cli.plan import may_begin
from experiments.cli.selection import (
    Sweep,
    cells_of,
    chosen,
    entries_of,
    planned_beside_others,
    sweep_of,
)
from experiments.thesis import grid
from experiments.thesis.grid import Figure, LatentTable, Table

if TYPE_CHECKING:
    from experiments.thesis.graph import Graph
    from experiments.thesis.jobs import Means
    from experiments.thesis.sweep import Progress


@dataclass(frozen=True)
class Tables:
    """Make tables of the thesis: train what is missing of their agents, show them beside it.

    What is done is not repeated, what was cut goes on, and agents are shared by all tables and
    figures. Ctrl-C saves and stops; the same command goes on.
    """

    names: tyro.conf.Positional[tuple[str, ...]]
    """Numbers of tables (1 to 17), or all."""
    sweep: tyro.conf.OmitArgPrefixes[Sweep] = Sweep()
    execution: tyro.conf.OmitArgPrefixes[Execution] = Execution()


@dataclass(frozen=True)
class Figures:
    """Make figures of the thesis, as `table` makes tables."""

    names: tyro.conf.Positional[tuple[str, ...]]
    """Numbers of figures (10 to 39), or all."""
    sweep: tyro.conf.OmitArgPrefixes[Sweep] = Sweep()
    execution: tyro.conf.OmitArgPrefixes[Execution] = Execution()


@dataclass(frozen=True)
class Sweeps:
    """Train what tables and figures of the thesis need, and make no reports of it.

    As `table` and `figure` do it: what is done is not repeated, and what was cut goes on.
    """

    table: tuple[str, ...] = ()
    """Numbers of tables (1 to 17), or all."""
    figure: tuple[str, ...] = ()
    """Numbers of figures (10 to 39), or all."""
    sweep: tyro.conf.OmitArgPrefixes[Sweep] = Sweep()
    execution: tyro.conf.OmitArgPrefixes[Execution] = Execution()


def table_defaults(base: Base) -> Tables:
    """Defaults of `table`."""
    return Tables(names=tyro.MISSING, sweep=sweep_of(base))


def figure_defaults(base: Base) -> Figures:
    """Defaults of `figure`."""
    return Figures(names=tyro.MISSING, sweep=sweep_of(base))


def sweep_defaults(base: Base) -> Sweeps:
    """Defaults of `sweep`."""
    return Sweeps(sweep=sweep_of(base))


def tables(command: Tables) -> int:
    """Makes tables."""
    with usage_errors():
        entries = chosen(grid.TABLES, command.names, command.sweep.backend)
    beside = [grid.beside(entry, command.sweep.compared) for entry in entries]
    return _make(beside, command.sweep, command.execution)


def figures(command: Figures) -> int:
    """Makes figures."""
    with usage_errors():
        entries = chosen(grid.FIGURES, command.names, command.sweep.backend)
    return _make(entries, command.sweep, command.execution)


def sweep(command: Sweeps) -> int:
    """Trains what tables and figures need."""
    entries = entries_of(command.table, command.figure, command.sweep, "train")
    if not _begins(entries, command.sweep, command.execution):
        return STOPPED
    _, progress = _carry_out(entries, command.sweep, command.execution)
    return tell_problems(progress)


def _carry_out(
    entries: Sequence[Table | Figure], sweep: Sweep, execution: Execution
) -> "tuple[Graph, Progress]":
    """Trains what is missing of tables and figures.

    Returns:
      The runs behind them, and what became of these.

    Raises:
      UsageError: results of other settings are there, or a simulator or an engine is not installed.
    """
    from dreamer_jax.devices import check_devices
    from dreamer_jax.host_memory import keep_freed_memory
    from experiments.thesis.graph import due
    from experiments.thesis.reservations import planned
    from experiments.thesis.sweep import carry_out_runs

    cells = cells_of(entries, sweep)
    with contextlib.ExitStack() as at_work:
        with usage_errors():
            check_execution(execution)
            if execution.executor == "local":  # elsewhere, there are those of each run
                check_devices(sweep.devices)
            runs = at_work.enter_context(planned(cells, sweep.config, sweep.root))
            wanted = chosen_run(runs, execution.run)
            if execution.executor == "local" and due(wanted):
                keep_freed_memory()
            progress = carry_out_runs(
                wanted,
                sweep.root,
                **engine_options(execution, wanted, _means(sweep)),
            )
    if progress.stopped and not progress.left:
        print(f"stopped and saved in {sweep.root}: the same command goes on")
    return runs, progress


def _means(sweep: Sweep) -> "Means":
    """How its runs are trained."""
    from experiments.thesis.jobs import Means

    return Means(
        sweep.simulators.workers,
        sweep.accept_failed,
        sweep.simulators.simulator_timeout,
        sweep.devices,
        sweep.config.schedule.mapping,
        sweep.config.schedule.mapping_chunk,
    )


def _begins(entries: Sequence[Table | Figure], sweep: Sweep, execution: Execution) -> bool:
    """Whether to begin: what takes long here is asked about at a terminal."""
    with usage_errors():
        check_execution(execution)
    if execution.executor != "local" or sweep.yes or not sys.stdin.isatty():
        return True
    runs = planned_beside_others(entries, sweep)
    with usage_errors():
        wanted = chosen_run(runs, execution.run)
    if may_begin(wanted, sweep.simulators.simulator_timeout, sweep.devices):
        return True
    print("nothing was begun")
    return False


def _make(entries: Sequence[Table | Figure], sweep: Sweep, execution: Execution) -> int:
    """Trains what is missing and writes tables and figures."""
    from dreamer_jax.progress import reported
    from experiments.cli.reports import write_reports
    from experiments.thesis.latent_tables import make_table

    if not _begins(entries, sweep, execution):
        return STOPPED
    runs, progress = _carry_out(entries, sweep, execution)
    if progress.stopped or execution.run is not None:
        return tell_problems(progress)
    run_of = {cell: run.name for run in runs for cell in run.cells}
    for entry in entries:
        if not isinstance(entry, LatentTable):
            continue
        (cell,) = grid.shown(entry, sweep.seeds)
        if (name := run_of[cell.name]) in progress.failed | progress.skipped:
            progress.skipped[entry.name] = f"it needs {name}"
            continue
        try:
            with reported("gathering") as report:
                make_table(
                    sweep.root,
                    entry,
                    sweep.seeds[0],
                    workers=sweep.simulators.workers,
                    timeout=sweep.simulators.simulator_timeout,
                    accept_failed=sweep.accept_failed,
                    report=report,
                )
        except ValueError as error:
            progress.failed[entry.name] = str(error)
    write_reports(entries, sweep.root, sweep.backend, sweep.seeds)
    return tell_problems(progress)
