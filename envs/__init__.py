"""Pixel tasks that jitted JAX programs can step: `make`, `task_names`, `spec`, `specs`.

Importing this package also registers the tasks with gymnasium, as `bullet_pixels/Hopper-v0`,
`brax_pixels/Hopper-v0` and so on. It imports no JAX by itself, for simulator processes import it
too.
"""

from envs.base import SIMULATOR_TIMEOUT, Env, SimulatorError, TaskSpec, TimeStep
from envs.registry import (
    described,
    make,
    names_module,
    register_gymnasium,
    spec,
    specs,
    task_names,
)

__all__ = [
    "SIMULATOR_TIMEOUT",
    "Env",
    "SimulatorError",
    "TaskSpec",
    "TimeStep",
    "described",
    "make",
    "names_module",
    "spec",
    "specs",
    "task_names",
]

register_gymnasium()
