"""The graph of runs behind cells of the grid: what is done, what is missing, and in which order.

Missing cells on one task, of one method, whose trees have one shape, are one run: a population.
The targets of fractional transfer to a task (sources × fractions × seeds) and its baselines are
one, as are the targets of meta-models (numbers of sources × seeds). Source agents are runs of
their own. What is missing of a population that is partly done is split into products.
"""

import dataclasses
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import envs
from dreamer_jax import config as configs
from dreamer_jax.checkpoint import Checkpointer, CorruptCheckpointError
from dreamer_jax.config import Config
from dreamer_jax.logs import read_metrics
from dreamer_jax.schedule import Counters, Schedule
from experiments.runs.folder import CELLS, begun, read_cells, run_folders
from experiments.runs.spec import RunSpec, read_spec
from experiments.thesis.grid import Backend, Cell

MULTITASK_STEPS = 2
"""Environment steps of an agent for several tasks, in those of one for one task (section 4.2.1)."""

# How members are mapped depends on the machine and changes no result but by rounding.
_OF_THE_MACHINE = ("schedule.mapping:", "schedule.mapping_chunk:")


@dataclass(frozen=True)
class PlannedRun:
    """One run of the graph: a population, and the folder that holds it or will.

    Attributes:
      name: of its folder under the root of results.
      cells: names of its cells, in the order of its members.
      spec: what it is; its sources are named by their runs. None if its folder is damaged.
      needs: names of the runs that must be done before it can begin; none once it has begun.
      state: "missing", "cut" (begun, and can be resumed), "done", or "corrupt".
      progress: share of its updates that is done.
      problem: what is wrong with a corrupt one.
    """

    name: str
    cells: tuple[str, ...]
    spec: RunSpec | None
    needs: tuple[str, ...] = ()
    state: Literal["missing", "cut", "done", "corrupt"] = "missing"
    progress: float = 0.0
    problem: str = ""


def task_name(backend: Backend, title: str) -> str:
    """The name of a task of the grid, such as "bullet/hopper" for Hopper on bullet.

    Raises:
      ValueError: the backend has no such task; names the tasks there are.
    """
    names = envs.task_names()
    for name in names:
        if name.partition("/")[0] == backend and envs.spec(name).title == title:
            return name
    raise ValueError(f"there is no task {title} of {backend}, the tasks are {', '.join(names)}")


def config_of(cell: Cell, config: Config) -> Config:
    """A preset's settings as a cell has them: agents for several tasks take more steps."""
    if len(cell.tasks) == 1:
        return config
    return _of_length(config, MULTITASK_STEPS * config.schedule.environment_steps)


def _of_length(config: Config, environment_steps: int) -> Config:
    schedule = dataclasses.replace(config.schedule, environment_steps=environment_steps)
    return dataclasses.replace(config, schedule=schedule)


def changed_settings(root: str | Path) -> tuple[str, ...]:
    """Settings of the runs under a root that are not those of the preset it is named after.

    Such as "environment_steps 30000", which stands for agents for one task.
    """
    root, found = Path(root), {}
    if root.name not in configs.PRESETS:
        return ()
    for folder in run_folders(root):
        try:
            spec = read_spec(folder)
        except (ValueError, KeyError, TypeError):
            continue  # `read_outcomes` warns of it
        config = spec.config
        if len(spec.tasks) > 1:
            config = _of_length(config, config.schedule.environment_steps // MULTITASK_STEPS)
        for text in configs.differences(config, configs.preset(root.name)):
            if not text.startswith(_OF_THE_MACHINE):
                name, _, value = text.partition(" / ")[0].partition(": ")
                found[f"{name.partition('.')[2]} {value}"] = None
    return tuple(found)


def plan_runs(cells: Iterable[Cell], config: Config, root: str | Path) -> tuple[PlannedRun, ...]:
    """The runs behind cells, each after those that it needs, and those that were cut first.

    Cells that are done, or whose run has begun, need no source any more: nothing is repeated, and
    sources that were not copied along are not missed.

    Args:
      cells: what is asked for.
      config: settings of all runs, those of a preset.
      root: the folder of all results of these settings.

    Raises:
      ValueError: a run was made with other settings; names them on both sides.
    """
    cells, root = tuple(cells), Path(root)
    held, found = _places(root)
    used: dict[str, PlannedRun] = {run.name: run for run in found.values() if not run.cells}
    missing: dict[Cell, None] = {}

    def visit(cell: Cell) -> None:
        if cell in missing:
            return
        if cell.name not in held:
            for needed in cell.needs:
                visit(needed)
            missing.setdefault(cell)
            return
        name, _ = held[cell.name]
        if name not in found:
            found[name] = _inspect(root / name)
        used[name] = found[name]
        _check_settings(root / name, found[name], config_of(cell, config))
        if found[name].needs:
            for needed in cell.needs:
                visit(needed)

    for cell in cells:
        visit(cell)
    new = _new_runs(tuple(missing), config, held, _taken_names(root))
    there = sorted(used.values(), key=lambda run: run.state != "cut")
    return _in_order([*there, *new])


def _in_order(runs: list[PlannedRun]) -> tuple[PlannedRun, ...]:
    """The runs as they are given, but each after those that it needs."""
    by_name = {run.name: run for run in runs}
    ordered: dict[str, PlannedRun] = {}

    def visit(run: PlannedRun) -> None:
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


def _places(root: Path) -> tuple[dict[str, tuple[str, int]], dict[str, PlannedRun]]:
    """Where each cell is, name -> (run, member), and the runs that do not say what they hold."""
    held, damaged = {}, {}
    for folder in run_folders(root):
        try:
            names = read_cells(folder)
        except ValueError as error:
            damaged[folder.name] = _corrupt(folder, (), error)
            continue
        for member, name in enumerate(names):
            held.setdefault(name, (folder.name, member))
    return held, damaged


def _corrupt(folder: Path, cells: tuple[str, ...], error: Exception) -> PlannedRun:
    return PlannedRun(folder.name, cells, None, state="corrupt", problem=str(error))


def _inspect(folder: Path) -> PlannedRun:
    """A run as its folder tells."""
    cells = read_cells(folder)
    try:
        spec = read_spec(folder)
        if len(spec.members) != len(cells):
            raise ValueError(f"{folder} has {len(spec.members)} agents and names {len(cells)}")
        schedule = Schedule(spec.config.schedule, len(spec.tasks))
        evaluations = _evaluations(folder)
        checkpoints = Checkpointer(folder / "checkpoints")
        if checkpoints.latest() is None:
            # Copied without checkpoints: what is evaluated to the end is done, for tables.
            done = evaluations >= schedule.evaluations
            needs = () if done else (*spec.sources, *spec.reward_sources)
            return PlannedRun(
                folder.name, cells, spec, needs, "done" if done else "cut", float(done)
            )
        counters = Counters(**checkpoints.metadata(checkpoints.latest())["counters"])
    except (ValueError, KeyError, TypeError, CorruptCheckpointError) as error:
        return _corrupt(folder, cells, error)
    done = schedule.next(counters) == "done"
    progress = counters.updates / max(1, schedule.updates)
    return PlannedRun(folder.name, cells, spec, (), "done" if done else "cut", progress)


def _evaluations(folder: Path) -> int:
    """How often each member of a run was evaluated."""
    if not (folder / "metrics.jsonl").exists():
        return 0
    rows = [row for row in read_metrics(folder) if row["kind"] == "evaluation"]
    return len({row["env_steps"] for row in rows})


def _check_settings(folder: Path, run: PlannedRun, config: Config) -> None:
    if run.spec is None:
        return
    different = [
        text
        for text in configs.differences(run.spec.config, config)
        if not text.startswith(_OF_THE_MACHINE)
    ]
    if different:
        raise ValueError(
            f"{folder} was made with other settings (there / here: {'; '.join(different)}): "
            "name another folder with --results, or move that one away"
        )


# What is missing.


def _new_runs(
    missing: tuple[Cell, ...], config: Config, held: dict[str, tuple[str, int]], taken: set[str]
) -> list[PlannedRun]:
    """Runs of the missing cells, each after those it needs.

    Args:
      missing: the cells, those that are needed before those that need them.
      config: the preset's settings.
      held: where other cells are; those of the new runs are added.
      taken: names that are not free.
    """
    groups: dict[tuple, list[Cell]] = {}
    for cell in missing:
        groups.setdefault(_group(cell), []).append(cell)
    ordered: dict[tuple, None] = {}

    def visit(key: tuple) -> None:
        for cell in groups[key]:
            for needed in cell.needs:
                if _group(needed) in groups and _group(needed) not in ordered:
                    visit(_group(needed))
        ordered.setdefault(key)

    for key in groups:
        visit(key)
    runs = []
    for key in ordered:
        for cells, spec in _populations(groups[key], config, held):
            name = _free_name(_run_name(cells), taken)
            taken.add(name)
            held.update({cell.name: (name, member) for member, cell in enumerate(cells)})
            needs = (*spec.sources, *spec.reward_sources)
            runs.append(PlannedRun(name, tuple(cell.name for cell in cells), spec, needs))
    return runs


def _group(cell: Cell) -> tuple:
    """What cells of one population share. Nothing transfers from cells of a shared one."""
    if len(cell.tasks) > 1 or cell.method == "uae":
        return ("alone", cell)
    if cell.method == "meta":
        return ("meta", cell.backend, cell.tasks, cell.source)
    return ("targets", cell.backend, cell.tasks)


def _run_name(cells: tuple[Cell, ...]) -> str:
    first = cells[0]
    words = [first.backend, "+".join(first.tasks)]
    if first.method == "scratch":
        words += ["baseline"] if len(first.tasks) == 1 else [f"seed-{first.seed}"]
    else:
        words += [first.method] + ([f"seed-{first.seed}"] if first.method == "uae" else [])
    return "-".join(words)


def _free_name(name: str, taken: set[str]) -> str:
    number, free = 2, name
    while free in taken:
        free, number = f"{name}-{number}", number + 1
    return free


def _populations(
    cells: list[Cell], config: Config, held: dict[str, tuple[str, int]]
) -> list[tuple[tuple[Cell, ...], RunSpec]]:
    """The cells of one group as populations: their cells in the order of the spec's members."""
    first = cells[0]
    tasks = tuple(task_name(first.backend, title) for title in first.tasks)
    config = config_of(first, config)
    if first.method == "uae":
        name, member = held[first.source.name]
        return [
            (tuple(cells), RunSpec(tasks, (first.seed,), config, (name,), member, method="uae"))
        ]
    if first.method == "meta":
        return [
            _meta_population(chosen, tasks, config, held)
            for chosen in _products(cells, _seed, lambda cell: len(cell.reward_sources))
        ]
    scratch = [cell for cell in cells if cell.method == "scratch"]
    targets = [cell for cell in cells if cell.method == "fractional"]
    # Sources of one population share the place of the agent in theirs.
    by_place: dict[int, list[Cell]] = {}
    for cell in targets:
        by_place.setdefault(held[cell.source.name][1], []).append(cell)
    found = []
    for place, some in by_place.items():
        for chosen in _products(some, _seed, lambda cell: cell.omega, lambda cell: cell.source):
            sources = dict.fromkeys(cell.source for cell in chosen)
            spec = RunSpec(
                tasks,
                tuple(dict.fromkeys(cell.seed for cell in chosen)),
                config,
                tuple(held[source.name][0] for source in sources),
                place,
                tuple(dict.fromkeys(cell.omega for cell in chosen)),
            )
            if scratch and {cell.seed for cell in scratch} == set(spec.seeds):
                by_seed = {cell.seed: cell for cell in scratch}
                chosen += tuple(by_seed[seed] for seed in spec.seeds)
                spec, scratch = dataclasses.replace(spec, baseline=True), []
            found.append((chosen, spec))
    if scratch:
        seeds = tuple(cell.seed for cell in scratch)
        found.append((tuple(scratch), RunSpec(tasks, seeds, config)))
    return found


def _meta_population(
    cells: tuple[Cell, ...],
    tasks: tuple[str, ...],
    config: Config,
    held: dict[str, tuple[str, int]],
) -> tuple[tuple[Cell, ...], RunSpec]:
    """Targets with meta-models of several numbers of stored models, the first of one list."""
    name, member = held[cells[0].source.name]
    stored = max((cell.reward_sources for cell in cells), key=len)
    spec = RunSpec(
        tasks,
        tuple(dict.fromkeys(cell.seed for cell in cells)),
        config,
        (name,),
        member,
        method="meta",
        reward_sources=tuple(held[cell.name][0] for cell in stored),
        reward_counts=tuple(dict.fromkeys(len(cell.reward_sources) for cell in cells)),
    )
    return cells, spec


def _seed(cell: Cell) -> int:
    return cell.seed


def _products(cells: Iterable[Cell], *axes: Callable[[Cell], Any]) -> list[tuple[Cell, ...]]:
    """Splits cells into products of their values along axes, the first axis innermost."""
    products = [[cell] for cell in cells]
    for axis in axes:
        others = [other for other in axes if other is not axis]
        merged: dict[tuple, list[Cell]] = {}
        for product in products:
            values = tuple(frozenset(map(other, product)) for other in others)
            merged.setdefault(values, []).extend(product)
        products = list(merged.values())
    for product in products:
        values = [list(dict.fromkeys(map(axis, product))) for axis in axes]
        product.sort(
            key=lambda cell, values=values: [
                known.index(axis(cell)) for axis, known in zip(axes, values, strict=True)
            ][::-1]
        )
    return [tuple(product) for product in products]
