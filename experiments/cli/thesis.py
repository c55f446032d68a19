"""Commands on the thesis's grid: table, figure, sweep, plan. Their options, and what they do.

What takes long to import is imported where it is used, so that bad input is told at once.
"""

import contextlib
import dataclasses
import json
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import tyro

from dreamer_jax import config as configs
from dreamer_jax.ranges import setting
from experiments.cli.engines import (
    Execution,
    check_execution,
    chosen_run,
    engine_options,
    tell_problems,
)
from experiments.cli.exits import STOPPED, usage_errors
from experiments.cli.options import (
    DEFAULT_PRESET,
    Base,
    Compared,
    ConfigFile,
    Devices,
    Preset,
    Simulators,
    sequence,
)
from experiments.thesis import grid
from experiments.thesis.grid import Backend, Figure, LatentTable, Shown, Table

if TYPE_CHECKING:
    from experiments.thesis.graph import Graph, PlannedRun
    from experiments.thesis.speeds import Known
    from experiments.thesis.sweep import Progress


@dataclass(frozen=True)
class Sweep:
    """What all runs of a sweep share."""

    preset: Preset = DEFAULT_PRESET
    """Settings of all agents, each of which can be overridden by its name below; results are in a
    folder of that name."""
    seeds: tuple[int, ...] = setting(grid.SEEDS, 0, 2**31 - 1)
    """Seeds of targets and baselines; source agents have the first of them."""
    backend: Backend = "bullet"
    """The simulators."""
    omegas: tuple[float, ...] = setting(grid.OMEGAS, 0, 1)
    """Train targets of these fractions only; what is left out is shown as not run."""
    counts: tuple[int, ...] = setting(grid.COUNTS, 1, 100)
    """Train targets of these numbers of source tasks only."""
    compared: tuple[Compared, ...] = ()
    """Other methods to train, too, from the same sources, for rows of their own in tables of
    fractional transfer."""
    results: Path = Path("results")
    """The folder of all results."""
    devices: Devices = setting("all", 1, 10_000)
    """Devices to spread members over, each member on one of them. How many is no part of what a run
    is: it goes on with more or fewer."""
    simulators: tyro.conf.OmitArgPrefixes[Simulators] = Simulators()
    yes: bool = False
    """At a terminal: begin without a question, however long it takes."""
    accept_failed: bool = False
    """Transfer from agents whose losses were not finite any more, as they were before."""
    file: ConfigFile = None
    """A YAML or JSON file of settings (config, and perhaps seeds), written as a run's own are
    (run.json): over the preset's, under those given by name."""
    config: tyro.conf.OmitArgPrefixes[configs.Config] = configs.preset("cpu")

    @property
    def root(self) -> Path:
        """The folder of the results of this preset."""
        return self.results / self.preset


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


@dataclass(frozen=True)
class Plan:
    """Show the runs that tables and figures need, and what they will take, without running them.

    Time, memory and disk are estimates, from a short measurement on this machine: half a minute
    for each simulator and one for updates, most of it compilation. It is made once for a machine
    and its settings, and kept.
    """

    table: tuple[str, ...] = ()
    """Numbers of tables (1 to 17), or all."""
    figure: tuple[str, ...] = ()
    """Numbers of figures (10 to 39), or all."""
    measure: bool = False
    """Measure this machine anew."""
    json: bool = False
    """Print the graph as JSON, with estimates where this machine was measured before."""
    sweep: tyro.conf.OmitArgPrefixes[Sweep] = Sweep()


def _sweep(base: Base) -> Sweep:
    """The defaults of a sweep."""
    if strange := sorted(set(base.values) - {"preset", "seeds", "config"}):
        told = ", ".join(strange)
        raise ValueError(f"{base.file}: the settings {told} are not those of a table")
    seeds = sequence(base.values, "seeds", grid.SEEDS)
    return Sweep(preset=base.preset, file=base.file, seeds=seeds, config=base.config)


def table_defaults(base: Base) -> Tables:
    """Defaults of `table`."""
    return Tables(names=tyro.MISSING, sweep=_sweep(base))


def figure_defaults(base: Base) -> Figures:
    """Defaults of `figure`."""
    return Figures(names=tyro.MISSING, sweep=_sweep(base))


def sweep_defaults(base: Base) -> Sweeps:
    """Defaults of `sweep`."""
    return Sweeps(sweep=_sweep(base))


def plan_defaults(base: Base) -> Plan:
    """Defaults of `plan`."""
    return Plan(sweep=_sweep(base))


def chosen(entries: Mapping[str, Shown], names: Sequence[str], backend: Backend) -> list[Shown]:
    """The tables or figures of the given numbers, on a backend.

    Raises:
      ValueError: there is no such table or figure; names those there are.
    """
    found: dict[str, None] = {}
    kind = next(iter(entries)).partition("-")[0]
    numbers = [name.partition("-")[2] for name in entries]
    if not names:
        raise ValueError(f"no {kind} named: choose from {numbers[0]} to {numbers[-1]}, or all")
    for name in names:
        if name == "all":
            found |= dict.fromkeys(entries)
        elif f"{kind}-{name}" in entries:
            found.setdefault(f"{kind}-{name}")
        else:
            raise ValueError(
                f"unknown {kind} {name!r}: choose from {numbers[0]} to {numbers[-1]}, or all"
            )
    return [grid.on_backend(entries[name], backend) for name in found]


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
    entries = _entries(command.table, command.figure, command.sweep, "train")
    if not _begins(entries, command.sweep, command.execution):
        return STOPPED
    _, progress = _carry_out(entries, command.sweep, command.execution)
    return tell_problems(progress)


def _entries(
    table: Sequence[str], figure: Sequence[str], sweep: Sweep, verb: str
) -> list[Table | Figure]:
    """The tables and figures of the given numbers."""
    with usage_errors():
        if not (table or figure):
            raise ValueError(f"nothing to {verb}: add --table 3, or --figure 12, or all of them")
        entries: list[Table | Figure] = [
            *(chosen(grid.TABLES, table, sweep.backend) if table else ()),
            *(chosen(grid.FIGURES, figure, sweep.backend) if figure else ()),
        ]
    return [grid.beside(entry, sweep.compared) for entry in entries]


def _cells(entries: Sequence[Table | Figure], sweep: Sweep) -> list[grid.Cell]:
    """The cells that tables and figures show.

    Raises:
      UsageError: what is asked for is not there.
    """
    with usage_errors():
        if not sweep.seeds or len(set(sweep.seeds)) < len(sweep.seeds):
            raise ValueError(f"seeds {sweep.seeds} must be one or more, each named once")
        for name, wanted, there in (
            ("omegas", sweep.omegas, grid.OMEGAS),
            ("counts", sweep.counts, grid.COUNTS),
        ):
            if not wanted or not set(wanted) <= set(there):
                raise ValueError(f"{name} {wanted} must be one or more of {there}")
        entries = [grid.restricted(entry, sweep.omegas, sweep.counts) for entry in entries]
        return [cell for entry in entries for cell in grid.shown(entry, sweep.seeds)]


def _planned(entries: Sequence[Table | Figure], sweep: Sweep) -> "Graph":
    """The runs behind tables and figures, beside what others are at; nothing is reserved."""
    from dreamer_jax.devices import check_devices
    from experiments.thesis.graph import plan_runs
    from experiments.thesis.reservations import standing

    cells = _cells(entries, sweep)
    with usage_errors():
        check_devices(sweep.devices)
        return plan_runs(cells, sweep.config, sweep.root, standing(sweep.root))


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

    cells = _cells(entries, sweep)
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
                **engine_options(execution, wanted, sweep.simulators),
                accept_failed=sweep.accept_failed,
                devices=sweep.devices,
                mapping=sweep.config.schedule.mapping,
                mapping_chunk=sweep.config.schedule.mapping_chunk,
            )
    if progress.stopped and not progress.left:
        print(f"stopped and saved in {sweep.root}: the same command goes on")
    return runs, progress


def plan(command: Plan) -> int:
    """Shows the graph with an estimate."""
    from experiments.thesis import estimate, measurement
    from experiments.thesis.graph import due

    sweep = command.sweep
    entries = _entries(command.table, command.figure, sweep, "plan")
    runs = _planned(entries, sweep)
    left = due(runs)
    timeout = sweep.simulators.simulator_timeout
    if command.json:
        if command.measure and left:
            _speed(left, timeout, again=True)
        print(json.dumps(_as_json(runs, sweep), indent=1))
        return 0
    known = _speed(left, timeout, again=command.measure) if left else None
    print(f"\n{', '.join(entry.name for entry in entries)}, preset {sweep.preset}: {sweep.root}\n")
    print(estimate.plan_table(runs, known and known.speed, sweep.devices))
    if known is not None:
        ticks = 1000 * max(known.speed.tick_seconds.values())
        when = f"kept in {known.path} (--measure measures anew)" if known.kept else "here and now"
        print(
            f"\nAn estimate, from {known.speed.update_seconds:.3g} s for an update of one agent "
            f"and {ticks:.1f} ms for a tick of the\nslowest simulator, measured {when}.\n"
            "Runs come one after another; each is compiled first."
        )
        if known.speed.scaled > 1:
            print(
                "The update was measured on smaller batches, and multiplied by "
                f"{known.speed.scaled:.3g}: its time may be off by {measurement.SCALING_ERROR:.0%}."
            )
    return 0


def _as_json(runs: "Graph", sweep: Sweep) -> dict[str, object]:
    """The graph as JSON holds it: what it is, and of each run what an engine asks."""
    from experiments.thesis.engines.demands import estimates
    from experiments.thesis.graph import PlannedRun
    from experiments.thesis.speeds import cache_folder

    known = estimates(runs, cache_folder(), sweep.devices)
    found = []
    for run in runs:
        one = known.get(run.name)
        estimated = {} if one is None else dataclasses.asdict(one)
        found.append(
            {
                "name": run.name,
                "needs": run.needs,
                "state": run.state,
                "progress": run.progress if isinstance(run, PlannedRun) else None,
                "tasks": run.spec.tasks if isinstance(run, PlannedRun) else None,
                "cells": run.cells,
                **{key: estimated.get(key) for key in ("seconds", "memory", "disk")},
            }
        )
    return {"root": str(sweep.root), "preset": sweep.preset, "runs": found}


LONG_SECONDS = 3600.0
"""What takes longer is begun at a terminal only after a question."""


def _speed(left: "Sequence[PlannedRun]", timeout: float, again: bool = False) -> "Known":
    """How fast this machine is at runs of which there is at least one."""
    from experiments.thesis.speeds import cache_folder, speed_of

    def report(number: int, count: int, what: str) -> None:
        if number == 1:
            print("measuring how fast this machine is:", file=sys.stderr)
        print(f"  [{number}/{count}] {what}", file=sys.stderr, flush=True)

    specs = [run.spec for run in left]
    return speed_of(specs, cache_folder(), again=again, timeout=timeout, report=report)


def _may_begin(runs: "Graph", timeout: float, devices: Devices) -> bool:
    """Asks before anything longer than an hour. Runs of few updates are short without measuring."""
    from dreamer_jax.schedule import Schedule
    from experiments.thesis import estimate
    from experiments.thesis.graph import due

    left = due(runs)
    updates = sum(
        Schedule(run.spec.config.schedule, len(run.spec.tasks)).updates * len(run.spec.members)
        for run in left
    )
    # An update that takes a second is one of the largest sizes on a machine without accelerator.
    if updates < LONG_SECONDS:
        return True
    speed = _speed(left, timeout).speed
    total = estimate.together(runs, speed, devices)
    if total.seconds < LONG_SECONDS:
        return True
    agents = sum(len(run.cells) for run in left)
    print(
        f"{len(left)} runs of {agents} agents will take {estimate.span(total.seconds, speed)}. "
        "They can be stopped with\nCtrl-C and go on with the same command; plan shows them one by "
        "one, --yes begins without asking."
    )
    try:
        return input("Begin? [y/N] ").strip().lower() in ("y", "yes")
    except EOFError:
        return False


def _begins(entries: Sequence[Table | Figure], sweep: Sweep, execution: Execution) -> bool:
    """Whether to begin: what takes long here is asked about at a terminal."""
    with usage_errors():
        check_execution(execution)
    if execution.executor != "local" or sweep.yes or not sys.stdin.isatty():
        return True
    runs = _planned(entries, sweep)
    with usage_errors():
        wanted = chosen_run(runs, execution.run)
    if _may_begin(wanted, sweep.simulators.simulator_timeout, sweep.devices):
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
