"""Results folders of runs that never were: made-up returns in the files that real runs write."""

import json

import numpy as np

import envs
from dreamer_jax.config import preset
from dreamer_jax.files import write_json_atomically
from dreamer_jax.schedule import Schedule
from experiments.runs.spec import RunSpec
from experiments.thesis import grid
from experiments.thesis.populations import task_name

VERSIONS = {"python": "3.11.7", "jax": "0.10.2", "backend": "cpu"}


def evaluation_steps(config, tasks=1):
    """Environment steps at each evaluation of a run."""
    schedule = Schedule(config.schedule, tasks)
    every = config.schedule.evaluate_every
    rounds = range(schedule.prefill_rounds, schedule.rounds + 1)
    first_round = {schedule.environment_steps(r) // every: r for r in reversed(rounds)}
    return [schedule.environment_steps(r) for bin, r in sorted(first_round.items()) if bin]


def baselines(seeds, task="InvertedPendulum"):
    """Agents from scratch."""
    return [grid.baseline("bullet", task, seed) for seed in seeds]


def targets(omegas, seeds, count=2, task="InvertedPendulum"):
    """Targets of fractional transfer; their sources have the first of the seeds."""
    return [
        grid.fractional("bullet", task, count, omega, seed, seeds[0])
        for omega in omegas
        for seed in seeds
    ]


def rising(cell, task, count):
    """10 more at each evaluation; seed 1 is 10 ahead of seed 0, and a transfer 100."""
    return 10.0 * (np.arange(count) + cell.seed) + (100 if cell.source else 0)


def write_folder(root, name, cells, returns, config=None, done=None, failed=()):
    """A results folder of a population.

    Args:
      root: the folder that it is in.
      name: of the folder.
      cells: of the members, all on the same tasks.
      returns: from a cell, a title of a task and the number of evaluations E to returns [E].
      config: settings, by default of the preset that the root is named after.
      done: evaluations made; by default all.
      failed: members whose losses were not finite by their second evaluation.
    """
    config = preset(root.name) if config is None else config
    tasks = tuple(task_name(cells[0].backend, title) for title in cells[0].tasks)
    spec = RunSpec(tasks, tuple(range(len(cells))), config)
    steps = evaluation_steps(config, len(tasks))
    folder = root / name
    folder.mkdir(parents=True)
    write_json_atomically(folder / "cells.json", [cell.name for cell in cells])
    write_json_atomically(
        folder / "run.json", {"spec": spec.to_dict(), "versions": VERSIONS, "revision": "0" * 40}
    )
    rows = []
    for member, cell in enumerate(cells):
        for task in tasks:
            values = returns(cell, envs.spec(task).title, len(steps))
            for env_steps, value in list(zip(steps, values, strict=True))[:done]:
                rows.append(
                    {"kind": "evaluation", "member": member, "task": task}
                    | {"env_steps": env_steps, "updates": env_steps, "return": float(value)}
                    | {"healthy": member not in failed or env_steps < steps[1]}
                )
    (folder / "metrics.jsonl").write_text("".join(json.dumps(row) + "\n" for row in rows))
    return folder


def write_done_and_cut(root, seeds):
    """Four evaluations a run: a baseline and ω = 0 done, ω = 0.1 with two evaluations each."""
    write_folder(root, "scratch", baselines(seeds), rising)
    write_folder(root, "targets", targets([0.0], seeds), rising)
    write_folder(root, "more", targets([0.1], seeds), rising, done=2)
    return root
