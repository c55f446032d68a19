"""How a run's agents begin: fresh ones, and what its method makes of them and of its sources.

Axis letters: P population member.
"""

import functools
from pathlib import Path

import jax
import jax.numpy as jnp

import envs
import transfer
from dreamer_jax.learning import AgentState
from experiments.methods import Sources
from experiments.runs.agents import check_source, load_source, make_agent
from experiments.runs.latents import own_latents
from experiments.runs.spec import RunSpec


def load_sources(spec: RunSpec, base: str | Path = "", *, accept_failed: bool = False) -> Sources:
    """Reads the agents that a run needs, and checks that they fit it.

    Args:
      spec: of the run.
      base: the folder that the spec's relative paths start from; by default the working directory.
      accept_failed: take members that failed, as they were before.

    Raises:
      ValueError: a folder holds no run or no checkpoint; sizes differ; a member failed; or
        the method cannot use a source.
    """
    method, load = spec.method, functools.partial(load_source, accept_failed=accept_failed)
    agents = tuple(load(path, method.source_member, base) for path in method.sources)
    stored = tuple(load(path, base=base) for path in method.stored)
    for one in (*agents, *stored):
        check_source(one, spec)
    sources = Sources(agents, stored)
    fresh = jax.eval_shape(make_agent(spec).init_params, jax.random.key(0))
    method.check_sources(sources, fresh)
    return sources


def transferred_members(
    spec: RunSpec,
    sources: Sources,
    *,
    workers: int | None = None,
    timeout: float = envs.SIMULATOR_TIMEOUT,
) -> tuple[AgentState, transfer.Report]:
    """Fresh agents for all members, the targets among them after the run's method.

    Args:
      spec: of the run.
      sources: from `load_sources`.
      workers: simulator processes for latent states that a method asks for.
      timeout: seconds after which a simulator that does not answer is given up.

    Returns:
      The state, leaves [P, ...], and the report of what happened to each leaf.

    Raises:
      ValueError: the sources do not fit what the method reads.
    """
    agent, method = make_agent(spec), spec.method
    sample = functools.partial(own_latents, workers=workers, timeout=timeout)
    given = method.knowledge(agent, spec.seeds, sources, sample)
    # Members from scratch come last.
    count = len(method.targets(spec.seeds))
    parameters = {name: jnp.array(x, jnp.float32) for name, x in given.parameters.items()}
    own = None if given.own is None else jnp.array(given.own)

    @jax.jit
    def start(seeds, knowledge, own, parameters):
        fresh = jax.vmap(agent.init)(seeds).params
        if own is not None:
            knowledge = jax.tree.map(lambda x: x[own], knowledge)
        targets, report = transfer.apply(
            given.plan,
            jax.tree.map(lambda x: x[:count], fresh),
            knowledge,
            population=True,
            **parameters,
        )
        join = lambda new, old: jnp.concatenate([new, old[count:]])  # noqa: E731
        return jax.vmap(agent.start)(jax.tree.map(join, targets, fresh), seeds), report

    seeds = jnp.array([member.seed for member in spec.members], jnp.int32)
    return start(seeds, given.source, own, parameters)
