"""Brax tasks with pictures by rays and by MuJoCo: agent steps per second of processor time.

    python -m benchmarks.brax [task=brax/hopper,...] [P=1,8] [image_size=32,64] [steps=100]
                              [repetitions=3]

Prints one line of JSON (and each result as it is known to the standard error). What is timed is
what a run does to collect: one program of resets, physics, pictures, policy (networks of the preset
`cpu`) and records, drawn by either renderer, in turns. Processor time is that of this process and
of the one that draws for MuJoCo, so that what else the machine does matters little; rates are
medians of the repetitions, "ratio" the median of those of each turn. "drawing" is the share of a
rollout with rays that as many pictures by rays alone take, read in the same turns; "trace" and
"compile" are processor seconds of the program with rays.
"""

from __future__ import annotations

import json
import statistics
import sys
import time
from dataclasses import replace
from pathlib import Path

import jax
import jax.numpy as jnp

import envs
from dreamer_jax.agent import Agent
from dreamer_jax.config import Config, preset
from dreamer_jax.population import init_members
from dreamer_jax.rollout import collect

DEFAULTS = {
    "task": ",".join(name for name in envs.task_names() if name.startswith("brax/")),
    "P": "1,8",
    "image_size": "32,64",
    "steps": "100",
    "repetitions": "3",
}


class Clock:
    """Processor seconds of this process and of others."""

    def __init__(self, processes=()):
        self._processes = tuple(processes)

    def now(self) -> float:
        spent = sum(
            int(thread.read_text().split()[0])
            for process in self._processes
            for thread in Path(f"/proc/{process}/task").glob("*/schedstat")
        )
        return time.process_time() + spent / 1e9

    def seconds(self, function, *arguments) -> float:
        """What a call takes, its result included."""
        started = self.now()
        jax.block_until_ready(function(*arguments))
        return self.now() - started


class Rollout:
    """The compiled phase of one task, as a run collects it.

    Args:
      name: of the task.
      config: the agents' settings.
      members: P, all of them with one agent's parameters, which are mapped nevertheless.
      steps: agent steps of a phase.

    Attributes:
      trace, compile: processor seconds that these took.
      compile_seconds: of the clock, for both.
    """

    def __init__(self, name: str, config: Config, members: int, steps: int):
        self._env = envs.make([name], members, config.network.image_size, workers=1)
        agent = Agent(config, self._env.action_size).on_any_schedule()
        seeds, number = jnp.arange(members), jnp.int32(0)
        one = init_members(agent, jnp.arange(1)).params
        params = jax.tree.map(lambda x: jnp.repeat(x, members, axis=0), one)
        self._arguments = (params, seeds, jnp.zeros_like(seeds), number)

        def phase(params, seeds, updates, number):
            return collect(
                agent, self._env, params, seeds, updates, number, tasks=1, ticks=steps,
                mode="explore",
            )  # fmt: skip

        began, started = time.perf_counter(), time.process_time()
        lowered = jax.jit(phase).lower(*self._arguments)
        self.trace = time.process_time() - started
        started = time.process_time()
        self._program = lowered.compile()
        self.compile = time.process_time() - started
        self.compile_seconds = time.perf_counter() - began
        pool = getattr(self._env, "_pool", None)
        self._clock = Clock(worker.process.pid for worker in pool._workers) if pool else Clock()

    def seconds(self) -> float:
        """Processor seconds of the phase."""
        found = self._clock.seconds(self._program, *self._arguments)
        self._env.check()
        return found

    def play(self) -> None:
        """The phase, to its end."""
        jax.block_until_ready(self._program(*self._arguments))
        self._env.check()

    def close(self) -> None:
        self._env.close()


class Rays:
    """As many pictures of a task by rays, in places near each other."""

    def __init__(self, name: str, members: int, image_size: int, steps: int):
        from envs.brax_physics import physics_of, task_scene
        from envs.ray_casting import render

        task = envs.spec(name)
        links = len(physics_of(task.title, task.physics).env.sys.link_parents)
        scene = task_scene(task.title)
        turned = jnp.tile(jnp.array([1.0, 0.0, 0.0, 0.0]), (links, 1))

        def tick(_, move):
            places = jnp.array([0.0, 0.0, 0.7]) + move[:, None, None] * jnp.ones((links, 1))
            return None, jax.vmap(lambda x: render(scene, x, turned, image_size))(places)

        self._moves = jnp.linspace(0, 0.1, steps * members).reshape(steps, members)
        program = jax.jit(lambda moves: jax.lax.scan(tick, None, moves)[1])
        self._program = program.lower(self._moves).compile()

    def seconds(self) -> float:
        """Processor seconds of the pictures."""
        return Clock().seconds(self._program, self._moves)

    def close(self) -> None:
        """Nothing is open."""


def result(name: str, members: int, image_size: int, steps: int, repetitions: int) -> dict:
    """What there is to say of one task at one size."""
    config = preset("cpu")
    config = replace(config, network=replace(config.network, image_size=image_size))
    parts = {
        "rays": Rollout(name, config, members, steps),
        "mujoco": Rollout(f"{name}:mujoco", config, members, steps),
        "drawing": Rays(name, members, image_size, steps),
    }
    # The first of each warms up.
    turns = [{part: one.seconds() for part, one in parts.items()} for _ in range(repetitions + 1)]
    turns = turns[1:]
    for one in parts.values():
        one.close()

    def median(figure) -> float:
        return statistics.median(figure(turn) for turn in turns)

    return {
        "task": name,
        "P": members,
        "image_size": image_size,
        "rays": round(steps * members / median(lambda turn: turn["rays"]), 1),
        "mujoco": round(steps * members / median(lambda turn: turn["mujoco"]), 1),
        "ratio": round(median(lambda turn: turn["mujoco"] / turn["rays"]), 2),
        "drawing": round(median(lambda turn: turn["drawing"] / turn["rays"]), 3),
        "trace": round(parts["rays"].trace, 1),
        "compile": round(parts["rays"].compile, 1),
    }


def main(arguments: list[str]) -> None:
    """Measure and print; `arguments` are name=value pairs that replace the defaults."""
    settings = DEFAULTS | dict(argument.split("=", 1) for argument in arguments)
    if unknown := settings.keys() - DEFAULTS.keys():
        sys.exit(f"got {sorted(unknown)}, expected names among {list(DEFAULTS)}")
    populations, sizes = (
        [int(number) for number in settings[name].split(",")] for name in ("P", "image_size")
    )
    steps, repetitions = int(settings["steps"]), int(settings["repetitions"])
    results = []
    for name in settings["task"].split(","):
        for members in populations:
            for size in sizes:
                results.append(result(name, members, size, steps, repetitions))
                print(json.dumps(results[-1]), file=sys.stderr, flush=True)
    unit = "agent steps per processor second"
    print(json.dumps({"benchmark": "brax", "unit": unit, "steps": steps, "results": results}))


if __name__ == "__main__":
    main(sys.argv[1:])
