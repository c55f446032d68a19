"""Pixel tasks that jitted JAX programs can step: `make`, `task_names`, `spec`."""

from envs.base import Env, SimulatorError, TaskSpec, TimeStep
from envs.registry import make, spec, task_names

__all__ = ["Env", "SimulatorError", "TaskSpec", "TimeStep", "make", "spec", "task_names"]
