"""How a run's agents begin: fresh ones, and what its method makes of them and of its sources.

Axis letters: P population member.
"""

import dataclasses
import functools
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

import envs
import transfer
from dreamer_jax.agent import Agent
from dreamer_jax.devices import Placement, on_one_device
from dreamer_jax.learning import AgentState
from dreamer_jax.population import init_members
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
    fresh = make_agent(spec).parameter_shapes()
    method.check_sources(sources, fresh)
    return sources


def transferred_members(
    spec: RunSpec,
    sources: Sources,
    *,
    workers: int | None = None,
    timeout: float = envs.SIMULATOR_TIMEOUT,
    placement: Placement | None = None,
) -> tuple[AgentState, transfer.Report]:
    """Fresh agents for all members, the targets among them after the run's method.

    Each device makes its own members; of several devices all are then gathered on the host.

    Args:
      spec: of the run.
      sources: from `load_sources`.
      workers: simulator processes for latent states that a method asks for.
      timeout: seconds after which a simulator that does not answer is given up.
      placement: where members lie; by default all on one device.

    Returns:
      The state, leaves [P, ...], and the report of what happened to each leaf.

    Raises:
      ValueError: the sources do not fit what the method reads.
    """
    agent, method, members = make_agent(spec), spec.method, len(spec.members)
    placement = placement or on_one_device(members)
    sample = functools.partial(own_latents, workers=workers, timeout=timeout)
    given = method.knowledge(agent, spec.seeds, sources, sample)
    count = len(method.targets(spec.seeds))

    def for_all(values):
        """Members from scratch come last. They are handed what the first target is, in vain."""
        return jnp.concatenate([values, jnp.repeat(values[:1], members - count, axis=0)])

    parameters = {name: jnp.array(x, jnp.float32) for name, x in given.parameters.items()}
    own = None if given.own is None else jnp.array(given.own)
    theirs = {name: given.source[name] for name in given.stacked}
    shared = given.source
    if theirs:
        shared = {name: tree for name, tree in shared.items() if name not in theirs}

    def chosen(first, one, other):
        return jax.tree.map(lambda x, y: jnp.where(first, x, y), one, other)

    def start(fresh, seeds, is_target, own, theirs, parameters, shared):
        knowledge = {**shared, **theirs} if theirs else shared
        if own is not None:
            knowledge = jax.tree.map(lambda x: x[own], knowledge)
        targets, report = transfer.apply(
            given.plan, fresh, knowledge, population=True, **parameters
        )
        if count < members:
            targets = jax.vmap(chosen)(is_target, targets, fresh)
        return jax.vmap(agent.start)(targets, seeds), report

    own_seeds = np.array([member.seed for member in spec.members], np.int32)
    of_members = (
        jnp.arange(members) < count,
        *jax.tree.map(for_all, (own, theirs, parameters)),
    )
    over = placement.over_devices
    # The draws compile longest by far: a program of their own, which all plans of an agent share.
    fresh = init_members(_untouched(agent), own_seeds).params
    made = jax.jit(over(start, (0, 0, 0, 0, 0, 0, None)), donate_argnums=0)
    state, report = placement.own(made(*placement.spread((fresh, own_seeds, *of_members)), shared))
    # It is of the targets alone.
    report = jax.tree.map(lambda x: x[:count], report)
    rows = tuple(row._replace(shape=(count, *row.shape[1:])) for row in report.rows)
    return state, dataclasses.replace(report, rows=rows)


def _untouched(agent: Agent) -> Agent:
    """The agent of which no method has frozen anything: what its initial parameters depend on."""
    agent = agent.on_any_schedule()
    learning = dataclasses.replace(agent.config.learning, frozen=())
    return dataclasses.replace(agent, config=dataclasses.replace(agent.config, learning=learning))
