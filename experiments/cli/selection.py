"""What of the thesis's grid a command is about: tables and figures by their numbers, and what all
of their runs share.

What takes long to import is imported where it is used, so that bad input is told at once.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import tyro

from dreamer_jax import config as configs
from dreamer_jax.ranges import setting
from experiments.cli.exits import usage_errors
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
from experiments.thesis.grid import Backend, Figure, Shown, Table

if TYPE_CHECKING:
    from experiments.thesis.graph import Graph


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


def sweep_of(base: Base) -> Sweep:
    """The defaults of a sweep."""
    if strange := sorted(set(base.values) - {"preset", "seeds", "config"}):
        told = ", ".join(strange)
        raise ValueError(f"{base.file}: the settings {told} are not those of a table")
    seeds = sequence(base.values, "seeds", grid.SEEDS)
    return Sweep(preset=base.preset, file=base.file, seeds=seeds, config=base.config)


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


def entries_of(
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


def cells_of(entries: Sequence[Table | Figure], sweep: Sweep) -> list[grid.Cell]:
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


def planned_beside_others(entries: Sequence[Table | Figure], sweep: Sweep) -> "Graph":
    """The runs behind tables and figures, beside what others are at; nothing is reserved."""
    from dreamer_jax.devices import check_devices
    from experiments.thesis.graph import plan_runs
    from experiments.thesis.reservations import standing

    cells = cells_of(entries, sweep)
    with usage_errors():
        check_devices(sweep.devices)
        return plan_runs(cells, sweep.config, sweep.root, standing(sweep.root))
