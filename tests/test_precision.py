"""bfloat16 activations: what stays float32, and that learning does not notice."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np

from dreamer_jax.agent import Agent
from dreamer_jax.config import preset
from dreamer_jax.rollout import collect
from probes import Probe

A, STORED, UPDATES, SEEDS = 2, 10, 200, 3
CONFIG = preset("debug")
B, L = CONFIG.learning.batch_size, CONFIG.learning.sequence_length
LOSSES = ("image_loss", "reward_loss", "kl", "termination_loss", "actor_loss", "value_loss")


def agent_of(precision):
    network = dataclasses.replace(CONFIG.network, precision=precision, termination=True)
    return Agent(dataclasses.replace(CONFIG, network=network), A)


def stored_batches(agent):
    """Batches [STORED, B, L, ...] of random steps in the probe."""
    records = collect(
        agent,
        Probe(action_size=A),
        jax.vmap(agent.init_params)(jax.random.split(jax.random.key(0), 1)),
        jnp.zeros(1, jnp.int32),
        jnp.zeros(1, jnp.int32),
        jnp.int32(0),
        tasks=1,
        ticks=STORED * B * L - 1,
        mode="random",
    )
    return records.at(0, 0).map(lambda x: x.reshape(STORED, B, L, *x.shape[1:]))


def equations(jaxpr):
    """All equations of a traced program, those of inner programs too."""
    for equation in jaxpr.eqns:
        yield equation
        for parameter in jax.tree.leaves(list(equation.params.values())):
            inner = getattr(parameter, "jaxpr", parameter)
            if hasattr(inner, "eqns"):
                yield from equations(inner)


def dtypes(tree):
    return {str(x.dtype) for x in jax.tree.leaves(tree)}


def test_parameters_states_distributions_and_losses_stay_float32():
    agent = agent_of("bfloat16")
    state = jax.eval_shape(agent.init, 0)
    batch = jax.eval_shape(lambda: jax.tree.map(lambda x: x[0], stored_batches(agent)))
    new, metrics = jax.eval_shape(agent.update, state, batch)
    assert dtypes((state.params, new.params, metrics)) == {"float32"}
    moments = [x for x in jax.tree.leaves(new.optimisers) if x.ndim]
    assert dtypes(moments) == {"float32"}

    def outputs(params, batch):
        observed = agent.observe(params, batch, jax.random.key(0))
        features = observed[0].features
        heads = [agent.head(params, name, features) for name in agent.heads]
        return observed, heads, agent.decode(params, features)

    assert dtypes(jax.eval_shape(outputs, state.params, batch)) == {"float32"}


def test_no_sum_of_an_update_is_made_in_bfloat16_but_the_products_are():
    agent = agent_of("bfloat16")
    state = jax.eval_shape(agent.init, 0)
    batch = jax.eval_shape(lambda: jax.tree.map(lambda x: x[0], stored_batches(agent)))
    reading_bfloat16 = {
        equation.primitive.name
        for equation in equations(jax.make_jaxpr(agent.update)(state, batch).jaxpr)
        if any(getattr(x.aval, "dtype", None) == jnp.bfloat16 for x in equation.invars)
    }
    assert "dot_general" in reading_bfloat16
    assert (
        not {"reduce_sum", "cumsum", "exp", "log", "log1p", "logistic", "tanh"} & reading_bfloat16
    )


def test_after_200_updates_the_losses_are_those_of_float32_within_the_noise_of_seeds():
    batches = stored_batches(agent_of("float32"))

    def losses(precision, seeds):
        """Those of all updates, each [seeds, UPDATES]."""
        agent = agent_of(precision)

        def update(state, number):
            state, metrics = agent.update(state, jax.tree.map(lambda x: x[number], batches))
            return state, {name: metrics[name] for name in LOSSES}

        def train(seed):
            return jax.lax.scan(update, agent.init(seed), jnp.arange(UPDATES) % STORED)

        # One after another: that compiles faster than all at once.
        every = jax.jit(lambda seeds: jax.lax.map(train, seeds))
        states, history = every(jnp.arange(seeds))
        assert states.healthy.all()
        return {name: np.asarray(x) for name, x in history.items()}

    # Other seeds in float32 say what noise is; in bfloat16 the first one is enough.
    exact, rounded = losses("float32", SEEDS), losses("bfloat16", 1)
    for name in LOSSES:
        first, last = (exact[name][:, part].mean() for part in (slice(10), slice(-100, None)))
        ends = exact[name][:, -100:].mean(1)
        difference = abs(ends[0] - rounded[name][0, -100:].mean())
        assert difference < ends.std(ddof=1), name
        if name in ("image_loss", "reward_loss", "termination_loss"):
            assert last < 0.8 * first, f"{name} was learned"
