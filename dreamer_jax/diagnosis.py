"""Is an agent learning? What its models know of an episode that it has played, and what the
metrics of its updates warn of. How to read them: docs/learning.md.

Axis letters: P population member, K task, T ticks in a phase, M latent feature size.
"""

import functools
from collections.abc import Mapping

import jax
import jax.numpy as jnp

from dreamer_jax import rssm
from dreamer_jax.config import LearningConfig
from dreamer_jax.freezing import Params
from dreamer_jax.model import Model
from dreamer_jax.randomness import diagnosis_key
from dreamer_jax.records import Records

OPEN_LOOP = (5, 15)
"""Steps ahead of which rewards are predicted from actions alone."""


def discounted_returns(
    rewards: jax.Array, last_value: jax.Array, last: jax.Array, discount: float
) -> jax.Array:
    """What the value of each record should have been.

    G_t = r_t + discount * G_{t+1}, and G = `last_value` where the episode ends or is cut.

    Args:
      rewards: float32 [T + 1]; entry t led to record t, as a value counts it.
      last_value: float32 [], the return from the last record on.
      last: int32 [], index of the last record.
      discount: of a reward one agent step later.

    Returns:
      float32 [T + 1]; entries after `last` are `last_value`.
    """
    times = jnp.arange(rewards.shape[0])

    def step(following, inputs):
        time, reward = inputs
        value = jnp.where(time < last, reward + discount * following, last_value)
        return value, value

    return jax.lax.scan(step, last_value, (times, rewards), reverse=True)[1]


@functools.partial(jax.jit, static_argnames="agent")
def diagnose(
    agent: Model, params: Params, records: Records, seeds: jax.Array, phase: jax.Array
) -> dict[str, jax.Array]:
    """Compares values and predicted rewards with what the first episode of each phase brought.

    Args:
      agent: its networks and settings.
      params: leaves [P, ...].
      records: leaves [P, K, T + 1, ...], as `dreamer_jax.rollout.collect` gives them.
      seeds: int32 [P].
      phase: int32 [], number of the phase.

    Returns:
      By name, float32 [P, K], all in rewards:
      value_bias, the mean of value minus discounted return (the value itself stands for what
      comes after an episode that was cut);
      reward_error_5 and reward_error_15, the mean absolute error of the reward that is predicted
      5 and 15 steps ahead from the actions taken, NaN for an episode that is too short;
      reward_spread, the mean absolute deviation of rewards from their mean, which is the error of
      a prediction that knows nothing.
    """

    def of_member(arguments):
        params, records, seed = arguments
        outputs = [
            _episode(agent, params, records.at(k), diagnosis_key(seed, phase, k))
            for k in range(records.reward.shape[0])
        ]
        return jax.tree.map(lambda *x: jnp.stack(x), *outputs)

    # One member after another: an episode is a large batch already.
    return jax.lax.map(of_member, (params, records, seeds))


def _episode(agent: Model, params: Params, records: Records, key: jax.Array):
    """The comparison for the first episode of one phase, leaves [T + 1, ...]."""
    observe_key, imagine_key = jax.random.split(key)
    posterior, _, _ = agent.observe(params, records.at(None), observe_key)
    posterior = jax.tree.map(lambda x: x[0], posterior)
    values = agent.value(params, posterior.features)
    times = jnp.arange(values.shape[0])
    # The record before the second reset, or else the last one.
    last = jnp.where(records.first & (times > 0), times, len(times)).min() - 1
    fell = records.terminal[last]
    last_value = jnp.where(fell, records.reward[last], values[last])
    returns = discounted_returns(records.reward, last_value, last, agent.config.learning.discount)
    inside = times <= last
    metrics = {"value_bias": _mean(values - returns, inside)}

    furthest = max(OPEN_LOOP)
    ahead = times[None, :] + jnp.arange(1, furthest + 1)[:, None]
    reachable = jnp.minimum(ahead, len(times) - 1)
    with agent.matmul_precision():
        imagined = rssm.imagine(
            agent.dynamics,
            params["dynamics"],
            lambda features, action: action,
            posterior,
            furthest,
            imagine_key,
            records.action[reachable],
        )
    for steps in OPEN_LOOP:
        features = imagined.features[steps - 1]
        errors = agent.reward(params, features) - records.reward[reachable[steps - 1]]
        metrics[f"reward_error_{steps}"] = _mean(jnp.abs(errors), ahead[steps - 1] <= last)
    rewarded = inside & ~records.first
    mean = _mean(records.reward, rewarded)
    metrics["reward_spread"] = _mean(jnp.abs(records.reward - mean), rewarded)
    return metrics


def _mean(values: jax.Array, chosen: jax.Array) -> jax.Array:
    """The mean of the chosen values, NaN if there are none."""
    return jnp.where(chosen, values, 0.0).sum() / chosen.sum()


DEAD_SATURATION = 0.98
"""Share of saturated actions, at a spread before the tanh below `DEAD_STD`, of a dead actor."""
DEAD_STD = 0.1
FLOORED_SHARE = 0.9
"""Share of updates with the divergence below its floor, of a prior that is hardly trained."""
SETTLED = 500
"""Updates before which the divergence says nothing: the model has yet to find what to encode."""


def warnings(averages: Mapping[str, float], config: LearningConfig, updates: int) -> dict[str, str]:
    """What keeps an agent from learning, in words, with the setting that helps.

    Args:
      averages: metrics of updates, averaged over a phase.
      config: the settings of those updates.
      updates: made so far.

    Returns:
      Messages by "actor" (saturated, so that no gradient reaches it) and "prior" (the divergence
      is below its floor, so that no gradient reaches it); none where all is well.
    """
    found = {}
    saturation = averages.get("actor_saturation", 0.0)
    if saturation > DEAD_SATURATION and averages["actor_std"] < DEAD_STD:
        found["actor"] = (
            f"the actor is dead: {saturation:.0%} of its actions are saturated, at a spread of "
            f"{averages['actor_std']:.2g}, and no gradient passes. An entropy term keeps it alive "
            f"(--entropy-scale 0.1, here {config.entropy_scale:g}), so does a smaller "
            f"--actor-learning-rate (here {config.actor_learning_rate:g}); start anew with it"
        )
    if updates >= SETTLED and averages.get("kl_floored", 0.0) > FLOORED_SHARE:
        found["prior"] = (
            f"the prior is not trained: the KL divergence ({averages['kl']:.2g} nats) is below its "
            f"floor of {config.free_nats:g}, where it has no gradient, and the agent imagines with "
            "the prior. Lower the floor (--free-nats), or let pictures count for more "
            f"(--image-std, here {config.image_std:g}; --kl-scale, here {config.kl_scale:g})"
        )
    return found
