"""Names of tasks and how to make them."""

from __future__ import annotations

import difflib
import pkgutil
from collections.abc import Sequence

import gymnasium

from envs.base import Env, TaskSpec


def _bullet(name: str, title: str, action_size: int) -> TaskSpec:
    return TaskSpec(
        name=f"bullet/{name}",
        title=title,
        action_size=action_size,
        simulator="envs.bullet:BulletSimulator",
        gymnasium_id=f"bullet_pixels/{title}-v0",
    )


_TASKS = {
    task.name: task
    for task in (
        _bullet("ant", "Ant", 8),
        _bullet("halfcheetah", "HalfCheetah", 6),
        _bullet("hopper", "Hopper", 3),
        _bullet("walker2d", "Walker2D", 6),
        _bullet("inverted_pendulum", "InvertedPendulum", 1),
        _bullet("inverted_double_pendulum", "InvertedDoublePendulum", 1),
    )
}

# The `Env` of each backend, by the first part of a task's name. Named, not imported: JAX stays
# out of simulator processes, and a backend's packages need not be installed unless it is used.
_BACKENDS = {"bullet": "envs.bridge:HostEnv"}


def task_names() -> tuple[str, ...]:
    """The names of all tasks, installed or not."""
    return tuple(_TASKS)


def spec(name: str) -> TaskSpec:
    """What is known of the task called `name`.

    Raises:
        ValueError: if there is no such task; the message lists those there are.
    """
    if name in _TASKS:
        return _TASKS[name]
    near = difflib.get_close_matches(name, _TASKS)
    hint = f" Did you mean {' or '.join(near)}?" if near else ""
    raise ValueError(f"unknown task {name!r}, expected one of {', '.join(_TASKS)}.{hint}")


def make(
    tasks: Sequence[str],
    members: int = 1,
    image_size: int = 64,
    action_repeat: int = 2,
    workers: int | None = None,
    action_size: int | None = None,
) -> Env:
    """The environment of a population: P = `members` simulators of each of K = len(tasks) tasks.

    Args:
        tasks: K names; slot s = member * K + task plays tasks[s % K].
        members: P, at least 1.
        image_size: height and width of the images in pixels.
        action_repeat: environment steps for which an action is held, at least 1.
        workers: number of simulator processes, by default min(cores, slots).
        action_size: A, the length of all actions; by default the largest |A| of the tasks.

    Raises:
        ValueError: for an unknown task or a number that is too small.
        ModuleNotFoundError: if the tasks' simulator is not installed, with how to install it.
    """
    if isinstance(tasks, str):
        raise ValueError(f"got the string {tasks!r}, expected a list of tasks such as [{tasks!r}]")
    specs = [spec(name) for name in tasks]
    backends = sorted({name.partition("/")[0] for name in tasks})
    if len(backends) != 1:
        raise ValueError(
            f"got tasks {list(tasks)} of backends {backends}, expected at least one task, and "
            "all of one backend"
        )
    numbers = dict(members=members, image_size=image_size, action_repeat=action_repeat)
    if workers is not None:
        numbers["workers"] = workers
    for name, number in numbers.items():
        if number < 1:
            raise ValueError(f"got {name}={number}, expected at least 1")
    largest = max(task.action_size for task in specs)
    if action_size is not None and action_size < largest:
        raise ValueError(
            f"got action_size={action_size}, but of the tasks {list(tasks)} the largest needs "
            f"{largest}"
        )
    make_env = pkgutil.resolve_name(_BACKENDS[backends[0]])
    return make_env(
        specs, members, image_size, action_repeat, action_size or largest, workers=workers
    )


def register_gymnasium() -> None:
    """Register every task with gymnasium, as one simulator of the usual interface."""
    for task in _TASKS.values():
        gymnasium.register(
            task.gymnasium_id, entry_point="envs.pixel_env:PixelEnv", kwargs={"task": task}
        )
