"""The graph of runs behind cells of the grid: what is done, what is missing, and in which order."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType
from typing import Literal

from dreamer_jax import config as configs
from dreamer_jax.checkpoint import Checkpointer, CorruptCheckpointError
from dreamer_jax.config import Config, Difference
from dreamer_jax.logs import read_metrics
from dreamer_jax.schedule import Counters, Schedule
from experiments.runs.folder import CELLS, begun, failed_members, read_cells, run_folders
from experiments.runs.spec import OF_THE_MACHINE, RunSpec, read_spec
from experiments.thesis.grid import Cell
from experiments.thesis.populations import (
    MULTITASK_STEPS,
    Population,
    config_of,
    new_populations,
    of_length,
)

# What reading a damaged folder raises; a checkpoint that its run replaces meanwhile is not found.
_UNREADABLE = (
    FileNotFoundError,
    ValueError,
    KeyError,
    TypeError,
    IndexError,
    CorruptCheckpointError,
)


@dataclass(frozen=True)
class PlannedRun:
    """One run of the graph: a population, and the folder that holds it or will.

    Attributes:
      name: of its folder under the root of results.
      cells: names of its cells, in the order of its members.
      spec: what it is; its sources are named by their runs.
      needs: names of the runs that must be done before it can begin; none once it has begun.
      state: "missing", "cut" (begun, and can be resumed) or "done".
      progress: share of its updates that is done.
      failed: names of the cells whose agents met losses that are not finite.
    """

    name: str
    cells: tuple[str, ...]
    spec: RunSpec
    needs: tuple[str, ...] = ()
    state: Literal["missing", "cut", "done"] = "missing"
    progress: float = 0.0
    failed: tuple[str, ...] = ()


@dataclass(frozen=True)
class DamagedRun:
    """A run of the graph whose folder cannot be read.

    Attributes:
      name: of its folder under the root of results.
      cells: names of its cells; none if the folder does not even say that.
      problem: what is wrong with it.
      needs: none; what it began from is not known.
      state: "corrupt".
    """

    name: str
    cells: tuple[str, ...]
    problem: str
    needs: tuple[()] = ()
    state: Literal["corrupt"] = "corrupt"


Graph = Sequence[PlannedRun | DamagedRun]
"""Runs, each after those that it needs."""


def due(runs: Graph) -> list[PlannedRun]:
    """The runs that still take time: those that are missing or were cut."""
    return [run for run in runs if isinstance(run, PlannedRun) and run.state != "done"]


def changed_settings(root: str | Path) -> tuple[Difference, ...]:
    """Settings of the runs under a root that are not those of the preset it is named after.

    The length of agents for several tasks is told as that of agents for one. Each value is told
    once; `one` is the runs', `other` the preset's.
    """
    root = Path(root)
    found: dict[Difference, None] = {}
    if root.name not in configs.PRESETS:
        return ()
    for folder in run_folders(root):
        try:
            spec = read_spec(folder)
        except (ValueError, KeyError, TypeError):
            continue  # `read_outcomes` warns of it
        config = spec.config
        if len(spec.tasks) > 1:
            config = of_length(config, config.schedule.environment_steps // MULTITASK_STEPS)
        found |= dict.fromkeys(_of_results(config, configs.preset(root.name)))
    return tuple(found)


def _of_results(one: Config, other: Config) -> tuple[Difference, ...]:
    """Differences of what results depend on."""
    pairs = configs.differences(one, other)
    return tuple(pair for pair in pairs if pair.path not in OF_THE_MACHINE)


def plan_runs(
    cells: Iterable[Cell],
    config: Config,
    root: str | Path,
    reserved: Mapping[str, PlannedRun] = MappingProxyType({}),
) -> Graph:
    """The runs behind cells, each after those that it needs, and those that were cut first.

    Cells that are done, or whose run has begun, need no source any more: nothing is repeated, and
    sources that were not copied along are not missed.

    Args:
      cells: what is asked for.
      config: settings of all runs, those of a preset.
      root: the folder of all results of these settings.
      reserved: runs that others plan there, by name; those that have begun are as they are found.

    Raises:
      ValueError: a run was made with other settings; names them on both sides.
    """
    cells, root = tuple(cells), Path(root)
    held, found = _places(root)
    used = {run.name: run for run in found.values() if not run.cells}
    missing: dict[Cell, None] = {}
    begun_names = {name for name, _ in held.values()} | set(found)
    for run in reserved.values():
        if run.name not in begun_names:
            found[run.name] = run
            for member, cell_name in enumerate(run.cells):
                held.setdefault(cell_name, (run.name, member))

    def use(name: str) -> PlannedRun | DamagedRun:
        if name not in found:
            found[name] = inspect_run(root / name)
        if name not in used:
            used[name] = found[name]
            for needed in found[name].needs:  # of those that others plan perhaps for other cells
                if needed in reserved or begun(root / needed):
                    use(needed)
        return found[name]

    def visit(cell: Cell) -> None:
        if cell in missing:
            return
        if cell.name not in held:
            for needed in cell.needs:
                visit(needed)
            missing.setdefault(cell)
            return
        name, _ = held[cell.name]
        run = use(name)
        _check_settings(root / name, run, config_of(cell, config))
        if run.needs:
            for needed in cell.needs:
                visit(needed)

    for cell in cells:
        visit(cell)
    taken = _taken_names(root) | set(reserved)
    populations = new_populations(tuple(missing), config, held, taken)
    new = [_planned(population) for population in populations]
    there = sorted(used.values(), key=lambda run: run.state != "cut")
    return _in_order([*there, *new])


def _planned(new: Population) -> PlannedRun:
    return PlannedRun(
        new.name, tuple(cell.name for cell in new.cells), new.spec, new.spec.method.needs
    )


def _in_order(runs: Graph) -> Graph:
    """The runs as they are given, but each after those that it needs."""
    by_name = {run.name: run for run in runs}
    ordered: dict[str, PlannedRun | DamagedRun] = {}

    def visit(run: PlannedRun | DamagedRun) -> None:
        for name in run.needs:
            if name in by_name and name not in ordered:
                visit(by_name[name])
        ordered.setdefault(run.name, run)

    for run in runs:
        visit(run)
    return tuple(ordered.values())


# What is there.


def _taken_names(root: Path) -> set[str]:
    """Names that new runs cannot have: not those of runs of which nothing was kept yet."""
    if not root.is_dir():
        return set()
    return {path.name for path in root.iterdir() if begun(path) or not (path / CELLS).exists()}


def _places(
    root: Path,
) -> tuple[dict[str, tuple[str, int]], dict[str, PlannedRun | DamagedRun]]:
    """Where each cell is, name -> (run, member), and the runs that do not say what they hold."""
    held: dict[str, tuple[str, int]] = {}
    damaged: dict[str, PlannedRun | DamagedRun] = {}
    for folder in run_folders(root):
        try:
            names = read_cells(folder)
        except ValueError as error:
            damaged[folder.name] = DamagedRun(folder.name, (), str(error))
            continue
        for member, name in enumerate(names):
            held.setdefault(name, (folder.name, member))
    return held, damaged


def inspect_run(folder: Path) -> PlannedRun | DamagedRun:
    """A run that has begun, as its folder tells."""
    cells: tuple[str, ...] = ()
    try:
        cells = read_cells(folder)
        spec = read_spec(folder)
        if len(spec.members) != len(cells):
            raise ValueError(f"{folder} has {len(spec.members)} agents and names {len(cells)}")
        schedule = Schedule(spec.config.schedule, len(spec.tasks))
        evaluations = _evaluations(folder)
        failed = tuple(cells[member] for member in sorted(failed_members(folder)))
        checkpoints = Checkpointer(folder / "checkpoints")
        if (latest := checkpoints.latest()) is None:
            # Copied without checkpoints: what is evaluated to the end is done, for tables.
            done = evaluations >= schedule.evaluations
            needs = () if done else spec.method.needs
            return PlannedRun(
                folder.name,
                cells,
                spec,
                needs,
                "done" if done else "cut",
                float(done),
                failed=failed,
            )
        counters = Counters(**checkpoints.metadata(latest)["counters"])
    except _UNREADABLE as error:
        return DamagedRun(folder.name, cells, str(error))
    done = schedule.next(counters) == "done"
    progress = counters.updates / max(1, schedule.updates)
    return PlannedRun(
        folder.name, cells, spec, (), "done" if done else "cut", progress, failed=failed
    )


def _evaluations(folder: Path) -> int:
    """How often each member of a run was evaluated."""
    if not (folder / "metrics.jsonl").exists():
        return 0
    rows = [row for row in read_metrics(folder) if row["kind"] == "evaluation"]
    return len({row["env_steps"] for row in rows})


def _check_settings(folder: Path, run: PlannedRun | DamagedRun, config: Config) -> None:
    if isinstance(run, DamagedRun):
        return
    if different := _of_results(run.spec.config, config):
        told = "; ".join(map(str, different))
        raise ValueError(
            f"{folder} was made with other settings (there / here: {told}): "
            "name another folder with --results, or move that one away"
        )
