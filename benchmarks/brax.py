"""Brax tasks with pictures by rays and by MuJoCo: agent steps per second of processor time.

    python -m benchmarks.brax [task=brax/hopper,...] [P=1,8] [image_size=32,64] [steps=100]
                              [repetitions=3]

Prints one line of JSON (and each result as it is known to the standard error). Processor time is
that of this process and of the one that draws for MuJoCo, so that what else the machine does
matters little. It is read in parts, in turns: a rollout with rays at the first size ("physics" is
what is left of it without pictures), as many pictures by rays alone, and as many by MuJoCo through
the host callback alone. Processor times add up, so a rollout is its physics and its pictures;
"ratio" is that with MuJoCo over that with rays, "drawing" the share of rays in the latter.
"compile" and "trace" are processor seconds too, of the rollout's program. The least of the
repetitions counts.
"""

from __future__ import annotations

import json
import os
import sys
import time
from pathlib import Path

import jax
import jax.numpy as jnp

import envs

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
        ticks = 0
        for process in self._processes:
            fields = Path(f"/proc/{process}/stat").read_text().rsplit(")", 1)[1].split()
            ticks += int(fields[11]) + int(fields[12])
        return time.process_time() + ticks / os.sysconf("SC_CLK_TCK")

    def seconds(self, function, *arguments) -> float:
        """What a call takes, its result included."""
        started = self.now()
        jax.block_until_ready(function(*arguments))
        return self.now() - started


def rollout(env, members: int, steps: int):
    """A compiled rollout of random actions, and processor seconds to trace and to compile it."""

    def run(key):
        slots, keys = jnp.arange(members), jax.random.split(key, members)
        state, _ = jax.vmap(env.reset)(slots, keys)
        actions = jax.random.uniform(key, (steps, members, env.action_size), minval=-1.0)
        return jax.lax.scan(jax.vmap(env.step), state, actions)[1]

    started = time.process_time()
    lowered = jax.jit(run).lower(jax.random.key(0))
    traced = time.process_time()
    program = lowered.compile()
    return program, traced - started, time.process_time() - traced


def rays(env, task, members: int, steps: int):
    """As many pictures by rays, of what the joints of a start are and of places near it."""
    from envs.brax_physics import physics_of, task_scene
    from envs.ray_casting import render

    physics, scene = physics_of(task.title, task.physics), task_scene(task.title)
    links = len(physics.env.sys.link_parents)
    turned = jnp.tile(jnp.array([1.0, 0.0, 0.0, 0.0]), (links, 1))

    def tick(_, move):
        places = jnp.array([0.0, 0.0, 0.7]) + move[:, None, None] * jnp.ones((links, 1))
        return None, jax.vmap(lambda x: render(scene, x, turned, env.image_size))(places)

    moves = jnp.linspace(0, 0.1, steps * members).reshape(steps, members)
    return jax.jit(lambda moves: jax.lax.scan(tick, None, moves)[1]).lower(moves).compile(), moves


def callbacks(env, members: int, steps: int):
    """As many pictures by MuJoCo's process through the callback."""
    slots = jnp.arange(members)

    def tick(_, positions):
        return None, env._images(slots, positions, jnp.zeros((members, 1)))[0]

    positions = 0.1 * jax.random.normal(jax.random.key(0), (steps, members, env._positions))
    program = jax.jit(lambda positions: jax.lax.scan(tick, None, positions)[1])
    return program.lower(positions).compile(), positions


def rows(name: str, populations, sizes, steps: int, repetitions: int):
    """The results of one task."""
    task, key = envs.spec(name), jax.random.key(1)
    drawing = [envs.make([f"{name}:mujoco"], max(populations), size, workers=1) for size in sizes]
    clocks = [Clock(w.process.pid for w in env._pool._workers) for env in drawing]
    for members in populations:
        made = [envs.make([name], members, size) for size in sizes]
        program, traced, compiled = rollout(made[0], members, steps)
        parts = {("rollout", sizes[0]): (Clock(), program, key)}
        for env, host, clock, size in zip(made, drawing, clocks, sizes, strict=True):
            parts["rays", size] = (Clock(), *rays(env, task, members, steps))
            parts["mujoco", size] = (clock, *callbacks(host, members, steps))
        found = {part: [] for part in parts}
        for _ in range(repetitions + 1):
            for part, (clock, *call) in parts.items():
                found[part].append(clock.seconds(*call))
        # The first of each warms up.
        least = {part: min(seconds[1:]) / (steps * members) for part, seconds in found.items()}
        physics = least["rollout", sizes[0]] - least["rays", sizes[0]]
        row = {"task": name, "P": members}
        row |= {"trace": round(traced, 1), "compile": round(compiled, 1)}
        row["physics_ms"] = round(1000 * physics, 4)
        for size in sizes:
            by_rays, by_mujoco = physics + least["rays", size], physics + least["mujoco", size]
            row[str(size)] = {
                "rays": round(1 / by_rays, 1),
                "mujoco": round(1 / by_mujoco, 1),
                "ratio": round(by_mujoco / by_rays, 2),
                "drawing": round(least["rays", size] / by_rays, 3),
            }
        yield row
    for env in drawing:
        env.check()
        env.close()


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
        for row in rows(name, populations, sizes, steps, repetitions):
            print(json.dumps(row), file=sys.stderr, flush=True)
            results.append(row)
    unit = "agent steps per processor second"
    print(json.dumps({"benchmark": "brax", "unit": unit, "steps": steps, "results": results}))


if __name__ == "__main__":
    main(sys.argv[1:])
