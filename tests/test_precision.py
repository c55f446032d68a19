"""bfloat16 activations: what stays float32, and that learning does not notice."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from dreamer_jax import networks
from dreamer_jax.agent import Agent
from dreamer_jax.config import preset
from dreamer_jax.diagnosis import diagnose
from dreamer_jax.population import batch_shapes
from dreamer_jax.records import Records
from runs import random_params
from traces import equations

A, STORED, UPDATES, SEEDS = 2, 10, 60, 3
DEBUG = preset("debug")
# Most updates here are computed, not only compiled.
CONFIG = dataclasses.replace(
    DEBUG, network=dataclasses.replace(DEBUG.network, convolutions="matmul")
)
B, L = CONFIG.learning.batch_size, CONFIG.learning.sequence_length
LOSSES = ("image_loss", "reward_loss", "kl", "termination_loss", "actor_loss", "value_loss")


def agent_of(precision):
    network = dataclasses.replace(CONFIG.network, precision=precision, termination=True)
    return Agent(dataclasses.replace(CONFIG, network=network), A)


def stored_batches():
    """Batches [STORED, B, L, ...] of random steps of a point, which a bright column shows: its
    reward depends on the action, and it falls whenever it is at one of both ends."""
    random, size = np.random.default_rng(0), CONFIG.network.image_size
    steps = STORED * B * L
    records = Records(
        image=np.full((steps, size, size, 3), 40, np.uint8),
        action=random.uniform(-1, 1, (steps, A)).astype(np.float32),
        reward=np.zeros(steps, np.float32),
        first=np.zeros(steps, bool),
        terminal=np.zeros(steps, bool),
    )
    column = fallen = None
    for step in range(steps):
        if column is None or fallen:
            column, fallen, records.first[step] = size // 2, False, True
            records.action[step] = 0
        else:
            column += round(4 * records.action[step, 0])
            fallen = abs(column - size // 2) > 6
            records.terminal[step] = fallen
            records.reward[step] = 1 - (records.action[step, 0] - 0.5) ** 2
        records.image[step, :, column] = 255
    return records.map(lambda x: x.reshape(STORED, B, L, *x.shape[1:]))


@pytest.fixture(scope="module")
def bfloat16_update():
    """An update in bfloat16, traced: the program, and the shapes that go in and come out."""
    agent = agent_of("bfloat16")
    state = jax.eval_shape(agent.init, 0)
    traced, out = jax.make_jaxpr(agent.update, return_shape=True)(state, batch_shapes(agent, B, L))
    return traced.jaxpr, state, out


def dtypes(tree):
    return {str(x.dtype) for x in jax.tree.leaves(tree)}


def test_parameters_states_distributions_and_losses_stay_float32(bfloat16_update):
    agent = agent_of("bfloat16")
    _, state, (new, metrics) = bfloat16_update
    assert dtypes((state.params, new.params, metrics)) == {"float32"}
    moments = [x for x in jax.tree.leaves(new.optimisers) if x.ndim]
    assert dtypes(moments) == {"float32"}

    def outputs(params, batch):
        observed = agent.observe(params, batch, jax.random.key(0))
        features = observed[0].features
        heads = [agent.head(params, name, features) for name in agent.heads]
        return observed, heads, agent.decode(params, features)

    assert dtypes(jax.eval_shape(outputs, state.params, batch_shapes(agent, B, L))) == {"float32"}


@pytest.mark.parametrize("offset_by", ["bias", "product"])
def test_a_bfloat16_head_tells_values_about_150_apart(offset_by):
    """True values of 150 ± 0.5: rounded to bfloat16 they would be 150, or one beside it."""
    head = networks.Head(1, layers=1, units=400, dtype=jnp.bfloat16)
    inputs = np.linspace(-1, 1, 4096, dtype=np.float32)[:, None]
    params = jax.jit(networks.Head(1, layers=1, units=400).init)(jax.random.key(0), inputs)
    params = jax.tree.map(np.array, params["params"])
    # Hidden units are about 1 each and move with the input, their sum does not.
    params["hidden_0"]["kernel"] -= params["hidden_0"]["kernel"].mean()
    params["hidden_0"]["bias"] += 1.0
    hidden = inputs @ params["hidden_0"]["kernel"] + params["hidden_0"]["bias"]
    hidden = np.where(hidden > 0, hidden, np.expm1(hidden))
    mean, (slope,) = 150.0, params["hidden_0"]["kernel"]
    weights = 0.5 * slope / (slope @ slope)
    weights += mean / 400 if offset_by == "product" else 0.0
    params["out"]["kernel"] = weights[:, None]
    params["out"]["bias"] += mean - (hidden @ weights).mean()
    truth, values = (
        np.asarray(jax.jit(each.apply)({"params": params}, inputs)[:, 0])
        for each in (head.clone(dtype=jnp.float32), head)
    )
    assert 149.4 < truth.min() < 149.6 and 150.4 < truth.max() < 150.6
    assert values.dtype == np.float32
    # Weights that are rounded move all values by as much, which is not what is looked at here.
    difference = values - truth
    assert (difference - difference.mean()).std() < 0.05
    assert len(np.unique(values)) > 200


def test_bfloat16_distributions_of_latent_states_are_float32_from_their_last_product_on():
    dynamics = agent_of("bfloat16").dynamics
    inputs = jnp.zeros((1, dynamics.embedding_size)), jnp.zeros((1, A))
    shapes = jax.eval_shape(dynamics.init, jax.random.key(0), *inputs)
    deterministic = jnp.zeros((1, dynamics.deterministic_size))

    def statistics(params, deterministic):
        return networks.applied(dynamics, params, deterministic, method="prior_statistics")

    traced = jax.make_jaxpr(statistics)(shapes["params"], deterministic)
    *_, last = [x for x in equations(traced.jaxpr) if x.primitive.name == "dot_general"]
    assert [x.aval.dtype for x in last.invars] == [jnp.bfloat16] * 2
    assert last.outvars[0].aval.dtype == jnp.float32


@pytest.mark.parametrize(
    ("setting", "expected"), [("default", None), ("float32", (jax.lax.Precision.HIGHEST,) * 2)]
)
def test_products_of_an_update_a_policy_and_a_diagnosis_have_the_precision_asked_for(
    setting, expected
):
    network = dataclasses.replace(CONFIG.network, matmul_precision=setting)
    agent = Agent(dataclasses.replace(CONFIG, network=network), A)
    state = jax.eval_shape(agent.init, 0)
    batch = batch_shapes(agent, B, L)
    first, size = jnp.bool_(True), agent.config.network.image_size
    image, key = jnp.zeros((size, size, 3), jnp.uint8), jax.random.key(0)

    def act(params):
        return agent.policy(params, agent.initial_carry(), image, first, key, "explore")

    def diagnosed(params, batch):
        one = jax.tree.map(lambda x: x[None], (params, batch, jnp.int32(0)))
        return diagnose(agent, *one, jnp.int32(0))

    for traced in (
        jax.make_jaxpr(agent.update)(state, batch),
        jax.make_jaxpr(act)(state.params),
        jax.make_jaxpr(diagnosed)(state.params, batch),
    ):
        products = [x for x in equations(traced.jaxpr) if x.primitive.name == "dot_general"]
        assert products
        assert {x.params["precision"] for x in products} == {expected}


def test_no_sum_of_an_update_is_made_in_bfloat16_but_the_products_are(bfloat16_update):
    reading_bfloat16 = {
        equation.primitive.name
        for equation in equations(bfloat16_update[0])
        if any(getattr(x.aval, "dtype", None) == jnp.bfloat16 for x in equation.invars)
    }
    assert "dot_general" in reading_bfloat16
    assert (
        not {"reduce_sum", "cumsum", "exp", "log", "log1p", "logistic", "tanh"} & reading_bfloat16
    )


def test_after_60_updates_the_losses_are_those_of_float32_within_a_tenth_of_the_noise_of_seeds():
    batches = stored_batches()

    def losses(precision, seeds):
        """Those of all updates, each [seeds, UPDATES]."""
        agent = agent_of(precision)
        start, update = jax.jit(agent.start), jax.jit(agent.update)
        history = {name: np.zeros((seeds, UPDATES)) for name in LOSSES}
        for seed in range(seeds):
            state = start(random_params(agent, seed), seed)
            for number in range(UPDATES):
                state, metrics = update(state, batches.at(number % STORED))
                for name in LOSSES:
                    history[name][seed, number] = metrics[name]
            assert state.healthy
        return history

    # Other seeds in float32 say what noise is; in bfloat16 the first one is enough.
    exact, rounded = losses("float32", SEEDS), losses("bfloat16", 1)
    for name in LOSSES:
        first, last = (exact[name][:, part].mean() for part in (slice(10), slice(-10, None)))
        ends = exact[name][:, -30:].mean(1)
        difference = abs(ends[0] - rounded[name][0, -30:].mean())
        # A fiftieth at most for nine seeds; where parameters are rounded to bfloat16 too, a tenth
        # and more of five losses, 1.5 of the image's.
        assert difference < 0.1 * ends.std(ddof=1), name
        if name in ("image_loss", "reward_loss", "termination_loss"):
            assert last < 0.9 * first, f"{name} was learned"
