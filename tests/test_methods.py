"""The thesis's methods, and what lies beyond them, on whole agents."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from runs import CONFIG, batch_for, spec_of, write_run
from transfer_trees import bits

from dreamer_jax import rssm
from dreamer_jax.networks import Head
from experiments.agents import frozen_paths, make_agent, plan
from experiments.methods import load_sources, transferred_members
from transfer.ltc import NOVEL, fit, suggest_threshold

M = CONFIG.network.feature_size
random = np.random.default_rng(0)
FEATURES = random.normal(size=(3, 7, M)).astype(np.float32)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """An autoencoder, four agents on it with dynamics of their own, and two on its dynamics."""
    folder = tmp_path_factory.mktemp("sources")
    write_run(folder / "uae", spec_of("hopper", "ant"))
    write_run(folder / "other", spec_of("hopper"), seed=9)
    on = {"source": folder / "uae", "method": "uae"}
    for seed, task in enumerate(("hopper", "walker2d", "ant", "halfcheetah"), start=1):
        write_run(folder / task, spec_of(task, **on), seed)
    for seed, task in enumerate(("hopper", "ant"), start=1):
        write_run(folder / f"{task}_frozen", spec_of(task, dynamics="frozen", **on), seed)
    return folder


def names(folder, *tasks, suffix=""):
    return tuple(str(folder / f"{task}{suffix}") for task in tasks)


def meta_spec(folder, *tasks, suffix="", **settings):
    return spec_of(
        "inverted_pendulum",
        source=folder / "uae",
        method="meta",
        reward_sources=names(folder, *tasks, suffix=suffix),
        **settings,
    )


def targets_of(spec):
    """Agent, sources, state and report of a run at its start."""
    sources = load_sources(spec)
    state, report = transferred_members(spec, sources)
    return make_agent(spec), sources, state, report


def member(tree, p):
    return jax.tree.map(lambda x: x[p], tree)


def usual(agent, name):
    """The module that an agent without meta-models has."""
    return dataclasses.replace(agent, modules=()).heads[name]


# --- the universal autoencoder ----------------------------------------------------------------


@pytest.mark.parametrize("dynamics", ["fresh", "copied", "frozen"])
def test_targets_start_from_the_sources_autoencoder(folder, dynamics):
    spec = spec_of("walker2d", source=folder / "uae", method="uae", dynamics=dynamics, seeds=(3, 4))
    agent, sources, state, report = targets_of(spec)
    given = sources.agent.params
    for p in range(2):
        params = member(state.params, p)
        assert bits(params["encoder"]) == bits(given["encoder"])
        assert bits(params["decoder"]) == bits(given["decoder"])
        same = bits(params["dynamics"]["gru"]) == bits(given["dynamics"]["gru"])
        assert same == (dynamics != "fresh")
        assert params["dynamics"]["action_in"]["kernel"].shape[0] == 6
        assert bits(params["reward"]) != bits(given["reward"])
    frozen = {row.leaf.split("/")[0] for row in report.rows if row.frozen}
    assert frozen == ({"encoder", "dynamics"} if dynamics == "frozen" else {"encoder"})
    trained = agent.trainable(member(state.params, 0))["model"]
    assert "encoder" not in trained and "decoder" in trained
    assert set(trained["dynamics"]) >= {"action_in"}
    assert ("gru" in trained["dynamics"]) == (dynamics != "frozen")


# --- meta-models ------------------------------------------------------------------------------


def test_a_meta_model_reads_the_features_and_what_each_stored_model_predicts(folder):
    agent, sources, state, _ = targets_of(meta_spec(folder, "hopper", "walker2d"))
    params = member(state.params, 0)
    plain = usual(agent, "reward")
    inputs = [FEATURES]
    for source in sources.stored:
        inputs.append(plain.apply({"params": source.params["reward"]}, FEATURES))
    inputs.append(np.zeros((*FEATURES.shape[:-1], 2)))
    own = {part: params["reward"][part] for part in ("hidden_0", "out")}
    expected = Head(1, 1, CONFIG.network.head_units).apply(
        {"params": own}, np.concatenate(inputs, -1)
    )
    assert_allclose(agent.reward(params, FEATURES), expected[..., 0], rtol=1e-5, atol=1e-6)


def test_exactly_what_is_frozen_does_not_move_by_a_bit_in_a_thousand_updates(folder):
    spec = meta_spec(
        folder, "hopper", "ant", suffix="_frozen", dynamics="frozen", meta=("reward", "value")
    )
    agent, sources, state, _ = targets_of(spec)
    start, batch = member(state, 0), batch_for(agent)

    @jax.jit
    def train(state):
        return jax.lax.fori_loop(0, 1000, lambda _, state: agent.update(state, batch)[0], state)

    end = train(start)
    assert end.updates == 1000 and end.healthy
    before, after = bits(start.params), bits(end.params)
    still = {path for path in before if after[path] == before[path]}
    assert still == set(frozen_paths(plan(spec), start.params))
    assert {"encoder/conv_0/kernel", "dynamics/gru/kernel", "value/stored/present"} < still
    for place, source in enumerate(sources.stored):
        for name in ("reward", "value"):
            stored = member(end.params[name]["stored"]["params"], place)
            assert bits(stored) == bits(source.params[name])


def test_the_gradient_passes_through_stored_models_into_the_features(folder):
    agent, _, state, _ = targets_of(meta_spec(folder, "hopper", "walker2d"))
    params = member(state.params, 0)
    # Only what stored models predict reaches this meta-model.
    params["reward"]["hidden_0"]["kernel"] = params["reward"]["hidden_0"]["kernel"].at[:M].set(0)
    gradient = jax.grad(lambda x: agent.reward(params, x).sum())(FEATURES)
    assert (np.abs(gradient).max(-1) > 0).all()
    into = jax.grad(
        lambda stored: agent.reward(
            params | {"reward": params["reward"] | {"stored": stored}}, FEATURES
        ).sum(),
        allow_int=True,
    )(params["reward"]["stored"])
    assert optax.tree.norm(into["params"]) == 0


def test_targets_with_two_three_and_four_sources_are_one_population(folder):
    tasks = ("hopper", "walker2d", "ant", "halfcheetah")
    spec = meta_spec(folder, *tasks, reward_counts=(2, 3, 4))
    agent, _, state, report = targets_of(spec)
    assert [m.label for m in spec.members] == ["sources=2", "sources=3", "sources=4"]
    assert_array_equal(state.params["reward"]["stored"]["present"].sum(1), [2, 3, 4])
    mapped = jax.jit(jax.vmap(agent.reward))(state.params, np.stack([FEATURES] * 3))
    for p, count in enumerate((2, 3, 4)):
        alone = meta_spec(folder, *tasks[:count])
        one, _, single, _ = targets_of(alone)
        assert_allclose(
            one.reward(member(single.params, 0), FEATURES), mapped[p], rtol=1e-5, atol=1e-6
        )
    moved, _ = jax.jit(jax.vmap(agent.update))(state, batch_for(agent, 3))
    assert moved.healthy.all()
    by_leaf = {record["leaf"]: record for record in report.records()}
    assert by_leaf["reward/stored/params/out/kernel"]["operation"] == "copy"
    assert by_leaf["reward/stored/params/out/kernel"]["frozen"]
    assert by_leaf["reward/stored/present"]["norm_after"] == pytest.approx(np.sqrt([2, 3, 4]))


def test_a_meta_model_of_the_value_reads_stored_values(folder):
    agent, sources, state, _ = targets_of(meta_spec(folder, "hopper", "ant", meta=("value",)))
    params = member(state.params, 0)
    assert "stored" not in params["reward"]
    assert agent.heads["reward"] == usual(agent, "reward")
    # A meta-model that only adds up what it reads of the first stored model.
    kernel = np.zeros_like(params["value"]["hidden_0"]["kernel"])
    kernel[M, 0], kernel[M, 1] = 1, -1
    out = np.zeros_like(params["value"]["out"]["kernel"])
    out[0], out[1] = 1, -1
    params["value"]["hidden_0"]["kernel"] = kernel
    params["value"]["out"]["kernel"] = out
    stored = usual(agent, "value").apply({"params": sources.stored[0].params["value"]}, FEATURES)
    x = stored[..., 0]
    expected = jax.nn.elu(x) - jax.nn.elu(-x)
    assert_allclose(agent.value(params, FEATURES), expected, rtol=1e-5, atol=1e-6)


def test_a_meta_model_of_the_dynamics_reads_the_next_states_that_stored_ones_predict(folder):
    spec = meta_spec(folder, "hopper", "walker2d", meta=("dynamics",), dynamics="copied")
    agent, sources, state, _ = targets_of(spec)
    params = member(state.params, 0)["dynamics"]
    plain = dataclasses.replace(agent, modules=()).dynamics
    sizes = CONFIG.network
    latent = rssm.LatentState(
        *(
            random.normal(size=(3, size)).astype(np.float32)
            for size in (sizes.stochastic_size,) * 3
        ),
        random.normal(size=(3, sizes.deterministic_size)).astype(np.float32),
    )
    action = random.uniform(-1, 1, (3, 1)).astype(np.float32)
    noise = np.zeros((3, sizes.stochastic_size), np.float32)

    def step(module, params, action):
        return module.apply({"params": params}, latent, action, noise, method="img_step")

    # Stored models learned 3 and 6 actions, the pendulum has 1: the others are zero.
    means = [
        step(dataclasses.replace(plain, action_size=size), source.params["dynamics"],
             np.pad(action, ((0, 0), (0, size - 1)))).mean
        for source, size in zip(sources.stored, (3, 6), strict=True)
    ]  # fmt: skip
    means = np.concatenate([*means, np.zeros((3, 2 * sizes.stochastic_size))], -1)
    # The predictions enter as further inputs of the kernel on state and action.
    wider = dict(params, stoch_in=dict(params["stoch_in"]))
    shift = means @ params["stored_in"]["kernel"]
    for row in range(3):
        wider["stoch_in"]["bias"] = params["stoch_in"]["bias"] + shift[row]
        expected = step(plain, {k: v for k, v in wider.items() if "stored" not in k}, action)
        found = step(agent.dynamics, params, action)
        assert_allclose(found.mean[row], expected.mean[row], rtol=1e-4, atol=1e-5)
    moved, _ = jax.jit(agent.update)(member(state, 0), batch_for(agent))
    assert bits(moved.params["dynamics"]["stored"]) == bits(params["stored"])
    assert bits(moved.params["dynamics"]["stored_in"]) != bits(params["stored_in"])


# --- switching --------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def switching(folder):
    """A switching agent whose classifier knows features about 3 as task 0, about -3 as task 1."""
    spec = meta_spec(
        folder, "hopper", "ant", suffix="_frozen", dynamics="frozen", switching=True, threshold=1.0
    )
    agent, sources = make_agent(spec), load_sources(spec)
    params = jax.jit(agent.init_params)(jax.random.key(0))
    plain = transferred_members(dataclasses.replace(spec, switching=False, threshold=None), sources)
    params["reward"]["stored"] = member(plain[0].params, 0)["reward"]["stored"]
    means = np.repeat([3.0, -3.0], 100)[:, None]
    latents = means + 0.01 * random.normal(size=(200, M))
    model = fit(latents, np.repeat([0, 1], 100))
    params["reward"]["classifier"] = {
        "latents": model.latents,
        "labels": model.labels,
        "threshold": suggest_threshold(model),
    }
    return agent, sources, params


def states_at(*centres):
    return np.stack([np.full(M, c) + 0.01 * random.normal(size=M) for c in centres]).astype("f4")


def test_a_switching_agent_uses_the_stored_model_of_a_known_task_and_else_the_meta_model(switching):
    agent, sources, params = switching
    features = states_at(3, -3, 0, 3, 40)
    found = agent.reward(params, features)
    plain = usual(agent, "reward")
    stored = [
        plain.apply({"params": source.params["reward"]}, features)[..., 0]
        for source in sources.stored
    ]
    ignorant = params | {"reward": params["reward"] | {"classifier": {
        **params["reward"]["classifier"], "threshold": jnp.float32(-1)}}}  # fmt: skip
    meta = agent.reward(ignorant, features)
    expected = [stored[0][0], stored[1][1], meta[2], stored[0][3], meta[4]]
    assert_allclose(found, expected, rtol=1e-5, atol=1e-6)
    assert len({round(float(x), 5) for x in (stored[0][0], stored[1][0], meta[0])}) == 3


def test_a_switching_agents_meta_model_learns_from_novel_states_only(switching):
    agent, _, params = switching

    def gradient(centre):
        own = {part: params["reward"][part] for part in ("hidden_0", "out")}
        reward = lambda own: agent.reward(  # noqa: E731
            params | {"reward": params["reward"] | own}, states_at(centre, centre)
        ).sum()
        return optax.tree.norm(jax.grad(reward)(own))

    assert gradient(3) == 0
    assert gradient(0) > 0


def test_a_switching_agent_recognises_tasks_while_it_runs(switching):
    """Along a batch, each posterior state is judged by itself, in one jitted update."""
    from experiments.meta_modules import recognise

    agent, _, params = switching
    batch = batch_for(agent)
    posterior, _, _ = agent.observe(params, batch, jax.random.key(0))
    flat = posterior.features.reshape(-1, M)
    # The first half of the batch's states become known; distances of the others stay positive.
    classifier = params["reward"]["classifier"]
    known = classifier["latents"].at[:5].set(flat[:5])
    classifier = classifier | {"latents": known, "threshold": jnp.float32(1e-4)}
    labels = recognise(classifier, posterior.features)
    assert labels.shape == posterior.features.shape[:-1]
    # One sample of a task is not among five neighbours by majority, but the nearest is within ξ.
    assert (labels.reshape(-1)[:5] != NOVEL).all()
    assert (labels.reshape(-1)[5:] == NOVEL).all()
    params = params | {"reward": params["reward"] | {"classifier": classifier}}
    state, metrics = jax.jit(agent.update)(agent.start(params, 0), batch)
    assert state.healthy
    assert bits(state.params["reward"]["classifier"]) == bits(classifier)
    assert bits(state.params["reward"]["out"]) != bits(params["reward"]["out"])


# --- what is refused --------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"method": "uae"}, "add --source DIR"),
        ({"method": "uae", "source": "x", "omegas": (0.2,)}, "--omega belongs to --method frac"),
        ({"method": "uae", "source": "x", "baseline": True}, "--baseline belongs to --method frac"),
        ({"source": "x", "omegas": (0.2,), "dynamics": "frozen"}, "--dynamics belongs to .*uae or"),
        ({"source": "x", "omegas": (0.2,), "fractions": ("rewards",)}, "no fraction for 'rewards'"),
        ({"method": "meta", "source": "x"}, "add --reward-sources DIR DIR"),
        ({"method": "meta", "source": "x", "reward_sources": ("a", "b"), "reward_counts": (3,)},
         r"must lie in \[1, 2\]"),
        ({"method": "meta", "source": "x", "reward_sources": ("a",), "meta": ("actor",)},
         "no meta-model for .'actor'."),
        ({"method": "meta", "source": "x", "reward_sources": ("a",), "switching": True},
         "add --dynamics frozen"),
        ({"method": "meta", "source": "x", "reward_sources": ("a",), "threshold": 3.0},
         "--threshold is that of --switching"),
    ],
)  # fmt: skip
def test_settings_that_do_not_go_together_are_refused_with_a_way_out(settings, message):
    with pytest.raises(ValueError, match=message):
        spec_of("hopper", **settings)


def test_an_agent_that_was_not_trained_on_the_frozen_encoder_is_refused(folder):
    with pytest.raises(ValueError, match="other was not trained on the frozen encoder of .*uae"):
        load_sources(meta_spec(folder, "hopper", "other"))


def test_stored_models_of_other_dynamics_are_refused_where_the_dynamics_are_frozen(folder):
    with pytest.raises(ValueError, match="frozen dynamics of .*--dynamics frozen"):
        load_sources(meta_spec(folder, "hopper", dynamics="frozen"))


def test_sources_of_other_sizes_are_refused_naming_both(folder):
    network = dataclasses.replace(CONFIG.network, head_units=9)
    config = dataclasses.replace(CONFIG, network=network)
    with pytest.raises(ValueError, match="head_units: 8 in the source, 9 here"):
        load_sources(spec_of("ant", config=config, source=folder / "uae", method="uae"))


def test_a_meta_model_is_not_stored_in_another(folder, tmp_path):
    write_run(tmp_path / "meta", meta_spec(folder, "hopper"))
    spec = meta_spec(folder, "hopper", reward_counts=())
    spec = dataclasses.replace(spec, reward_sources=(str(tmp_path / "meta"),))
    with pytest.raises(ValueError, match="the reward of .*meta is a meta-model itself"):
        load_sources(spec)


def test_a_spec_says_all_of_a_method_after_json(folder):
    import json

    spec = meta_spec(folder, "hopper", "ant", reward_counts=(1, 2), meta=("reward", "value"))
    assert type(spec).from_dict(json.loads(json.dumps(spec.to_dict()))) == spec
    assert make_agent(spec) == make_agent(dataclasses.replace(spec, seeds=(9,)))
    assert "meta-model of reward, value, fresh dynamics" in str(plan(spec))
