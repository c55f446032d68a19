"""Meta-models as modules of an agent: networks that also read what frozen ones predict (§3.3.2).

The frozen models are among a module's parameters, as `stored`: so they live in the agent's state
and in its checkpoints. Who trains the agent leaves them out of what is trained. The arithmetic is
that of `transfer.meta_model` and `transfer.ltc`.

Axis letters: N places for stored models, M latent feature size, S samples, A action.
"""

from typing import Any

import jax
import jax.numpy as jnp
from flax import linen as nn

from dreamer_jax import networks, rssm
from transfer import ltc
from transfer.meta_model import StoredHeads, meta_inputs, predictions, switch


def empty_places(key: jax.Array, module: nn.Module, places: int, *inputs) -> dict[str, Any]:
    """The parameters of N modules none of which is there: StoredHeads' fields, leaves [N, ...]."""
    shapes = jax.eval_shape(module.init, key, *inputs)["params"]
    params = jax.tree.map(lambda x: jnp.zeros((places, *x.shape), x.dtype), shapes)
    return {"params": params, "present": jnp.zeros(places, bool)}


def empty_classifier(key: jax.Array, samples: int, size: int) -> dict[str, jax.Array]:
    """The parameters of a classifier of latent states to which every task is novel."""
    return {
        "latents": jnp.zeros((samples, size)),
        "labels": jnp.zeros(samples, jnp.int32),
        "threshold": jnp.float32(-1.0),
    }


def recognise(classifier: dict[str, jax.Array], features: jax.Array) -> jax.Array:
    """The task of each latent state by its place among the stored ones, or `ltc.NOVEL`.

    Args:
      classifier: latents [S, M], labels [S] and the threshold [].
      features: float32 [..., M].

    Returns:
      int32 [...].
    """
    model = ltc.Classifier(classifier["latents"], classifier["labels"])
    queries = jax.lax.stop_gradient(features).reshape(-1, features.shape[-1])
    labels = ltc.classify(model, queries, classifier["threshold"]).labels
    return labels.reshape(features.shape[:-1])


class MetaHead(networks.Head, kw_only=True):
    """A head that reads [features, predictions of N frozen heads] (equation 20).

    Its parameters are those of a head, `stored`, and `classifier` if there are samples.

    Attributes:
      stored_layers: hidden layers of a frozen head.
      places: N; those that hold no head give zeros.
      samples: S, labelled latent states to recognise tasks by. With any, the output for a state
        of a known task is that of its frozen head, and only novel ones are left to this head.
    """

    stored_layers: int
    places: int
    samples: int = 0

    @nn.compact
    def __call__(self, features: jax.Array) -> jax.Array:
        head = networks.Head(self.outputs, self.stored_layers, self.units, self.dtype, parent=None)
        stored = self.param("stored", empty_places, head, self.places, features)

        def apply(params, features):
            return head.apply({"params": params}, features)

        inputs = meta_inputs(apply, StoredHeads(**stored), features)
        outputs = super().__call__(inputs)
        if not self.samples:
            return outputs
        size = features.shape[-1]
        labels = recognise(self.param("classifier", empty_classifier, self.samples, size), features)
        frozen = inputs[..., size:].reshape(*outputs.shape[:-1], self.places, self.outputs)
        return switch(labels, frozen, outputs)


class MetaDynamics(rssm.Dynamics, kw_only=True):
    """A latent dynamics model that also reads what N frozen ones predict of the next state.

    A frozen model's prediction is the mean of its prior after the same state and action. All of
    them enter beside state and action, through the kernel `stored_in`.

    Attributes:
      places: N; those that hold no model give zeros.
    """

    places: int

    def setup(self):
        super().setup()
        embedding, action = jnp.zeros((1, self.embedding_size)), jnp.zeros((1, self.action_size))
        usual = self._usual()
        self.stored = self.param("stored", empty_places, usual, self.places, embedding, action)
        self.stored_in = networks.Dense(self.hidden_size, use_bias=False, dtype=self.dtype)

    @nn.nowrap
    def _usual(self) -> rssm.Dynamics:
        return rssm.Dynamics(
            stochastic_size=self.stochastic_size,
            deterministic_size=self.deterministic_size,
            hidden_size=self.hidden_size,
            action_size=self.action_size,
            embedding_size=self.embedding_size,
            minimum_std=self.minimum_std,
            dtype=self.dtype,
            parent=None,
        )

    def _recur(self, state: rssm.LatentState, action: jax.Array) -> jax.Array:
        usual = self._usual()

        def predict(params, inputs):
            return networks.applied(usual, params, *inputs, 0.0, method="img_step").mean

        means = predictions(predict, StoredHeads(**self.stored), (state, action))
        x = self.stoch_in(state.stochastic) + self.action_in(action)
        x = x + self.stored_in(means.reshape(*means.shape[:-2], -1))
        return self.gru(networks.elu(x), state.deterministic)


def meta_head(head: networks.Head, *, layers: int, places: int, samples: int = 0) -> MetaHead:
    """The meta-model over frozen heads like `head`, with hidden layers of as many units."""
    return MetaHead(
        outputs=head.outputs,
        layers=layers,
        units=head.units,
        dtype=head.dtype,
        stored_layers=head.layers,
        places=places,
        samples=samples,
    )


def meta_dynamics(dynamics: rssm.Dynamics, *, places: int) -> MetaDynamics:
    """The meta-model over frozen dynamics models like `dynamics`."""
    return MetaDynamics(
        stochastic_size=dynamics.stochastic_size,
        deterministic_size=dynamics.deterministic_size,
        hidden_size=dynamics.hidden_size,
        action_size=dynamics.action_size,
        embedding_size=dynamics.embedding_size,
        minimum_std=dynamics.minimum_std,
        dtype=dynamics.dtype,
        places=places,
    )
