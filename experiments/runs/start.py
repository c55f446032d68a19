"""The thesis's methods on whole populations: fresh agents and sources -> targets to train.

Axis letters: P population member, N source or stored model, M latent feature size, S samples.
"""

import dataclasses
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import transfer
from dreamer_jax.agent import AgentState
from experiments.runs.agents import (
    KNOWN_SAMPLES,
    Source,
    check_source,
    load_source,
    make_agent,
    plan,
)
from experiments.runs.latents import gather, phases_for
from experiments.runs.spec import RunSpec
from transfer import ltc
from transfer.meta_model import StoredHeads, store


@dataclasses.dataclass(frozen=True)
class Sources:
    """All agents that a run takes knowledge from.

    Attributes:
      agents: those that parameters are transferred from; one but for fractional transfer.
      stored: those whose models a meta-model reads; none for other methods.
    """

    agents: tuple[Source, ...]
    stored: tuple[Source, ...] = ()


def load_sources(spec: RunSpec, base: str | Path = "") -> Sources:
    """Reads the agents that a run needs, and checks that they fit it.

    Args:
      spec: of the run.
      base: the folder that the spec's relative paths start from; by default the working directory.

    Raises:
      ValueError: a folder holds no run or no checkpoint; sizes differ; a stored model was not
        trained on what the target keeps frozen, or is no plain model.
    """
    agents = tuple(load_source(path, spec.source_member, base) for path in spec.sources)
    stored = tuple(load_source(path, base=base) for path in spec.reward_sources)
    for one in (*agents, *stored):
        check_source(one, spec)
    for one in stored:
        _check_stored(one, agents[0], spec)
    return Sources(agents, stored)


def _check_stored(stored: Source, agent: Source, spec: RunSpec) -> None:
    """A stored model must read the features that the target's frozen parts give."""
    if stored.spec.method == "meta" and (both := set(stored.spec.meta) & set(spec.meta)):
        raise ValueError(
            f"the {' and '.join(sorted(both))} of {stored.directory} is a meta-model itself, which "
            "cannot be stored: name the runs of its own reward sources"
        )
    flat, wanted = transfer.flatten(stored.params), transfer.flatten(agent.params)
    fresh = jax.eval_shape(make_agent(spec).init_params, jax.random.key(0))
    for path, rule in transfer.claims(plan(spec), fresh).items():
        if not rule.frozen or rule.source != "autoencoder":
            continue
        if path not in flat or not np.array_equal(flat[path], wanted[path]):
            component = path.partition("/")[0]
            option = " --dynamics frozen" if component == "dynamics" else ""
            raise ValueError(
                f"the agent of {stored.directory} was not trained on the frozen {component} of "
                f"{agent.directory} ({path} differs), so its models read other features: train it "
                f"with --method uae --source {agent.directory}{option}"
            )


def transferred_members(
    spec: RunSpec, sources: Sources, *, workers: int | None = None
) -> tuple[AgentState, transfer.Report]:
    """Fresh agents for all members, the targets among them after the run's method.

    Args:
      spec: of the run.
      sources: from `load_sources`.
      workers: simulator processes for the samples that a switching agent needs.

    Returns:
      The state, leaves [P, ...], and the report of what happened to each leaf.

    Raises:
      ValueError: the sources do not fit what the method reads.
    """
    agent, members = make_agent(spec), spec.members
    seeds = jnp.array([member.seed for member in members], jnp.int32)
    parameters: dict[str, Any] = {}
    count, knowledge, own = len(members), sources.agents[0].params, None
    if spec.method == "fractional":
        # Members from scratch come last.
        count = len(spec.sources) * len(spec.omegas) * len(spec.seeds)
        omegas = [member.tags["omega"] for member in members[:count]]
        parameters["omega"] = jnp.array(omegas, jnp.float32)
        knowledge = _stacked(spec, sources.agents)
        own = jnp.repeat(jnp.arange(len(spec.sources)), len(spec.omegas) * len(spec.seeds))
    elif spec.method == "meta":
        stored = stored_models(spec, sources.stored, action_size=agent.action_size)
        if spec.switching:
            classifier = known_tasks(spec, sources.stored, workers=workers)
            stored["reward"]["classifier"] = transfer.replicate(classifier, size=count)
        knowledge = {"autoencoder": knowledge, "stored": stored}

    @jax.jit
    def start(seeds, knowledge, own, parameters):
        fresh = jax.vmap(agent.init)(seeds).params
        if own is not None:
            knowledge = jax.tree.map(lambda x: x[own], knowledge)
        targets, report = transfer.apply(
            plan(spec),
            jax.tree.map(lambda x: x[:count], fresh),
            knowledge,
            population=True,
            **parameters,
        )
        join = lambda new, old: jnp.concatenate([new, old[count:]])  # noqa: E731
        return jax.vmap(agent.start)(jax.tree.map(join, targets, fresh), seeds), report

    return start(seeds, knowledge, own, parameters)


def _stacked(spec: RunSpec, sources: Sequence[Source]) -> dict[str, Any]:
    """What fractional transfer reads of its sources, by path: leaves [N, ...].

    Leaves that it does not read, those that handle actions, are left out: sources may differ in
    their shapes.

    Raises:
      ValueError: a leaf that is read has another shape in another source.
    """
    fresh = jax.eval_shape(make_agent(spec).init_params, jax.random.key(0))
    read = [p for p, rule in transfer.claims(plan(spec), fresh).items() if rule.operation != "keep"]
    flat = [transfer.flatten(source.params) for source in sources]
    for path in read:
        for source, leaves in zip(sources, flat, strict=True):
            shapes = [np.shape(x[path]) if path in x else "absent" for x in (flat[0], leaves)]
            if shapes[0] != shapes[1]:
                raise ValueError(
                    f"{path} is {shapes[0]} in the source {sources[0].directory} and {shapes[1]} "
                    f"in {source.directory}: targets of one population need sources of one shape"
                )
    return {path: np.stack([x[path] for x in flat]) for path in read if path in flat[0]}


def stored_models(
    spec: RunSpec, sources: Sequence[Source], *, action_size: int
) -> dict[str, dict[str, Any]]:
    """The models that each member's meta-models read, as the leaves of its parameters.

    Args:
      spec: of the run.
      sources: N agents; a member reads the first so many of them as its tag says.
      action_size: A of the target. A stored dynamics model reads as many actions: those that it
        has not learned have no effect on it, and those that the target has not are zero.

    Returns:
      {component: {"stored": {"params": leaves [P, N, ...], "present": [P, N]}}}.
    """
    found: dict[str, dict[str, Any]] = {}
    for component in spec.meta:
        models = [source.params[component] for source in sources]
        if component == "dynamics":
            models = [_of_action_size(model, action_size) for model in models]
        members = [
            store(models[: member.tags["sources"]], size=spec.places) for member in spec.members
        ]
        stored: StoredHeads = transfer.stack(members)
        found[component] = {"stored": {"params": stored.params, "present": stored.present}}
    return found


def _of_action_size(dynamics: dict[str, Any], size: int) -> dict[str, Any]:
    """A dynamics model that reads actions of another size, padded or cut with zeros."""
    kernel = dynamics["action_in"]["kernel"]
    target = {"kernel": jnp.zeros((size, kernel.shape[1]), kernel.dtype)}
    fit = transfer.pad if size >= len(kernel) else transfer.crop
    return dynamics | {"action_in": fit(target, {"kernel": kernel}, axis="input")}


def known_tasks(
    spec: RunSpec, sources: Sequence[Source], *, workers: int | None = None
) -> dict[str, jax.Array]:
    """The classifier of a switching agent: samples of the tasks that stored models know.

    Each source's own latent states of its tasks, by a random policy, labelled with its place.

    Returns:
      latents [S, M], labels [S] and the threshold [].
    """
    latents, labels, episodes = [], [], []
    for place, source in enumerate(sources):
        phases = phases_for(source, KNOWN_SAMPLES)
        parts = gather(source, source.spec.tasks, phases, workers=workers)
        shares = np.array_split(np.arange(KNOWN_SAMPLES), len(parts))
        for part, share in zip(parts, shares, strict=True):
            drawn = part.draw(len(share), seed=place)
            latents.append(drawn.features)
            labels += [place] * len(share)
            # Distinct numbers for the episodes of all tasks of all sources.
            episodes.append(drawn.episodes + (max(map(np.max, episodes)) if episodes else 0))
    model = ltc.fit(np.concatenate(latents), np.array(labels))
    threshold = spec.threshold
    if threshold is None:
        threshold = ltc.suggest_threshold(model, groups=np.concatenate(episodes))
    return {
        "latents": model.latents,
        "labels": model.labels,
        "threshold": jnp.asarray(threshold, jnp.float32),
    }
