"""How an agent learns: what an update minimises, with which optimisers, and the update.

The world model's loss, the actor's and the value head's (thesis section 3.1, equations 16 and 17).
Axis letters: P population member, B batch, L sequence length, H imagination horizon, A action,
M latent feature size. Everything here is written for one member.
"""

import functools
from typing import Any

import chex
import flax.struct
import jax
import jax.numpy as jnp
import optax

from dreamer_jax import losses, networks, randomness, rssm
from dreamer_jax.config import LearningConfig
from dreamer_jax.convolutions import arrange, image_distance
from dreamer_jax.freezing import Params, check_frozen, joined, trained
from dreamer_jax.model import Model
from dreamer_jax.records import Records

Metrics = dict[str, jax.Array]

GROUPS = {
    "model": ("encoder", "decoder", "dynamics", "reward", "termination"),
    "value": ("value",),
    "actor": ("actor",),
}
"""The components that each of the three optimisers trains."""

SATURATED = 0.95
"""Size of a continuous action beyond which the tanh lets less than a tenth of a gradient pass."""


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


def make_optimisers(config: LearningConfig) -> dict[str, optax.GradientTransformation]:
    """The optimiser of each group: Adam after its gradient's norm is clipped."""
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


def trainable(model: Model, params: Params) -> dict[str, Params]:
    """The leaves that each of the three optimisers trains, by its name: those not frozen."""
    parts = trained(params, model.config.learning.frozen)
    return {
        group: {name: parts[name] for name in names if name in parts}
        for group, names in GROUPS.items()
    }


def start(model: Model, params: Params, seed: jax.Array | int) -> AgentState:
    """An agent that starts from given parameters, with fresh optimisers.

    Raises:
      ValueError: what is to be frozen is none of the agent's.
    """
    check_frozen(params, model.config.learning.frozen)
    optimisers = make_optimisers(model.config.learning)
    return AgentState(
        params=params,
        optimisers={
            name: optimisers[name].init(parts) for name, parts in trainable(model, params).items()
        },
        updates=jnp.int32(0),
        seed=jnp.asarray(seed, jnp.int32),
        healthy=jnp.bool_(True),
    )


def update(model: Model, state: AgentState, batch: Records) -> tuple[AgentState, Metrics]:
    """One update of model, value and actor, all gradients from the same parameters.

    Args:
      model: its networks and settings.
      state: of one member.
      batch: of one member, leaves [B, L, ...].

    Returns:
      The new state, and metrics: float32 scalars by name. Where a loss or gradient is not
      finite, or was before, all but `updates` stays as it was and `healthy` is False.
    """
    chex.assert_rank(batch.image, 5)
    chex.assert_shape(batch.action, (*batch.reward.shape, model.action_size))
    chex.assert_equal_shape([batch.reward, batch.first, batch.terminal])
    key = randomness.update_key(state.seed, state.updates)
    model_key, behaviour_key = jax.random.split(key)

    params = state.params
    parts = trainable(model, params)
    (_, (posterior, metrics)), model_gradient = jax.value_and_grad(
        model_loss, argnums=1, has_aux=True
    )(model, parts["model"], params, batch, model_key)
    (_, behaviour_metrics), behaviour_gradient = jax.value_and_grad(
        behaviour_loss, argnums=1, has_aux=True
    )(
        model,
        parts["actor"] | parts["value"],
        params,
        posterior,
        behaviour_key,
        state.updates,
    )
    gradients = {"model": model_gradient} | {
        group: {name: behaviour_gradient[name] for name in parts[group]}
        for group in ("actor", "value")
    }
    metrics |= behaviour_metrics
    for group, gradient in gradients.items():
        if gradient:
            norm = optax.tree.norm(gradient)
            clipped = norm > model.config.learning.gradient_norm
            metrics |= {
                f"{group}_gradient_norm": norm,
                f"{group}_gradient_clipped": clipped.astype(jnp.float32),
            }

    optimisers, memories, new_params = make_optimisers(model.config.learning), {}, params
    for group, gradient in gradients.items():
        updates, memories[group] = optimisers[group].update(gradient, state.optimisers[group])
        new_params = joined(new_params, optax.apply_updates(parts[group], updates))
    finite = jnp.isfinite(jnp.stack(list(metrics.values()))).all()
    healthy = state.healthy & finite
    new_params, memories = jax.tree.map(
        lambda new, old: jnp.where(healthy, new, old),
        (new_params, memories),
        (params, state.optimisers),
    )
    return AgentState(new_params, memories, state.updates + 1, state.seed, healthy), metrics


def model_loss(model: Model, trainable: Params, params: Params, batch: Records, key: jax.Array):
    """Loss of the world model: image and reward likelihoods and the floored KL divergence.

    Args:
      model: its networks and settings.
      trainable: the leaves that the gradient is taken for.
      params: all components; what is in `trainable` is not used.
      batch: of one member.
      key: for the posterior's samples.

    Returns:
      The loss, and (posterior states [B, L, ...], metrics).
    """
    config = model.config.learning
    params = joined(params, trainable)
    batch = batch._replace(image=arrange(batch.image, method=model.convolutions))
    posterior, prior_mean, prior_std = model.observe(params, batch, key)
    features = posterior.features
    prediction = model.decode(params, features)
    image_loss = image_distance(prediction, batch.image, method=model.convolutions).mean()
    reward_loss = losses.unit_gaussian_loss(model.reward(params, features), batch.reward)
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
    if "termination" in model.heads:
        logits = model.head(params, "termination", features)[..., 0]
        target = config.discount * (1.0 - batch.terminal)
        termination_loss = losses.bernoulli_loss(logits, target)
        loss += config.termination_scale * termination_loss
        metrics["termination_loss"] = termination_loss
    metrics["model_loss"] = loss
    return loss, (posterior, metrics)


def behaviour_loss(
    model: Model,
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
      model: its networks and settings.
      trainable: the leaves of "actor" and "value" that the gradient is taken for.
      params: all components.
      posterior: states to start from, leaves [B, L, ...]; no gradient reaches them.
      key: for starts, actions and states.
      updates: int [], updates so far, for the schedule of the entropy's weight.

    Returns:
      The sum of the losses, and metrics.
    """
    config = model.config.learning
    starts_key, action_key, state_key = jax.random.split(key, 3)
    params = joined(jax.lax.stop_gradient(params), trainable)
    start = jax.tree.map(lambda x: jax.lax.stop_gradient(x).reshape(-1, x.shape[-1]), posterior)
    if config.imagination_starts is not None:
        count = start.mean.shape[0]
        chosen = jax.random.permutation(starts_key, count)[: config.imagination_starts]
        start = jax.tree.map(lambda x: x[chosen], start)

    def policy(features, noise):
        outputs = model.head(params, "actor", jax.lax.stop_gradient(features))
        return model.sample(outputs, noise)

    noise = model.action_noise(action_key, (config.horizon, start.mean.shape[0]))
    states = rssm.imagine(
        model.dynamics, params["dynamics"], policy, start, config.horizon, state_key, noise
    )
    features = states.features
    rewards = model.reward(params, features)
    values, trained_values = _forked(model.value, params, features)
    if "termination" in model.heads:
        discounts = jax.nn.sigmoid(model.head(params, "termination", features)[..., 0])
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
    outputs = model.head(params, "actor", jax.lax.stop_gradient(acted_in))
    if model.discrete:
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
