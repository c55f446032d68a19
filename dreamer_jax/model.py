"""The networks of an agent as one model: encode, observe, imagine from, decode, and the heads.

Axis letters: P population member, B batch, L sequence length, A action, E embedding size,
M latent feature size. Everything here is written for one member.

Parameters are one dict whose names read like the thesis:

    encoder/…  decoder/…  dynamics/{stoch_in, action_in, gru, prior, posterior}/…
    reward/{hidden_i, out}  value/{hidden_i, out}  actor/{hidden_i, out}
    termination/{hidden_i, out}, where the option is on
"""

import contextlib
import dataclasses
import functools
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, TypeVar

import jax
import jax.numpy as jnp

from dreamer_jax import networks, randomness, rssm
from dreamer_jax.config import Config
from dreamer_jax.convolutions import Method, normalise_image
from dreamer_jax.freezing import Params
from dreamer_jax.records import Records

Wrapped = TypeVar("Wrapped", bound=Callable)


def multiplies(method: Wrapped) -> Wrapped:
    """A method of a model, with products of matrices in the precision that its settings ask for."""

    @functools.wraps(method)
    def within(self, *arguments, **named):
        with self.matmul_precision():
            return method(self, *arguments, **named)

    return within  # type: ignore[return-value]


@dataclass(frozen=True)
class Model:
    """The networks of given sizes, as pure functions of parameters. Holds no parameters.

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
    modules: tuple[tuple[str, Any], ...] = ()

    @functools.cached_property
    def dtype(self):
        return jnp.dtype(self.config.network.precision)

    def matmul_precision(self) -> contextlib.AbstractContextManager:
        """Within it, products that are traced have the precision that the settings ask for."""
        precision = self.config.network.matmul_precision
        if precision == "default":
            # What JAX's own setting says, JAX_DEFAULT_MATMUL_PRECISION.
            return contextlib.nullcontext()
        return jax.default_matmul_precision(precision)

    @property
    def convolutions(self) -> Method | None:
        """How they are computed; None: as is best on the default device."""
        method = self.config.network.convolutions
        return None if method == "auto" else method

    @functools.cached_property
    def encoder(self) -> networks.Encoder:
        network = self.config.network
        sizes = network.encoder_depth, network.image_size
        return networks.Encoder(*sizes, self.dtype, self.convolutions)

    @functools.cached_property
    def decoder(self) -> networks.Decoder:
        network = self.config.network
        sizes = network.encoder_depth, network.image_size
        return networks.Decoder(*sizes, self.dtype, self.convolutions)

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

    def parameter_shapes(self) -> Params:
        """The shapes of `init_params`, `jax.ShapeDtypeStruct`; traced once for equal networks."""
        plain = dataclasses.replace(self, config=Config(network=self.config.network))
        return jax.tree.map(lambda x: x, _parameter_shapes(plain))

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
            name: module.init(randomness.component_key(key, name), *inputs)["params"]
            for name, (module, inputs) in modules.items()
        }

    @multiplies
    def head(self, params: Params, name: str, features: jax.Array) -> jax.Array:
        """The outputs of one head: float [..., M] -> float32 [..., outputs]."""
        return networks.applied(self.heads[name], params[name], features)

    def reward(self, params: Params, features: jax.Array) -> jax.Array:
        """Predicted reward of a latent state: [..., M] -> float32 [...]."""
        return self.head(params, "reward", features)[..., 0]

    def value(self, params: Params, features: jax.Array) -> jax.Array:
        """Predicted value of a latent state: [..., M] -> float32 [...]."""
        return self.head(params, "value", features)[..., 0]

    @multiplies
    def encode(self, params: Params, image: jax.Array) -> jax.Array:
        """Embeddings: uint8 [..., size, size, 3] -> [..., E]."""
        return networks.applied(self.encoder, params["encoder"], normalise_image(image))

    @multiplies
    def decode(self, params: Params, features: jax.Array) -> jax.Array:
        """Reconstructed images, float32 about [-0.5, 0.5]: [..., M] -> [..., size, size, 3]."""
        return networks.applied(self.decoder, params["decoder"], features)

    @multiplies
    def observe(
        self, params: Params, batch: Records, key: jax.Array
    ) -> tuple[rssm.LatentState, jax.Array, jax.Array]:
        """Posterior states [B, L, ...] of a batch, and the prior's mean and std beside them."""
        embeddings = self.encode(params, batch.image)
        return rssm.observe(
            self.dynamics, params["dynamics"], embeddings, batch.action, batch.first, key
        )

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

    @multiplies
    def predict(
        self, params: Params, batch: Records, context: int, key: jax.Array
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
        seen = batch.at(slice(None), slice(context))
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


@functools.cache
def _parameter_shapes(model: Model) -> Params:
    return jax.eval_shape(model.init_params, jax.random.key(0))
