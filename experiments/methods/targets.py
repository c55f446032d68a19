"""What methods share that make targets of their own for each of several sources."""

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from experiments.methods.base import (
    Cell,
    FromSources,
    Held,
    Knowledge,
    Sources,
    require,
    setting,
)


@dataclass(frozen=True)
class Targets(FromSources):
    """Targets of one or several sources: all combinations of sources, variants and seeds."""

    baseline: bool = setting(
        False, "baseline", "Add agents from scratch, one per seed, to the transfer targets."
    )

    def check_settings(self) -> None:
        """Checks the settings that all such methods have.

        Raises:
          ValueError: with the way out.
        """
        require(
            self.sources,
            f"--method {self.NAME} needs a source agent: add --source DIR",
        )
        require(
            len(set(self.sources)) == len(self.sources),
            f"a source is named twice: {self.sources}",
        )

    @property
    def axes(self) -> dict[str, tuple[Any, ...]]:
        """Sources, outermost."""
        return {"source": self.sources}

    def mark(self, values: Mapping[str, Any]) -> tuple[str, dict[str, Any]]:
        """The method's name, and the source's where there are several."""
        return self.marked(self.NAME, {}, values["source"])

    def marked(self, label: str, tags: dict[str, Any], source: str) -> tuple[str, dict[str, Any]]:
        """A label and columns with what tells the targets of several sources apart."""
        if len(self.sources) == 1:
            return label, tags
        names = [Path(one).name for one in self.sources]
        name = Path(source).name if len(set(names)) == len(names) else source
        return f"{label} from {name}", tags | {"source": name}

    def from_sources(
        self, plan, seeds: Sequence[int], sources: Sources, fresh: Any, **parameters
    ) -> Knowledge:
        """What a plan reads of each target's own source.

        Leaves that the plan does not read are left out: sources may differ in their shapes.

        Raises:
          ValueError: a leaf that is read has another shape in another source.
        """
        import numpy as np

        import transfer

        claims = transfer.claims(plan, fresh).items()
        read = [path for path, rule in claims if rule.operation != "keep"]
        flat = [transfer.flatten(source.params) for source in sources.agents]
        for path in read:
            for source, leaves in zip(sources.agents, flat, strict=True):
                shapes = [np.shape(x[path]) if path in x else "absent" for x in (flat[0], leaves)]
                require(
                    shapes[0] == shapes[1],
                    f"{path} is {shapes[0]} in the source {sources.agents[0].directory} and "
                    f"{shapes[1]} in {source.directory}: targets of one population need sources of "
                    "one shape",
                )
        stacked = {path: np.stack([x[path] for x in flat]) for path in read if path in flat[0]}
        own = [self.sources.index(values["source"]) for values in self.targets(seeds)]
        return Knowledge(plan, stacked, own, parameters)

    @staticmethod
    def unfit(fresh: Any, sources: Sources) -> tuple[str, ...]:
        """Paths of the leaves that no source has in the target's shape.

        Args:
          fresh: shapes of a target's parameters.
          sources: the agents that are read.
        """
        import numpy as np

        import transfer

        flat = [transfer.flatten(source.params) for source in sources.agents]
        return tuple(
            path
            for path, leaf in transfer.flatten(fresh).items()
            if not any(path in x and np.shape(x[path]) == leaf.shape for x in flat)
        )

    @classmethod
    def cell_words(cls, cell: Cell) -> list[str]:
        """The source's tasks."""
        return ["from", "+".join(cell.source.tasks)]

    @classmethod
    def shared(cls, cell: Cell, held: Held) -> Any:
        """Sources of one population share the place of the agent in theirs."""
        return held[cell.source.name][1]

    @classmethod
    def coordinates(cls, cell: Cell) -> dict[str, Any]:
        """Its source."""
        return {"source": cell.source}

    @classmethod
    def from_cells(cls, cells: Sequence[Cell], axes: Mapping[str, Sequence[Any]], held: Held):
        """From the runs that hold the sources."""
        return cls(**cls.source_settings(axes, held))

    @classmethod
    def source_settings(cls, axes: Mapping[str, Sequence[Any]], held: Held) -> dict[str, Any]:
        """The settings that name the sources of cells."""
        places = [held[source.name] for source in axes["source"]]
        return {"sources": tuple(name for name, _ in places), "source_member": places[0][1]}


OF_ACTIONS = ("dynamics/action_in/*", "actor/out/*")
"""What is of the actions' size, in every agent."""


@dataclass(frozen=True)
class CopiedTargets(Targets):
    """Targets that begin as their sources, as far as shapes fit."""

    def plan(self, unfit: Collection[str] = OF_ACTIONS):
        """What is copied and what is drawn anew.

        Args:
          unfit: patterns of the leaves that the sources have in another shape, or not at all.
        """
        raise NotImplementedError

    def knowledge(self, agent, seeds, sources, sample):
        """Each target's source, as far as it fits."""
        fresh = agent.parameter_shapes()
        plan = self.plan(self.unfit(fresh, sources))
        return self.from_sources(plan, seeds, sources, fresh)
