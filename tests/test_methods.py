"""The thesis's methods, and what lies beyond them, on whole agents."""

import dataclasses
import functools
import json

import jax
import numpy as np
import optax
import pytest
from numpy.testing import assert_allclose, assert_array_equal

import transfer
from compilation import QUICK_CODE
from dreamer_jax import rssm
from dreamer_jax.networks import Head
from experiments.methods.meta import MetaModel
from experiments.methods.modules.meta import recognise
from experiments.runs.agents import make_agent
from experiments.runs.latents import infer
from experiments.runs.start import load_sources, transferred_members
from runs import CONFIG, batch_for, random_params, spec_of, write_run
from transfer.ltc import NOVEL
from transfer_trees import bits

M = CONFIG.network.feature_size
random = np.random.default_rng(0)
FEATURES = random.normal(size=(3, 7, M)).astype(np.float32)


@functools.partial(jax.jit, static_argnums=0)
def apply(module, params, *inputs):
    return module.apply({"params": params}, *inputs)


@functools.partial(jax.jit, static_argnums=0)
def reward_of(agent, params, features):
    return agent.reward(params, features)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """An autoencoder, four agents on it with dynamics of their own, and two on its dynamics."""
    folder = tmp_path_factory.mktemp("sources")
    write_run(folder / "uae", spec_of("hopper", "ant"))
    write_run(folder / "other", spec_of("hopper"), seed=9)
    on = {"sources": [folder / "uae"], "method": "uae"}
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
        sources=(folder / "uae",),
        method="meta",
        reward_sources=names(folder, *tasks, suffix=suffix),
        **settings,
    )


def stored_models(spec, sources, action_size):
    """What the members' meta-models hold."""
    counts = [member.tags["sources"] for member in spec.members]
    return spec.method.stored_models(sources.stored, counts, action_size=action_size)


def meta_agent(spec):
    """Agent, sources, and parameters that hold the sources' models, of a run's first member."""
    agent, sources = make_agent(spec), load_sources(spec)
    params = random_params(agent)
    stored = stored_models(spec, sources, action_size=agent.action_size)
    for name in spec.method.meta:
        params[name] |= member(stored[name], 0)
    return agent, sources, params


def member(tree, p):
    return jax.tree.map(lambda x: x[p], tree)


def predictions(agent, sources, name="reward"):
    """What each source's own model predicts from FEATURES, float32 [N, ...]."""
    plain = usual(agent, name)
    return [apply(plain, source.params[name], FEATURES)[..., 0] for source in sources.stored]


def usual(agent, name):
    """The module that an agent without meta-models has."""
    return dataclasses.replace(agent, modules=()).heads[name]


def test_fractions_of_any_components_last_layer_are_a_setting_of_a_run():
    spec = spec_of("hopper", sources=("x",), omegas=(0.2,), fractions=("value", "dynamics"))
    tree = jax.eval_shape(make_agent(spec).init_params, jax.random.key(0))
    claims = transfer.claims(spec.method.plan(), tree)
    mixed = {path for path, rule in claims.items() if rule.operation == "fraction"}
    layers = ("dynamics/posterior/out", "dynamics/prior/out", "value/out")
    assert mixed == {f"{layer}/{leaf}" for layer in layers for leaf in ("bias", "kernel")}
    assert claims["reward/out/kernel"].operation == "keep"


def test_a_plan_that_freezes_one_leaf_freezes_that_leaf_alone(monkeypatch):
    leaf = "dynamics/prior/out/kernel"
    rules = (transfer.Rule(leaf, "copy", frozen=True), transfer.Rule(("**", f"!{leaf}"), "keep"))
    spec = spec_of("hopper", sources=("x",), omegas=(0.2,))
    chosen = transfer.Plan(name="one leaf", rules=rules)
    monkeypatch.setattr(type(spec.method), "plan", lambda self: chosen)
    agent = make_agent.__wrapped__(spec)
    params = random_params(agent)
    groups = agent.trainable(params).values()
    trained = {path for parts in groups for path in transfer.flatten(parts)}
    # As transfer's own freezing divides them.
    still, trains = transfer.partition(params, leaf)
    assert set(transfer.flatten(still)) == {leaf}
    assert trained == set(transfer.flatten(trains))


@pytest.fixture(scope="module")
def two_sources(tmp_path_factory):
    """Agents for other numbers of tasks, and of other action sizes."""
    folder = tmp_path_factory.mktemp("two")
    write_run(folder / "first", spec_of("hopper", "ant"), seed=1)
    write_run(folder / "second", spec_of("halfcheetah"), seed=2)
    return folder / "first", folder / "second"


def test_targets_of_several_sources_are_one_population_each_with_its_own(two_sources):
    spec = spec_of("hopper", sources=two_sources, omegas=(0.0, 0.5), seeds=(3, 4), baseline=True)
    labels = [member.label for member in spec.members]
    assert labels[::2] == [
        "omega=0 from first", "omega=0.5 from first", "omega=0 from second",
        "omega=0.5 from second", "baseline",
    ]  # fmt: skip
    assert spec.members[4].tags == {"omega": 0.0, "source": "second"}
    sources = load_sources(spec)
    params = transferred_members(spec, sources)[0].params
    fresh = {seed: member(params, 8 + place) for place, seed in enumerate(spec.seeds)}
    for p, tagged in enumerate(spec.members[:8]):
        given, target = sources.agents[p // 4].params, member(params, p)
        assert bits(target["encoder"]) == bits(given["encoder"])
        assert bits(target["dynamics"]["action_in"]) == bits(
            fresh[tagged.seed]["dynamics"]["action_in"]
        )
        mixed = (
            fresh[tagged.seed]["value"]["out"]["kernel"]
            + tagged.tags["omega"] * (given["value"]["out"]["kernel"])
        )
        assert_allclose(target["value"]["out"]["kernel"], mixed, rtol=1e-6)


def test_sources_whose_shapes_differ_in_what_is_read_are_refused_naming_both(two_sources):
    spec = spec_of("hopper", sources=two_sources, omegas=(0.2,), fractions=("actor",))
    with pytest.raises(ValueError, match=r"actor/out/.* in the source .*first and .* in .*second"):
        transferred_members(spec, load_sources(spec))


def test_relative_sources_are_found_from_the_base_folder(two_sources):
    spec = spec_of("hopper", sources=("first", "second"), omegas=(0.2,))
    base = two_sources[0].parent
    assert [source.directory for source in load_sources(spec, base).agents] == list(two_sources)


# --- the universal autoencoder ----------------------------------------------------------------


@pytest.mark.parametrize("dynamics", ["fresh", "copied", "frozen"])
def test_targets_start_from_the_sources_autoencoder(folder, dynamics):
    spec = spec_of(
        "hopper", sources=(folder / "uae",), method="uae", dynamics=dynamics, seeds=(3, 4)
    )
    agent, sources = make_agent(spec), load_sources(spec)
    state, report = transferred_members(spec, sources)
    given = sources.agents[0].params
    for p in range(2):
        params = member(state.params, p)
        assert bits(params["encoder"]) == bits(given["encoder"])
        assert bits(params["decoder"]) == bits(given["decoder"])
        same = bits(params["dynamics"]["gru"]) == bits(given["dynamics"]["gru"])
        assert same == (dynamics != "fresh")
        assert params["dynamics"]["action_in"]["kernel"].shape[0] == 3
        assert bits(params["reward"]) != bits(given["reward"])
    frozen = {row.leaf.split("/")[0] for row in report.rows if row.frozen}
    assert frozen == ({"encoder", "dynamics"} if dynamics == "frozen" else {"encoder"})
    trained = agent.trainable(member(state.params, 0))["model"]
    assert "encoder" not in trained and "decoder" in trained
    assert set(trained["dynamics"]) >= {"action_in"}
    assert ("gru" in trained["dynamics"]) == (dynamics != "frozen")


# --- meta-models ------------------------------------------------------------------------------


@pytest.mark.parametrize("count", [2, 3, 4])
def test_a_meta_model_reads_the_features_and_what_each_stored_model_predicts(folder, count):
    spec = meta_spec(folder, *("hopper", "walker2d", "ant", "halfcheetah")[:count])
    agent, sources, params = meta_agent(spec)
    read = np.zeros((*FEATURES.shape[:-1], M + 4), np.float32)
    read[..., :M] = FEATURES
    read[..., M : M + count] = np.stack(predictions(agent, sources), -1)
    own = {part: params["reward"][part] for part in ("hidden_0", "out")}
    expected = apply(Head(1, 1, CONFIG.network.head_units), own, read)[..., 0]
    assert_allclose(reward_of(agent, params, FEATURES), expected, rtol=1e-5, atol=1e-6)
    # Agents with two, three and four sources are one, so they train as one population.
    assert agent == make_agent(meta_spec(folder, "hopper", "ant"))


def test_targets_with_two_three_and_four_sources_are_one_population(folder):
    tasks = ("hopper", "walker2d", "ant", "halfcheetah")
    spec = meta_spec(folder, *tasks, reward_counts=(2, 3, 4), seeds=(0, 1))
    assert [m.label for m in spec.members[::2]] == ["sources=2", "sources=3", "sources=4"]
    sources = load_sources(spec)
    stored = stored_models(spec, sources, action_size=1)["reward"]["stored"]
    assert_array_equal(stored["present"].sum(1), [2, 2, 3, 3, 4, 4])
    for p, tagged in enumerate(spec.members):
        for place, source in enumerate(sources.stored[: tagged.tags["sources"]]):
            assert bits(member(member(stored["params"], p), place)) == bits(source.params["reward"])


def test_exactly_what_is_frozen_does_not_move_by_a_bit_in_a_thousand_updates(folder, monkeypatch):
    # Small batches, for there are many.
    sizes = {"batch_size": 1, "sequence_length": 2, "horizon": 2}
    config = dataclasses.replace(CONFIG, learning=dataclasses.replace(CONFIG.learning, **sizes))
    spec = meta_spec(
        folder, "hopper", "ant", suffix="_frozen", dynamics="frozen", meta=("reward", "value"),
        switching=True, config=config,
    )  # fmt: skip
    monkeypatch.setattr(MetaModel, "known_tasks", lambda *_: classifier_of(0.5))
    agent, sources = make_agent(spec), load_sources(spec)
    state, report = transferred_members(spec, sources)
    start, batch = jax.device_get(member(state, 0)), batch_for(agent)

    @functools.partial(jax.jit, compiler_options=QUICK_CODE)
    def train(state):
        return jax.lax.fori_loop(0, 1000, lambda _, state: agent.update(state, batch)[0], state)

    end = jax.device_get(train(start))
    assert end.updates == 1000 and end.healthy
    before, after = bits(start.params), bits(end.params)
    still = {path for path in before if after[path] == before[path]}
    claims = transfer.claims(spec.method.plan(), start.params)
    assert still == {path for path, rule in claims.items() if rule.frozen}
    assert {"encoder/conv_0/kernel", "dynamics/gru/kernel", "reward/classifier/latents"} < still
    assert {row.leaf for row in report.rows if row.frozen} == still
    for place, source in enumerate(sources.stored):
        for name in ("reward", "value"):
            stored = member(end.params[name]["stored"]["params"], place)
            assert bits(stored) == bits(source.params[name])


def test_the_gradient_passes_through_stored_models_into_the_features_not_into_them(folder):
    agent, _, params = meta_agent(meta_spec(folder, "hopper", "walker2d"))
    # Only what stored models predict reaches this meta-model.
    params["reward"]["hidden_0"]["kernel"][:M] = 0

    def total(stored, features):
        reward = params["reward"] | {"stored": stored}
        return agent.reward(params | {"reward": reward}, features).sum()

    gradients = jax.jit(jax.grad(total, argnums=(0, 1), allow_int=True))
    into_stored, into_features = gradients(params["reward"]["stored"], FEATURES)
    assert (np.abs(into_features).max(-1) > 0).all()
    assert optax.tree.norm(into_stored["params"]) == 0
    assert "stored" not in agent.trainable(params)["model"]["reward"]


def test_a_meta_model_of_the_value_reads_stored_values(folder):
    agent, sources, params = meta_agent(meta_spec(folder, "hopper", "ant", meta=("value",)))
    assert "stored" not in params["reward"]
    assert agent.heads["reward"] == usual(agent, "reward")
    # A meta-model of two units that reads the second stored model alone.
    value = jax.tree.map(np.zeros_like, {k: params["value"][k] for k in ("hidden_0", "out")})
    value["hidden_0"]["kernel"][M + 1, :2] = 1, -1
    value["out"]["kernel"][:2, 0] = 1, -1
    params["value"] |= value
    x = predictions(agent, sources, "value")[1]
    expected = jax.nn.elu(x) - jax.nn.elu(-x)
    assert_allclose(agent.value(params, FEATURES), expected, rtol=1e-5, atol=1e-6)
    assert "stored" not in agent.trainable(params)["value"]["value"]


def test_a_meta_model_of_the_dynamics_reads_the_next_states_that_stored_ones_predict(folder):
    spec = meta_spec(folder, "hopper", "walker2d", meta=("dynamics",), dynamics="copied")
    agent, sources, whole = meta_agent(spec)
    params = whole["dynamics"]
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

    @functools.partial(jax.jit, static_argnums=0)
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
    trained = agent.trainable(whole)["model"]["dynamics"]
    assert "stored" not in trained and "stored_in" in trained


# --- switching --------------------------------------------------------------------------------


def classifier_of(threshold):
    """One that knows features about 3 as task 0 and about -3 as task 1."""
    means = np.repeat([3.0, -3.0], 100)[:, None]
    return {
        "latents": (means + 0.01 * random.normal(size=(200, M))).astype(np.float32),
        "labels": np.repeat([0, 1], 100).astype(np.int32),
        "threshold": np.float32(threshold),
    }


@pytest.fixture(scope="module")
def switching(folder):
    spec = meta_spec(
        folder, "hopper", "ant", suffix="_frozen", dynamics="frozen", switching=True, threshold=1.0
    )
    agent, sources, params = meta_agent(spec)
    params["reward"]["classifier"] = classifier_of(1.0)
    return agent, sources, params


def states_at(*centres):
    return np.stack([np.full(M, c) + 0.01 * random.normal(size=M) for c in centres]).astype("f4")


def with_classifier(params, **changes):
    classifier = params["reward"]["classifier"] | changes
    return params | {"reward": params["reward"] | {"classifier": classifier}}


def test_a_switching_agent_uses_the_stored_model_of_a_known_task_and_else_the_meta_model(switching):
    agent, sources, params = switching
    features = states_at(3, -3, 0, 3, 40)
    found = reward_of(agent, params, features)
    plain = usual(agent, "reward")
    first, second = (
        apply(plain, source.params["reward"], features)[..., 0] for source in sources.stored
    )
    # To this one every task is novel.
    meta = reward_of(agent, with_classifier(params, threshold=np.float32(-1)), features)
    expected = [first[0], second[1], meta[2], first[3], meta[4]]
    assert_allclose(found, expected, rtol=1e-5, atol=1e-6)
    assert len({round(float(x), 5) for x in (first[0], second[0], meta[0])}) == 3


def test_a_switching_agents_meta_model_learns_from_novel_states_only(switching):
    agent, _, params = switching
    own = {part: params["reward"][part] for part in ("hidden_0", "out")}

    @jax.jit
    @jax.grad
    def gradient(own, features):
        return agent.reward(params | {"reward": params["reward"] | own}, features).sum()

    assert optax.tree.norm(gradient(own, states_at(3, -3))) == 0
    assert optax.tree.norm(gradient(own, states_at(3, 0))) > 0


def test_a_switching_agent_recognises_the_states_that_it_infers_as_it_runs(switching):
    agent, _, params = switching
    posterior, _, _ = jax.jit(agent.observe)(params, batch_for(agent), jax.random.key(0))
    flat = np.asarray(posterior.features).reshape(-1, M)
    # Three states of the batch become five samples each of task 1.
    latents = params["reward"]["classifier"]["latents"].copy()
    latents[100:115] = np.repeat(flat[:3], 5, axis=0)
    params = with_classifier(params, latents=latents, threshold=np.float32(1e-3))
    labels = recognise(params["reward"]["classifier"], posterior.features)
    assert labels.shape == posterior.features.shape[:-1]
    assert_array_equal(labels.reshape(-1), [1] * 3 + [NOVEL] * (len(flat) - 3))


# --- the latent states that are classified ---------------------------------------------------


def test_latent_states_are_samples_along_episodes_or_their_means_or_of_single_images(folder):
    source = load_sources(spec_of("ant", sources=(folder / "uae",), method="uae")).agents[0]
    agent, size = make_agent(source.spec), CONFIG.network.stochastic_size
    batch = batch_for(agent)
    records = batch.at(0)._replace(first=np.arange(5) == 0)
    found = {
        (kind, seed): np.asarray(
            infer(agent, source.params, records, jax.random.key(seed), features=kind)
        )
        for kind in ("sample", "mean", "first")
        for seed in (0, 1)
    }
    alone = records.at(None)
    posterior, _, _ = jax.jit(agent.observe)(source.params, alone, jax.random.key(0))
    assert_allclose(found["sample", 0], posterior.features[0], rtol=1e-5, atol=1e-6)
    assert_allclose(found["mean", 0][:, :size], posterior.mean[0], rtol=1e-5, atol=1e-6)
    assert (found["sample", 0][0, :size] != found["sample", 1][0, :size]).all()
    assert_array_equal(found["mean", 0][0], found["mean", 1][0])
    # Without a past, the recurrent state is one and the same for all images.
    assert_array_equal(found["first", 0][:, size:], found["first", 0][:1, size:].repeat(5, 0))
    assert (found["sample", 0][1:, size:] != found["sample", 0][:1, size:]).any(1).all()


# --- what is refused --------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"method": "uae"}, "add --source DIR"),
        ({"method": "uae", "sources": ("x",), "omegas": (0.2,)},
         "--omega belongs to --method frac"),
        ({"method": "uae", "sources": ("x",), "baseline": True},
         "--baseline belongs to --method .*frac"),
        ({"method": "uae", "sources": ("x", "y")}, "add --source DIR, one only"),
        ({"method": "frozen-source", "sources": ("x",), "baseline": True},
         "leave out --baseline, and train them in a run of their own"),
        ({"sources": ("x", "x"), "omegas": (0.2,)}, "a source is named twice"),
        ({"sources": ("x",), "omegas": (0.2,), "dynamics": "frozen"},
         "--dynamics belongs to .*uae or"),
        ({"sources": ("x",), "omegas": (0.2,), "fractions": ("rewards",)},
         "no fraction for 'rewards'"),
        ({"method": "meta", "sources": ("x",)}, "add --reward-sources DIR DIR"),
        ({"method": "meta", "sources": ("x",), "reward_sources": ("a", "b"), "reward_counts": (3,)},
         r"must lie in \[1, 2\]"),
        ({"method": "meta", "sources": ("x",), "reward_sources": ("a",), "meta": ("actor",)},
         "no meta-model for .'actor'."),
        ({"method": "meta", "sources": ("x",), "reward_sources": ("a",), "switching": True},
         "add --dynamics frozen"),
        ({"method": "meta", "sources": ("x",), "reward_sources": ("a",), "threshold": 3.0},
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
        load_sources(spec_of("ant", config=config, sources=(folder / "uae",), method="uae"))


def test_a_meta_model_is_not_stored_in_another(folder, tmp_path):
    write_run(tmp_path / "meta", meta_spec(folder, "hopper"))
    spec = meta_spec(folder, "hopper")
    method = dataclasses.replace(spec.method, reward_sources=(str(tmp_path / "meta"),))
    spec = dataclasses.replace(spec, method=method)
    with pytest.raises(ValueError, match="the reward of .*meta is a meta-model itself"):
        load_sources(spec)


def test_a_spec_says_all_of_a_method_after_json(folder):
    spec = meta_spec(folder, "hopper", "ant", reward_counts=(1, 2), meta=("reward", "value"))
    assert type(spec).from_dict(json.loads(json.dumps(spec.to_dict()))) == spec
    assert make_agent(spec) == make_agent(dataclasses.replace(spec, seeds=(9,)))
    assert "meta-model of reward, value, fresh dynamics" in str(spec.method.plan())


def test_latent_states_that_are_not_finite_are_novel_and_counted():
    from experiments.runs.classify import distance_table, judge, to_dict
    from experiments.runs.latents import Latents

    random = np.random.default_rng(0)
    episodes = np.arange(20) // 4
    half = lambda offset: Latents(random.normal(offset, 0.1, (20, 3)), episodes)  # noqa: E731
    tasks = ("bullet/ant", "bullet/hopper")
    drawn = {task: (half(9 * i), half(9 * i)) for i, task in enumerate(tasks)}
    drawn["bullet/ant"][1].features[:5] = np.nan
    outcome = judge(tasks, tasks, drawn, thresholds=(3.0,))
    assert outcome.accuracies[0]["bullet/ant"].not_novel == 0.75
    assert outcome.votes["bullet/ant"] == {"bullet/ant": 15}
    assert to_dict(outcome)["accuracies"][0]["not_finite"] == 0.25
    assert "not finite 5" in distance_table(outcome)
