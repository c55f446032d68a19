"""An agent of one number, for laws of schedules, files and devices: its programs compile in tenths
of seconds, where those of the networks take many.

Axis letters as in dreamer_jax.
"""

import dataclasses
from dataclasses import dataclass

import jax
import jax.numpy as jnp

from dreamer_jax import diagnosis
from dreamer_jax.agent import Agent
from dreamer_jax.learning import AgentState
from dreamer_jax.randomness import update_key


@dataclass(frozen=True)
class Small(Agent):
    """An agent whose one number learns the mean of what it has seen, with noise of its own.

    Beside it is one that is added to its loss: 0, for tests to put NaN there.
    """

    def init(self, seed):
        value = jax.random.normal(jax.random.key(seed))
        return self.start({"actor": {"value": value}, "loss": {"shift": jnp.zeros(())}}, seed)

    def start(self, params, seed):
        seed = jnp.asarray(seed, jnp.int32)
        return AgentState(params, {}, jnp.int32(0), seed, jnp.bool_(True))

    def update(self, state, batch):
        value = state.params["actor"]["value"]
        noise = jax.random.normal(update_key(state.seed, state.updates))
        seen = batch.image.astype(jnp.float32).mean() / 255 + batch.reward.mean()
        loss = (seen - value) ** 2 + state.params["loss"]["shift"]
        healthy = state.healthy & jnp.isfinite(loss)
        new = jnp.where(healthy, value + 0.1 * (seen + 0.1 * noise - value), value)
        params = state.params | {"actor": {"value": new}}
        counted = {"updates": state.updates + 1, "healthy": healthy}
        return dataclasses.replace(state, params=params, **counted), {"model_loss": loss}

    def policy(self, params, carry, image, first, key, mode, updates=0):
        noise = jax.random.normal(key, (self.action_size,))
        seen = image.astype(jnp.float32).mean() / 255
        return jnp.tanh(params["actor"]["value"] * seen + noise), carry


def diagnose(agent, params, records, seeds, phase):
    """In the place of `population.diagnose`, which asks networks: what a small agent's number is
    off by, float32 [P, K]."""
    if not isinstance(agent, Small):
        return diagnosis.diagnose(agent, params, records, seeds, phase)
    return {"value_bias": params["actor"]["value"][:, None] - records.reward.mean(-1)}
