"""Laws of the agent's update and policy, at sizes that compile in seconds."""

import dataclasses
import functools

import chex
import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
from flax import linen as nn
from numpy.testing import assert_allclose, assert_array_equal

from dreamer_jax import networks, rssm
from dreamer_jax.agent import MODES, Agent
from dreamer_jax.config import preset
from dreamer_jax.learning import behaviour_loss, model_loss
from dreamer_jax.losses import gaussian_kl
from dreamer_jax.population import map_members
from dreamer_jax.records import Records
from experiments.thesis.measurement import operations
from runs import random_params
from small_agent import Small

A = 2
CONFIG = preset("debug")
B, L = CONFIG.learning.batch_size, CONFIG.learning.sequence_length
random = np.random.default_rng(0)


def batch_of(*leading, seed=0):
    random = np.random.default_rng(seed)
    shape = (*leading, B, L)
    return Records(
        image=random.integers(0, 256, (*shape, 32, 32, 3), dtype=np.uint8),
        action=random.uniform(-1, 1, (*shape, A)).astype(np.float32),
        reward=random.normal(size=shape).astype(np.float32),
        first=random.random(shape) < 0.1,
        terminal=np.zeros(shape, bool),
    )


def with_settings(group, **settings):
    return dataclasses.replace(
        CONFIG, **{group: dataclasses.replace(getattr(CONFIG, group), **settings)}
    )


@pytest.fixture(scope="module")
def agent():
    return Agent(CONFIG, A)


@pytest.fixture(scope="module")
def update(agent):
    """Refuses to be traced a second time."""
    return jax.jit(chex.assert_max_traces(agent.update, n=1))


@pytest.fixture(scope="module")
def observe(agent):
    return jax.jit(agent.observe)


@pytest.fixture(scope="module")
def with_termination():
    """An agent with one more head."""
    return Agent(with_settings("network", termination=True), A)


@pytest.fixture(scope="module")
def initial(agent, with_termination):
    """Parameters of both agents from a seed."""

    @jax.jit
    def init(key):
        return agent.init_params(key), with_termination.init_params(key)

    return lambda seed: jax.device_get(init(jax.random.key(seed)))


@pytest.fixture(scope="module")
def loss_of_model(with_termination):
    """The model's loss on a batch, posterior states and metrics: (params, batch, key) -> those."""
    return jax.jit(functools.partial(model_loss, with_termination, {}))


@pytest.fixture(scope="module")
def states(agent, initial):
    """Of three members."""
    params = jax.tree.map(lambda *x: np.stack(x), *(initial(seed)[0] for seed in range(3)))
    return jax.jit(jax.vmap(agent.start))(params, np.arange(3))


@pytest.fixture(scope="module")
def state(states):
    return member(states, 0)


@pytest.fixture(scope="module")
def mapped(update):
    """Three members at once."""
    return jax.jit(map_members(update, "vmap"))


def member(tree, number):
    """One member of a population, as NumPy arrays: slices of those compile nothing."""
    return jax.tree.map(lambda x: np.asarray(x)[number], tree)


def test_updates_lower_the_losses_on_one_repeated_batch(update, state):
    batch = batch_of()
    # Plain images: those of batch_of are noise, which no decoder of this size can learn.
    batch = batch._replace(image=np.full_like(batch.image, 255))
    _, before = update(state, batch)
    history = []
    for _ in range(100):
        state, metrics = update(state, batch)
        history.append((metrics["image_loss"], metrics["reward_loss"]))
    image, reward = np.mean(history[-30:], axis=0)
    assert image < 0.5 * before["image_loss"]
    assert reward < 0.9 * before["reward_loss"]


def test_an_update_is_a_function_of_state_and_batch_alone(update, state):
    chex.assert_trees_all_equal(update(state, batch_of()), update(state, batch_of()))


def test_nothing_is_traced_twice(update, state):
    for seed in range(4):
        state, _ = update(state, batch_of(seed=seed))
    assert state.updates == 4


def test_agents_of_other_seeds_differ_and_of_the_same_seed_do_not(initial):
    one, same, other = (initial(seed) for seed in (0, 0, 1))
    chex.assert_trees_all_equal(one, same)
    for differ in zip(one, other, strict=True):
        assert not np.allclose(*(tree["encoder"]["conv_0"]["kernel"] for tree in differ))


def test_a_population_of_three_equals_three_agents_alone(update, mapped, states):
    alone = [member(states, p) for p in range(3)]
    for step in range(3):
        batches = batch_of(3, seed=step)
        states, metrics = mapped(states, batches)
        for p in range(3):
            alone[p], single = update(alone[p], member(batches, p))
            chex.assert_trees_all_close(member(metrics, p), single, rtol=1e-3, atol=1e-4)
    for p in range(3):
        chex.assert_trees_all_close(member(states.params, p), alone[p].params, atol=2e-4)


@pytest.mark.parametrize("chunk", [1, 2, 3, 5])
def test_members_in_chunks_of_any_size_are_as_all_at_once(chunk):
    """Of an agent of one number, for what is mapped is any function of a member."""
    small = Small(CONFIG, A)
    states, batches = jax.vmap(small.init)(jnp.arange(3)), batch_of(3)
    at_once, in_chunks = (
        jax.jit(map_members(small.update, *how))(states, batches)
        for how in (("vmap",), ("chunks", chunk))
    )
    chex.assert_trees_all_close(in_chunks, at_once, rtol=1e-6)
    assert len(np.unique(at_once[0].params["actor"]["value"])) == 3


def test_an_unknown_mapping_is_refused_with_the_choices(agent):
    with pytest.raises(ValueError, match="auto, vmap or chunks"):
        map_members(agent.update, "pmap")


def leaves_of(tree):
    """Leaves by their paths."""
    flat = jax.tree_util.tree_flatten_with_path(tree)[0]
    return {"/".join(key.key for key in path): np.asarray(leaf) for path, leaf in flat}


def largest(tree):
    """The largest absolute value of each leaf, by its path."""
    return {path: np.abs(leaf).max() for path, leaf in leaves_of(tree).items()}


def test_the_actor_learns_through_the_dynamics_and_does_not_touch_them(agent, state, observe):
    posterior, _, _ = observe(state.params, batch_of(), jax.random.key(0))

    @jax.jit
    @functools.partial(jax.grad, argnums=(0, 1))
    def gradients(actor, params):
        return behaviour_loss(agent, {"actor": actor}, params, posterior, jax.random.key(1))[0]

    # Only what is passed as trainable gets a gradient: dynamics, reward and value get none.
    of_actor, of_others = map(largest, gradients(state.params["actor"], state.params))
    assert min(of_actor.values()) > 0
    assert max(of_others.values()) == 0
    # Where actions have no effect on the next state, no gradient reaches the actor.
    dynamics = state.params["dynamics"]
    unmoved = {"kernel": 0 * dynamics["action_in"]["kernel"]}
    blind = state.params | {"dynamics": dynamics | {"action_in": unmoved}}
    assert max(largest(gradients(state.params["actor"], blind)[0]).values()) == 0


def test_no_gradient_of_actor_or_value_reaches_the_world_model(agent, state):
    def loss(encoder):
        params = state.params | {"encoder": encoder}
        posterior, _, _ = agent.observe(params, batch_of(), jax.random.key(0))
        trainable = {name: params[name] for name in ("actor", "value")}
        return behaviour_loss(agent, trainable, params, posterior, jax.random.key(1))[0]

    gradient = jax.jit(jax.grad(loss))(state.params["encoder"])
    assert max(largest(gradient).values()) == 0


def test_the_gradients_of_actor_and_value_are_those_of_their_own_losses(agent, state, observe):
    posterior, _, _ = observe(state.params, batch_of(), jax.random.key(0))
    parts = {name: state.params[name] for name in ("actor", "value")}

    @jax.jit
    @jax.jacrev
    def gradients(trainable):
        total, metrics = behaviour_loss(
            agent, trainable, state.params, posterior, jax.random.key(1)
        )
        return jnp.stack([total, metrics["actor_loss"], metrics["value_loss"]])

    found = gradients(parts)
    both, actor, value = (member(found, number) for number in range(3))
    assert max(largest(actor["value"]).values()) == 0
    assert max(largest(value["actor"]).values()) == 0
    chex.assert_trees_all_close(both["actor"], actor["actor"], rtol=1e-4, atol=1e-6)
    chex.assert_trees_all_close(both["value"], value["value"], rtol=1e-4, atol=1e-6)


FROZEN = (
    "encoder", "value", "dynamics/stoch_in", "dynamics/gru", "dynamics/prior/out/kernel",
    "actor/hidden_0", "reward/out/bias",
)  # fmt: skip


@pytest.fixture(scope="module")
def frozen(state):
    """The state from which an agent with frozen parts starts, and what its update makes of it."""
    # Without a floor, below which the prior has no gradient.
    agent = Agent(with_settings("learning", frozen=FROZEN, free_nats=0.0), A)
    start = agent.start(state.params, 0)
    new, step = start, jax.jit(agent.update)
    for seed in range(3):
        new, metrics = step(new, batch_of(seed=seed))
    return start, new, metrics


def test_exactly_the_frozen_leaves_stay_to_the_bit_and_all_others_train(frozen):
    start, new, metrics = frozen
    before, after = leaves_of(start.params), leaves_of(new.params)
    still = {path for path in before if before[path].tobytes() == after[path].tobytes()}
    named = {path for path in before if any(f"{path}/".startswith(f"{x}/") for x in FROZEN)}
    assert still == named
    # Beside a leaf that is frozen, the others of its layer train.
    assert "dynamics/prior/out/bias" not in still and "reward/out/kernel" not in still
    assert metrics["actor_gradient_norm"] > 0


def test_what_is_frozen_costs_no_optimiser_memory(frozen, state):
    start, _, metrics = frozen
    before = leaves_of(start.params)
    named = {path for path in before if any(f"{path}/".startswith(f"{x}/") for x in FROZEN)}
    # Adam remembers the trained leaves only; of the value, which is frozen whole, nothing.
    groups = [group for group in ("model", "value", "actor") if group in start.optimisers]
    remembered = {
        path for group in groups for path in leaves_of(start.optimisers[group][1][0].mu)
    }  # fmt: skip
    assert remembered == set(before) - named
    full = sum(x.size for x in jax.tree.leaves(state.optimisers))
    part = sum(x.size for x in jax.tree.leaves(start.optimisers))
    saved = sum(before[path].size for path in named)
    assert full - part == 2 * saved
    assert "value_gradient_norm" not in metrics


@pytest.mark.parametrize(
    ("frozen", "message"),
    [
        ("dynamics/gruu", "'dynamics/gruu': the parts of dynamics are .*gru"),
        ("dynamics/prior/out/kernl", "the parts of dynamics/prior/out are bias, kernel"),
        ("dynamics/gru/kernel/0", "dynamics/gru/kernel is a leaf"),
        ("termination/out", "termination is not in this agent"),
    ],
)
def test_what_is_to_be_frozen_and_not_there_is_refused_with_what_there_is(state, frozen, message):
    agent = Agent(with_settings("learning", frozen=(frozen,)), A)
    with pytest.raises(ValueError, match=message):
        agent.start(state.params, 0)


@pytest.mark.parametrize("frozen", ["encoder", "dynamics/gru", "dynamics/gru/recurrent_kernel"])
def test_the_gradient_of_what_is_frozen_is_not_computed(agent, frozen):
    frozen = Agent(with_settings("learning", frozen=(frozen,)), A)
    assert operations(frozen) < operations(agent)


class Shifted(networks.Head):
    """A head with one more part, which is added to its outputs."""

    @nn.compact
    def __call__(self, features):
        shift = self.param("shift", lambda key: {"by": jnp.ones(())})
        return super().__call__(features) + shift["by"]


def test_a_module_takes_the_place_of_a_components_usual_one(agent, state):
    head = agent.heads["reward"]
    module = Shifted(head.outputs, head.layers, head.units, head.dtype)
    shifted = dataclasses.replace(agent, modules=(("reward", module),))
    params = random_params(shifted)
    features = random.normal(size=(3, CONFIG.network.feature_size)).astype(np.float32)
    usual = params | {"reward": {k: v for k, v in params["reward"].items() if k != "shift"}}
    by = params["reward"]["shift"]["by"]
    assert_allclose(shifted.reward(params, features), agent.reward(usual, features) + by, rtol=1e-5)
    assert shifted.heads["value"] == agent.heads["value"]
    # Equal agents share their compiled functions.
    assert hash(shifted) == hash(dataclasses.replace(agent, modules=(("reward", module),)))


def test_a_member_whose_loss_is_not_finite_is_frozen_and_the_others_go_on(mapped, states):
    batches = batch_of(3)
    healthy, _ = mapped(states, batches)
    batches.reward[0, 0, 0] = np.nan
    injected, metrics = mapped(states, batches)
    assert_array_equal(injected.healthy, [False, True, True])
    assert not np.isfinite(metrics["reward_loss"][0])
    chex.assert_trees_all_equal(member(injected.params, 0), member(states.params, 0))
    for p in (1, 2):
        chex.assert_trees_all_close(
            member(injected.params, p), member(healthy.params, p), atol=1e-6
        )
    # It stays frozen when its batches are sound again, and keeps in step with the others.
    later, _ = mapped(injected, batch_of(3, seed=1))
    assert_array_equal(later.healthy, [False, True, True])
    assert_array_equal(later.updates, [2, 2, 2])
    chex.assert_trees_all_equal(
        member((later.params, later.optimisers), 0),
        member((injected.params, injected.optimisers), 0),
    )


def test_imagination_from_fewer_states_costs_less(agent):
    fewer = Agent(with_settings("learning", imagination_starts=3), A)
    params = jax.eval_shape(fewer.init_params, jax.random.key(0))
    posterior = jax.tree.map(jnp.zeros_like, agent.dynamics.initial((B, L)))

    def matrix_products(agent):
        loss = functools.partial(behaviour_loss, agent, {})
        lowered = jax.jit(loss).lower(params, posterior, jax.random.key(0))
        return lowered.cost_analysis()["flops"]

    assert matrix_products(fewer) < matrix_products(agent) * 4 / (B * L)


def with_termination_logit(params, logit):
    """Parameters whose termination head answers `logit` whatever it reads."""
    out = params["termination"]["out"]
    constant = {"kernel": 0 * out["kernel"], "bias": np.full_like(out["bias"], logit)}
    return params | {"termination": params["termination"] | {"out": constant}}


def test_the_termination_heads_target_is_the_discount_and_its_scale_ten(
    with_termination, loss_of_model
):
    params = with_termination_logit(random_params(with_termination), 1.5)
    batch = batch_of()
    batch.terminal[0, :3] = True  # 3 of 10 records
    _, (_, metrics) = loss_of_model(params, batch, jax.random.key(1))
    # Cross-entropy of sigmoid(1.5) with targets 0 (terminal) and 0.99 (the others).
    p = 1 / (1 + np.exp(-1.5))
    going_on = -0.99 * np.log(p) - 0.01 * np.log(1 - p)
    expected = (3 * -np.log(1 - p) + 7 * going_on) / 10
    assert_allclose(metrics["termination_loss"], expected, rtol=1e-5)
    rest = metrics["image_loss"] + metrics["reward_loss"] + max(3.0, metrics["kl"])
    assert_allclose(metrics["model_loss"] - rest, 10 * expected, rtol=1e-3)


def test_imagination_weighs_what_follows_by_the_termination_head(agent, with_termination):
    params = random_params(with_termination)
    # A reward of 2 wherever the agent is.
    out = {"kernel": 0 * params["reward"]["out"]["kernel"], "bias": np.full(1, 2.0, np.float32)}
    params["reward"] = params["reward"] | {"out": out}
    start = jax.tree.map(np.asarray, agent.dynamics.initial((B, L)))

    @functools.partial(jax.jit, static_argnums=0)
    def actor_loss(some, params):
        return behaviour_loss(some, {}, params, start, jax.random.key(1))[1]["actor_loss"]

    # Where every state ends the episode, a return is its reward, and only the first one counts.
    ended = actor_loss(with_termination, with_termination_logit(params, -100.0))
    assert_allclose(ended, -2.0 / (CONFIG.learning.horizon - 1), rtol=1e-5)
    # Where none does, all is as without the head.
    endless = actor_loss(with_termination, with_termination_logit(params, np.log(0.99 / 0.01)))
    assert_allclose(endless, actor_loss(agent, params), rtol=1e-4)


@pytest.fixture(scope="module")
def with_choices():
    """An agent of three choices that predicts terminations and is paid for entropy, what its actor
    and its termination head have become by 60 steps on a batch that is all terminal, with what is
    known of the others, and the metrics."""
    config = with_settings("learning", entropy_scale=100.0)
    network = dataclasses.replace(config.network, termination=True)
    agent = Agent(dataclasses.replace(config, network=network), 3, discrete=True)
    choices = np.eye(3, dtype=np.float32)[np.zeros((B, L), int)]
    batch = batch_of()._replace(action=choices, terminal=np.ones((B, L), bool))
    params = random_params(agent)
    rates = {"actor": optax.adam(1e-2), "termination": optax.adam(5e-3)}
    learned = {name: params[name] for name in rates}
    optimiser = optax.multi_transform(rates, {name: name for name in rates})

    def step(carry, key):
        learned, moments = carry

        def loss(learned):
            head, actor = ({name: learned[name]} for name in ("termination", "actor"))
            total, (posterior, metrics) = model_loss(agent, head, params, batch, key)
            others, behaviour = behaviour_loss(agent, actor, params | learned, posterior, key)
            return total + others, metrics | behaviour

        gradient, metrics = jax.grad(loss, has_aux=True)(learned)
        changes, moments = optimiser.update(gradient, moments)
        metrics["actor_gradient_norm"] = optax.tree.norm(gradient["actor"])
        return (optax.apply_updates(learned, changes), moments), metrics

    @jax.jit
    def learn(learned, keys):
        (learned, _), history = jax.lax.scan(step, (learned, optimiser.init(learned)), keys)
        return learned, history

    learned, history = jax.device_get(learn(learned, jax.random.split(jax.random.key(0), 60)))
    return agent, params | learned, batch, history


def test_a_termination_head_learns_the_discount(with_choices):
    agent, params, batch, metrics = with_choices
    # Every record is terminal, so the learned discount falls towards zero.
    posterior, _, _ = jax.jit(agent.observe)(params, batch, jax.random.key(0))
    logits = agent.head(params, "termination", np.asarray(posterior.features))
    assert (1 / (1 + np.exp(-np.asarray(logits)))).mean() < 0.2
    assert metrics["termination_loss"][-1] < 0.3


def test_discrete_actions_are_one_hot_and_their_actor_learns(with_choices):
    agent, params, batch, metrics = with_choices
    assert (metrics["actor_gradient_norm"] > 0).all()
    policy = jax.jit(agent.policy, static_argnames="mode")
    for mode in ("explore", "evaluate"):
        for seed in range(5):
            action, _ = policy(
                params,
                agent.initial_carry(),
                batch.image[0, 0],
                jnp.bool_(True),
                jax.random.key(seed),
                mode=mode,
            )
            assert sorted(action.tolist()) == [0.0, 0.0, 1.0]


def test_entropys_weight_pulls_an_actor_towards_even_odds(with_choices):
    *_, metrics = with_choices
    entropies = metrics["actor_entropy"]
    assert entropies[0] < entropies[-1] <= np.log(3) + 1e-6
    assert np.log(3) - entropies[-1] < 0.2 * (np.log(3) - entropies[0])


def test_entropys_weight_spreads_continuous_actions_over_their_range(state, observe):
    # A squashed Gaussian comes nearest to the uniform distribution, whose entropy is log 2 for
    # each of the A actions, at a spread of about 0.9.
    agent = Agent(with_settings("learning", entropy_scale=100.0), A)
    posterior, _, _ = observe(state.params, batch_of(), jax.random.key(0))
    optimiser = optax.adam(3e-2)

    def step(carry, key):
        actor, moments = carry

        def loss(actor):
            return behaviour_loss(agent, {"actor": actor}, state.params, posterior, key)

        gradient, metrics = jax.grad(loss, has_aux=True)(actor)
        changes, moments = optimiser.update(gradient, moments)
        carry = optax.apply_updates(actor, changes), moments
        return carry, (metrics["actor_entropy"], metrics["actor_std"])

    @jax.jit
    def learn(actor, keys):
        return jax.lax.scan(step, (actor, optimiser.init(actor)), keys)[1]

    history = learn(state.params["actor"], jax.random.split(jax.random.key(1), 100))
    (entropy, last_entropy), (std, last_std) = (np.asarray(x)[[0, -1]] for x in history)
    assert entropy < 0 and std > 3, "an actor begins with nearly all actions at their limits"
    assert A * np.log(2) - 0.4 < last_entropy <= A * np.log(2) + 0.1
    assert 0.6 < last_std < 1.3


def test_the_entropys_weight_falls_linearly_to_its_end(state, observe):
    falling = Agent(
        with_settings("learning", entropy_scale=0.5, entropy_scale_end=0.1, entropy_decay=1000),
        A,
    )
    posterior, _, _ = observe(state.params, batch_of(), jax.random.key(1))

    @jax.jit
    def loss(updates):
        return behaviour_loss(falling, {}, state.params, posterior, jax.random.key(2), updates)[0]

    at = {updates: float(loss(updates)) for updates in (0, 500, 1000, 5000)}
    assert_allclose(at[500], (at[0] + at[1000]) / 2, rtol=1e-4)
    assert at[1000] == at[5000]
    assert at[0] != at[1000]


def test_the_entropys_gradient_goes_through_the_samples():
    outputs, noise = np.float32([[0.3, -1.2, 0.1, -4.0]]), np.float32([[0.4, -0.7]])

    def entropy(outputs):
        mean, std = networks.tanh_normal(outputs)
        return -networks.tanh_normal_log_probability(outputs, mean + std * noise).sum()

    # -log p(tanh(mean + std * noise)) = log std + log(1 - tanh²) + constants of the noise.
    def by_hand(outputs):
        mean, std = networks.tanh_normal(outputs)
        return (jnp.log(std) + jnp.log1p(-(jnp.tanh(mean + std * noise) ** 2))).sum()

    found, expected = jax.jit(lambda x: (jax.grad(entropy)(x), jax.grad(by_hand)(x)))(outputs)
    assert_allclose(found, expected, rtol=1e-4)


def test_the_images_spread_divides_its_loss_by_its_square(state):
    batch, key = batch_of(), jax.random.key(1)

    @jax.jit
    def losses(params):
        agents = {
            std: Agent(with_settings("learning", image_std=std, reward_std=2 * std), A)
            for std in (1.0, 0.5)
        }
        return {std: model_loss(agents[std], {}, params, batch, key) for std in agents}

    found = losses(state.params)
    for std, (loss, (_, metrics)) in found.items():
        expected = metrics["image_loss"] / std**2 + metrics["reward_loss"] / (2 * std) ** 2 + 3.0
        assert_allclose(loss, expected, rtol=1e-5)
    image_losses = [metrics["image_loss"] for _, (_, metrics) in found.values()]
    assert image_losses[0] == image_losses[1]


def test_the_divergence_of_first_records_is_told_apart(initial, observe, loss_of_model):
    (plain, params), batch, key = initial(0), batch_of(), jax.random.key(1)
    _, (_, metrics) = loss_of_model(params, batch, key)
    posterior, mean, std = observe(plain, batch, key)
    kl = np.asarray(jax.jit(gaussian_kl)(posterior.mean, posterior.std, mean, std))
    assert_allclose(metrics["kl_at_start"], kl[:, 0].mean(), rtol=1e-4)
    assert_allclose(metrics["kl_share_below_floor"], (kl < 3.0).mean())
    assert bool(metrics["kl_floored"]) == bool(metrics["kl"] < 3.0)


@pytest.mark.parametrize("discrete", [False, True])
def test_random_actions_are_held_as_long_as_told_on_average(discrete):
    agent = Agent(with_settings("exploration", exploration_hold=8.0), 2, discrete)
    image = batch_of().image[0, 0]

    def tick(carry, inputs):
        first, key = inputs
        action, carry = agent.policy({}, carry, image, first, key, "random")
        return carry, action

    keys, first = jax.random.split(jax.random.key(0), 4000), np.arange(4000) == 0
    actions = np.asarray(jax.lax.scan(tick, agent.initial_carry(), (first, keys))[1])
    changes = (actions[1:] != actions[:-1]).any(axis=1)
    # Half of the new choices among two are the old one.
    assert_allclose(changes.mean(), 1 / 16 if discrete else 1 / 8, rtol=0.15)
    if not discrete:
        drawn = actions[1:][changes]
        assert_allclose(drawn.std(), 1 / np.sqrt(3), rtol=0.1)


def test_held_random_actions_of_epsilon_greedy_are_uniform():
    settings = {"exploration_kind": "epsilon_greedy", "exploration_hold": 4.0}
    agent = Agent(with_settings("exploration", epsilon_start=1.0, epsilon_end=1.0, **settings), 2)

    def tick(held, inputs):
        first, key = inputs
        action, held = agent._explore(jnp.zeros(2), held, first, key, 0)
        return held, action

    keys, first = jax.random.split(jax.random.key(0), 8000), np.arange(8000) == 0
    actions = np.asarray(jax.lax.scan(tick, np.zeros(2, np.float32), (first, keys))[1])
    drawn = actions[1:][(actions[1:] != actions[:-1]).any(axis=1)]
    assert_allclose(len(drawn) / len(actions), 1 / 4, rtol=0.1)
    assert_allclose(drawn.mean(0), 0.0, atol=0.06)
    assert_allclose(drawn.std(0), 1 / np.sqrt(3), rtol=0.06)


def test_an_episodes_first_action_is_not_held_from_the_one_before():
    agent = Agent(with_settings("exploration", exploration_hold=1e6), 2)
    image = batch_of().image[0, 0]
    carry = agent.initial_carry()._replace(random=jnp.array([0.25, -0.5]))
    key = jax.random.key(0)
    held, _ = agent.policy({}, carry, image, jnp.bool_(False), key, "random")
    fresh, after = agent.policy({}, carry, image, jnp.bool_(True), key, "random")
    assert_array_equal(held, [0.25, -0.5])
    assert (fresh != held).all()
    assert_array_equal(after.random, fresh)


def test_held_noise_explores_around_the_actors_samples(agent, state):
    held = Agent(with_settings("exploration", exploration_hold=1e6, exploration_noise=0.1), A)
    quiet = Agent(with_settings("exploration", exploration_noise=0.0), A)
    image, key = batch_of().image[0, 0], jax.random.key(3)
    carry = held.initial_carry()._replace(random=np.float32([1.0, -2.0]))

    @jax.jit
    def played(carry):
        explored = (state.params, carry, image, jnp.bool_(False), key, "explore")
        return held.policy(*explored), quiet.policy(*explored)[0]

    (noisy, after), plain = played(carry)
    assert_allclose(noisy, np.clip(plain + np.float32([0.1, -0.2]), -1, 1), atol=1e-6)
    assert_array_equal(after.random, carry.random)


def test_evaluation_can_play_the_tanh_of_the_mean(state):
    agent = Agent(with_settings("exploration", evaluation_action="mean"), A)
    image = batch_of().image[0, 0]

    @jax.jit
    def played(key):
        start = agent.initial_carry(), image, jnp.bool_(True)
        action, carry = agent.policy(state.params, *start, key, "evaluate")
        return action, networks.tanh_normal(agent.head(state.params, "actor", carry.state.features))

    action, (mean, _) = played(jax.random.key(0))
    assert_allclose(action, np.tanh(mean), atol=1e-6)


def test_epsilon_greedy_falls_from_its_start_to_its_end():
    config = with_settings("exploration", exploration_kind="epsilon_greedy", epsilon_decay=100)
    agent = Agent(config, 1)

    @jax.jit
    @jax.vmap
    def explored(key, updates):
        action, _ = agent._explore(jnp.full(1, 0.123), jnp.zeros(1), jnp.bool_(False), key, updates)
        return action[0] != jnp.float32(0.123)

    keys = jax.random.split(jax.random.key(0), 4000)
    for updates, expected in ((0, 0.4), (50, 0.25), (100, 0.1), (10_000, 0.1)):
        share = explored(keys, jnp.full(4000, updates)).mean()
        assert_allclose(share, expected, atol=0.03)


@pytest.fixture(scope="module")
def policy(agent, state):
    """What the agent does, with a mode that is chosen as the program runs: (carry, image, first,
    key, number of the mode) -> (action, carry)."""
    return jax.jit(functools.partial(agent.policy, state.params))


def test_the_policy_forgets_across_a_first_image(agent, policy):
    image, key = batch_of().image[0, 0], jax.random.key(0)
    fresh = jax.tree.map(np.asarray, agent.initial_carry())
    other = jax.tree.map(lambda x: x + np.float32(1), fresh)
    remembered = [
        policy(carry, image, np.bool_(first), key, np.int32(MODES.index("evaluate")))
        for carry, first in ((fresh, True), (other, True), (other, False))
    ]
    chex.assert_trees_all_equal(remembered[0], remembered[1])
    features = [np.asarray(carry.state.features) for _, carry in remembered]
    assert not np.allclose(features[0], features[2])


def test_the_policy_acts_on_the_states_that_training_observes(agent, state):
    # Filtering image by image and observing a whole sequence are one computation.
    batch = batch_of()
    sequence = jax.tree.map(lambda x: x[:1], batch)._replace(first=np.zeros((1, L), bool))
    key = jax.random.key(0)

    def step(carry, inputs):
        image, action, noise = inputs
        variables = {"params": state.params["dynamics"]}
        embedding = agent.encode(state.params, image[None])[0]
        projected = agent.dynamics.apply(variables, embedding, method="project")
        carry = agent.dynamics.apply(
            variables, carry, action, projected, jnp.bool_(False), noise, method="obs_step"
        )
        return carry, carry.features

    @jax.jit
    def both(sequence):
        noise = jax.random.normal(key, (L, 1, CONFIG.network.stochastic_size))
        inputs = sequence.image[0], sequence.action[0], noise[:, 0]
        _, one_by_one = jax.lax.scan(step, agent.initial_carry().state, inputs)
        return one_by_one, agent.observe(state.params, sequence, key)[0].features

    one_by_one, states = both(sequence)
    assert_allclose(one_by_one, states[0], atol=1e-5)


def test_exploration_stays_in_the_range_of_actions(agent, state):
    image = batch_of().image[0, 0]

    @jax.jit
    @jax.vmap
    def explored(key):
        return agent.policy(
            state.params, agent.initial_carry(), image, jnp.bool_(True), key, "explore"
        )[0]

    actions = np.asarray(explored(jax.random.split(jax.random.key(0), 500)))
    assert np.abs(actions).max() <= 1.0
    assert actions.std() > 0.2


def test_a_mode_can_be_chosen_as_the_program_runs(agent, state, policy):
    inputs = agent.initial_carry(), batch_of().image[0, 0], np.bool_(True), jax.random.key(3)
    named = jax.jit(lambda: [agent.policy(state.params, *inputs, mode) for mode in MODES])()
    actions = []
    for number, mode in enumerate(MODES):
        action, carry = policy(*inputs, np.int32(number))
        chex.assert_trees_all_close((action, carry), named[number], atol=1e-5)
        assert np.any(carry.action) != (mode == "random"), "who acts at random sees nothing"
        actions.append(action)
    assert len(np.unique(actions, axis=0)) == 3


def test_an_unknown_policy_mode_is_refused(agent, state):
    with pytest.raises(ValueError, match="choose one of random, explore, evaluate"):
        agent.policy(
            state.params,
            agent.initial_carry(),
            batch_of().image[0, 0],
            True,
            jax.random.key(0),
            "x",
        )


def test_a_batch_of_another_action_size_is_refused(agent, state):
    batch = batch_of()
    with pytest.raises(AssertionError):
        agent.update(state, batch._replace(action=batch.action[..., :1]))


def test_predictions_see_the_context_and_nothing_of_what_follows(agent, state):
    batch = batch_of()._replace(first=np.zeros((B, L), bool))
    changed = batch._replace(image=batch.image.copy())
    changed.image[:, 3:] = 0
    key = jax.random.key(0)
    predict = jax.jit(agent.predict, static_argnums=2)
    truth, one = predict(state.params, batch, 3, key)
    _, two = predict(state.params, changed, 3, key)
    assert_array_equal(one, two)
    assert_allclose(truth, batch.image / 255.0, atol=1e-6)
    assert one.shape == truth.shape


def test_a_seeds_initial_parameters_do_not_depend_on_options(initial):
    plain, extended = initial(0)
    assert set(extended) - set(plain) == {"termination"}
    chex.assert_trees_all_equal(plain, {name: extended[name] for name in plain})


def test_latent_features_are_the_sample_and_the_deterministic_part():
    zeros, ones = jnp.zeros(2), jnp.ones(3)
    state = rssm.LatentState(zeros + 7, zeros + 8, zeros, ones)
    assert_array_equal(state.features, [0, 0, 1, 1, 1])
