"""The recurrent state-space model: latent dynamics with a stochastic and a deterministic part.

Thesis sections 2.3.3 and 3.1 (representation and transition model). Axis letters: B batch,
L sequence length, H imagination horizon, A action, E embedding size, M latent feature size.
Steps work on any leading axes, written "...".
"""

import functools
from typing import NamedTuple

import jax
import jax.numpy as jnp
from flax import linen as nn

from dreamer_jax.networks import Dense, Dtype, add_bias, applied, elu, glorot_uniform, zeros


class LatentState(NamedTuple):
    """A latent state and the Gaussian its stochastic part was drawn from, all float32.

    Attributes:
      mean: [..., stochastic_size].
      std: [..., stochastic_size].
      stochastic: [..., stochastic_size], the sample.
      deterministic: [..., deterministic_size], the state of the GRU.
    """

    mean: jax.Array
    std: jax.Array
    stochastic: jax.Array
    deterministic: jax.Array

    @property
    def features(self) -> jax.Array:
        """What the heads read: stochastic and deterministic parts joined, [..., M]."""
        return jnp.concatenate([self.stochastic, self.deterministic], axis=-1)


@functools.partial(jax.jit, static_argnums=1)
def orthogonal(key: jax.Array, shape: tuple[int, int]) -> jax.Array:
    """A matrix with orthonormal rows (or columns, if it is tall), uniform among all such.

    Gram-Schmidt on a Gaussian matrix, each vector orthogonalised twice, which is as exact as
    Householder's method. No LAPACK call is made: several of those side by side can deadlock
    XLA's thread pool on a machine of two cores.
    """
    rows, columns = min(shape), max(shape)
    gaussian = jax.random.normal(key, (rows, columns))

    def orthogonalise(i, basis):
        vector = gaussian[i]
        # Rows from i on are still zero and take nothing away.
        for _ in range(2):
            vector = vector - (basis @ vector) @ basis
        return basis.at[i].set(vector / jnp.linalg.norm(vector))

    with jax.default_matmul_precision("highest"):
        basis = jax.lax.fori_loop(0, rows, orthogonalise, jnp.zeros((rows, columns)))
    return basis if shape[0] <= shape[1] else basis.T


class GRU(nn.Module):
    """Gated recurrent unit with the reset gate applied after the recurrent product.

    z, r = sigmoid(x W + b + h U + c) for the update and reset gates,
    n = tanh(x W + b + r * (h U + c)), h' = z * h + (1 - z) * n;
    gates in the order z, r, n along the columns, as in Keras with `reset_after`.
    `bias` holds b and c in its two rows.
    """

    features: int
    dtype: Dtype = jnp.float32

    @nn.compact
    def __call__(self, inputs: jax.Array, hidden: jax.Array) -> jax.Array:
        """inputs [..., I], hidden [..., features] -> float32 [..., features]."""
        columns = 3 * self.features
        kernel = self.param("kernel", glorot_uniform, (inputs.shape[-1], columns))
        recurrent = self.param("recurrent_kernel", orthogonal, (self.features, columns))
        bias = self.param("bias", zeros, (2, columns))
        from_inputs = inputs.astype(self.dtype) @ kernel.astype(self.dtype) + bias[0]
        from_hidden = hidden.astype(self.dtype) @ recurrent.astype(self.dtype) + bias[1]
        gates, recurrent_gates = (jnp.split(x, 3, axis=-1) for x in (from_inputs, from_hidden))
        update = jax.nn.sigmoid(gates[0] + recurrent_gates[0])
        reset = jax.nn.sigmoid(gates[1] + recurrent_gates[1])
        candidate = jnp.tanh(gates[2] + reset * recurrent_gates[2])
        return update * hidden + (1 - update) * candidate


class JoinedDense(nn.Module):
    """A dense layer on the concatenation of two inputs, whose parts may be computed apart.

    The second input's share (`project`) needs no recurrence, so a sequence computes it at once.
    """

    sizes: tuple[int, int]
    features: int
    dtype: Dtype = jnp.float32

    def setup(self):
        self.kernel = self.param("kernel", glorot_uniform, (sum(self.sizes), self.features))
        self.bias = self.param("bias", zeros, (self.features,))

    def project(self, second: jax.Array) -> jax.Array:
        """The second input's share and the bias: [..., sizes[1]] -> [..., features]."""
        kernel = self.kernel[self.sizes[0] :].astype(self.dtype)
        return add_bias(second.astype(self.dtype) @ kernel, self.bias)

    def __call__(self, first: jax.Array, projected: jax.Array) -> jax.Array:
        """[..., sizes[0]] and `project`'s [..., features] -> [..., features]."""
        kernel = self.kernel[: self.sizes[0]].astype(self.dtype)
        return first.astype(self.dtype) @ kernel + projected


class Prior(nn.Module):
    """From the deterministic part to a Gaussian's two parameters, float32."""

    hidden_size: int
    outputs: int
    dtype: Dtype = jnp.float32

    def setup(self):
        self.hidden = Dense(self.hidden_size, dtype=self.dtype)
        self.out = Dense(self.outputs, dtype=self.dtype, output_dtype=jnp.float32)

    def __call__(self, deterministic: jax.Array) -> jax.Array:
        return self.out(elu(self.hidden(deterministic)))


class Posterior(nn.Module):
    """From the deterministic part and the embedding to a Gaussian's two parameters, float32."""

    sizes: tuple[int, int]
    hidden_size: int
    outputs: int
    dtype: Dtype = jnp.float32

    def setup(self):
        self.hidden = JoinedDense(self.sizes, self.hidden_size, dtype=self.dtype)
        self.out = Dense(self.outputs, dtype=self.dtype, output_dtype=jnp.float32)

    def project(self, embedding: jax.Array) -> jax.Array:
        return self.hidden.project(embedding)

    def __call__(self, deterministic: jax.Array, projected: jax.Array) -> jax.Array:
        return self.out(elu(self.hidden(deterministic, projected)))


class Dynamics(nn.Module):
    """The RSSM. Noise is passed in as standard normal samples, so that steps are deterministic.

    Attributes:
      stochastic_size, deterministic_size, hidden_size: sizes.
      action_size: A.
      embedding_size: E.
      minimum_std: added to every standard deviation.
      dtype: dtype of the matrix products; states and distributions are float32.
    """

    stochastic_size: int
    deterministic_size: int
    hidden_size: int
    action_size: int
    embedding_size: int
    minimum_std: float = 0.1
    dtype: Dtype = jnp.float32

    def setup(self):
        # Two kernels in place of one on the concatenation [stochastic, action], drawn alike:
        # fractional transfer treats the weights from the action apart.
        fan_in = self.stochastic_size + self.action_size
        size = self.hidden_size
        self.stoch_in = Dense(size, fan_in=fan_in, dtype=self.dtype)
        self.action_in = Dense(size, fan_in=fan_in, use_bias=False, dtype=self.dtype)
        self.gru = GRU(self.deterministic_size, dtype=self.dtype)
        outputs = 2 * self.stochastic_size
        self.prior = Prior(size, outputs, dtype=self.dtype)
        sizes = (self.deterministic_size, self.embedding_size)
        self.posterior = Posterior(sizes, size, outputs, dtype=self.dtype)

    def _latent_state(self, statistics, noise, deterministic) -> LatentState:
        mean, std = jnp.split(statistics, 2, axis=-1)
        std = jax.nn.softplus(std) + self.minimum_std
        return LatentState(mean, std, mean + std * noise, deterministic)

    def _recur(self, state: LatentState, action: jax.Array) -> jax.Array:
        x = elu(self.stoch_in(state.stochastic) + self.action_in(action))
        return self.gru(x, state.deterministic)

    def img_step(self, state: LatentState, action: jax.Array, noise: jax.Array) -> LatentState:
        """The prior: the next state from a state and an action, without seeing an image.

        Args:
          state: leaves [..., sizes].
          action: float32 [..., A].
          noise: float32 [..., stochastic_size], standard normal.
        """
        deterministic = self._recur(state, action)
        return self._latent_state(self.prior(deterministic), noise, deterministic)

    def project(self, embedding: jax.Array) -> jax.Array:
        """The embedding's share of the posterior's hidden layer, [..., E] -> [..., hidden]."""
        return self.posterior.project(embedding)

    def obs_step(
        self,
        state: LatentState,
        action: jax.Array,
        projected: jax.Array,
        first: jax.Array,
        noise: jax.Array,
    ) -> LatentState:
        """The posterior: the state after an action, having seen the image it led to.

        Args:
          state: the state before; forgotten where `first`.
          action: float32 [..., A], the action taken in it; ignored where `first`.
          projected: `project` of the image's embedding, [..., hidden_size].
          first: bool [...], whether the image is the first of an episode.
          noise: float32 [..., stochastic_size], standard normal.
        """
        keep = ~first[..., None]
        state = jax.tree.map(lambda x: jnp.where(keep, x, 0.0), state)
        deterministic = self._recur(state, jnp.where(keep, action, 0.0))
        return self._latent_state(self.posterior(deterministic, projected), noise, deterministic)

    def prior_statistics(self, deterministic: jax.Array) -> tuple[jax.Array, jax.Array]:
        """Mean and standard deviation of the prior, given the GRU's new state."""
        state = self._latent_state(self.prior(deterministic), 0.0, deterministic)
        return state.mean, state.std

    def __call__(self, embedding: jax.Array, action: jax.Array) -> LatentState:
        """One step of everything from the initial state; its use is to create parameters."""
        state = self.initial(embedding.shape[:-1])
        noise = jnp.zeros_like(state.mean)
        self.img_step(state, action, noise)
        first = jnp.zeros(embedding.shape[:-1], bool)
        return self.obs_step(state, action, self.project(embedding), first, noise)

    @nn.nowrap
    def initial(self, shape: tuple[int, ...] = ()) -> LatentState:
        """The state before an episode: zeros, with leading axes `shape`."""
        stochastic = jnp.zeros((*shape, self.stochastic_size))
        deterministic = jnp.zeros((*shape, self.deterministic_size))
        return LatentState(stochastic, stochastic, stochastic, deterministic)


def observe(
    dynamics: Dynamics,
    params,
    embeddings: jax.Array,
    actions: jax.Array,
    first: jax.Array,
    key: jax.Array,
) -> tuple[LatentState, jax.Array, jax.Array]:
    """Posterior states along sequences, from the initial state, and the priors beside them.

    Args:
      dynamics: the module.
      params: its parameters.
      embeddings: float [B, L, E].
      actions: float32 [B, L, A]; entry t led to image t.
      first: bool [B, L].
      key: for the posterior's samples.

    Returns:
      Posterior states with leaves [B, L, ...], and the prior's mean and standard deviation,
      each [B, L, stochastic_size].
    """
    batch, length = first.shape
    noise = jax.random.normal(key, (length, batch, dynamics.stochastic_size))
    projected = applied(dynamics, params, embeddings, method="project")
    inputs = jax.tree.map(lambda x: jnp.swapaxes(x, 0, 1), (actions, projected, first))

    def step(state, inputs):
        action, projected, first, noise = inputs
        inputs = (state, action, projected, first, noise)
        state = applied(dynamics, params, *inputs, method="obs_step")
        return state, state

    _, states = jax.lax.scan(step, dynamics.initial((batch,)), (*inputs, noise))
    states = jax.tree.map(lambda x: jnp.swapaxes(x, 0, 1), states)
    # The prior needs no sample of its own in the recurrence, so one product serves all steps.
    mean, std = applied(dynamics, params, states.deterministic, method="prior_statistics")
    return states, mean, std


def imagine(
    dynamics: Dynamics,
    params,
    policy,
    start: LatentState,
    horizon: int,
    key: jax.Array,
    policy_noise: jax.Array,
) -> LatentState:
    """Imagined states 1 ... H from a start, which is not among them.

    Args:
      dynamics: the module.
      params: its parameters.
      policy: (features [..., M], noise [..., A]) -> action [..., A].
      start: leaves [..., sizes].
      horizon: H.
      key: for the prior's samples.
      policy_noise: [H, ..., A], handed to the policy step by step.

    Returns:
      States with leaves [H, ..., sizes].
    """
    noise = jax.random.normal(key, (horizon, *start.stochastic.shape))

    def step(state, noises):
        noise, policy_noise = noises
        action = policy(state.features, policy_noise)
        state = applied(dynamics, params, state, action, noise, method="img_step")
        return state, state

    _, states = jax.lax.scan(step, start, (noise, policy_noise))
    return states
