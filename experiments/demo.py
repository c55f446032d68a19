"""The main job at the smallest scale that shows all of it, in minutes on two cores.

One multi-task source agent on InvertedDoublePendulum and HalfCheetah, transferred to
InvertedPendulum with three fractions and two seeds each, beside two seeds from scratch; all
eight targets are one mapped population.
"""

import dataclasses
from pathlib import Path

from dreamer_jax.config import Config
from dreamer_jax.schedule import Schedule
from experiments.spec import RunSpec

SOURCE_TASKS = ("bullet/inverted_double_pendulum", "bullet/halfcheetah")
TARGET_TASK = "bullet/inverted_pendulum"
OMEGAS = (0.0, 0.2, 0.4)
SEEDS = (0, 1)


def specs(directory: Path, config: Config) -> dict[str, RunSpec]:
    """The demo's two runs in their order, by the name of their folder in `directory`.

    The source collects from two tasks and so makes its phases in twice the environment steps.
    """
    steps = config.schedule.environment_steps
    longer = dataclasses.replace(config.schedule, environment_steps=len(SOURCE_TASKS) * steps)
    return {
        "source": RunSpec(SOURCE_TASKS, SEEDS[:1], dataclasses.replace(config, schedule=longer)),
        "targets": RunSpec(
            (TARGET_TASK,),
            SEEDS,
            config,
            sources=(str(directory / "source"),),
            omegas=OMEGAS,
            baseline=True,
        ),
    }


def scale(config: Config) -> str:
    """A plain word on what runs of this size can show."""
    schedule = Schedule(config.schedule, tasks=1)
    return (
        "This demo shows the machinery, not the effect. Its agents are small, and a target makes "
        f"{schedule.updates:,} updates\non {schedule.environment_steps(schedule.rounds):,} "
        "environment steps, where one of the thesis makes about 100,000 on 1,000,000. None has "
        "learned its task:\nthe differences between the rows above are noise."
    )
