"""Agent steps per second: simulators through the bridge, beside the same simulators bare.

    python -m benchmarks.rollout [task=bullet/hopper,bullet/ant] [P=1,3,8] [steps=200]
                                 [image_size=64] [workers=2] [repetitions=3]

Prints one line of JSON. "bridge" is a jitted scan over vmapped steps with random actions. Beside
it, for simulators on the host, "bare" is a plain Python loop over as many of them in as many
processes, with no JAX and nobody to wait for: what the machine can do at most; "ratio" is their
quotient. For Brax, "jax" and "mujoco" are the same scan with pictures drawn by either, in turns,
and "ratio" is the first over the second; "drawing_jax" and "drawing_mujoco" are the shares of the
time that go into pictures: of as many drawn alone, or that passes while the processes draw.
Rates are the best of the repetitions.
"""

from __future__ import annotations

import json
import sys
import time
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context

import numpy as np

import envs
from envs.pool import available_cores
from envs.worker import Phase
from envs.wrappers import ActionRepeat

DEFAULTS = {
    "task": ",".join(name for name in envs.task_names() if name.startswith("bullet/")),
    "P": "1,3,8",
    "steps": "200",
    "image_size": "64",
    "workers": "",
    "repetitions": "3",
}


def bare_seconds(task: envs.TaskSpec, simulators: int, steps: int, image_size: int) -> float:
    """Time for `steps` random actions in each of `simulators` in this process."""
    from envs.bullet import BulletSimulator

    def make():
        return ActionRepeat(BulletSimulator(task.title, image_size), task.action_repeat)

    phases = [Phase(make) for _ in range(simulators)]
    for seed, phase in enumerate(phases):
        phase.reset([seed])
    actions = np.random.default_rng(0).uniform(-1, 1, (steps, simulators, task.action_size))
    start = time.perf_counter()
    for step in range(steps):
        for phase, action in zip(phases, actions[step], strict=True):
            phase.step(action)
    seconds = time.perf_counter() - start
    for phase in phases:
        phase.close()
    return seconds


def bare_rate(task, members: int, steps: int, image_size: int, workers: int) -> float:
    """Agent steps per second of `members` simulators shared out to `workers` processes."""
    shares = [len(range(index, members, workers)) for index in range(workers)]
    with ProcessPoolExecutor(workers, mp_context=get_context("spawn")) as pool:
        futures = [pool.submit(bare_seconds, task, n, steps, image_size) for n in shares]
        return members * steps / max(future.result() for future in futures)


class Rollout:
    """A jitted rollout of one task with random actions, compiled and ready to be timed."""

    def __init__(self, task, members: int, steps: int, image_size: int, workers: int):
        import jax
        import jax.numpy as jnp

        self.members, self.steps = members, steps
        self.env = env = envs.make([task.name], members, image_size, task.action_repeat, workers)
        # Seconds that passed while simulators or renderers of their own processes worked.
        self._waits: list[float] = []
        if (pool := getattr(env, "_pool", None)) is not None:
            pool.step = self._timed(pool.step)

        @jax.jit
        def reset(key):
            return jax.vmap(env.reset)(jnp.arange(members), jax.random.split(key, members))[0]

        @jax.jit
        def roll(state, key):
            actions = jax.random.uniform(key, (steps, members, task.action_size), minval=-1.0)
            return jax.lax.scan(jax.vmap(env.step), state, actions)

        self._reset, self._roll = reset, roll
        started = time.perf_counter()
        self.run()
        self.first_seconds = time.perf_counter() - started

    def _timed(self, step):
        def call(*arguments):
            start = time.perf_counter()
            try:
                return step(*arguments)
            finally:
                self._waits.append(time.perf_counter() - start)

        return call

    def run(self) -> tuple[float, float]:
        """Agent steps per second without resets, and the share of the time that was waited."""
        import jax

        state = jax.block_until_ready(self._reset(jax.random.key(0)))
        self._waits.clear()
        start = time.perf_counter()
        jax.block_until_ready(self._roll(state, jax.random.key(1)))
        seconds = time.perf_counter() - start
        self.env.check()
        return self.members * self.steps / seconds, sum(self._waits) / seconds


def drawing_rates(task, members: int, steps: int, image_size: int, repetitions: int):
    """Pictures per second of a Brax task, drawn by JAX `members` at a time in a jitted scan."""
    import jax
    import jax.numpy as jnp

    from envs.brax_physics import physics_of, task_scene
    from envs.ray_casting import render

    physics, scene = physics_of(task.title, task.physics), task_scene(task.title)
    poses = jax.jit(lambda key: physics.poses(physics.start(key)))(jax.random.key(0))

    @jax.jit
    def draw(moves):
        def tick(_, move):
            places = poses[0] + move[:, None, None]
            return None, jax.vmap(lambda x: render(scene, x, poses[1], image_size))(places)

        return jax.lax.scan(tick, None, moves)

    moves = jnp.linspace(0, 0.1, steps * members).reshape(steps, members)
    jax.block_until_ready(draw(moves))
    for _ in range(repetitions):
        start = time.perf_counter()
        jax.block_until_ready(draw(moves))
        yield members * steps / (time.perf_counter() - start)


def brax_row(task, members: int, steps: int, image_size: int, workers: int, repetitions: int):
    """Both renderers in turns."""
    rollouts = {
        renderer: Rollout(envs.spec(f"{task.name}:{renderer}"), members, steps, image_size, workers)
        for renderer in ("jax", "mujoco")
    }
    rates = {renderer: [] for renderer in rollouts}
    alone = drawing_rates(task, members, steps, image_size, repetitions)
    drawn = []
    for _ in range(repetitions):
        for renderer, rollout in rollouts.items():
            rates[renderer].append(rollout.run())
        drawn.append(next(alone))
    for rollout in rollouts.values():
        rollout.env.close()
    (jax_rate, _), (mujoco_rate, waited) = (max(rates[x]) for x in ("jax", "mujoco"))
    return {
        "jax": round(jax_rate, 1),
        "mujoco": round(mujoco_rate, 1),
        "ratio": round(jax_rate / mujoco_rate, 2),
        "drawing_jax": round(jax_rate / max(drawn), 3),
        "drawing_mujoco": round(waited, 3),
        "first_seconds_jax": round(rollouts["jax"].first_seconds, 1),
        "first_seconds_mujoco": round(rollouts["mujoco"].first_seconds, 1),
    }


def host_row(task, members: int, steps: int, image_size: int, workers: int, repetitions: int):
    """Through the bridge, and bare."""
    rollout = Rollout(task, members, steps, image_size, workers)
    bridge, _ = max(rollout.run() for _ in range(repetitions))
    rollout.env.close()
    bare = max(bare_rate(task, members, steps, image_size, workers) for _ in range(repetitions))
    return {
        "bridge": round(bridge, 1),
        "bare": round(bare, 1),
        "ratio": round(bridge / bare, 3),
    }


def main(arguments: list[str]) -> None:
    """Measure and print; `arguments` are name=value pairs that replace the defaults."""
    settings = DEFAULTS | dict(argument.split("=", 1) for argument in arguments)
    if unknown := settings.keys() - DEFAULTS.keys():
        sys.exit(f"got {sorted(unknown)}, expected names among {list(DEFAULTS)}")
    steps, image_size = int(settings["steps"]), int(settings["image_size"])
    repetitions = int(settings["repetitions"])
    results = []
    for task in map(envs.spec, settings["task"].split(",")):
        for members in map(int, settings["P"].split(",")):
            workers = min(int(settings["workers"] or available_cores()), members)
            row = {"task": task.name, "P": members, "workers": workers}
            kind = brax_row if task.name.startswith("brax/") else host_row
            row |= kind(task, members, steps, image_size, workers, repetitions)
            results.append(row)
    print(
        json.dumps(
            {
                "benchmark": "rollout",
                "unit": "agent steps per second",
                "steps": steps,
                "image_size": image_size,
                "results": results,
            }
        )
    )


if __name__ == "__main__":
    main(sys.argv[1:])
