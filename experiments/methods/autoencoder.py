"""Targets on a universal autoencoder (section 3.3.1)."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar, Literal

from experiments.methods.base import (
    Cell,
    FromSources,
    Held,
    Knowledge,
    require,
    setting,
)


@dataclass(frozen=True)
class UniversalAutoencoder(FromSources):
    """Targets with a source's frozen encoder, one per seed."""

    NAME: ClassVar[str] = "uae"
    SUMMARY: ClassVar[str] = "on a source's frozen encoder, and its decoder"

    dynamics: Literal["fresh", "copied", "frozen"] = setting(
        "fresh",
        "dynamics",
        "The latent dynamics, drawn anew, or copied from the source to train on, or copied and "
        "frozen but for the kernel of the action.",
    )

    def check_settings(self) -> None:
        """Checks the source.

        Raises:
          ValueError: with the way out.
        """
        require(
            len(self.sources) == 1,
            f"--method {self.NAME} needs the agent whose autoencoder is used: add --source DIR, "
            "one only",
        )

    def mark(self, values: Mapping[str, Any]) -> tuple[str, dict[str, Any]]:
        """The method, and what becomes of the dynamics."""
        return self.NAME, {"dynamics": self.dynamics}

    def plan(self):
        """Figure 9, without a meta-model."""
        from transfer.recipes import universal_autoencoder

        return universal_autoencoder(self.dynamics)

    def knowledge(self, agent, seeds, sources, sample) -> Knowledge:
        """The source's parameters."""
        return Knowledge(self.plan(), sources.agents[0].params)

    @classmethod
    def run_words(cls, cell: Cell) -> list[str]:
        """Each is a run of its own."""
        return [cls.NAME, f"seed-{cell.seed}"]

    @classmethod
    def group(cls, cell: Cell) -> tuple[Any, ...]:
        """Stored models are transferred from runs of their own."""
        return ("alone", cell)

    @classmethod
    def from_cells(cls, cells: Sequence[Cell], axes: Mapping[str, Sequence[Any]], held: Held):
        """From the run that holds the autoencoder."""
        name, member = held[cells[0].source.name]
        return cls(sources=(name,), source_member=member)


METHOD = UniversalAutoencoder
