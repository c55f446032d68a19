"""Training from scratch: no transfer."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar

from experiments.methods.base import BASELINE, Cell, Method


@dataclass(frozen=True)
class Scratch(Method):
    """Agents that begin with random parameters, one per seed."""

    NAME: ClassVar[str] = "scratch"
    SUMMARY: ClassVar[str] = "no source"

    def mark(self, values: Mapping[str, Any]) -> tuple[str, dict[str, Any]]:
        """They are the baseline of others."""
        return BASELINE, {}

    @classmethod
    def run_words(cls, cell: Cell) -> list[str]:
        """Agents for several tasks are sources, each a run of its own."""
        return [BASELINE] if len(cell.tasks) == 1 else [f"seed-{cell.seed}"]

    @classmethod
    def group(cls, cell: Cell) -> tuple[Any, ...]:
        """Baselines join the targets on their task."""
        return ("alone", cell) if len(cell.tasks) > 1 else ("targets", cell.backend, cell.tasks)


METHOD = Scratch
