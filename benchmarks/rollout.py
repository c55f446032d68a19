"""Agent steps per second: simulators through the bridge, beside the same simulators bare.

    python -m benchmarks.rollout [task=bullet/hopper,bullet/ant] [P=1,3,8] [steps=200]
                                 [image_size=64] [workers=2] [repetitions=3]

Prints one line of JSON. "bridge" is a jitted scan over vmapped steps with random actions. Beside
it, for simulators on the host, "bare" is a plain Python loop over as many of them in as many
processes, with no JAX and nobody to wait for: what the machine can do at most; "ratio" is their
quotient. For Brax, whose physics is part of the jitted program, "drawing" and "physics" are the
shares of the time that passes while the processes draw, and otherwise. Rates are the best of the
repetitions.
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


def bridge_rates(task, members: int, steps: int, image_size: int, workers: int, repetitions: int):
    """Agent steps per second of each repetition, and the share of its time that passed in the
    simulators' processes; compilation and resets left out."""
    import jax
    import jax.numpy as jnp

    env = envs.make([task.name], members, image_size, task.action_repeat, workers)
    pool_step, waits = env._pool.step, []

    def timed_step(*arguments):
        start = time.perf_counter()
        result = pool_step(*arguments)
        waits.append(time.perf_counter() - start)
        return result

    env._pool.step = timed_step
    reset = jax.jit(jax.vmap(env.reset))

    @jax.jit
    def roll(state, key):
        actions = jax.random.uniform(key, (steps, members, task.action_size), minval=-1.0)
        return jax.lax.scan(jax.vmap(env.step), state, actions)

    for repetition in range(repetitions + 1):
        state, _ = reset(jnp.arange(members), jax.random.split(jax.random.key(0), members))
        jax.block_until_ready(state)
        waits.clear()
        start = time.perf_counter()
        jax.block_until_ready(roll(state, jax.random.key(1)))
        seconds = time.perf_counter() - start
        env.check()
        if repetition > 0:
            yield members * steps / seconds, sum(waits) / seconds
    env.close()


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
            bridge, waiting = max(
                bridge_rates(task, members, steps, image_size, workers, repetitions)
            )
            row = {
                "task": task.name,
                "P": members,
                "workers": workers,
                "bridge": round(bridge, 1),
            }
            if task.name.startswith("brax/"):
                row |= {"drawing": round(waiting, 3), "physics": round(1 - waiting, 3)}
            else:
                bare = max(
                    bare_rate(task, members, steps, image_size, workers) for _ in range(repetitions)
                )
                row |= {"bare": round(bare, 1), "ratio": round(bridge / bare, 3)}
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
