"""What a method of transfer answers.

A method is a value: a frozen dataclass whose fields are its settings. Its options on the command
line, its part of a run's settings on disk and its rows of the thesis's grid are made from it, so
that a new one is a new file in this folder, which names its class as METHOD.

What takes long to import (JAX, the agent, `transfer`) is imported where it is used: the command
line reads all methods before it knows what is asked for.

Axis letters: P population member, N source or stored model.
"""

import dataclasses
import itertools
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, NamedTuple, Protocol

from dreamer_jax.ranges import Range

if TYPE_CHECKING:
    import transfer
    from dreamer_jax.agent import Agent
    from dreamer_jax.population import Member

BASELINE = "baseline"
"""The label of agents from scratch."""


SOURCE_HELP = (
    "The agent to transfer from: a results folder, a .safetensors file that `export` wrote, or "
    "zoo:NAME (`zoo` lists them). Several, but for uae and meta: each has targets of its own in "
    "the population."
)


def setting(
    default: Any, option: str, help: str, *, folder: bool = False, allowed: Range | None = None
) -> Any:
    """A field of a method that is also an option of the command line.

    Args:
      default: where nothing is given.
      option: its name on the command line, without dashes before it.
      help: what it is.
      folder: whether it names results folders.
      allowed: the range of a number, or of the numbers in a tuple.
    """
    metadata = {"option": option, "help": help, "folder": folder}
    if allowed is not None:
        metadata["range"] = allowed
    return dataclasses.field(default=default, metadata=metadata)


def require(condition: Any, message: str) -> None:
    """Raises ValueError with a message unless a condition holds."""
    if not condition:
        raise ValueError(message)


def combinations(axes: Mapping[str, Iterable[Any]]) -> list[dict[str, Any]]:
    """All combinations of the values along axes, those of the last axis following one another.

    This is the order of the members of every population, seeds being the last axis.
    """
    return [dict(zip(axes, values, strict=True)) for values in itertools.product(*axes.values())]


class SourceAgent(Protocol):
    """One trained agent that knowledge is taken from.

    Attributes:
      directory: its results folder.
      spec: what that run is; its `method` and `tasks` count here.
      params: its parameters.
    """

    directory: Path
    spec: Any
    params: dict[str, Any]


@dataclass(frozen=True)
class Sources:
    """All agents that a run takes knowledge from.

    Attributes:
      agents: those that parameters are transferred from, one for each of a method's `sources`.
      stored: those whose models are read as they are, one for each of a method's `stored`.
    """

    agents: tuple[Any, ...]
    stored: tuple[Any, ...] = ()


class Knowledge(NamedTuple):
    """What a method hands to `transfer.apply` for its targets.

    Attributes:
      plan: what happens to each leaf.
      source: the tree or trees that are read.
      own: for each target, its place on the leading axis of the source's leaves; None where all
        targets read the same.
      parameters: values of the plan, one for each target.
      stacked: which of the source's trees have leaves for each target, on a leading axis.
    """

    plan: "transfer.Plan"
    source: Any
    own: Sequence[int] | None = None
    parameters: Mapping[str, Sequence[float]] = {}
    stacked: tuple[str, ...] = ()


class Cell(Protocol):
    """An agent of a grid, as methods see it: see `experiments.thesis.grid.Cell`."""

    @property
    def name(self) -> str: ...
    @property
    def backend(self) -> str: ...
    @property
    def tasks(self) -> tuple[str, ...]: ...
    @property
    def method(self) -> str: ...
    @property
    def seed(self) -> int: ...
    @property
    def source(self) -> Any: ...
    @property
    def omega(self) -> float | None: ...
    @property
    def reward_sources(self) -> tuple[Any, ...]: ...


Held = Mapping[str, tuple[str, int]]
"""Where the cells of a grid are: name -> (folder, member)."""


@dataclass(frozen=True)
class Method:
    """How the agents of a run begin and what of them is trained. Itself it transfers nothing."""

    NAME: ClassVar[str]
    """On the command line, in run.json and in the names of cells."""
    SUMMARY: ClassVar[str]
    """What it is, for the command line's help."""
    COMPARED: ClassVar[bool] = False
    """Whether tables of fractional transfer may show it beside their own: then a cell is made from
    its source alone."""

    # Those that are settings of a method are fields there.

    @property
    def sources(self) -> tuple[str, ...]:
        """Folders of the runs whose agents are transferred."""
        return ()

    @property
    def source_member(self) -> int:
        """Which member of each source's population."""
        return 0

    @property
    def stored(self) -> tuple[str, ...]:
        """Folders of the runs whose models are read as they are."""
        return ()

    @property
    def baseline(self) -> bool:
        """Whether agents from scratch, one per seed, join the targets."""
        return False

    @property
    def needs(self) -> tuple[str, ...]:
        """Folders of all runs that must be there before this one begins."""
        return (*self.sources, *self.stored)

    @property
    def axes(self) -> dict[str, tuple[Any, ...]]:
        """What members differ in beside their seeds, outermost first."""
        return {}

    def targets(self, seeds: Sequence[int]) -> list[dict[str, Any]]:
        """The values along the axes, and the seed, of each target in the population's order."""
        return combinations({**self.axes, "seed": seeds})

    def members(self, seeds: Sequence[int]) -> "tuple[Member, ...]":
        """The population: one target for each combination and seed; then the baseline."""
        from dreamer_jax.population import Member

        scratch = [Member(seed, BASELINE) for seed in seeds] if self.baseline else []
        marked = [(values["seed"], *self.mark(values)) for values in self.targets(seeds)]
        return (*(Member(seed, label, tags) for seed, label, tags in marked), *scratch)

    def mark(self, values: Mapping[str, Any]) -> tuple[str, dict[str, Any]]:
        """The label of a target with these values along the axes, and its columns of metrics."""
        return self.NAME, {}

    def plan(self) -> "transfer.Plan | None":
        """What happens to each leaf of a fresh agent, and what of it stays frozen."""
        return None

    def modules(self, agent: "Agent") -> tuple[tuple[str, Any], ...]:
        """Networks that take the place of an agent's components, by name."""
        return ()

    def check_sources(self, sources: Sources, fresh: Any) -> None:
        """Checks that the sources serve this method.

        Args:
          sources: all of them, whose networks are of the target's sizes.
          fresh: shapes of a target's parameters.

        Raises:
          ValueError: naming the source that does not.
        """

    def knowledge(
        self,
        agent: "Agent",
        seeds: Sequence[int],
        sources: Sources,
        sample: Callable[[Any, int], Any],
    ) -> Knowledge:
        """What is transferred to the targets.

        Args:
          agent: the functions of the run's agents.
          seeds: of the targets.
          sources: from the folders of `sources` and `stored`.
          sample: gives latent states of a source on each of its tasks, at least so many.

        Raises:
          ValueError: the sources do not fit what the method reads.
        """
        raise NotImplementedError(f"--method {self.NAME} transfers nothing")

    # How cells of a grid become populations.

    @classmethod
    def cell_words(cls, cell: Cell) -> list[str]:
        """What sets a cell's name apart from others of its tasks, method and seeds."""
        return []

    @classmethod
    def run_words(cls, cell: Cell) -> list[str]:
        """The end of the name of a run of such cells."""
        return [cls.NAME]

    @classmethod
    def group(cls, cell: Cell) -> tuple[Any, ...]:
        """What cells share that may be members of one population."""
        return (cls.NAME, cell.backend, cell.tasks)

    @classmethod
    def shared(cls, cell: Cell, held: Held) -> Any:
        """What cells of one group must also share, once it is known where their sources are."""
        return None

    @classmethod
    def coordinates(cls, cell: Cell) -> dict[str, Any]:
        """A cell's values along `axes`, in their order."""
        return {}

    @classmethod
    def from_cells(cls, cells: Sequence[Cell], axes: Mapping[str, Sequence[Any]], held: Held):
        """The method of a population of cells.

        Args:
          cells: all of them.
          axes: their coordinates, each value once.
          held: where their sources are.
        """
        return cls()


@dataclass(frozen=True)
class FromSources(Method):
    """A method that begins from trained agents; `check_settings` checks its settings."""

    sources: tuple[str, ...] = setting((), "source", SOURCE_HELP, folder=True)
    source_member: int = setting(
        0,
        "source-member",
        "Which member of each source's population.",
        allowed=Range(0, 10**6),
    )

    def __post_init__(self):
        self.check_settings()

    def check_settings(self) -> None:
        """Checks the method's settings.

        Raises:
          ValueError: with the way out.
        """
        raise NotImplementedError
