"""Dreamer (version 1) as pure functions: init, policy, update (thesis section 3.1, algorithm 3).

Axis letters: P population member, B batch, L sequence length, A action. Everything here is written
for one member and maps over P with `jax.vmap` or `map_members`.
"""

import dataclasses
from dataclasses import dataclass
from typing import Literal, NamedTuple, get_args

import jax
import jax.numpy as jnp
import optax

from dreamer_jax import learning, networks, randomness, rssm
from dreamer_jax.config import ScheduleConfig
from dreamer_jax.freezing import Params
from dreamer_jax.learning import AgentState, Metrics
from dreamer_jax.model import Model, multiplies
from dreamer_jax.records import Records

Mode = Literal["random", "explore", "evaluate"]
MODES: tuple[Mode, ...] = get_args(Mode)


class Carry(NamedTuple):
    """What the policy remembers between steps.

    Attributes:
      state: the latent state.
      action: float32 [A], the action taken in it.
      random: float32 [A], the random action or noise that is held.
    """

    state: rssm.LatentState
    action: jax.Array
    random: jax.Array


def _one_of(condition: bool | jax.Array, yes, no):
    """yes() or no(): chosen now, or as the program runs if the condition is traced."""
    if isinstance(condition, bool):
        return yes() if condition else no()
    return jax.lax.cond(condition, yes, no)


@dataclass(frozen=True)
class Agent(Model):
    """A model that acts and learns: the pure functions of an agent. Holds no parameters."""

    def on_any_schedule(self) -> "Agent":
        """The same agent, without what only a run asks about.

        None of its functions reads the schedule, so those who compile them do it for this one:
        agents that differ in their schedules alone share their programs.
        """
        schedule = ScheduleConfig(phase_environment_steps=10**6)  # as long as any sequence
        return dataclasses.replace(self, config=dataclasses.replace(self.config, schedule=schedule))

    def init(self, seed: jax.Array | int) -> AgentState:
        """A fresh agent of that seed."""
        key = randomness.member_key(seed, randomness.Purpose.INIT)
        return self.start(self.init_params(key), seed)

    def start(self, params: Params, seed: jax.Array | int) -> AgentState:
        """An agent that starts from given parameters, with fresh optimisers.

        Raises:
          ValueError: what is to be frozen is none of the agent's.
        """
        return learning.start(self, params, seed)

    @multiplies
    def update(self, state: AgentState, batch: Records) -> tuple[AgentState, Metrics]:
        """One update of all that is trained: see `dreamer_jax.learning.update`."""
        return learning.update(self, state, batch)

    def trainable(self, params: Params) -> dict[str, Params]:
        """The leaves that each of the three optimisers trains, by its name."""
        return learning.trainable(self, params)

    def initial_carry(self) -> Carry:
        """The policy's memory before an episode."""
        nothing = jnp.zeros(self.action_size)
        return Carry(self.dynamics.initial(), nothing, nothing)

    @multiplies
    def policy(
        self,
        params: Params,
        carry: Carry,
        image: jax.Array,
        first: jax.Array,
        key: jax.Array,
        mode: Mode | jax.Array,
        updates: jax.Array | int = 0,
    ) -> tuple[jax.Array, Carry]:
        """Chooses an action for one image.

        Args:
          params: the agent's parameters.
          carry: memory; forgotten where `first`.
          image: uint8 [size, size, 3].
          first: bool [], whether the image is the first of an episode.
          key: for the latent sample, the action and the exploration.
          mode: "random" looks at nothing; "explore" adds exploration to a sample; "evaluate" takes
            the mode, without noise. Or its index in `MODES`, int32 []: one program for all three.
          updates: int [], updates so far, for the schedule of epsilon-greedy.

        Returns:
          The action, float32 [A], and the new memory.
        """
        if isinstance(mode, str):
            if mode not in MODES:
                raise ValueError(f"unknown policy mode {mode!r}: choose one of {', '.join(MODES)}")
            chosen: int | jax.Array = MODES.index(mode)
        else:
            chosen = mode

        def at_random() -> tuple[jax.Array, Carry]:
            action = self._held(self.random_action(key), carry.random, first, key)
            return action, carry._replace(random=action)

        def by_actor() -> tuple[jax.Array, Carry]:
            latent_key, action_key, explore_key = jax.random.split(key, 3)
            dynamics, variables = self.dynamics, params["dynamics"]
            embedded = self.encode(params, image[None])[0]
            projected = networks.applied(dynamics, variables, embedded, method="project")
            noise = jax.random.normal(latent_key, carry.state.stochastic.shape)
            inputs = (carry.state, carry.action, projected, first, noise)
            state = networks.applied(dynamics, variables, *inputs, method="obs_step")
            outputs = self.head(params, "actor", state.features)

            def evaluated() -> tuple[jax.Array, jax.Array]:
                return self._mode(outputs, action_key), jnp.where(first, 0.0, carry.random)

            def explored() -> tuple[jax.Array, jax.Array]:
                action = self.sample(outputs, self.action_noise(action_key, ()))
                return self._explore(action, carry.random, first, explore_key, updates)

            action, random = _one_of(chosen == MODES.index("evaluate"), evaluated, explored)
            return action, Carry(state, action, random)

        return _one_of(chosen == MODES.index("random"), at_random, by_actor)

    def _mode(self, outputs: jax.Array, key: jax.Array) -> jax.Array:
        if self.discrete:
            return jax.nn.one_hot(jnp.argmax(outputs, -1), self.action_size)
        if self.config.exploration.evaluation_action == "mean":
            return jnp.tanh(networks.tanh_normal(outputs)[0])
        return networks.tanh_normal_mode(outputs, key)

    def _held(self, fresh: jax.Array, held: jax.Array, first: jax.Array, key: jax.Array):
        """What was drawn before, or `fresh` as often as the mean time of holding says."""
        hold = self.config.exploration.exploration_hold
        if hold == 1:
            return fresh
        changes = jax.random.uniform(randomness.hold_key(key)) < 1 / hold
        return jnp.where(first | changes, fresh, held)

    def _explore(
        self,
        action: jax.Array,
        held: jax.Array,
        first: jax.Array,
        key: jax.Array,
        updates: jax.Array | int,
    ) -> tuple[jax.Array, jax.Array]:
        """The action with what explores, and what is held of that."""
        exploration = self.config.exploration
        if not self.discrete and exploration.exploration_kind == "gaussian":
            noise = self._held(jax.random.normal(key, action.shape), held, first, key)
            explored = action + exploration.exploration_noise * noise
            return jnp.clip(explored, -1.0, 1.0), noise
        schedule = optax.linear_schedule(
            exploration.epsilon_start, exploration.epsilon_end, exploration.epsilon_decay
        )
        choice_key, action_key = jax.random.split(key)
        explores = jax.random.uniform(choice_key) < schedule(updates)
        random = self._held(self.random_action(action_key), held, first, action_key)
        return jnp.where(explores, random, action), random
