"""Dreamer (version 1) as pure functions: init, policy, update (thesis section 3.1, algorithm 3).

Axis letters: P population member, B batch, L sequence length, H imagination horizon, A action,
M latent feature size, N imagination starts. Everything here is written for one member and maps
over P with `jax.vmap` or `map_members`.

Parameters are one dict whose names read like the thesis:

    encoder/…  decoder/…  dynamics/{stoch_in, action_in, gru, prior, posterior}/…
    reward/{hidden_i, out}  value/{hidden_i, out}  actor/{hidden_i, out}
    termination/{hidden_i, out}, where the option is on
"""

import functools
from dataclasses import dataclass
from typing import Any, Literal, NamedTuple, get_args

import chex
import flax.struct
import jax
import jax.numpy as jnp
import optax
from flax import linen as nn

from dreamer_jax import learning, networks, rssm
from dreamer_jax.config import COMPONENTS, Config
from dreamer_jax.convolutions import normalise_image

Params = dict[str, Any]
Metrics = dict[str, jax.Array]
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


@flax.struct.dataclass
class AgentState:
    """All that an update reads and writes. A population stacks every leaf on a leading axis P.

    Attributes:
      params: dict of components.
      optimisers: Adam's state for each of the groups "model", "value" and "actor".
      updates: int32 [], updates so far.
      seed: int32 [], the member's seed; keys derive from it and `updates`.
      healthy: bool [], False from the first update on whose losses or gradients were not
        finite: the member is then frozen as it was before that update.
    """

    params: Params
    optimisers: dict[str, Any]
    updates: jax.Array
    seed: jax.Array
    healthy: jax.Array


class Batch(NamedTuple):
    """Sequences of records; record t holds image t and the action and reward that led to it.

    Attributes:
      image: uint8 [B, L, size, size, 3].
      action: float32 [B, L, A].
      reward: float32 [B, L].
      first: bool [B, L], the record is a reset.
      terminal: bool [B, L], the episode ended here (not merely cut).
    """

    image: jax.Array
    action: jax.Array
    reward: jax.Array
    first: jax.Array
    terminal: jax.Array


# Salts that keep the streams of random numbers of one seed apart.
_INIT, _UPDATE = 0, 1

# Set apart from a key's other use: whether what was drawn from it takes the place of what is held.
_HOLD = 1


def member_key(seed: jax.Array | int, purpose: int) -> jax.Array:
    """The key of a member for one purpose; members with one seed share it."""
    return jax.random.fold_in(jax.random.key(seed), purpose)


def _one_of(condition: bool | jax.Array, yes, no):
    """yes() or no(): chosen now, or as the program runs if the condition is traced."""
    if isinstance(condition, bool):
        return yes() if condition else no()
    return jax.lax.cond(condition, yes, no)


@dataclass(frozen=True)
class Agent:
    """The pure functions of an agent of given sizes. Holds no parameters.

    Attributes:
      config: sizes, losses and exploration (the schedule is not used here).
      action_size: A.
      discrete: whether actions are one-hot vectors; else they lie in [-1, 1].
      modules: what takes the place of the usual module of "dynamics" or of a head, as pairs of
        name and module: one with the same methods, and with any parameters of its own.
    """

    config: Config
    action_size: int
    discrete: bool = False
    modules: tuple[tuple[str, nn.Module], ...] = ()

    @functools.cached_property
    def dtype(self):
        return jnp.dtype(self.config.network.precision)

    @functools.cached_property
    def encoder(self) -> networks.Encoder:
        network = self.config.network
        return networks.Encoder(network.encoder_depth, network.image_size, self.dtype)

    @functools.cached_property
    def decoder(self) -> networks.Decoder:
        network = self.config.network
        return networks.Decoder(network.encoder_depth, network.image_size, self.dtype)

    @functools.cached_property
    def dynamics(self) -> rssm.Dynamics:
        network = self.config.network
        layers = networks.encoder_layers(network.image_size)
        usual = rssm.Dynamics(
            stochastic_size=network.stochastic_size,
            deterministic_size=network.deterministic_size,
            hidden_size=network.hidden_size,
            action_size=self.action_size,
            # The encoder ends at 2 x 2 pixels.
            embedding_size=4 * network.encoder_depth * 2 ** (layers - 1),
            minimum_std=network.minimum_std,
            dtype=self.dtype,
        )
        return dict(self.modules).get("dynamics", usual)

    @functools.cached_property
    def heads(self) -> dict[str, networks.Head]:
        """The heads on the latent features, by component name."""
        network = self.config.network
        outputs = self.action_size if self.discrete else 2 * self.action_size
        sizes = {
            "reward": (1, network.reward_layers),
            "value": (1, network.value_layers),
            "actor": (outputs, network.actor_layers),
        }
        if network.termination:
            sizes["termination"] = (1, network.termination_layers)
        usual = {
            name: networks.Head(outputs, layers, network.head_units, self.dtype)
            for name, (outputs, layers) in sizes.items()
        }
        return usual | {name: module for name, module in self.modules if name in usual}

    @functools.cached_property
    def groups(self) -> dict[str, tuple[str, ...]]:
        """The trainable components of each of the three optimisers."""
        components = [name for name in COMPONENTS if name != "termination" or name in self.heads]
        trainable = [name for name in components if name not in self.config.learning.frozen]
        behaviour = ("value", "actor")
        return {
            "model": tuple(name for name in trainable if name not in behaviour),
            **{name: (name,) if name in trainable else () for name in behaviour},
        }

    def trainable(self, params: Params) -> dict[str, Params]:
        """What each of the three optimisers trains: the parts of its components not frozen."""
        frozen = self.config.learning.frozen

        def parts(name):
            return {part: x for part, x in params[name].items() if f"{name}/{part}" not in frozen}

        return {
            group: {name: parts(name) for name in names if parts(name)}
            for group, names in self.groups.items()
        }

    @functools.cached_property
    def _optimisers(self) -> dict[str, optax.GradientTransformation]:
        config = self.config.learning
        rates = {
            "model": config.model_learning_rate,
            "value": config.value_learning_rate,
            "actor": config.actor_learning_rate,
        }
        return {
            name: optax.chain(
                optax.clip_by_global_norm(config.gradient_norm),
                optax.adam(rate, eps=config.adam_epsilon),
            )
            for name, rate in rates.items()
        }

    def init_params(self, key: jax.Array) -> Params:
        """Fresh parameters, float32."""
        size = self.config.network.image_size
        image = jnp.zeros((1, size, size, 3))
        features = jnp.zeros((1, self.config.network.feature_size))
        embedding = jnp.zeros((1, self.dynamics.embedding_size))
        action = jnp.zeros((1, self.action_size))
        modules = {
            "encoder": (self.encoder, (image,)),
            "decoder": (self.decoder, (features,)),
            "dynamics": (self.dynamics, (embedding, action)),
            **{name: (head, (features,)) for name, head in self.heads.items()},
        }
        return {
            # A component's draw depends on its name's place only, so options leave others alone.
            name: module.init(jax.random.fold_in(key, COMPONENTS.index(name)), *inputs)["params"]
            for name, (module, inputs) in modules.items()
        }

    def init(self, seed: jax.Array | int) -> AgentState:
        """A fresh agent of that seed."""
        return self.start(self.init_params(member_key(seed, _INIT)), seed)

    def start(self, params: Params, seed: jax.Array | int) -> AgentState:
        """An agent that starts from given parameters, with fresh optimisers.

        Raises:
          ValueError: a part that is to be frozen is none of the agent's.
        """
        for name in self.config.learning.frozen:
            component, _, part = name.partition("/")
            if part and part not in params.get(component, {}):
                raise ValueError(
                    f"cannot freeze {name!r}: the parts of {component} are "
                    f"{', '.join(params.get(component, {})) or 'none, it is not in this agent'}"
                )
        optimisers = {
            name: self._optimisers[name].init(parts)
            for name, parts in self.trainable(params).items()
        }
        return AgentState(
            params=params,
            optimisers=optimisers,
            updates=jnp.int32(0),
            seed=jnp.asarray(seed, jnp.int32),
            healthy=jnp.bool_(True),
        )

    def head(self, params: Params, name: str, features: jax.Array) -> jax.Array:
        """The outputs of one head: float [..., M] -> float32 [..., outputs]."""
        return self.heads[name].apply({"params": params[name]}, features)

    def reward(self, params: Params, features: jax.Array) -> jax.Array:
        """Predicted reward of a latent state: [..., M] -> float32 [...]."""
        return self.head(params, "reward", features)[..., 0]

    def value(self, params: Params, features: jax.Array) -> jax.Array:
        """Predicted value of a latent state: [..., M] -> float32 [...]."""
        return self.head(params, "value", features)[..., 0]

    def encode(self, params: Params, image: jax.Array) -> jax.Array:
        """Embeddings: uint8 [..., size, size, 3] -> [..., E]."""
        image = normalise_image(image)
        return self.encoder.apply({"params": params["encoder"]}, image)

    def decode(self, params: Params, features: jax.Array) -> jax.Array:
        """Reconstructed images, float32 about [-0.5, 0.5]: [..., M] -> [..., size, size, 3]."""
        return self.decoder.apply({"params": params["decoder"]}, features)

    def observe(self, params: Params, batch: Batch, key: jax.Array):
        """Posterior states [B, L, ...] of a batch, and the prior's mean and std beside them."""
        embeddings = self.encode(params, batch.image)
        return rssm.observe(
            self.dynamics, params["dynamics"], embeddings, batch.action, batch.first, key
        )

    # Acting.

    def initial_carry(self) -> Carry:
        """The policy's memory before an episode."""
        nothing = jnp.zeros(self.action_size)
        return Carry(self.dynamics.initial(), nothing, nothing)

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
            mode = MODES.index(mode)

        def at_random() -> tuple[jax.Array, Carry]:
            action = self._held(self.random_action(key), carry.random, first, key)
            return action, carry._replace(random=action)

        def by_actor() -> tuple[jax.Array, Carry]:
            latent_key, action_key, explore_key = jax.random.split(key, 3)
            variables = {"params": params["dynamics"]}
            embedded = self.encode(params, image[None])[0]
            projected = self.dynamics.apply(variables, embedded, method="project")
            noise = jax.random.normal(latent_key, carry.state.stochastic.shape)
            state = self.dynamics.apply(
                variables, carry.state, carry.action, projected, first, noise, method="obs_step"
            )
            outputs = self.head(params, "actor", state.features)

            def evaluated() -> tuple[jax.Array, jax.Array]:
                return self._mode(outputs, action_key), jnp.where(first, 0.0, carry.random)

            def explored() -> tuple[jax.Array, jax.Array]:
                action = self.sample(outputs, self.action_noise(action_key, ()))
                return self._explore(action, carry.random, first, explore_key, updates)

            action, random = _one_of(mode == MODES.index("evaluate"), evaluated, explored)
            return action, Carry(state, action, random)

        return _one_of(mode == MODES.index("random"), at_random, by_actor)

    def random_action(self, key: jax.Array) -> jax.Array:
        """A uniformly random action, float32 [A]."""
        if self.discrete:
            choice = jax.random.randint(key, (), 0, self.action_size)
            return jax.nn.one_hot(choice, self.action_size)
        return jax.random.uniform(key, (self.action_size,), minval=-1.0, maxval=1.0)

    def action_noise(self, key: jax.Array, shape: tuple[int, ...]) -> jax.Array:
        """What `sample` turns into actions, float32 [*shape, A]."""
        draw = jax.random.gumbel if self.discrete else jax.random.normal
        return draw(key, (*shape, self.action_size))

    def sample(self, outputs: jax.Array, noise: jax.Array) -> jax.Array:
        """An action, [..., A], from the actor's outputs and `action_noise`."""
        if self.discrete:
            return networks.one_hot_sample(outputs, noise)
        return networks.tanh_normal_sample(outputs, noise)

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
        changes = jax.random.uniform(jax.random.fold_in(key, _HOLD)) < 1 / hold
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
        random = self._held(self.random_action(action_key), held, first, key)
        return jnp.where(explores, random, action), random

    # Learning.

    def update(self, state: AgentState, batch: Batch) -> tuple[AgentState, Metrics]:
        """One update of model, value and actor, all gradients from the same parameters.

        Args:
          state: of one member.
          batch: of one member.

        Returns:
          The new state, and metrics: float32 scalars by name. Where a loss or gradient is not
          finite, or was before, all but `updates` stays as it was and `healthy` is False.
        """
        chex.assert_rank(batch.image, 5)
        chex.assert_shape(batch.action, (*batch.reward.shape, self.action_size))
        chex.assert_equal_shape([batch.reward, batch.first, batch.terminal])
        key = jax.random.fold_in(member_key(state.seed, _UPDATE), state.updates)
        model_key, behaviour_key = jax.random.split(key)

        params = state.params
        parts = self.trainable(params)
        (_, (posterior, metrics)), model_gradient = jax.value_and_grad(
            learning.model_loss, argnums=1, has_aux=True
        )(self, parts["model"], params, batch, model_key)
        (_, behaviour_metrics), behaviour_gradient = jax.value_and_grad(
            learning.behaviour_loss, argnums=1, has_aux=True
        )(
            self,
            parts["actor"] | parts["value"],
            params,
            posterior,
            behaviour_key,
            state.updates,
        )
        gradients = {"model": model_gradient} | {
            name: {part: behaviour_gradient[part] for part in parts[name]}
            for name in ("actor", "value")
        }
        metrics |= behaviour_metrics
        for name, gradient in gradients.items():
            if gradient:
                norm = optax.tree.norm(gradient)
                clipped = norm > self.config.learning.gradient_norm
                metrics |= {
                    f"{name}_gradient_norm": norm,
                    f"{name}_gradient_clipped": clipped.astype(jnp.float32),
                }

        optimisers, new_params = {}, dict(params)
        for name, gradient in gradients.items():
            updates, optimisers[name] = self._optimisers[name].update(
                gradient, state.optimisers[name]
            )
            new_params = learning.joined(new_params, optax.apply_updates(parts[name], updates))
        finite = jnp.isfinite(jnp.stack(list(metrics.values()))).all()
        healthy = state.healthy & finite
        new_params, optimisers = jax.tree.map(
            lambda new, old: jnp.where(healthy, new, old),
            (new_params, optimisers),
            (params, state.optimisers),
        )
        state = AgentState(new_params, optimisers, state.updates + 1, state.seed, healthy)
        return state, metrics

    def predict(
        self, params: Params, batch: Batch, context: int, key: jax.Array
    ) -> tuple[jax.Array, jax.Array]:
        """Reconstructs the first images of sequences and predicts the rest from actions alone.

        Args:
          params: the agent's parameters.
          batch: sequences without a reset after the context.
          context: images that are seen.
          key: for the latent samples.

        Returns:
          truth and model, float32 [B, L, size, size, 3] in [0, 1].
        """
        context_key, rollout_key = jax.random.split(key)
        seen = Batch(*(x[:, :context] for x in batch))
        posterior, _, _ = self.observe(params, seen, context_key)
        start = jax.tree.map(lambda x: x[:, -1], posterior)
        actions = jnp.swapaxes(batch.action[:, context:], 0, 1)
        states = rssm.imagine(
            self.dynamics,
            params["dynamics"],
            lambda features, action: action,
            start,
            actions.shape[0],
            rollout_key,
            actions,
        )
        features = jnp.concatenate(
            [posterior.features, jnp.swapaxes(states.features, 0, 1)], axis=1
        )
        truth = normalise_image(batch.image)
        model = self.decode(params, features)
        return truth + 0.5, jnp.clip(model + 0.5, 0.0, 1.0)
