"""The thesis's recipes on the trees of real agents."""

import ast
import dataclasses
import functools
from collections import Counter
from pathlib import Path

import jax
import numpy as np
import optax
import pytest

import transfer
from dreamer_jax import config
from dreamer_jax.agent import Agent
from experiments.methods.modules.meta import meta_dynamics, meta_head
from transfer import recipes
from transfer_trees import bits

AGENTS = {
    "continuous": {},
    "discrete": {"discrete": True},
    "with termination": {"termination": True},
    "discrete with termination": {"discrete": True, "termination": True},
    "32 pixels": {"image_size": 32},
}


def agent_tree(**settings):
    """The shapes of a real agent's parameters, with meta-models of the components in `meta`."""
    return jax.tree.map(lambda x: x, _shapes(**settings))


@functools.cache
def _shapes(preset="debug", action_size=3, discrete=False, meta=(), samples=0, **network):
    chosen = config.preset(preset)
    chosen = dataclasses.replace(
        chosen, network=dataclasses.replace(chosen.network, **{"image_size": 64} | network)
    )
    agent = Agent(chosen, action_size, discrete)
    modules = {
        name: meta_dynamics(agent.dynamics, places=4)
        if name == "dynamics"
        else meta_head(agent.heads[name], layers=1, places=4, samples=samples)
        for name in meta
    }
    agent = dataclasses.replace(agent, modules=tuple(modules.items()))
    return jax.eval_shape(agent.init_params, jax.random.key(0))


def filled(tree, seed):
    """Random values, multiples of 1/8, of the shapes of a tree."""
    random = np.random.default_rng(seed)
    draw = lambda x: (random.integers(-32, 32, x.shape) / 8).astype(x.dtype)  # noqa: E731
    return jax.tree.map(draw, tree)


def operations(plan, tree):
    """How many leaves of each component each operation claims."""
    return Counter(
        (path.split("/")[0], rule.operation) for path, rule in transfer.claims(plan, tree).items()
    )


@pytest.mark.parametrize("preset", ["thesis", "debug"])
@pytest.mark.parametrize("name", AGENTS)
def test_fractional_transfer_treats_each_component_as_figure_8_says(preset, name):
    tree = agent_tree(preset=preset, **AGENTS[name])
    layers = 3 if name == "32 pixels" else 4
    expected = {
        ("encoder", "copy"): 2 * layers,
        ("decoder", "copy"): 2 + 2 * layers,
        # stoch_in 2, gru 3, prior 4, posterior 4; and the kernel of the action.
        ("dynamics", "copy"): 13,
        ("dynamics", "keep"): 1,
        ("reward", "copy"): 4,
        ("reward", "fraction"): 2,
        ("value", "copy"): 6,
        ("value", "fraction"): 2,
        ("actor", "copy"): 8,
        ("actor", "keep"): 2,
    }
    if "termination" in name:
        expected |= {("termination", "copy"): 6, ("termination", "fraction"): 2}
    assert operations(recipes.fractional_transfer(), tree) == expected
    assert sum(expected.values()) == len(transfer.paths(tree))


@pytest.mark.parametrize("name", AGENTS)
@pytest.mark.parametrize("dynamics", ["fresh", "copied", "frozen"])
def test_the_universal_autoencoder_freezes_the_encoder_and_the_dynamics_where_asked(name, dynamics):
    tree = agent_tree(**AGENTS[name])
    plan = recipes.universal_autoencoder(dynamics)
    layers = 3 if name == "32 pixels" else 4
    found = operations(plan, tree)
    assert found["encoder", "copy"] == 2 * layers
    assert found["decoder", "copy"] == 2 + 2 * layers
    assert found["dynamics", "copy"] == (0 if dynamics == "fresh" else 13)
    assert found["dynamics", "keep"] == (14 if dynamics == "fresh" else 1)
    for head in set(tree) - {"encoder", "decoder", "dynamics"}:
        assert found[head, "copy"] == 0
    frozen = transfer.flatten(jax.tree.map(np.asarray, transfer.frozen(plan, tree)))
    counts = Counter(path.split("/")[0] for path, flag in frozen.items() if flag)
    assert counts == {"encoder": 2 * layers} | ({"dynamics": 13} if dynamics == "frozen" else {})


@pytest.mark.parametrize("name", AGENTS)
@pytest.mark.parametrize("dynamics", ["fresh", "copied", "frozen"])
def test_a_meta_model_of_the_reward_holds_stored_models_and_all_else_is_as_before(name, dynamics):
    tree = agent_tree(meta=("reward",), **AGENTS[name])
    plan = recipes.meta_model(dynamics)
    found = operations(plan, tree)
    # Of each stored model two hidden layers and an output, and who is present; of its own one
    # hidden layer and an output.
    assert found["reward", "copy"] == 3 * 2 + 1
    assert found["reward", "keep"] == 2 * 2
    usual = operations(recipes.universal_autoencoder(dynamics), agent_tree(**AGENTS[name]))
    for component in set(tree) - {"reward"}:
        for operation in ("copy", "keep"):
            assert found[component, operation] == usual[component, operation]
    assert sum(found.values()) == len(transfer.paths(tree))
    frozen = Counter(
        path.split("/")[0] for path, rule in transfer.claims(plan, tree).items() if rule.frozen
    )
    layers = 3 if name == "32 pixels" else 4
    expected = {"encoder": 2 * layers, "reward": 7}
    assert frozen == expected | ({"dynamics": 13} if dynamics == "frozen" else {})


@pytest.mark.parametrize("dynamics", ["fresh", "frozen"])
def test_meta_models_of_all_components_and_a_classifier(dynamics):
    components = ("reward", "value", "dynamics")
    tree = agent_tree(meta=components, samples=8)
    # The value has a classifier too in this tree; the recipe knows one of the reward alone.
    del tree["value"]["classifier"]
    plan = recipes.meta_model(dynamics, components=components, switching=True)
    found = operations(plan, tree)
    assert found["reward", "copy"] == 3 * 2 + 1 + 3
    assert (found["value", "copy"], found["value", "keep"]) == (4 * 2 + 1, 2 * 2)
    # A stored dynamics model has 14 leaves. The kernels on actions and predictions are fresh.
    own = 0 if dynamics == "fresh" else 13
    assert found["dynamics", "copy"] == 14 + 1 + own
    assert found["dynamics", "keep"] == 15 - own
    for path, rule in transfer.claims(plan, tree).items():
        held = "/stored/" in path or "/classifier/" in path
        assert (rule.source == "stored") == held
        if held:
            assert rule.frozen


def test_every_rule_claims_leaves_of_an_agent_with_all_heads():
    tree = agent_tree(termination=True)
    for plan in (
        recipes.fractional_transfer(),
        recipes.fractional_transfer(fractions=["dynamics", "actor", "value"]),
        *map(recipes.universal_autoencoder, ("fresh", "copied", "frozen")),
    ):
        claimed = {id(rule) for rule in transfer.claims(plan, tree).values()}
        assert claimed == {id(rule) for rule in plan.rules}


def test_fractional_transfer_between_action_sizes_gives_each_leaf_what_the_thesis_says():
    target, source = filled(agent_tree(action_size=3), 0), filled(agent_tree(action_size=8), 1)
    new, report = transfer.apply(recipes.fractional_transfer(0.25), target, source)
    old, given, found = map(transfer.flatten, (target, source, new))
    fresh = {"dynamics/action_in/kernel", "actor/out/kernel", "actor/out/bias"}
    mixed = {f"{head}/out/{leaf}" for head in ("reward", "value") for leaf in ("kernel", "bias")}
    for path, leaf in found.items():
        if path in fresh:
            assert leaf is old[path]
        elif path in mixed:
            np.testing.assert_array_equal(leaf, old[path] + 0.25 * given[path])
        else:
            np.testing.assert_array_equal(leaf, given[path])
    assert {row.leaf for row in report.rows if row.operation == "fraction"} == mixed


def test_one_population_holds_targets_of_all_fractions_seeds_and_source_sets():
    targets = [filled(agent_tree(action_size=3), seed) for seed in range(4)]
    # Sources of different action sizes, alike in what the recipe reads.
    plan = recipes.fractional_transfer()
    sources = [
        transfer.source_leaves(plan, targets[0], filled(agent_tree(action_size=size), size))
        for size in (3, 6, 8, 8)
    ]
    omegas = np.array([0.0, 0.1, 0.2, 0.5], np.float32)
    stacked = [jax.tree.map(lambda *x: np.stack(x), *trees) for trees in (targets, sources)]
    run = jax.jit(jax.vmap(lambda t, s, w: transfer.apply(plan, t, s, omega=w)))
    mapped, report = run(*stacked, omegas)
    bound = recipes.fractional_transfer(omegas)
    at_once, _ = jax.jit(lambda t, s: transfer.apply(bound, t, s, population=True))(*stacked)
    by_itself = jax.jit(lambda t, s, w: transfer.apply(plan, t, s, omega=w)[0])
    for index, omega in enumerate(omegas.tolist()):
        alone = by_itself(targets[index], sources[index], omega)
        for path, leaf in transfer.flatten(alone).items():
            for population in (mapped, at_once):
                np.testing.assert_allclose(
                    transfer.flatten(population)[path][index], leaf, rtol=1e-6, atol=1e-6
                )
        (record,) = (r for r in report.member(index).records() if r["leaf"] == "reward/out/kernel")
        assert record["parameters"] == {"omega": pytest.approx(omega)}


def test_copying_the_actors_output_from_another_action_size_is_refused_with_a_way_out():
    target, source = agent_tree(action_size=3), agent_tree(action_size=8)
    with pytest.raises(ValueError, match=r"actor/out/bias: .*\(6,\).*\(16,\).*pad or crop.*keep"):
        transfer.copy(target, source, where="actor/out/*")
    with pytest.raises(ValueError, match="actor/out"):
        transfer.apply(recipes.fractional_transfer(0.1, fractions=["actor"]), target, source)


def test_the_actors_means_and_deviations_are_padded_apart():
    target, source = filled(agent_tree(action_size=3), 0), filled(agent_tree(action_size=2), 1)
    new = transfer.pad(target, source, axis="output", groups=2, where="actor/out/*")
    for leaf in ("kernel", "bias"):
        found, given = new["actor"]["out"][leaf], source["actor"]["out"][leaf]
        np.testing.assert_array_equal(found[..., :2], given[..., :2])
        np.testing.assert_array_equal(found[..., 3:5], given[..., 2:])
        np.testing.assert_array_equal(found[..., 2], target["actor"]["out"][leaf][..., 2])


@pytest.mark.parametrize(
    ("fractions", "mixed"),
    [
        ((), set()),
        (("dynamics",), {"dynamics/prior/out", "dynamics/posterior/out"}),
        (("actor", "reward"), {"actor/out", "reward/out"}),
    ],
)
def test_fractions_of_any_components_last_layer_are_an_option(fractions, mixed):
    tree = agent_tree(termination=True)
    plan = recipes.fractional_transfer(0.5, fractions=fractions)
    claimed = transfer.claims(plan, tree)
    found = {
        path.rsplit("/", 1)[0] for path, rule in claimed.items() if rule.operation == "fraction"
    }
    assert found == mixed
    for head in ("reward", "value", "termination", "actor"):
        if f"{head}/out" not in mixed:
            assert claimed[f"{head}/out/kernel"].operation == "keep"


def test_unknown_options_name_the_choices():
    with pytest.raises(ValueError, match="no fraction for 'rewards'; choose from reward, value"):
        recipes.fractional_transfer(fractions=["rewards"])
    with pytest.raises(ValueError, match="'fresh', 'copied' or 'frozen'; got 'new'"):
        recipes.universal_autoencoder("new")
    with pytest.raises(ValueError, match="'fresh', 'copied' or 'frozen'; got 'new'"):
        recipes.meta_model("new")
    with pytest.raises(ValueError, match=r"no meta-model for \['actor'\]; choose reward, value"):
        recipes.meta_model(components=("actor", "reward"))
    with pytest.raises(ValueError, match="needs a component"):
        recipes.meta_model(components=())
    with pytest.raises(ValueError, match="add 'reward'"):
        recipes.meta_model(components=("value",), switching=True)


@pytest.mark.parametrize("suffix", ["json", "yaml"])
def test_recipes_are_data(tmp_path, suffix):
    for plan in (
        recipes.fractional_transfer(0.2),
        recipes.universal_autoencoder("frozen"),
        recipes.meta_model(components=("reward", "dynamics"), switching=True),
    ):
        transfer.write_plan(plan, tmp_path / f"plan.{suffix}")
        assert transfer.read_plan(tmp_path / f"plan.{suffix}") == plan


def test_the_frozen_encoder_does_not_move_when_the_target_trains():
    tree, source = filled(agent_tree(), 0), filled(agent_tree(action_size=8), 1)
    plan = recipes.universal_autoencoder("frozen")
    params, _ = transfer.apply(plan, tree, source)
    optimizer = transfer.freeze(optax.sgd(0.1, momentum=0.9), transfer.frozen(plan, params))

    @jax.jit
    def step(params):
        updates, _ = optimizer.update(params, optimizer.init(params), params)
        return optax.apply_updates(params, updates)

    moved = step(params)
    assert bits(moved["encoder"]) == bits(source["encoder"])
    assert bits(moved["dynamics"]["gru"]) == bits(source["dynamics"]["gru"])
    assert bits(moved["dynamics"]["action_in"]) != bits(tree["dynamics"]["action_in"])
    assert bits(moved["decoder"]) != bits(source["decoder"])


def test_the_transfer_library_knows_nothing_of_agents_and_environments():
    for path in Path(transfer.__file__).parent.glob("*.py"):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            names = [alias.name for alias in node.names] if isinstance(node, ast.Import) else []
            names += [node.module or ""] if isinstance(node, ast.ImportFrom) else []
            assert not {name.split(".")[0] for name in names} & {
                "dreamer_jax",
                "envs",
                "experiments",
            }
