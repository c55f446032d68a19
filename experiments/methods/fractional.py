"""Fractional transfer learning (section 3.2)."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

from dreamer_jax.ranges import Range
from experiments.methods.base import Cell, Held, require, setting
from experiments.methods.targets import Targets


@dataclass(frozen=True)
class FractionalTransfer(Targets):
    """One target per source, fraction of equation 19 and seed."""

    NAME: ClassVar[str] = "fractional"
    SUMMARY: ClassVar[str] = (
        "all but what handles actions copied, a fraction of the last layers added"
    )

    omegas: tuple[float, ...] = setting(
        (),
        "omega",
        "Fractions of the source's last reward and value layers to add (0 to 1).",
        allowed=Range(0, 1),
    )
    fractions: tuple[str, ...] = setting(
        ("reward", "value", "termination"),
        "fractions",
        "The components whose last layer a fraction is transferred of (any of reward, value, "
        "termination, dynamics, actor); the last layers of the other heads are drawn anew.",
    )

    def check_settings(self) -> None:
        """Checks sources and fractions.

        Raises:
          ValueError: with the way out.
        """
        require(self.sources or not self.omegas, "--omega needs a source agent: add --source DIR")
        super().check_settings()
        require(self.omegas, "--source needs the fractions to transfer: add --omega 0 0.2")
        require(
            all(0 <= omega <= 1 for omega in self.omegas),
            f"omega {self.omegas} must lie in [0, 1] (equation 19)",
        )
        self.plan()

    @property
    def axes(self) -> dict[str, tuple[Any, ...]]:
        """Sources, and fractions within them."""
        return {**super().axes, "omega": self.omegas}

    def mark(self, values: Mapping[str, Any]) -> tuple[str, dict[str, Any]]:
        """The fraction, and the source where there are several."""
        omega = values["omega"]
        return self.marked(f"omega={omega:g}", {"omega": omega}, values["source"])

    def plan(self):
        """Figure 8; ω is left open."""
        from transfer.recipes import fractional_transfer

        return fractional_transfer(fractions=self.fractions)

    def knowledge(self, agent, seeds, sources, sample):
        """Each target's source and fraction."""
        fresh = agent.parameter_shapes()
        omegas = [values["omega"] for values in self.targets(seeds)]
        return self.from_sources(self.plan(), seeds, sources, fresh, omega=omegas)

    @classmethod
    def cell_words(cls, cell: Cell) -> list[str]:
        """The source's tasks and the fraction."""
        return [*super().cell_words(cell), f"omega={cell.omega:g}"]

    @classmethod
    def group(cls, cell: Cell) -> tuple[Any, ...]:
        """Baselines on the same task join."""
        return ("targets", cell.backend, cell.tasks)

    @classmethod
    def coordinates(cls, cell: Cell) -> dict[str, Any]:
        """Its source and fraction."""
        return {**super().coordinates(cell), "omega": cell.omega}

    @classmethod
    def from_cells(cls, cells: Sequence[Cell], axes: Mapping[str, Sequence[Any]], held: Held):
        """From the runs that hold the sources."""
        return cls(**cls.source_settings(axes, held), omegas=tuple(axes["omega"]))


METHOD = FractionalTransfer
