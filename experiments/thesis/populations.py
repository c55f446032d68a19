"""Cells of the grid as populations: which train as one run, and in which order.

Missing cells on one task, of one method, whose trees have one shape, are one run: a population.
The targets of fractional transfer to a task (sources × fractions × seeds) and its baselines are
one, as are the targets of meta-models (numbers of sources × seeds). Source agents are runs of
their own. What is missing of a population that is partly done is split into products.
"""

import dataclasses
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import envs
from dreamer_jax.config import Config
from experiments import methods
from experiments.methods.scratch import Scratch
from experiments.runs.spec import RunSpec
from experiments.thesis.grid import Backend, Cell

MULTITASK_STEPS = 2
"""Environment steps of an agent for several tasks, in those of one for one task (section 4.2.1)."""


@dataclass(frozen=True)
class Population:
    """Cells that are to train as one run.

    Attributes:
      name: of its folder under the root of results.
      cells: in the order of the run's members.
      spec: what it is; its sources are named by their runs.
    """

    name: str
    cells: tuple[Cell, ...]
    spec: RunSpec


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
    return of_length(config, MULTITASK_STEPS * config.schedule.environment_steps)


def of_length(config: Config, environment_steps: int) -> Config:
    """Settings of a run of so many environment steps."""
    schedule = dataclasses.replace(config.schedule, environment_steps=environment_steps)
    return dataclasses.replace(config, schedule=schedule)


def new_populations(
    missing: tuple[Cell, ...], config: Config, held: dict[str, tuple[str, int]], taken: set[str]
) -> list[Population]:
    """Populations of the missing cells, each after those it needs.

    Args:
      missing: the cells, those that are needed before those that need them.
      config: the preset's settings.
      held: where other cells are; those of the new runs are added.
      taken: names that are not free; those of the new runs are added.
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
    found = []
    for key in ordered:
        for cells, spec in _specs(groups[key], config, held):
            name = _free_name(_run_name(cells[0]), taken)
            taken.add(name)
            held.update({cell.name: (name, member) for member, cell in enumerate(cells)})
            found.append(Population(name, cells, spec))
    return found


def _group(cell: Cell) -> tuple:
    return methods.named(cell.method).group(cell)


def _run_name(cell: Cell) -> str:
    """The name of a run, from its first cell."""
    words = methods.named(cell.method).run_words(cell)
    return "-".join([cell.backend, "+".join(cell.tasks), *words])


def _free_name(name: str, taken: set[str]) -> str:
    number, free = 2, name
    while free in taken:
        free, number = f"{name}-{number}", number + 1
    return free


def _specs(
    cells: Sequence[Cell], config: Config, held: Mapping[str, tuple[str, int]]
) -> list[tuple[tuple[Cell, ...], RunSpec]]:
    """The cells of one group as populations: their cells in the order of the spec's members."""
    first = cells[0]
    tasks = tuple(task_name(first.backend, title) for title in first.tasks)
    config = config_of(first, config)
    scratch = [cell for cell in cells if cell.method == Scratch.NAME]
    alike: dict[Any, list[Cell]] = {}
    for cell in cells:
        if cell not in scratch:
            shared = methods.named(cell.method).shared(cell, held)
            alike.setdefault((cell.method, shared), []).append(cell)
    found = []
    for (name, _), some in alike.items():
        for chosen, axes in _products(some, name):
            method = methods.named(name).from_cells(chosen, axes, held)
            if scratch and {cell.seed for cell in scratch} == set(axes["seed"]):
                by_seed = {cell.seed: cell for cell in scratch}
                chosen += tuple(by_seed[seed] for seed in axes["seed"])
                method, scratch = dataclasses.replace(method, baseline=True), []
            found.append((chosen, RunSpec(tasks, axes["seed"], config, method)))
    if scratch:
        seeds = tuple(cell.seed for cell in scratch)
        found.append((tuple(scratch), RunSpec(tasks, seeds, config)))
    return found


def _products(
    cells: Iterable[Cell], name: str
) -> list[tuple[tuple[Cell, ...], dict[str, tuple[Any, ...]]]]:
    """Splits cells of a method into products of values along its axes and seeds.

    Returns:
      Of each product, its cells in the order of members, and the values along each axis.
    """
    places = {cell: {**methods.named(name).coordinates(cell), "seed": cell.seed} for cell in cells}
    products = [[cell] for cell in places]
    # Seeds, the innermost axis, first.
    axes = tuple(next(iter(places.values())))[::-1]
    for axis in axes:
        merged: dict[tuple, list[Cell]] = {}
        for product in products:
            values = tuple(
                frozenset(places[cell][other] for cell in product)
                for other in axes
                if other != axis
            )
            merged.setdefault(values, []).extend(product)
        products = list(merged.values())
    found = []
    for product in products:
        along = {
            axis: tuple(dict.fromkeys(places[cell][axis] for cell in product))
            for axis in axes[::-1]
        }
        of = {tuple(places[cell].values()): cell for cell in product}
        ordered = [of[tuple(chosen.values())] for chosen in methods.combinations(along)]
        found.append((tuple(ordered), along))
    return found
