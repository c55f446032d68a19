"""Records of experience: one type, from the simulators through the replay to the losses."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple


class Records(NamedTuple):
    """Record t holds image t and the action and reward that led to it.

    The leading axes "..." say what they are records of: [T + 1] of a phase, [B, L] of a batch of
    sequences, with [P] or [P, K] before them those of a population. Fields are NumPy or JAX arrays.

    Attributes:
      image: uint8 [..., size, size, 3].
      action: float32 [..., A]; zero where `first`.
      reward: float32 [...]; zero where `first`.
      first: bool [...], the record is a reset.
      terminal: bool [...], the episode ended here (it was not merely cut).
    """

    image: Any
    action: Any
    reward: Any
    first: Any
    terminal: Any

    def map(self, function: Callable[[Any], Any]) -> Records:
        """The records with `function` of each field in its place."""
        return Records(*map(function, self))

    def at(self, *index: Any) -> Records:
        """Those at an index of the leading axes, one entry (a number, a slice) for each axis."""
        return self.map(lambda x: x[index])
