"""What an update minimises: the world model's loss, and the actor's and the value head's.

Thesis section 3.1, equations 16 and 17. Axis letters: B batch, L sequence length, H imagination
horizon, A action, M latent feature size.
"""

from __future__ import annotations

import functools
from typing import TYPE_CHECKING

import jax
import jax.numpy as jnp
import optax

from dreamer_jax import losses, networks, rssm
from dreamer_jax.config import LearningConfig
from dreamer_jax.convolutions import arrange, image_distance

if TYPE_CHECKING:
    from dreamer_jax.agent import Agent, Batch, Params


SATURATED = 0.95
"""Size of a continuous action beyond which the tanh lets less than a tenth of a gradient pass."""


def joined(params: Params, trainable: Params) -> Params:
    """Parameters with the parts of components in `trainable` in place of their own."""
    return params | {name: params[name] | parts for name, parts in trainable.items()}


def model_loss(agent: Agent, trainable: Params, params: Params, batch: Batch, key: jax.Array):
    """Loss of the world model: image and reward likelihoods and the floored KL divergence.

    Args:
      agent: its modules and settings.
      trainable: the components, or parts of them, that the gradient is taken for.
      params: all components; what is in `trainable` is not used.
      batch: of one member.
      key: for the posterior's samples.

    Returns:
      The loss, and (posterior states [B, L, ...], metrics).
    """
    config = agent.config.learning
    params = joined(params, trainable)
    batch = batch._replace(image=arrange(batch.image))
    posterior, prior_mean, prior_std = agent.observe(params, batch, key)
    features = posterior.features
    image_loss = image_distance(agent.decode(params, features), batch.image).mean()
    reward_loss = losses.unit_gaussian_loss(agent.reward(params, features), batch.reward)
    kl = losses.gaussian_kl(posterior.mean, posterior.std, prior_mean, prior_std)
    loss = image_loss / config.image_std**2 + reward_loss / config.reward_std**2
    loss += config.kl_scale * losses.floored_kl(kl, config.free_nats)
    mean_kl = kl.mean()
    metrics = {
        "image_loss": image_loss,
        "reward_loss": reward_loss,
        "kl": mean_kl,
        "kl_at_start": kl[:, 0].mean(),
        "kl_share_below_floor": (kl < config.free_nats).mean(),
        "kl_floored": (mean_kl < config.free_nats).astype(jnp.float32),
    }
    if "termination" in agent.heads:
        logits = agent.head(params, "termination", features)[..., 0]
        target = config.discount * (1.0 - batch.terminal)
        termination_loss = losses.bernoulli_loss(logits, target)
        loss += config.termination_scale * termination_loss
        metrics["termination_loss"] = termination_loss
    metrics["model_loss"] = loss
    return loss, (posterior, metrics)


def behaviour_loss(
    agent: Agent,
    trainable: Params,
    params: Params,
    posterior: rssm.LatentState,
    key: jax.Array,
    updates: jax.Array | int = 0,
):
    """Loss of the actor plus loss of the value head, both on the same imagined states.

    The actor's gradient comes through the dynamics. The policy reads stopped features: the
    gradient reaches an action through the states and rewards that follow it, not through the
    states that the policy saw before. The value head is trained towards returns that are held
    fixed, on features that are, so neither loss has a gradient for the other's parameters.

    Args:
      agent: its modules and settings.
      trainable: the components of "actor" and "value" that the gradient is taken for.
      params: all components.
      posterior: states to start from, leaves [B, L, ...]; no gradient reaches them.
      key: for starts, actions and states.
      updates: int [], updates so far, for the schedule of the entropy's weight.

    Returns:
      The sum of the losses, and metrics.
    """
    config = agent.config.learning
    starts_key, action_key, state_key = jax.random.split(key, 3)
    params = joined(jax.lax.stop_gradient(params), trainable)
    start = jax.tree.map(lambda x: jax.lax.stop_gradient(x).reshape(-1, x.shape[-1]), posterior)
    if config.imagination_starts is not None:
        count = start.mean.shape[0]
        chosen = jax.random.permutation(starts_key, count)[: config.imagination_starts]
        start = jax.tree.map(lambda x: x[chosen], start)

    def policy(features, noise):
        outputs = agent.head(params, "actor", jax.lax.stop_gradient(features))
        return agent.sample(outputs, noise)

    noise = agent.action_noise(action_key, (config.horizon, start.mean.shape[0]))
    states = rssm.imagine(
        agent.dynamics, params["dynamics"], policy, start, config.horizon, state_key, noise
    )
    features = states.features
    rewards = agent.reward(params, features)
    values, trained_values = _forked(agent.value, params, features)
    if "termination" in agent.heads:
        discounts = jax.nn.sigmoid(agent.head(params, "termination", features)[..., 0])
    else:
        discounts = jnp.full_like(rewards, config.discount)
    returns = losses.lambda_return(rewards, values, discounts, config.return_lambda)
    weights = losses.trajectory_weights(discounts)
    actor_loss = losses.actor_loss(returns, weights)
    value_loss = losses.value_loss(trained_values[:-1], returns, weights)
    metrics = {
        "actor_loss": actor_loss,
        "value_loss": value_loss,
        "imagined_reward": rewards.mean(),
        "imagined_value": values.mean(),
    }
    # The states that the actor acted in: the start, and all but the last two.
    acted_in = jnp.concatenate([start.features[None], features[:-2]])
    outputs = agent.head(params, "actor", jax.lax.stop_gradient(acted_in))
    if agent.discrete:
        entropy = losses.categorical_entropy(outputs)
    else:
        mean, std = networks.tanh_normal(outputs)
        before_tanh = mean + std * noise[:-1]
        # An estimate from the actions that were taken; its gradient goes through them too.
        entropy = -networks.tanh_normal_log_probability(outputs, before_tanh)
        saturated = jnp.abs(jnp.tanh(before_tanh)) > SATURATED
        metrics |= {"actor_std": std.mean(), "actor_saturation": saturated.mean()}
    if config.entropy_scale:
        actor_loss -= _entropy_scale(config, updates) * (weights * entropy).mean()
    metrics |= {"actor_loss": actor_loss, "actor_entropy": entropy.mean()}
    return actor_loss + value_loss, metrics


def _entropy_scale(config: LearningConfig, updates: jax.Array | int) -> jax.Array | float:
    """The weight of the policy's entropy after some updates."""
    if config.entropy_scale_end is None:
        return config.entropy_scale
    return optax.linear_schedule(
        config.entropy_scale, config.entropy_scale_end, config.entropy_decay
    )(updates)


@functools.partial(jax.custom_vjp, nondiff_argnums=(0,))
def _forked(function, params, features):
    """function(params, features) twice, computed once.

    The gradient of the first reaches the features only, that of the second the parameters only.
    """
    output = function(params, features)
    return output, output


def _forked_forward(function, params, features):
    output, pull_back = jax.vjp(function, params, features)
    return (output, output), pull_back


def _forked_backward(function, pull_back, gradients):
    to_features, to_params = gradients
    return pull_back(to_params)[0], pull_back(to_features)[1]


_forked.defvjp(_forked_forward, _forked_backward)
