"""Selecting leaves of any pytree by glob patterns over their paths."""

import dataclasses

import equinox as eqx
import hypothesis
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import strategies as st

import transfer
from transfer.patterns import match, match_paths
from transfer.select import selected
from transfer_trees import LIBRARIES, library_tree, trees

AGENT = {
    "dynamics": {
        "action_in": {"kernel": jnp.ones((2, 3))},
        "prior": {"hidden": {"kernel": jnp.ones(1)}, "out": {"kernel": jnp.ones(1)}},
    },
    "reward": {"hidden_0": {"kernel": jnp.ones(1)}, "out": {"kernel": jnp.ones(1)}},
}


@pytest.mark.parametrize(
    ("pattern", "path", "matches"),
    [
        ("reward/out/*", "reward/out/kernel", True),
        ("reward/*", "reward/out/kernel", False),
        ("reward/**", "reward/out/kernel", True),
        ("reward/**", "reward", True),
        ("reward/**", "rewards/out", False),
        ("**/kernel", "kernel", True),
        ("**/kernel", "a/b/kernel", True),
        ("**/kernel", "a/b/mykernel", False),
        ("a/**/z", "a/z", True),
        ("a/**/z", "a/b/c/z", True),
        ("a/**/z", "az", False),
        ("**", "", True),
        ("*", "", False),
        ("hidden_?", "hidden_0", True),
        ("hidden_?", "hidden_10", False),
        ("hidden_[01]", "hidden_1", True),
        ("hidden_[!01]", "hidden_1", False),
        ("a.c", "abc", False),
        ("A", "a", False),
    ],
)
def test_a_pattern_matches_whole_paths_part_by_part(pattern, path, matches):
    assert match(pattern, path) is matches


@hypothesis.given(
    st.lists(st.text("ab", min_size=1, max_size=2), min_size=1, max_size=4),
    st.lists(st.sampled_from(["a", "b", "*", "**", "a*"]), min_size=1, max_size=4),
)
def test_double_star_agrees_with_trying_every_number_of_single_stars(path, pattern):
    def expand(parts):
        if "**" not in parts:
            return [parts]
        at = parts.index("**")
        return [
            full
            for stars in range(len(path) + 1)
            for full in expand(parts[:at] + ["*"] * stars + parts[at + 1 :])
        ]

    expected = any(
        len(parts) == len(path)
        and all(
            part == "*" or part == name or (part == "a*" and name.startswith("a"))
            for part, name in zip(parts, path, strict=True)
        )
        for parts in expand(pattern)
    )
    assert match("/".join(pattern), "/".join(path)) is expected


@hypothesis.given(trees())
def test_every_array_has_a_path_that_selects_it_and_it_alone(tree):
    names = transfer.paths(tree)
    assert len(names) == len(jax.tree.leaves(tree)) - len(
        [x for x in jax.tree.leaves(tree) if isinstance(x, int)]
    )
    for name in names:
        assert selected(tree, transfer.select(tree, name, count=1)) == {name}


@pytest.mark.parametrize("name", LIBRARIES)
def test_a_mask_has_the_structure_of_its_tree(name):
    tree = library_tree(name)
    mask = transfer.select(tree, "**")
    assert jax.tree.structure(mask) == jax.tree.structure(tree)
    assert sum(jax.tree.leaves(mask)) == len(transfer.paths(tree))


def test_paths_read_alike_in_every_library():
    assert transfer.paths(library_tree("linen")) == (
        "hidden/bias",
        "hidden/kernel",
        "out/bias",
        "out/kernel",
    )
    assert transfer.paths(library_tree("nnx state")) == transfer.paths(library_tree("linen"))
    assert set(transfer.paths(library_tree("nnx module"))) == set(
        transfer.paths(library_tree("linen"))
    )
    assert "layers/0/weight" in transfer.paths(library_tree("equinox"))
    assert "mlp/~/linear_0/w" in transfer.paths(library_tree("haiku"))
    assert "1/0/mu/out/kernel" in transfer.paths(library_tree("optax"))


def test_patterns_are_taken_in_order():
    select = lambda *patterns: selected(AGENT, transfer.select(AGENT, *patterns))  # noqa: E731
    assert select("dynamics/**", "!dynamics/action_in/**") == {
        "dynamics/prior/hidden/kernel",
        "dynamics/prior/out/kernel",
    }
    assert select("!dynamics/**") == {"reward/hidden_0/kernel", "reward/out/kernel"}
    assert select("reward/**", "!**/out/*", "reward/out/*") == select("reward/**")


def test_a_pattern_that_matches_nothing_names_what_was_meant():
    with pytest.raises(ValueError, match=r"'rewards/out/\*' matches no leaf.*reward/out"):
        transfer.select(AGENT, "rewards/out/*")
    with pytest.raises(ValueError, match=r"'!dynamic/\*\*' matches no leaf.*dynamics/\*\*"):
        transfer.select(AGENT, "**", "!dynamic/**")


def test_a_count_that_is_off_lists_what_was_found():
    with pytest.raises(ValueError, match=r"select 2 leaves, expected 3: reward/hidden_0/kernel,"):
        transfer.select(AGENT, "reward/**", count=3)
    with pytest.raises(ValueError, match="select 2 leaves, expected 1"):
        transfer.select(AGENT, "reward/**", count=1)


def test_no_pattern_is_an_error():
    with pytest.raises(ValueError, match="No pattern"):
        transfer.select(AGENT)


def test_two_leaves_of_one_path_are_an_error():
    with pytest.raises(ValueError, match="same path: a/b"):
        transfer.paths({"a/b": jnp.ones(1), "a": {"b": jnp.ones(1)}})


def test_masks_combine_as_sets_do():
    kernels, reward = transfer.select(AGENT, "**/kernel"), transfer.select(AGENT, "reward/**")
    as_set = lambda mask: selected(AGENT, mask)  # noqa: E731
    assert as_set(transfer.union(kernels, reward)) == as_set(kernels) | as_set(reward)
    assert as_set(transfer.intersection(kernels, reward)) == as_set(kernels) & as_set(reward)
    assert as_set(transfer.difference(kernels, reward)) == as_set(kernels) - as_set(reward)
    assert as_set(transfer.complement(reward)) == set(transfer.paths(AGENT)) - as_set(reward)


def test_masks_of_different_trees_do_not_combine():
    with pytest.raises(ValueError, match="structure of mask 2 is not that of mask 1"):
        transfer.union({"a": True}, {"b": True})


def test_settings_of_an_equinox_module_are_in_no_mask_and_in_no_complement():
    module = eqx.nn.MLP(2, 1, 3, 1, activation=jnp.tanh, key=jax.random.key(0))
    mask = transfer.complement(transfer.select(module, "**/bias"), tree=module)
    assert selected(module, mask) == {"layers/0/weight", "layers/1/weight"}
    assert mask.activation is False


def test_selection_reads_shapes_only_and_works_on_abstract_trees():
    abstract = jax.eval_shape(lambda: AGENT)
    assert transfer.select(abstract, "reward/**") == transfer.select(AGENT, "reward/**")


def test_unflatten_refuses_a_name_the_tree_has_not():
    with pytest.raises(ValueError, match=r"no leaf 'reward/out/kernle'.*reward/out/kernel"):
        transfer.unflatten(AGENT, {"reward/out/kernle": jnp.ones(1)})


def test_unflatten_undoes_flatten():
    @jax.tree_util.register_dataclass
    @dataclasses.dataclass
    class Net:
        w: jax.Array
        layers: list

    net = Net(jnp.ones(1), [jnp.zeros(2), None, np.ones(3)])
    again = transfer.unflatten(net, transfer.flatten(net))
    assert jax.tree.structure(again) == jax.tree.structure(net)
    assert all(a is b for a, b in zip(jax.tree.leaves(again), jax.tree.leaves(net), strict=True))


def test_optional_patterns_may_match_nothing():
    assert match_paths(["a"], "b", optional=True) == frozenset()
