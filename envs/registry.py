"""Names of tasks and how to make them."""

from __future__ import annotations

import difflib
import pkgutil
from collections.abc import Sequence
from dataclasses import replace

import gymnasium

from envs.base import SIMULATOR_TIMEOUT, Env, TaskSpec

# Returns of whole episodes at an action repeat of 2, from 20 episodes at random and 5 of the rest.
# A saturated actor presses a pendulum's cart against an end of the rail (constant action); who
# swings it up at once and keeps it there has balanced it.
_LEVELS = {
    "bullet/ant": {"no action": 10.0, "random actions": 401.0},
    "bullet/halfcheetah": {"no action": -1368.0, "random actions": -1165.0},
    "bullet/hopper": {"no action": 44.0, "random actions": 18.0},
    "bullet/walker2d": {"no action": 38.0, "random actions": 15.0},
    "bullet/inverted_pendulum": {
        "no action": -1000.0,
        "constant action": -837.0,
        "random actions": -875.0,
        "balanced": 880.0,
    },
    "bullet/inverted_double_pendulum": {
        "no action": -1.0,
        "constant action": -203.0,
        "random actions": -322.0,
    },
    "brax/inverted_pendulum": {
        "no action": -1000.0,
        "constant action": -955.0,
        "random actions": -783.0,
    },
    "brax/inverted_double_pendulum": {
        "no action": 0.0,
        "constant action": -319.0,
        "random actions": -301.0,
    },
}


def _levels(name: str) -> tuple[tuple[str, float], ...]:
    return tuple(_LEVELS.get(name, {}).items())


def _bullet(name: str, title: str, action_size: int) -> TaskSpec:
    return TaskSpec(
        name=f"bullet/{name}",
        title=title,
        action_size=action_size,
        simulator="envs.bullet:BulletSimulator",
        gymnasium_id=f"bullet_pixels/{title}-v0",
        levels=_levels(f"bullet/{name}"),
    )


# Brax's physics engines, the first the one that its own environments use by default.
BRAX_ENGINES = ("generalized", "spring", "positional", "mjx")
# What can draw a Brax task, the first what does unless another is named: JAX, as a part of the
# program (`envs.ray_casting`), or MuJoCo in processes of its own.
BRAX_RENDERERS = ("jax", "mujoco")


def _brax(name: str, title: str, action_size: int, step_seconds: float) -> TaskSpec:
    return TaskSpec(
        name=f"brax/{name}",
        title=title,
        action_size=action_size,
        simulator=_brax_simulator(BRAX_ENGINES[0], BRAX_RENDERERS[0]),
        gymnasium_id=f"brax_pixels/{title}-v0",
        levels=_levels(f"brax/{name}"),
        step_seconds=step_seconds,
        physics=BRAX_ENGINES[0],
        renderer=BRAX_RENDERERS[0],
    )


def _brax_simulator(engine: str, renderer: str) -> str:
    return f"envs.brax_pixels:simulators.{engine}.{renderer}"


_TASKS = {
    task.name: task
    for task in (
        _bullet("ant", "Ant", 8),
        _bullet("halfcheetah", "HalfCheetah", 6),
        _bullet("hopper", "Hopper", 3),
        _bullet("walker2d", "Walker2D", 6),
        _bullet("inverted_pendulum", "InvertedPendulum", 1),
        _bullet("inverted_double_pendulum", "InvertedDoublePendulum", 1),
        # As near to PyBullet's 16.5 ms as a whole number of Brax's own physics steps comes; those
        # of the swing-ups are ours to choose, and meet it.
        _brax("ant", "Ant", 8, 0.02),
        _brax("halfcheetah", "HalfCheetah", 6, 0.02),
        _brax("hopper", "Hopper", 3, 0.016),
        _brax("walker2d", "Walker2D", 6, 0.016),
        _brax("inverted_pendulum", "InvertedPendulum", 1, TaskSpec.step_seconds),
        _brax("inverted_double_pendulum", "InvertedDoublePendulum", 1, TaskSpec.step_seconds),
    )
}

# The `Env` of tasks, by what draws them: "" is their own simulator on the host. Named, not
# imported: JAX stays out of simulator processes, and a backend's packages need not be installed
# unless it is used.
_ENVS = {
    "": "envs.bridge:HostEnv",
    "jax": "envs.brax_pixels:BraxEnv",
    "mujoco": "envs.brax_pixels:HostDrawnBraxEnv",
}


def task_names() -> tuple[str, ...]:
    """The names of the tasks of this package, installed or not. Beside them, `gymnasium/ID` is
    the gymnasium environment of that id, and `brax/NAME@ENGINE:RENDERER` a Brax task with another
    of its physics engines (`@ENGINE`), another renderer (`:RENDERER`), or both."""
    return tuple(_TASKS)


def spec(name: str) -> TaskSpec:
    """What is known of the task called `name`.

    Raises:
      ValueError: if there is no such task, with those there are; or if a gymnasium environment
        has no images or no fitting actions.
      ModuleNotFoundError: if a gymnasium environment needs a package that is not installed.
    """
    task = described(name)
    if not is_gymnasium(name):
        return task
    # Imported for those alone: a misspelt name is told without what reads and scales pictures.
    from envs.gymnasium_simulator import gymnasium_task

    return gymnasium_task(task.title)


def is_gymnasium(name: str) -> bool:
    """Whether a name is `gymnasium/ID`."""
    backend, _, id = name.partition("/")
    return backend == "gymnasium" and bool(id)


def names_module(name: str) -> bool:
    """Whether a task can only be made by importing a module that its name names."""
    return is_gymnasium(name) and ":" in name


def described(name: str) -> TaskSpec:
    """What a task's name alone tells: no environment is made, no module imported.

    Of a gymnasium environment that is its title; its other attributes mean nothing.

    Raises:
      ValueError: if there is no such task, with those there are.
    """
    if name in _TASKS:
        return _TASKS[name]
    backend, _, id = name.partition("/")
    if is_gymnasium(name):
        return TaskSpec(name=name, title=id, action_size=0, simulator="", gymnasium_id=id)
    if backend == "brax" and (task := _brax_choice(name)) is not None:
        return task
    near = difflib.get_close_matches(name, _TASKS)
    hint = f" Did you mean {' or '.join(near)}?" if near else ""
    raise ValueError(
        f"unknown task {name!r}, expected one of {', '.join(_TASKS)}, or gymnasium/ID.{hint}"
    )


def _brax_choice(name: str) -> TaskSpec | None:
    """The task `brax/NAME@ENGINE:RENDERER`, of which either choice may be missing; None if there
    is no such NAME."""
    rest, colon, renderer = name.partition(":")
    base, at, engine = rest.partition("@")
    if base not in _TASKS or not (at or colon):
        return None
    for kind, sign, chosen, choices in (
        ("physics engine", at, engine, BRAX_ENGINES),
        ("renderer", colon, renderer, BRAX_RENDERERS),
    ):
        if sign and chosen not in choices:
            raise ValueError(
                f"unknown {kind} {chosen!r} in the task {name!r}, expected one of "
                f"{', '.join(choices)}: brax/NAME@ENGINE:RENDERER"
            )
    engine, renderer = engine or BRAX_ENGINES[0], renderer or BRAX_RENDERERS[0]
    task = _TASKS[base]
    return replace(
        task,
        name=name,
        simulator=_brax_simulator(engine, renderer),
        physics=engine,
        renderer=renderer,
        # Measured with the first engine; what draws does not matter to returns.
        levels=task.levels if engine == BRAX_ENGINES[0] else (),
    )


def specs(names: Sequence[str]) -> tuple[TaskSpec, ...]:
    """What is known of the tasks that one agent is to play.

    Raises:
      ValueError: if one is unknown (see `spec`), or some are continuous and others discrete.
      ModuleNotFoundError: see `spec`.
    """
    tasks = tuple(spec(name) for name in names)
    discrete = [task.name for task in tasks if task.discrete]
    if 0 < len(discrete) < len(tasks):
        continuous = [task.name for task in tasks if not task.discrete]
        raise ValueError(
            f"the actions of {', '.join(discrete)} are discrete, those of {', '.join(continuous)} "
            "continuous: an agent's tasks must all be of one kind"
        )
    return tasks


def make(
    tasks: Sequence[str],
    members: int = 1,
    image_size: int = 64,
    action_repeat: int = 2,
    workers: int | None = None,
    action_size: int | None = None,
    supersample: int = 1,
    timeout: float = SIMULATOR_TIMEOUT,
    shards: int = 1,
) -> Env:
    """The environment of a population: P = `members` simulators of each of K = len(tasks) tasks.

    Args:
      tasks: K names; slot s = member * K + task plays tasks[s % K].
      members: P, at least 1.
      image_size: height and width of the images in pixels.
      action_repeat: environment steps for which an action is held, at least 1.
      workers: number of simulator processes for each backend, by default min(cores, slots).
      action_size: A, the length of all actions; by default the largest |A| of the tasks.
      supersample: pictures are drawn this many times as large and averaged down, which turns
        the jumps of edges from pixel to pixel into shades; 1 draws them as they are.
      timeout: seconds after which a simulator process that does not answer is ended, as one that
        died by itself.
      shards: how many programs play it at once, at most P: the first those of the first
        P / shards members, rounded up, the next those of as many that follow, and so on. Slots
        that are then beyond P * K may be played, but nothing is simulated in them.

    Raises:
      ValueError: for an unknown task or a number that is too small.
      ModuleNotFoundError: if the tasks' simulator is not installed, with how to install it.
    """
    if isinstance(tasks, str):
        raise ValueError(f"got the string {tasks!r}, expected a list of tasks such as [{tasks!r}]")
    known = specs(tasks)
    if not known:
        raise ValueError("got no tasks, expected at least one task")
    numbers = dict(
        members=members,
        image_size=image_size,
        action_repeat=action_repeat,
        supersample=supersample,
        shards=shards,
    )
    if workers is not None:
        numbers["workers"] = workers
    for name, number in numbers.items():
        if number < 1:
            raise ValueError(f"got {name}={number}, expected at least 1")
    if not timeout > 0:
        raise ValueError(f"got timeout={timeout}, expected more than 0 seconds")
    known = tuple(replace(task, supersample=supersample) for task in known)
    largest = max(task.action_size for task in known)
    if action_size is not None and action_size < largest:
        raise ValueError(
            f"got action_size={action_size}, but of the tasks {list(tasks)} the largest needs "
            f"{largest}"
        )
    makers = [_ENVS[task.renderer] for task in known]
    places = {maker: [k for k, other in enumerate(makers) if other == maker] for maker in makers}
    parts = []
    try:
        for maker, chosen in places.items():
            make_env = pkgutil.resolve_name(maker)
            part = [known[k] for k in chosen]
            size = action_size or largest
            options = {"workers": workers, "timeout": timeout, "shards": shards}
            parts.append(make_env(part, members, image_size, action_repeat, size, **options))
    except BaseException:
        for part in parts:
            part.close()
        raise
    if len(parts) == 1:
        return parts[0]
    return pkgutil.resolve_name("envs.mixed:MixedEnv")(
        parts, list(places.values()), members, shards
    )


def register_gymnasium() -> None:
    """Register every task with gymnasium, as one simulator of the usual interface."""
    for task in _TASKS.values():
        gymnasium.register(
            task.gymnasium_id, entry_point="envs.pixel_env:PixelEnv", kwargs={"task": task}
        )
