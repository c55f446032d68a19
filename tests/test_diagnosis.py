"""What tells whether an agent is learning: values, predictions ahead, and warnings."""

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose

from dreamer_jax.agent import Agent
from dreamer_jax.config import LearningConfig, preset
from dreamer_jax.diagnosis import diagnose, discounted_returns, warnings
from dreamer_jax.records import Records
from runs import random_members

CONFIG = preset("debug")
AGENT = Agent(CONFIG, 2)
T = 40


def records_of(members, tasks, seed=0):
    """Random records of whole phases, leaves [P, K, T + 1, ...], without an end inside."""
    random = np.random.default_rng(seed)
    shape = (members, tasks, T + 1)
    return Records(
        image=random.integers(0, 256, (*shape, 32, 32, 3), dtype=np.uint8),
        action=random.uniform(-1, 1, (*shape, 2)).astype(np.float32),
        reward=random.normal(size=shape).astype(np.float32),
        first=np.broadcast_to(np.arange(T + 1) == 0, shape).copy(),
        terminal=np.zeros(shape, bool),
    )


def params_of(members, **constant_outputs):
    """Parameters of each member, some of whose heads answer a number whatever they read."""
    params = random_members(AGENT, range(members))
    for name, value in constant_outputs.items():
        out = params[name]["out"]
        constant = {"kernel": 0 * out["kernel"], "bias": jnp.full_like(out["bias"], value)}
        params[name] = params[name] | {"out": constant}
    return params


def test_returns_are_discounted_up_to_the_last_record_and_go_on_with_its_value():
    rewards = jnp.array([1.0, 2.0, 4.0, 100.0])
    returns = discounted_returns(rewards, jnp.float32(10.0), jnp.int32(2), 0.5)
    assert_allclose(returns, [1 + 0.5 * (2 + 0.5 * 10), 2 + 0.5 * 10, 10, 10])


def test_a_value_that_is_right_has_no_bias_and_one_that_is_off_by_two_has_two():
    discount = CONFIG.learning.discount
    records = records_of(1, 1)
    records.reward[:] = 1.0
    right = 1 / (1 - discount)
    seeds, phase = jnp.zeros(1, jnp.int32), jnp.int32(1)
    for off in (0.0, 2.0):
        params = params_of(1, value=right + off, reward=1.0)
        found = diagnose(AGENT, params, records, seeds, phase)
        # The last value stands for what comes after the cut, so a constant error fades before it.
        remaining = np.mean(discount ** np.arange(T + 1))
        assert_allclose(found["value_bias"], [[off * (1 - remaining)]], atol=2e-4 * right)


def test_an_episode_that_fell_is_worth_no_more_than_its_rewards():
    records = records_of(1, 1)
    records.reward[:] = 0.0
    records.terminal[0, 0, 9] = True
    records.first[0, 0, 10] = True
    found = diagnose(AGENT, params_of(1, value=7.0), records, jnp.zeros(1, jnp.int32), jnp.int32(1))
    assert_allclose(found["value_bias"], [[7.0]], rtol=1e-5)
    # Nine records lie after the first: none is 15 steps ahead of another.
    assert np.isfinite(found["reward_error_5"]).all()
    assert np.isnan(found["reward_error_15"]).all()


def test_a_constant_prediction_of_rewards_errs_by_their_distance():
    records = records_of(2, 2)
    found = diagnose(AGENT, params_of(2, reward=0.5), records, jnp.array([3, 4]), jnp.int32(1))
    for steps in (5, 15):
        expected = np.abs(records.reward[..., steps:] - 0.5).mean(-1)
        assert_allclose(found[f"reward_error_{steps}"], expected, rtol=1e-5)
    rewards = records.reward[..., 1:]
    spread = np.abs(rewards - rewards.mean(-1, keepdims=True)).mean(-1)
    assert_allclose(found["reward_spread"], spread, rtol=1e-5)


def test_predictions_ahead_follow_the_actions_that_were_taken():
    # Without noise in the latent states, what is predicted depends on the actions alone.
    records = records_of(1, 1)
    params, seeds = params_of(1), jnp.zeros(1, jnp.int32)
    before = diagnose(AGENT, params, records, seeds, jnp.int32(1))
    # The error of a prediction that starts at record 0 reads the actions 1 to 5, and so on.
    # Not in place: JAX may read an array where it lies, after the call.
    signs = np.where(np.arange(records.action.shape[2]) < 1, 1, -1).astype(np.float32)
    records = records._replace(action=records.action * signs[:, None])
    after = diagnose(AGENT, params, records, seeds, jnp.int32(1))
    assert before["reward_error_5"] != after["reward_error_5"]
    again = diagnose(AGENT, params, records, seeds, jnp.int32(1))
    assert after["reward_error_5"] == again["reward_error_5"]


HEALTHY = {"actor_saturation": 0.6, "actor_std": 0.5, "kl": 4.0, "kl_floored": 0.0}


@pytest.mark.parametrize(
    ("metrics", "updates", "expected"),
    [
        ({}, 1000, set()),
        ({"actor_saturation": 1.0, "actor_std": 1e-3}, 100, {"actor"}),
        # Saturated by its spread alone, as every actor begins.
        ({"actor_saturation": 1.0, "actor_std": 5.0}, 100, set()),
        ({"kl_floored": 1.0, "kl": 2.5}, 1000, {"prior"}),
        ({"kl_floored": 1.0, "kl": 0.2}, 100, set()),
    ],
)
def test_a_dead_actor_and_an_untrained_prior_are_warned_of(metrics, updates, expected):
    found = warnings(HEALTHY | metrics, LearningConfig(), updates)
    assert set(found) == expected
    settings = {"actor": "--entropy-scale 0.1", "prior": "--free-nats"}
    for name, message in found.items():
        assert settings[name] in message


def test_a_discrete_actor_is_never_called_saturated():
    metrics = {"kl": 4.0, "kl_floored": 0.0, "actor_entropy": 0.0}
    assert warnings(metrics, dataclasses.replace(LearningConfig(), free_nats=1.0), 1000) == {}
