"""What is measured on a card: parts, the cases of each, and its share of the time.

Axis letters: P population member.
"""

from dataclasses import dataclass

MINUTES = 20.0
"""All parts together."""


@dataclass(frozen=True)
class Sizes:
    """How large everything is.

    Attributes:
      preset: settings of the agents, but for the run that learns.
      task: what they play.
      populations: P of updates.
      rollouts: P of rollouts.
      ticks: agent steps of a rollout.
      seconds: how long updates and rollouts are repeated, three times at least.
      rounds: how many are timed, after one that compiles.
      turns: of ours and of the peer.
      learning: preset of the run that learns.
      seeds: of that run.
    """

    preset: str
    task: str
    populations: tuple[int, ...]
    rollouts: tuple[int, ...]
    ticks: int
    seconds: float
    rounds: int
    turns: int
    learning: str
    seeds: tuple[int, ...]


SIZES = {
    "thesis": Sizes(
        preset="thesis",
        task="brax/hopper",
        populations=(1, 3, 9, 18, 57),
        rollouts=(1, 4, 16, 64, 256, 1024),
        ticks=100,
        seconds=2.0,
        rounds=3,
        turns=3,
        learning="cpu",
        seeds=(0, 1, 2),
    ),
    # Of the smallest, and little of each, so that all of it runs in a few minutes of one core.
    "debug": Sizes(
        preset="debug",
        task="brax/inverted_pendulum",
        populations=(2,),
        rollouts=(2,),
        ticks=20,
        seconds=0.0,
        rounds=1,
        turns=1,
        learning="debug",
        seeds=(0,),
    ),
}

LEARNING_TASK = "brax/inverted_pendulum"

ONE_PROGRAM, DISPATCHES = "one program", "a dispatch for each update"
"""The two ways of a round."""


@dataclass(frozen=True)
class Part:
    """What one process measures, case after case.

    Attributes:
      name: such as "update float32".
      cases: in the order in which they are measured; memory grows along them.
      share: of all of the time. What a part does not need the next ones have.
    """

    name: str
    cases: tuple[str, ...]
    share: float


def parts(sizes: Sizes) -> tuple[Part, ...]:
    """All parts, in the order in which they are measured."""
    populations, rollouts = (
        tuple(f"P={members}" for members in several)
        for several in (sizes.populations, sizes.rollouts)
    )
    return (
        Part("update float32", populations, 0.16),
        Part("update bfloat16", populations, 0.14),
        Part("peer", ("P=1",), 0.06),
        Part("rollout", rollouts, 0.10),
        Part("round", (ONE_PROGRAM, DISPATCHES), 0.16),
        Part("learning", (LEARNING_TASK,), 0.38),
    )


def members_of(case: str) -> int:
    """P of a case that is named by it."""
    return int(case.removeprefix("P="))
