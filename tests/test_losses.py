"""Losses against hand-computed numbers, plain loops and independent libraries."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import rlax
from numpy.testing import assert_allclose

from dreamer_jax import losses

random = np.random.default_rng(0)
H, N = 15, 7


def draws(*shape):
    return random.normal(size=shape).astype(np.float32)


def test_lambda_returns_equal_a_plain_loop():
    rewards, values = draws(H, N), draws(H, N)
    discounts = random.uniform(0.8, 1, (H, N)).astype(np.float32)
    expected, following = np.zeros((H - 1, N)), values[-1]
    for t in reversed(range(H - 1)):
        following = rewards[t] + discounts[t] * (0.05 * values[t + 1] + 0.95 * following)
        expected[t] = following
    assert_allclose(losses.lambda_return(rewards, values, discounts, 0.95), expected, rtol=1e-5)


def test_lambda_returns_equal_rlax():
    rewards, values = draws(H), draws(H)
    discounts = random.uniform(0.8, 1, H).astype(np.float32)
    expected = rlax.lambda_returns(rewards[:-1], discounts[:-1], values[1:], 0.95)
    assert_allclose(losses.lambda_return(rewards, values, discounts, 0.95), expected, rtol=1e-5)


def test_lambda_returns_equal_the_weighted_sum_of_equation_16():
    rewards, values = draws(H), draws(H)
    discount, lambda_ = 0.99, 0.95
    last = H - 1

    def n_step(n):
        # V_N^n of the first state: n rewards, then the value of the state after them.
        return sum(discount**i * rewards[i] for i in range(n)) + discount**n * values[n]

    expected = (1 - lambda_) * sum(lambda_ ** (n - 1) * n_step(n) for n in range(1, last))
    expected += lambda_ ** (last - 1) * n_step(last)
    returns = losses.lambda_return(rewards, values, jnp.full(H, discount), lambda_)
    assert_allclose(returns[0], expected, rtol=1e-4)


def test_a_lambda_return_of_three_states_by_hand():
    # R_1 = 2 + 0.5 * 8 = 6; R_0 = 1 + 0.5 * (0.5 * 4 + 0.5 * 6) = 3.5.
    returns = losses.lambda_return(
        jnp.array([1.0, 2.0, 99.0]), jnp.array([0.0, 4.0, 8.0]), jnp.full(3, 0.5), 0.5
    )
    assert_allclose(returns, [3.5, 6.0])


def test_weights_start_at_one_and_fall_by_the_discount():
    weights = losses.trajectory_weights(jnp.full(15, 0.99))
    assert_allclose(weights, 0.99 ** np.arange(14), rtol=1e-6)


def test_kl_of_gaussians_by_hand():
    # log(2) + (1 + 1) / (2 * 4) - 1 / 2 for N(0, 1) and N(1, 2).
    kl = losses.gaussian_kl(jnp.zeros(1), jnp.ones(1), jnp.ones(1), 2 * jnp.ones(1))
    assert_allclose(kl, np.log(2) + 2 / 8 - 0.5, rtol=1e-6)


def test_kl_of_gaussians_equals_a_monte_carlo_estimate():
    mean, other_mean = draws(3), draws(3)
    std, other_std = np.exp(0.3 * draws(3)), np.exp(0.3 * draws(3))
    samples = mean + std * random.normal(size=(400_000, 3))

    def log_density(x, mean, std):
        return (-0.5 * ((x - mean) / std) ** 2 - np.log(std)).sum(-1)

    estimate = log_density(samples, mean, std) - log_density(samples, other_mean, other_std)
    kl = losses.gaussian_kl(mean, std, other_mean, other_std)
    assert_allclose(kl, estimate.mean(), atol=5 * estimate.std() / 400_000**0.5)


def test_below_the_free_nats_the_kl_has_no_gradient():
    gradient = jax.grad(lambda kl: losses.floored_kl(kl, 3.0))
    assert_allclose(gradient(jnp.array([1.0, 2.0])), 0.0)
    assert_allclose(gradient(jnp.array([5.0, 2.0])), 0.5)
    assert losses.floored_kl(jnp.array([1.0, 2.0]), 3.0) == 3.0


def test_the_floor_is_on_the_mean_not_on_each_kl():
    assert losses.floored_kl(jnp.array([0.0, 8.0]), 3.0) == 4.0


def test_the_unit_gaussian_loss_is_half_the_mean_squared_error():
    prediction, target = jnp.zeros((2, 5)), jnp.full((2, 5), 2.0).at[0, 0].set(0.0)
    assert_allclose(losses.unit_gaussian_loss(prediction, target), 2.0 * 9 / 10)


def test_the_bernoulli_loss_is_the_cross_entropy_also_of_soft_targets():
    logits, target = draws(20), random.uniform(size=20).astype(np.float32)
    p = 1 / (1 + np.exp(-logits))
    expected = -(target * np.log(p) + (1 - target) * np.log(1 - p)).mean()
    assert_allclose(losses.bernoulli_loss(logits, target), expected, rtol=1e-5)


def test_the_value_loss_has_no_gradient_into_its_target():
    returns, weights = jnp.ones(3), jnp.ones(3)
    gradient = jax.grad(losses.value_loss, argnums=1)(jnp.zeros(3), returns, weights)
    assert_allclose(gradient, 0.0)


def test_losses_refuse_shapes_that_would_broadcast():
    with pytest.raises(AssertionError):
        losses.unit_gaussian_loss(jnp.zeros((4, 1)), jnp.zeros((4,)))
    with pytest.raises(AssertionError):
        losses.value_loss(jnp.zeros((4, 1)), jnp.zeros((4,)), jnp.zeros((4,)))


def test_the_entropy_of_even_odds_is_log_2_and_of_a_certain_choice_0():
    logits = jnp.array([[0.0, 0.0], [50.0, 0.0], [jnp.log(3.0), 0.0]])
    quarter = -(0.25 * np.log(0.25) + 0.75 * np.log(0.75))
    assert_allclose(losses.categorical_entropy(logits), [np.log(2), 0, quarter], atol=1e-6)
