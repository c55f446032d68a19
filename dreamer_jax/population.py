"""Populations: the agent's functions over a leading axis P of members.

Axis letters: P population member, K task, B batch, L sequence length, T ticks in a phase.
"""

import dataclasses
import functools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from dreamer_jax.agent import MODES, Agent, Mode
from dreamer_jax.devices import Placement
from dreamer_jax.diagnosis import diagnose
from dreamer_jax.freezing import Params
from dreamer_jax.learning import AgentState
from dreamer_jax.records import Records
from dreamer_jax.rollout import collect


@dataclass(frozen=True)
class Member:
    """One member of a population.

    Attributes:
      seed: of its parameters, simulators, batches and noise.
      label: how it is named in messages and metrics.
      tags: further columns of its metrics (for example omega).
    """

    seed: int
    label: str
    tags: Mapping[str, Any] = field(default_factory=dict)


def map_members(function, mapping: str, chunk: int = 1):
    """Maps a function of one member over a leading axis P of all its arguments.

    Args:
      function: of trees of one member.
      mapping: "vmap" runs all members at once, "chunks" `chunk` members after `chunk` members;
        "auto" is "chunks" on the CPU, where batched small products and grouped convolutions are
        slower than a loop, and "vmap" elsewhere.
      chunk: members in a chunk.

    Raises:
      ValueError: unknown mapping.
    """
    if mapping == "auto":
        mapping = "chunks" if jax.default_backend() == "cpu" else "vmap"
    if mapping == "vmap":
        return jax.vmap(function)
    if mapping != "chunks":
        raise ValueError(f"unknown mapping {mapping!r}: choose auto, vmap or chunks")

    def mapped(*trees):
        members = jax.tree.leaves(trees)[0].shape[0]
        if members == 1:
            outputs = function(*jax.tree.map(lambda x: x[0], trees))
            return jax.tree.map(lambda x: x[None], outputs)
        batch_size = chunk if chunk > 1 else None
        return jax.lax.map(lambda arguments: function(*arguments), trees, batch_size=batch_size)

    return mapped


@functools.partial(jax.jit, static_argnums=0, inline=True)
def update_member(agent: Agent, state: AgentState, batch: Records):
    """`agent.update`, whose tracing takes a second: once for whatever asks with the same shapes."""
    return agent.update(state, batch)


@functools.partial(jax.jit, static_argnames=("agent", "mapping", "chunk"), donate_argnums=(1, 2))
def update_members(
    agent: Agent, state: AgentState, sums, batch: Records, *, mapping: str, chunk: int
):
    """One update of every member.

    Args:
      agent: the agent's functions.
      state: leaves [P, ...]; its memory is reused.
      sums: running sums of the metrics, [P] each; its memory is reused.
      batch: leaves [P, B, L, ...].
      mapping, chunk: see `map_members`.

    Returns:
      The new state, the new sums, and the model's loss of this update, [P].
    """
    update = functools.partial(update_member, agent)
    state, metrics = map_members(update, mapping, chunk)(state, batch)
    sums = jax.tree.map(jnp.add, sums, metrics)
    return state, sums, metrics["model_loss"]


@jax.jit
def copied(tree):
    """A tree of arrays in memory of their own, which no program that reuses the other's writes."""
    return jax.tree.map(jnp.copy, tree)


def init_members(agent: Agent, seeds: Sequence[int] | np.ndarray | jax.Array) -> AgentState:
    """Fresh agents of the given seeds, int [P] -> NumPy leaves [P, ...].

    They are drawn one after the other, so that populations of all sizes share one program: its
    code takes longer to compile than members to draw.
    """
    draw = init_program()
    members = [jax.device_get(draw(agent, np.int32(seed))) for seed in np.asarray(seeds)]
    return jax.tree.map(lambda *leaves: np.stack(leaves), *members)


@functools.cache
def init_program():
    """`agent.init` of an agent and a seed, compiled quickly: one function for all that call it.

    It is no part of another program, for JAX allows no options of compilation there.
    """
    return jax.jit(_fresh, static_argnames="agent", compiler_options=_of_one_use())


def _fresh(agent: Agent, seed: jax.Array) -> AgentState:
    return agent.init(seed)


def _of_one_use() -> dict[str, int] | None:
    """How a program is compiled that runs once: a CPU's code of draws takes half a minute to
    optimise, and without that a tenth of a second to run."""
    return {"xla_backend_optimization_level": 0} if jax.default_backend() == "cpu" else None


def batch_shapes(agent: Agent, batch_size: int, length: int) -> Records:
    """The shapes of one member's batch, `jax.ShapeDtypeStruct` [B, L, ...]."""
    shape, size = (batch_size, length), agent.config.network.image_size
    return Records(
        image=jax.ShapeDtypeStruct((*shape, size, size, 3), jnp.uint8),
        action=jax.ShapeDtypeStruct((*shape, agent.action_size), jnp.float32),
        reward=jax.ShapeDtypeStruct(shape, jnp.float32),
        first=jax.ShapeDtypeStruct(shape, jnp.bool_),
        terminal=jax.ShapeDtypeStruct(shape, jnp.bool_),
    )


def zero_sums(agent: Agent, state: AgentState, batch_size: int, length: int) -> dict:
    """Sums of metrics before the first update, [P] each, without running an update."""
    batch = batch_shapes(agent, batch_size, length)
    member = jax.tree.map(lambda x: jax.ShapeDtypeStruct(x.shape[1:], x.dtype), state)
    metrics = update_member.eval_shape(agent, member, batch)[1]
    members = state.updates.shape[0]
    return {name: jnp.zeros(members, x.dtype) for name, x in metrics.items()}


def check_environment(agent: Agent, env, placement: Placement) -> None:
    """Whether an environment is one for these agents, and for where they lie.

    Raises:
      ValueError: it is not; names both sides.
    """
    if (shards := getattr(env, "shards", 1)) != placement.count:
        raise ValueError(
            f"the environment is made for {shards} devices, the members lie on "
            f"{placement.count}: build it with shards={placement.count}"
        )
    if env.action_size != agent.action_size:
        raise ValueError(
            f"the environment takes actions of size {env.action_size}, the agent gives "
            f"{agent.action_size}: build both for the same tasks"
        )
    if env.discrete != agent.discrete:
        kinds = ["discrete" if x.discrete else "continuous" for x in (env, agent)]
        raise ValueError(
            f"the environment takes {kinds[0]} actions, the agent gives {kinds[1]} ones: "
            "build both for the same tasks"
        )
    if env.image_size != agent.config.network.image_size:
        raise ValueError(
            f"the environment renders {env.image_size} pixels, the agent reads "
            f"{agent.config.network.image_size}: build both with the same image_size"
        )


class Population:
    """What an agent does, for all members: each device does it for its own.

    P counts the padding of the placement, if members lie on several devices.

    Args:
      agent: the agent's functions.
      env: an environment of P * K slots, see `dreamer_jax.rollout`.
      tasks: K.
      own_seeds: of the members.
      placement: where they lie.

    Attributes:
      own_seeds: of the members.
      seeds: int32 [P], the same on the devices.
      copied: a function of a tree, leaves [P, ...]: it in memory of its own.
    """

    def __init__(
        self, agent: Agent, env, tasks: int, own_seeds: Sequence[int], placement: Placement
    ):
        self._agent, self._env, self._tasks = agent.on_any_schedule(), env, tasks
        self._schedule = agent.config.schedule
        self._placement, self._numbers = placement, placement.numbers()
        self.own_seeds = list(own_seeds)
        self.seeds = placement.spread(jnp.array(self.own_seeds, jnp.int32))
        over = placement.over_devices
        self._update = over(self._update_members, axes=(0, 0, 0), donate=(0, 1))
        self._collect = over(self._collect_members, axes=(0, 0, 0, None, None, 0))
        self._diagnose = over(functools.partial(diagnose, self._agent), axes=(0, 0, 0, None))
        self.copied = over(copied, axes=(0,))

    def fresh(self) -> AgentState:
        """Fresh agents of the members' seeds: leaves [P, ...]."""
        fresh = init_members(self._agent, self.own_seeds)
        return self.put(fresh if self._placement.mesh else jax.device_put(fresh))

    def shapes(self) -> AgentState:
        """Their shapes, `jax.ShapeDtypeStruct` [P with padding, ...]."""
        return jax.eval_shape(jax.vmap(self._agent.init), self.seeds)

    def put(self, state: AgentState) -> AgentState:
        """Agents brought to their devices."""
        return self.without_padding(self._placement.spread(state))

    def without_padding(self, state: AgentState) -> AgentState:
        """Agents of which padding is not healthy, so that nothing trains it."""
        healthy = self._placement.without_padding(state.healthy)
        return dataclasses.replace(state, healthy=healthy)

    def zero_sums(self, state: AgentState) -> dict[str, jax.Array]:
        """Sums of metrics before the first update, [P] each."""
        learning = self._agent.config.learning
        sums = zero_sums(self._agent, state, learning.batch_size, learning.sequence_length)
        return jax.device_put(sums, self._placement.sharding())

    def update(
        self, state: AgentState, sums: dict[str, jax.Array], batch: Records
    ) -> tuple[AgentState, dict[str, jax.Array], jax.Array]:
        """One update of every member, see `update_members`; the batch is of the members alone."""
        return self._update(state, sums, self._placement.spread(batch))

    def _update_members(self, state, sums, batch):
        mapping, chunk = self._schedule.mapping, self._schedule.mapping_chunk
        return update_members(self._agent, state, sums, batch, mapping=mapping, chunk=chunk)

    def collect(self, state: AgentState, phase: int, mode: Mode) -> Records:
        """One phase of every task by every member, see `dreamer_jax.rollout.collect`.

        Returns:
          Leaves [P, K, T + 1, ...].
        """
        numbers = jnp.int32(phase), jnp.int32(MODES.index(mode))
        return self._collect(state.params, self.seeds, state.updates, *numbers, self._numbers)

    def _collect_members(self, params, seeds, updates, phase, mode, numbers):
        return collect(
            self._agent,
            self._env,
            params,
            seeds,
            updates,
            phase,
            tasks=self._tasks,
            ticks=self._schedule.phase_ticks,
            mode=mode,
            numbers=numbers,
        )

    def diagnose(self, params: Params, records: Records, phase: int) -> dict[str, jax.Array]:
        """What models know of a phase, see `dreamer_jax.diagnosis.diagnose`.

        Args:
          params: leaves [P, ...].
          records: of the members alone, leaves [., K, T + 1, ...].
          phase: its number.

        Returns:
          By name, float32 [P, K].
        """
        played = self._placement.spread(records)
        return self._diagnose(params, played, self.seeds, jnp.int32(phase))
