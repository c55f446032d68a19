"""Results folders made in a moment: a run as its spec says, of agents that have not trained."""

import dataclasses
import json

import jax
import numpy as np

import transfer
from dreamer_jax.checkpoint import Checkpointer
from dreamer_jax.config import preset
from dreamer_jax.files import write_json_atomically
from dreamer_jax.records import Records
from dreamer_jax.schedule import Counters, Schedule
from experiments import methods
from experiments.methods.autoencoder import UniversalAutoencoder
from experiments.runs.agents import Source, load_source, make_agent
from experiments.runs.spec import RunSpec

CONFIG = preset("debug")


def spec_of(*tasks, seeds=(0,), config=CONFIG, method=None, **settings) -> RunSpec:
    """A spec for tasks named without their backend, with a method and its settings."""
    names = tuple(f"bullet/{task}" for task in tasks)
    for name in {"sources", "reward_sources"} & set(settings):
        settings[name] = tuple(map(str, settings[name]))
    return RunSpec(names, seeds, config, methods.make(method, settings))


def random_params(agent, seed=0):
    """Parameters of the shapes of an agent's, without compiling its initialisation."""
    random, shapes = np.random.default_rng(seed), agent.parameter_shapes()
    return jax.tree.map(lambda x: random.normal(0, 0.3, x.shape).astype(x.dtype), shapes)


def random_members(agent, seeds):
    """Such parameters of each member, leaves [P, ...]."""
    return jax.tree.map(lambda *x: np.stack(x), *[random_params(agent, seed) for seed in seeds])


def write_run(directory, spec: RunSpec, seed=0, keep=False, counters=None) -> Source:
    """A results folder of agents with random parameters, after the run's method.

    Args:
      keep: leave what the folder holds beside the parameters as it is.
      counters: how far the run is, for what asks.

    Returns:
      Its first agent.
    """
    params = random_params(make_agent(spec), seed)
    if type(spec.method) is UniversalAutoencoder:
        source = load_source(spec.method.sources[0])
        given, claims = transfer.flatten(source.params), transfer.claims(spec.method.plan(), params)
        copied = [path for path, rule in claims.items() if rule.operation == "copy"]
        params = transfer.unflatten(params, {path: given[path] for path in copied})
    params = jax.tree.map(lambda x: np.stack([x] * len(spec.members)), params)
    checkpoints = Checkpointer(directory / "checkpoints")
    if keep:
        step = checkpoints.latest()
        checkpoints.save(step, {"agent": {"params": params}}, checkpoints.metadata(step))
        return load_source(directory)
    metadata = {} if counters is None else {"counters": counters}
    checkpoints.save(0, {"agent": {"params": params}}, metadata)
    write_json_atomically(directory / "run.json", {"spec": spec.to_dict()})
    return load_source(directory)


def finish(run, root, share=1.0) -> None:
    """What a planned run leaves behind after a share of its rounds: made-up evaluations, whose
    returns are the places of the members, and a checkpoint of next to nothing."""
    folder, spec = root / run.name, run.spec
    schedule = Schedule(spec.config.schedule, len(spec.tasks))
    rounds = max(schedule.prefill_rounds, round(share * schedule.rounds))
    folder.mkdir(parents=True, exist_ok=True)
    write_json_atomically(folder / "cells.json", list(run.cells))
    write_json_atomically(folder / "run.json", {"spec": spec.to_dict()})
    every, steps = spec.config.schedule.evaluate_every, schedule.environment_steps
    evaluated = {steps(r) // every: steps(r) for r in range(schedule.prefill_rounds, rounds + 1)}
    rows = [
        {"kind": "evaluation", "member": member, "env_steps": env_steps, "task": task}
        | {"return": float(member)}
        for crossed, env_steps in evaluated.items()
        if crossed
        for member in range(len(spec.members))
        for task in spec.tasks
    ]
    lines = "".join(json.dumps(row) + "\n" for row in rows)
    (folder / "metrics.jsonl").write_text(lines)
    counters = Counters(rounds, schedule.updates_due(rounds), steps(rounds) // every)
    Checkpointer(folder / "checkpoints").save(
        rounds, {"agent": {"params": np.zeros(3)}}, {"counters": dataclasses.asdict(counters)}
    )


class Trainer:
    """Finishes runs in a moment and notes their names; those named in `failing` raise."""

    def __init__(self, failing=None, stop_at=None):
        self.failing, self.stop_at, self.trained = failing or {}, stop_at, []

    def __call__(self, run, root, means):
        self.trained.append(run.name)
        if run.name == self.stop_at:
            finish(run, root, share=0.5)
            return "stopped"
        if run.name in self.failing:
            finish(run, root, share=0.5)
            raise self.failing[run.name]
        finish(run, root)
        return "finished"


def batch_for(agent, *leading, seed=0) -> Records:
    """Random records, leaves [..., B, L, ...]."""
    random = np.random.default_rng(seed)
    learning, size = agent.config.learning, agent.config.network.image_size
    shape = (*leading, learning.batch_size, learning.sequence_length)
    return Records(
        image=random.integers(0, 256, (*shape, size, size, 3), dtype=np.uint8),
        action=random.uniform(-1, 1, (*shape, agent.action_size)).astype(np.float32),
        reward=random.normal(size=shape).astype(np.float32),
        first=random.random(shape) < 0.1,
        terminal=np.zeros(shape, bool),
    )
