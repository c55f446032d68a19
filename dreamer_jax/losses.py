"""Losses of the world model, the actor and the value head (thesis section 3.1).

Axis letters: B batch, L sequence length, H imagination horizon, N imagined trajectories.
"""

import chex
import jax
import jax.numpy as jnp


def gaussian_kl(
    mean: jax.Array, std: jax.Array, other_mean: jax.Array, other_std: jax.Array
) -> jax.Array:
    """KL divergence of diagonal Gaussians, in nats, summed over the last axis.

    KL(N(mean, std) ‖ N(other_mean, other_std)) =
    Σ log(other_std / std) + (std² + (mean - other_mean)²) / (2 other_std²) - 1/2.
    """
    chex.assert_equal_shape([mean, std, other_mean, other_std])
    ratio = (std / other_std) ** 2
    distance = ((mean - other_mean) / other_std) ** 2
    return 0.5 * (ratio + distance - 1 - jnp.log(ratio)).sum(-1)


def unit_gaussian_loss(prediction: jax.Array, target: jax.Array) -> jax.Array:
    """Mean negative log-likelihood of `target` under N(prediction, 1), without its constant."""
    chex.assert_equal_shape([prediction, target])
    return (0.5 * (prediction - target) ** 2).mean()


def bernoulli_loss(logits: jax.Array, target: jax.Array) -> jax.Array:
    """Mean cross-entropy of Bernoulli distributions with targets in [0, 1]."""
    chex.assert_equal_shape([logits, target])
    return (jax.nn.softplus(logits) - target * logits).mean()


def floored_kl(kl: jax.Array, free_nats: float) -> jax.Array:
    """The mean KL divergence, floored: below `free_nats` it has no gradient."""
    return jnp.maximum(kl.mean(), free_nats)


def lambda_return(
    rewards: jax.Array, values: jax.Array, discounts: jax.Array, lambda_: float
) -> jax.Array:
    """λ-returns, equation 16 in recursive form.

    R_t = r_t + γ_t ((1 - λ) v_{t+1} + λ R_{t+1}), with R_{H-1} = v_{H-1}. Index t is an
    imagined state: `rewards[t]` is predicted in it, `values[t]` is its value, and
    `discounts[t]` weighs all that comes after it.

    Args:
      rewards, values, discounts: float32 [H, ...].
      lambda_: λ in [0, 1].

    Returns:
      float32 [H - 1, ...]: the last state only bootstraps.
    """
    chex.assert_equal_shape([rewards, values, discounts])

    def step(following, inputs):
        reward, next_value, discount = inputs
        following = reward + discount * ((1 - lambda_) * next_value + lambda_ * following)
        return following, following

    inputs = (rewards[:-1], values[1:], discounts[:-1])
    return jax.lax.scan(step, values[-1], inputs, reverse=True)[1]


def trajectory_weights(discounts: jax.Array) -> jax.Array:
    """How much each imagined state counts: 1, γ_0, γ_0 γ_1, ... for all but the last.

    Args:
      discounts: float32 [H, ...].

    Returns:
      float32 [H - 1, ...], without gradient.
    """
    factors = jnp.concatenate([jnp.ones_like(discounts[:1]), discounts[:-2]])
    # Not cumprod: XLA takes seconds to fold one of constants while it compiles.
    return jax.lax.stop_gradient(jax.lax.associative_scan(jnp.multiply, factors))


def actor_loss(returns: jax.Array, weights: jax.Array) -> jax.Array:
    """Minus the mean weighted return (first line of equation 17)."""
    chex.assert_equal_shape([returns, weights])
    return -(weights * returns).mean()


def categorical_entropy(logits: jax.Array) -> jax.Array:
    """Entropy of categorical distributions, in nats: [..., A] -> [...]."""
    log_probabilities = jax.nn.log_softmax(logits)
    return -(jnp.exp(log_probabilities) * log_probabilities).sum(-1)


def value_loss(values: jax.Array, returns: jax.Array, weights: jax.Array) -> jax.Array:
    """Mean weighted half squared error to the returns (second line of equation 17)."""
    chex.assert_equal_shape([values, returns, weights])
    target = jax.lax.stop_gradient(returns)
    return (weights * 0.5 * (values - target) ** 2).mean()
