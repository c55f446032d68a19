"""Latent states that a trained agent infers from episodes of given tasks (section 4.3).

A latent state's features are what the agent's heads read: a sample of the posterior, joined with
the deterministic state of the recurrent network, inferred along an episode from its first image
on. docs/transfer.md says why these are taken for the features of the thesis, and what the others
are for.

Axis letters: K task, R records, M latent feature size, S samples.
"""

import functools
from collections.abc import Sequence
from typing import Literal, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

import envs
from dreamer_jax.agent import Agent
from dreamer_jax.progress import Report, unreported
from dreamer_jax.randomness import LATENT_PHASES, choice_generator, latent_key
from dreamer_jax.records import Records
from dreamer_jax.rollout import collect
from dreamer_jax.waiting import to_host
from experiments.runs.agents import Source, make_agent

Features = Literal["sample", "mean", "first"]
Policy = Literal["random", "trained"]


class Latents(NamedTuple):
    """Latent states of one task.

    Attributes:
      features: float32 [R, M].
      episodes: int [R], the number of the episode that each is of.
    """

    features: np.ndarray
    episodes: np.ndarray

    def halves(self) -> tuple["Latents", "Latents"]:
        """Those of the first half of the phases, and those of the second."""
        middle = len(self.episodes) // 2
        return Latents(*(x[:middle] for x in self)), Latents(*(x[middle:] for x in self))

    def draw(self, samples: int, seed: int) -> "Latents":
        """S of them at random, each at most once."""
        chosen = choice_generator(seed).permutation(len(self.episodes))[:samples]
        return Latents(self.features[chosen], self.episodes[chosen])


def phases_for(source: Source, samples: int) -> int:
    """Phases of a task to draw so many samples from: two at least, so episodes differ."""
    records = source.spec.config.schedule.phase_ticks + 1
    return max(2, -(-samples // records))


@functools.partial(jax.jit, static_argnames=("agent", "features"))
def infer(
    agent: Agent, params, records: Records, key: jax.Array, *, features: Features
) -> jax.Array:
    """The features of one phase's records, leaves [R, ...] -> float32 [R, M].

    Args:
      agent, params: its functions and parameters.
      records: of one simulator.
      key: for the posterior's samples.
      features: "sample" of the posterior, its "mean" instead, or "first": each image as if it were
        the first of an episode, so that nothing but the image counts.
    """
    batch = records.map(lambda x: jnp.asarray(x)[None])
    if features == "first":
        batch = batch._replace(first=jnp.ones_like(batch.first))
    posterior, _, _ = agent.observe(params, batch, key)
    stochastic = posterior.mean if features == "mean" else posterior.stochastic
    return jnp.concatenate([stochastic, posterior.deterministic], axis=-1)[0]


def gather(
    source: Source,
    tasks: Sequence[str],
    phases: int,
    *,
    seed: int = 0,
    policy: Policy = "random",
    actor: Source | None = None,
    features: Features = "sample",
    workers: int | None = None,
    timeout: float = envs.SIMULATOR_TIMEOUT,
    report: Report = unreported,
) -> list[Latents]:
    """Plays phases of K tasks and infers the latent states of all their records.

    Args:
      source: the agent that infers.
      tasks: K names.
      phases: how many; each has other starts and actions.
      seed: of simulators, actions and samples.
      policy: "random" actions, or those of a "trained" agent (the mode, without noise).
      actor: the trained agent that acts; by default the source.
      features: see `infer`.
      workers: simulator processes; by default one per core.
      timeout: seconds after which a simulator that does not answer is given up.
      report: called after each phase; it counts phases.

    Returns:
      Latent states, one entry per task, phase after phase with as many in each.

    Raises:
      ValueError: the tasks' actions or images are not of the agents' sizes.
    """
    actor = source if actor is None else actor
    agent, acting = make_agent(source.spec), make_agent(actor.spec)
    _check_sizes(source, actor, agent, acting, tasks)
    env = envs.make(
        tasks,
        image_size=source.spec.config.network.image_size,
        action_repeat=source.spec.config.schedule.action_repeat,
        workers=workers,
        timeout=timeout,
        action_size=acting.action_size,
        supersample=source.spec.config.schedule.supersample,
    )
    params = jax.device_put(jax.tree.map(lambda x: np.asarray(x)[None], actor.params))
    found: list[list[Latents]] = [[] for _ in tasks]
    try:
        for phase in range(phases):
            records = collect(
                acting,
                env,
                params,
                jnp.array([seed], jnp.int32),
                jnp.zeros(1, jnp.int32),
                jnp.int32(LATENT_PHASES[phase]),
                tasks=len(tasks),
                ticks=source.spec.config.schedule.phase_ticks,
                mode="random" if policy == "random" else "evaluate",
            )
            records = to_host(records).at(0)
            env.check()
            missing = agent.action_size - acting.action_size
            action = np.pad(records.action, ((0, 0), (0, 0), (0, missing)))
            records = records._replace(action=action)
            for k in range(len(tasks)):
                one = records.at(k)
                sampling_key = latent_key(seed, phase, k)
                inferred = infer(agent, source.params, one, sampling_key, features=features)
                # Numbers of episodes go on from phase to phase.
                before = found[k][-1].episodes[-1] if found[k] else 0
                found[k].append(Latents(np.asarray(inferred), before + np.cumsum(one.first)))
            report(phase + 1, phases, "")
    finally:
        env.close()
    return [Latents(*(np.concatenate(x) for x in zip(*parts, strict=True))) for parts in found]


def own_latents(
    source: Source,
    samples: int,
    *,
    workers: int | None = None,
    timeout: float = envs.SIMULATOR_TIMEOUT,
) -> list[Latents]:
    """At least so many latent states of an agent on each of its own tasks, by random actions."""
    phases = phases_for(source, samples)
    return gather(source, source.spec.tasks, phases, workers=workers, timeout=timeout)


def _check_sizes(
    source: Source, actor: Source, agent: Agent, acting: Agent, tasks: Sequence[str]
) -> None:
    for task in tasks:
        size = envs.spec(task).action_size
        if size > acting.action_size:
            raise ValueError(
                f"{task} takes actions of size {size}, the agent of {actor.directory} gives "
                f"{acting.action_size}: choose an agent trained on a task with as many"
            )
    if acting.action_size > agent.action_size:
        raise ValueError(
            f"the agent of {actor.directory} gives actions of size {acting.action_size}, the "
            f"dynamics of {source.directory} read {agent.action_size}: choose an actor with no more"
        )
    sizes = [one.spec.config.network.image_size for one in (source, actor)]
    if sizes[0] != sizes[1]:
        raise ValueError(
            f"the agent of {actor.directory} reads images of {sizes[1]} pixels, that of "
            f"{source.directory} of {sizes[0]}: choose agents of one image size"
        )
