"""What a run does next, as a function of how far it has come (thesis algorithm 3, 3.2.1).

A round is one phase of each task; then come the updates that are due, and an evaluation when the
environment steps pass a multiple of `evaluate_every`.
"""

import math
from dataclasses import dataclass
from typing import Literal

from dreamer_jax.config import ScheduleConfig


@dataclass(frozen=True)
class Counters:
    """How far a run has come.

    Attributes:
      rounds: rounds collected, prefill included; a round is one phase of each task.
      updates: updates made.
      evaluations: multiples of `evaluate_every` that have been evaluated.
      averaged: updates in the running sums of metrics.
    """

    rounds: int = 0
    updates: int = 0
    evaluations: int = 0
    averaged: int = 0


Action = Literal["prefill", "update", "evaluate", "collect", "done"]


@dataclass(frozen=True)
class Schedule:
    """Which action is next, in a run over `tasks` tasks."""

    config: ScheduleConfig
    tasks: int

    @property
    def prefill_rounds(self) -> int:
        """Rounds of random actions: the configured phases, or one of each of several tasks."""
        return self.config.prefill_phases if self.tasks == 1 else 1

    @property
    def rounds(self) -> int:
        """Rounds of the whole run."""
        return max(
            self.prefill_rounds,
            math.ceil(self.config.environment_steps / self.environment_steps(1)),
        )

    @property
    def updates(self) -> int:
        """Updates of the whole run."""
        return self.updates_due(self.rounds)

    def environment_steps(self, rounds: int) -> int:
        """Environment steps of `rounds` rounds, summed over tasks."""
        return rounds * self.tasks * self.config.phase_environment_steps

    def updates_due(self, rounds: int) -> int:
        """Updates that should have been made after `rounds` rounds."""
        trained = max(0, rounds - self.prefill_rounds + 1)
        return trained * self.tasks * self.config.updates_per_phase

    @property
    def evaluations(self) -> int:
        """Evaluations of one member in the whole run; a round that crosses several multiples of
        `evaluate_every` is followed by one."""
        steps, every = self.environment_steps(1), self.config.evaluate_every
        if steps >= every:  # after every round
            return self.rounds - self.prefill_rounds + 1
        first, last = (
            self.environment_steps(r) // every for r in (self.prefill_rounds, self.rounds)
        )
        return last - first + (1 if first else 0)

    def next(self, done: Counters) -> Action:
        """What to do after what is done."""
        if done.rounds < self.prefill_rounds:
            return "prefill"
        if done.updates < self.updates_due(done.rounds):
            return "update"
        steps = self.environment_steps(done.rounds)
        if done.evaluations < steps // self.config.evaluate_every:
            return "evaluate"
        return "collect" if done.rounds < self.rounds else "done"
