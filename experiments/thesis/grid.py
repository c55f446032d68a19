"""The thesis's grid as data: targets and their sources, tables, figures, and the agents they need.

Sections 4.2.1, 4.3.1 and 4.4.1. A cell is one agent: how it is trained, on what, and from what.
Tables and figures name the cells that they show; cells name the cells that they transfer from, so
the whole is a graph in which each agent occurs once, whoever asks for it.
"""

import dataclasses
from collections.abc import Container, Iterable, Sequence
from dataclasses import dataclass
from typing import Literal, TypeVar

from experiments import methods

TASKS = ("HalfCheetah", "Hopper", "Walker2D", "InvertedPendulum", "InvertedDoublePendulum", "Ant")
"""Titles of the six tasks, in the order of the thesis's tables."""

SOURCES = {
    "HalfCheetah": ("Hopper", "Ant", "Walker2D", "InvertedPendulum"),
    "Hopper": ("HalfCheetah", "Walker2D", "Ant", "InvertedPendulum"),
    "Walker2D": ("HalfCheetah", "Hopper", "Ant", "InvertedPendulum"),
    "InvertedPendulum": ("HalfCheetah", "InvertedDoublePendulum", "Hopper", "Ant"),
    "InvertedDoublePendulum": ("Hopper", "InvertedPendulum", "Walker2D", "Ant"),
    "Ant": ("HalfCheetah", "Walker2D", "Hopper", "InvertedPendulum"),
}
"""Each target's sources: its agents of 2, 3 and 4 source tasks use the first so many."""

COUNTS = (2, 3, 4)
"""Numbers of source tasks."""
OMEGAS = (0.0, 0.1, 0.2, 0.3, 0.4, 0.5)
"""Fractions of equation 19."""
SEEDS = (0, 1, 2)
"""Seeds of targets and baselines; a source agent is a single run, of the first of them."""
THRESHOLDS = (50.0, 70.0, 90.0)
"""Thresholds ξ of latent task classification, for M = 230 latent features."""
AUTOENCODER = ("Hopper", "Ant")
"""The tasks of the agent whose autoencoder is the universal one (section 4.3.1)."""

Backend = Literal["bullet", "brax"]
Metric = Literal["overall", "final"]


@dataclass(frozen=True)
class Cell:
    """One agent of the grid.

    Attributes:
      backend: the simulator.
      tasks: titles of the tasks it is trained on, in the order of `TASKS`.
      method: the name of one of `experiments.methods`.
      seed: of the agent and of its simulators.
      source: the agent whose parameters are transferred.
      omega: the fraction of equation 19.
      reward_sources: the agents whose reward models a meta-model reads, in order.
    """

    backend: Backend
    tasks: tuple[str, ...]
    method: str
    seed: int
    source: "Cell | None" = None
    omega: float | None = None
    reward_sources: tuple["Cell", ...] = ()

    @property
    def name(self) -> str:
        """A name that no other cell has."""
        words = [self.backend, "+".join(self.tasks), self.method]
        words += methods.named(self.method).cell_words(self)
        if self.source is not None:
            words.append(f"source-seed={self.source.seed}")
        return " ".join([*words, f"seed={self.seed}"])

    @property
    def needs(self) -> tuple["Cell", ...]:
        """The cells that it transfers from."""
        return (*([self.source] if self.source else []), *self.reward_sources)


@dataclass(frozen=True)
class ReturnsTable:
    """What a table of returns shows.

    Attributes:
      name: such as "table-3".
      kind: "ftl" (fractional transfer to one target) or "meta" (reward meta-models for all
        targets).
      targets: titles of the target tasks.
      metric: of the returns, see section 4.2.3.
      counts: numbers of source tasks.
      omegas: fractions.
      backend: the simulator.
      compared: names of other methods, from the same sources, shown beside those of the thesis in
        tables of fractional transfer.
    """

    name: str
    kind: Literal["ftl", "meta"]
    targets: tuple[str, ...]
    metric: Metric
    counts: tuple[int, ...] = COUNTS
    omegas: tuple[float, ...] = OMEGAS
    backend: Backend = "bullet"
    compared: tuple[str, ...] = ()


@dataclass(frozen=True)
class LatentTable:
    """What a table of latent task classification shows.

    Attributes:
      name: such as "table-13".
      novel: titles of the tasks that the classifier has not seen.
      known: titles of those that it was fitted on.
      backend: the simulator.
    """

    name: str
    novel: tuple[str, ...]
    known: tuple[str, ...]
    backend: Backend = "bullet"

    @property
    def tasks(self) -> tuple[str, ...]:
        """All of them, in the order of the columns."""
        return (*self.novel, *self.known)


Table = ReturnsTable | LatentTable


@dataclass(frozen=True)
class Figure:
    """What a figure of the thesis shows.

    Attributes:
      name: such as "figure-12".
      kind: "tasks" (their pictures), "ftl", "meta" (learning curves of targets beside baselines),
        "baselines", or "multitask" (a source agent on all its tasks, beside their baselines).
      tasks: titles: of the pictures, of the target, of the baselines, of the source agent.
      counts: numbers of source tasks.
      omegas: fractions.
      backend: the simulator.
    """

    name: str
    kind: Literal["tasks", "ftl", "meta", "baselines", "multitask"]
    tasks: tuple[str, ...]
    counts: tuple[int, ...] = ()
    omegas: tuple[float, ...] = OMEGAS
    backend: Backend = "bullet"


_METRICS: tuple[Metric, ...] = ("overall", "final")

# Novel and known tasks of section 4.3.1, in the order of the tables' columns.
_SPLITS = (
    (
        ("HalfCheetah", "InvertedDoublePendulum"),
        ("Hopper", "Walker2D", "Ant", "InvertedPendulum"),
    ),
    (
        ("Hopper", "Walker2D"),
        ("HalfCheetah", "InvertedPendulum", "InvertedDoublePendulum", "Ant"),
    ),
    (
        ("Ant", "InvertedPendulum"),
        ("Hopper", "Walker2D", "InvertedDoublePendulum", "HalfCheetah"),
    ),
)

# Tables 16 and 17 name Walker2D after InvertedPendulum.
_META_TARGETS = (
    "HalfCheetah",
    "Hopper",
    "InvertedPendulum",
    "Walker2D",
    "InvertedDoublePendulum",
    "Ant",
)

_TABLES: tuple[Table, ...] = (
    *(
        ReturnsTable(f"table-{2 * i + j + 1}", "ftl", (target,), metric)
        for i, target in enumerate(TASKS)
        for j, metric in enumerate(_METRICS)
    ),
    *(LatentTable(f"table-{13 + i}", novel, known) for i, (novel, known) in enumerate(_SPLITS)),
    *(
        ReturnsTable(f"table-{16 + i}", "meta", _META_TARGETS, metric)
        for i, metric in enumerate(_METRICS)
    ),
)
TABLES = {table.name: table for table in _TABLES}
"""Tables 1 to 17 by name."""

FIGURES = {
    figure.name: figure
    for figure in (
        Figure("figure-10", "tasks", ("HalfCheetah", "Hopper", "Walker2D", "Ant")),
        Figure("figure-11", "tasks", ("InvertedPendulum", "InvertedDoublePendulum")),
        *(
            Figure(f"figure-{12 + 3 * i + j}", "ftl", (target,), (count,))
            for i, target in enumerate(TASKS)
            for j, count in enumerate(COUNTS)
        ),
        *(Figure(f"figure-{30 + i}", "meta", (target,), COUNTS) for i, target in enumerate(TASKS)),
        Figure("figure-36", "baselines", TASKS),
        Figure("figure-37", "multitask", ("InvertedPendulum", "Hopper")),
        Figure("figure-38", "multitask", ("InvertedPendulum", "Walker2D", "Hopper")),
        Figure("figure-39", "multitask", ("InvertedPendulum", "Walker2D", "Hopper", "Ant")),
    )
}
"""Figures 10 to 39 by name. Figures 1 to 9 are diagrams."""


def baseline(backend: Backend, task: str, seed: int) -> Cell:
    """An agent from scratch on one task."""
    return Cell(backend, (task,), "scratch", seed)


def multitask(backend: Backend, tasks: Iterable[str], seed: int) -> Cell:
    """A source agent on several tasks, the same whatever order they are named in."""
    tasks = set(tasks)
    return Cell(backend, tuple(task for task in TASKS if task in tasks), "scratch", seed)


def fractional(
    backend: Backend, target: str, count: int, omega: float, seed: int, source: int
) -> Cell:
    """A target of fractional transfer from `count` tasks; `source` is the source agent's seed."""
    agent = multitask(backend, SOURCES[target][:count], source)
    return Cell(backend, (target,), "fractional", seed, agent, omega)


def on_autoencoder(backend: Backend, task: str, source: int) -> Cell:
    """A single-source agent on the universal autoencoder, which a meta-model's target reads."""
    return Cell(backend, (task,), "uae", source, multitask(backend, AUTOENCODER, source))


def meta(backend: Backend, target: str, count: int, seed: int, source: int) -> Cell:
    """A target with a reward meta-model over `count` stored reward models."""
    stored = tuple(on_autoencoder(backend, task, source) for task in SOURCES[target][:count])
    autoencoder = multitask(backend, AUTOENCODER, source)
    return Cell(backend, (target,), "meta", seed, autoencoder, reward_sources=stored)


def compared(
    backend: Backend, target: str, count: int, method: str, seed: int, source: int
) -> Cell:
    """A target that another method makes of the agent of `count` tasks."""
    agent = multitask(backend, SOURCES[target][:count], source)
    return Cell(backend, (target,), method, seed, agent)


Shown = TypeVar("Shown", bound=ReturnsTable | LatentTable | Figure)
"""A table or figure."""

# --- what is shown --------------------------------------------------------------------------------

Key = tuple[str, int | None, float | str | None]
"""Which entry of a table of returns: the target; the number of source tasks, None for the baseline;
the fraction, or the name of the method where it is not the table's own."""


def entries(table: ReturnsTable, seeds: Sequence[int] = SEEDS) -> dict[Key, tuple[Cell, ...]]:
    """The cells of each entry of a table of returns, one per seed; a target's baseline first."""
    backend, source = table.backend, seeds[0]
    found: dict[Key, tuple[Cell, ...]] = {}
    for target in table.targets:
        found[target, None, None] = _baselines(backend, target, seeds)
        if table.kind == "meta":
            for count in table.counts:
                found[target, count, None] = tuple(
                    meta(backend, target, count, seed, source) for seed in seeds
                )
            continue
        for omega in table.omegas:
            for count in table.counts:
                found[target, count, omega] = tuple(
                    fractional(backend, target, count, omega, seed, source) for seed in seeds
                )
        for method in table.compared:
            for count in table.counts:
                found[target, count, method] = tuple(
                    compared(backend, target, count, method, seed, source) for seed in seeds
                )
    return found


def panels(
    figure: Figure, seeds: Sequence[int] = SEEDS
) -> dict[tuple[str, int | float | None], tuple[tuple[Cell, ...], ...]]:
    """The cells of each panel of a figure of learning curves.

    Returns:
      Title of the panel's task, and the fraction or number of sources, if they differ -> the cells
      of each of its lines, one per seed: the transfers or the source agent, then the baseline.
    """
    backend, source = figure.backend, seeds[0]
    base = {task: _baselines(backend, task, seeds) for task in figure.tasks}
    if figure.kind == "tasks":
        return {}
    if figure.kind == "baselines":
        return {(task, None): (base[task],) for task in figure.tasks}
    if figure.kind == "multitask":
        agent = (multitask(backend, figure.tasks, source),)
        return {(task, None): (agent, base[task]) for task in figure.tasks}
    (task,) = figure.tasks
    if figure.kind == "meta":
        return {
            (task, count): (
                tuple(meta(backend, task, count, seed, source) for seed in seeds),
                base[task],
            )
            for count in figure.counts
        }
    (count,) = figure.counts
    return {
        (task, omega): (
            tuple(fractional(backend, task, count, omega, seed, source) for seed in seeds),
            base[task],
        )
        for omega in figure.omegas
    }


def _baselines(backend: Backend, task: str, seeds: Sequence[int]) -> tuple[Cell, ...]:
    return tuple(baseline(backend, task, seed) for seed in seeds)


def shown(entry: Table | Figure, seeds: Sequence[int] = SEEDS) -> tuple[Cell, ...]:
    """The cells that a table or figure shows, each once, baselines last.

    A table of latent task classification shows samples of one agent; figures of the tasks none.
    """
    if isinstance(entry, LatentTable):
        return (multitask(entry.backend, AUTOENCODER, seeds[0]),)
    if isinstance(entry, ReturnsTable):
        groups = list(entries(entry, seeds).values())
    else:
        groups = [cells for lines in panels(entry, seeds).values() for cells in lines]
    cells = dict.fromkeys(cell for group in groups for cell in group)
    # Those that are made from others come first; a source agent is no baseline.
    return tuple(sorted(cells, key=lambda cell: cell.source is None and len(cell.tasks) == 1))


def may_be_compared() -> tuple[str, ...]:
    """Names of the methods that tables of fractional transfer may show beside their own."""
    return tuple(name for name, method in methods.known().items() if method.COMPARED)


def beside(entry: Shown, compared: tuple[str, ...]) -> Shown:
    """A table of fractional transfer with rows of other methods; anything else as it is."""
    if isinstance(entry, ReturnsTable) and entry.kind == "ftl":
        return dataclasses.replace(entry, compared=compared)
    return entry


def restricted(entry: Shown, omegas: Container[float], counts: Container[int]) -> Shown:
    """A table or figure of some fractions and numbers of source tasks only."""
    if isinstance(entry, LatentTable):
        return entry
    return dataclasses.replace(
        entry,
        omegas=tuple(omega for omega in entry.omegas if omega in omegas),
        counts=tuple(count for count in entry.counts if count in counts),
    )


def with_compared(entry: Shown, held: Container[str], seeds: Sequence[int] = SEEDS) -> Shown:
    """A table with the rows of all methods of comparison of which there are cells.

    Args:
      entry: a table; anything else is given back as it is.
      held: names of the cells that are there.
      seeds: see `entries`.
    """
    if not isinstance(entry, ReturnsTable):
        return entry
    whole = beside(entry, may_be_compared())
    there = {
        variant
        for (_, _, variant), cells in entries(whole, seeds).items()
        if any(cell.name in held for cell in cells)
    }
    return beside(entry, tuple(x for x in whole.compared if x in there or x in entry.compared))


def closure(cells: Iterable[Cell]) -> tuple[Cell, ...]:
    """The cells and all that they need, each once, what is needed before what needs it."""
    ordered: dict[Cell, None] = {}

    def visit(cell: Cell) -> None:
        for needed in cell.needs:
            visit(needed)
        ordered.setdefault(cell)

    for cell in cells:
        visit(cell)
    return tuple(ordered)


def on_backend(entry: Shown, backend: Backend) -> Shown:
    """The same table or figure on another simulator."""
    return dataclasses.replace(entry, backend=backend)
