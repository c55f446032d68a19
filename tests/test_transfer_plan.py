"""Plans: rules that claim every leaf once, their reports, and plans as files."""

import inspect
import json

import hypothesis
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import strategies as st

import transfer
from transfer import OPERATIONS, Plan, Rule, apply, claims, plan_files
from transfer_trees import (
    LIBRARIES,
    assert_same_kind,
    bits,
    floating,
    library_tree,
    like,
    trees,
)

KEY = jax.random.key(0)
TARGET = {"body": {"w": jnp.zeros(2)}, "head": {"w": jnp.array([3.0, 4.0])}, "new": jnp.ones(3)}
SOURCE = {"body": {"w": jnp.ones(2)}, "head": {"w": jnp.array([4.0, -3.0])}, "new": jnp.ones(5)}
PLAN = Plan(
    (
        Rule("body/**", "copy", note="features"),
        Rule("head/*", "fraction"),
        Rule("new", "keep"),
    ),
    name="example",
)


# --- claiming ------------------------------------------------------------------------------------


@hypothesis.settings(max_examples=50, deadline=None)
@hypothesis.given(trees(), st.data())
def test_every_leaf_is_claimed_by_exactly_one_rule(tree, data):
    names = transfer.paths(tree)
    owner = {name: data.draw(st.integers(0, 2)) for name in names}
    rules = [
        Rule(tuple(name for name in names if owner[name] == index), operation)
        for index, operation in enumerate(("keep", "copy"))
        if index in owner.values()
    ]
    found = claims(Plan(tuple(rules), default="keep"), tree)
    assert list(found) == list(names)
    for name, rule in found.items():
        assert rule.operation == ("keep", "copy", "keep")[owner[name]]
    if 2 in owner.values():
        with pytest.raises(ValueError, match="No rule claims"):
            claims(Plan(tuple(rules)), tree)


def test_a_leaf_claimed_twice_names_both_rules():
    plan = Plan((Rule("**", "copy"), Rule("head/*", "keep")))
    message = r"head/w is claimed twice: by the rules '\*\* -> copy' and 'head/\* -> keep'"
    with pytest.raises(ValueError, match=message):
        apply(plan, TARGET, TARGET)


def test_a_leaf_nobody_claims_is_named():
    with pytest.raises(ValueError, match="No rule claims 1 of 3 leaves: new"):
        apply(Plan((Rule(("body/*", "head/*"), "keep"),)), TARGET)


def test_a_rule_that_claims_nothing_is_an_error_unless_it_is_optional():
    missing = Rule("tail/*", "keep")
    with pytest.raises(ValueError, match=r"'tail/\*' matches no leaf"):
        apply(Plan((missing,), default="keep"), TARGET)
    plan = Plan((Rule("tail/*", "keep", optional=True),), default="keep")
    assert bits(apply(plan, TARGET)[0]) == bits(TARGET)


def test_rules_need_patterns():
    for patterns in ((), [1]):
        with pytest.raises(ValueError, match="one pattern or several, as strings"):
            Rule(patterns, "copy")


# --- applying ------------------------------------------------------------------------------------


def test_apply_does_to_each_leaf_what_its_rule_says():
    new, _ = apply(PLAN, TARGET, SOURCE, omega=0.5)
    np.testing.assert_array_equal(new["body"]["w"], [1, 1])
    np.testing.assert_array_equal(new["head"]["w"], [5, 2.5])
    assert new["new"] is TARGET["new"]


@pytest.mark.parametrize("name", LIBRARIES)
def test_a_plan_equals_its_operations_one_by_one_on_trees_of_every_library(name):
    target = like(library_tree(name), 1)
    source = like(target, 2)
    halves = floating(target)[::2], floating(target)[1::2]
    rules = (Rule(halves[0], "fraction", {"omega": 0.5}), Rule(halves[1], "copy"))
    new, report = apply(Plan(rules, default="keep"), target, source)
    expected = transfer.fraction(target, source, omega=0.5, where=halves[0])
    expected = transfer.copy(expected, source, where=halves[1])
    assert_same_kind(new, target)
    assert bits(expected) == bits(new)
    assert [row.leaf for row in report.rows] == list(transfer.paths(target))


@pytest.mark.parametrize(
    ("plan", "arguments", "message"),
    [
        (PLAN, {}, "'head/. -> fraction' leaves 'omega' open"),
        (PLAN, {"omega": 1.0, "omga": 2.0}, "No rule leaves the parameter omga open"),
        (Plan((Rule("**", "copi"),)), {}, "no known operation; expected one of keep, copy"),
        (Plan((Rule("**", "copy", {"omega": 1}),)), {}, "sets 'omega'; .* of copy are casting"),
        (Plan((Rule("**", "fraction", {"where": "a"}),)), {"omega": 1.0}, "sets 'where'"),
        (
            Plan((Rule("**", "reinitialise", {"initializer": "zeros"}),)),
            {},
            "draws random numbers; give apply a key",
        ),
    ],
)
def test_parameters_that_are_missing_or_unknown_are_named(plan, arguments, message):
    with pytest.raises(ValueError, match=message):
        apply(plan, TARGET, TARGET, **arguments)


def test_what_the_plan_sets_is_not_open_to_the_caller():
    with pytest.raises(ValueError, match="No rule leaves the parameter omega open"):
        apply(Plan((Rule("**", "fraction", {"omega": 0.5}),)), TARGET, TARGET, omega=0.1)


def test_a_plan_that_reads_nothing_needs_no_source():
    with pytest.raises(ValueError, match="'body/.. -> copy' reads a source"):
        apply(PLAN, TARGET, omega=0.5)
    assert bits(apply(Plan((), default="keep"), TARGET)[0]) == bits(TARGET)


def test_rules_may_read_different_sources_and_average_several():
    plan = Plan(
        (
            Rule("body/**", "copy", source="first"),
            Rule("head/*", "average", {"weights": [3, 1]}, source=("first", "second")),
        ),
        default="keep",
    )
    sources = {"first": SOURCE, "second": TARGET}
    new, report = apply(plan, TARGET, sources)
    np.testing.assert_array_equal(new["body"]["w"], [1, 1])
    np.testing.assert_allclose(new["head"]["w"], [3.75, -1.25])
    assert report.records()[1]["parameters"] == {"weights": (3, 1)}
    for source, message in (
        ({"first": SOURCE}, "reads the source 'second'; given are first"),
        (jnp.ones(2), "name their sources"),
    ):
        with pytest.raises(ValueError, match=message):
            apply(plan, TARGET, source)
    with pytest.raises(ValueError, match="needs the name of one source, got None"):
        apply(Plan((*plan.rules, Rule("new", "copy"))), TARGET, sources)
    with pytest.raises(ValueError, match="reads several sources; name them"):
        apply(Plan((Rule("**", "average"),)), TARGET, SOURCE)


def test_own_operations_extend_the_plan():
    def negate(target, *, where=None):
        leaves = transfer.flatten(target)
        chosen = transfer.select(target, "**") if where is None else where
        flags = transfer.flatten(jax.tree.map(np.asarray, chosen))
        return transfer.unflatten(target, {p: -x for p, x in leaves.items() if flags[p]})

    plan = Plan((Rule("head/*", "negate"),), default="keep")
    new, report = apply(plan, TARGET, operations={**OPERATIONS, "negate": negate})
    np.testing.assert_array_equal(new["head"]["w"], [-3, -4])
    assert bits(new["body"]) == bits(TARGET["body"])
    assert report.records()[1]["operation"] == "negate"


def test_every_operation_of_a_plan_has_keyword_only_parameters():
    for operation in OPERATIONS.values():
        kinds = [p.kind for p in inspect.signature(operation).parameters.values()]
        assert all(kind is inspect.Parameter.KEYWORD_ONLY for kind in kinds[2:])
        assert "where" in inspect.signature(operation).parameters


def test_source_leaves_are_what_the_plan_reads_and_suffice():
    leaves = transfer.source_leaves(PLAN, TARGET, SOURCE)
    assert set(leaves) == {"body/w", "head/w"}
    assert bits(apply(PLAN, TARGET, leaves, omega=0.5)[0]) == bits(
        apply(PLAN, TARGET, SOURCE, omega=0.5)[0]
    )
    with pytest.raises(ValueError, match="source has no leaf 'head/w'"):
        transfer.source_leaves(PLAN, TARGET, {"body": SOURCE["body"]})


# --- jit, vmap, populations ----------------------------------------------------------------------


def members(count, tree=TARGET):
    return [like(tree, seed) for seed in range(count)]


def test_jit_gives_the_tree_and_the_report_of_eager():
    run = lambda omega: apply(PLAN, TARGET, SOURCE, omega=omega)  # noqa: E731
    (tree, report), (eager_tree, eager_report) = jax.jit(run)(0.5), run(0.5)
    assert bits(tree) == bits(eager_tree)
    for a, b in zip(report.records(), eager_report.records(), strict=True):
        assert a.keys() == b.keys()
        assert a["parameters"] == b["parameters"]
        np.testing.assert_allclose(a["norm_after"], b["norm_after"], rtol=1e-6)


def test_vmap_and_population_give_each_member_what_it_gets_alone():
    targets, omegas = members(3), [0.0, 0.25, 1.0]
    sources = [transfer.source_leaves(PLAN, TARGET, source) for source in members(3, SOURCE)]
    alone = [apply(PLAN, t, s, omega=w) for t, s, w in zip(targets, sources, omegas, strict=True)]
    stacked = transfer.stack(targets), transfer.stack(sources), jnp.array(omegas)
    mapped = jax.vmap(lambda t, s, w: apply(PLAN, t, s, omega=w))(*stacked)
    population = apply(PLAN, *stacked[:2], omega=stacked[2], population=True)
    for tree, report in (mapped, population):
        assert report.members == 3
        for index, (one, one_report) in enumerate(alone):
            assert bits(transfer.unstack(tree)[index]) == bits(one)
            found = report.member(index)
            for name in ("norm_before", "norm_after", "norm_source", "cosine_to_source"):
                np.testing.assert_allclose(
                    getattr(found, name), getattr(one_report, name), rtol=1e-6, atol=1e-6
                )
            assert found.records()[1]["parameters"] == {"omega": omegas[index]}


def test_a_population_may_share_one_source():
    targets = members(2)
    shared, _ = apply(PLAN, transfer.stack(targets), SOURCE, omega=0.5, population=True)
    for member, target in zip(transfer.unstack(shared), targets, strict=True):
        assert bits(member) == bits(apply(PLAN, target, SOURCE, omega=0.5)[0])
    with pytest.raises(ValueError, match="say population=True"):
        apply(PLAN, transfer.stack(targets), SOURCE, omega=0.5)


def test_members_of_a_population_draw_differently_from_one_key():
    plan = Plan((Rule("**", "reinitialise", {"initializer": "normal"}),))
    population = transfer.replicate(TARGET, size=2)
    new, _ = apply(plan, population, key=KEY, population=True)
    assert (new["new"][0] != new["new"][1]).all()
    keys = jax.random.split(KEY)
    assert bits(transfer.unstack(new)[1]) == bits(apply(plan, TARGET, key=keys[1])[0])


# --- reports -------------------------------------------------------------------------------------


def test_records_say_what_happened_in_numbers():
    _, report = apply(PLAN, TARGET, SOURCE, omega=0.5)
    body, head, new = report.records()
    assert body["leaf"] == "body/w" and body["rule"] == "body/**" and body["operation"] == "copy"
    assert (body["norm_before"], body["cosine_to_source"]) == (0, pytest.approx(1))
    assert head["parameters"] == {"omega": 0.5} and head["shape"] == (2,)
    # (3, 4) + 0.5 (4, -3) = (5, 2.5): norm sqrt(31.25), cosine (20 - 7.5) / (5 sqrt(31.25)).
    assert head["norm_before"] == pytest.approx(5)
    assert head["norm_source"] == pytest.approx(5)
    assert head["norm_after"] == pytest.approx(31.25**0.5)
    assert head["cosine_to_source"] == pytest.approx(12.5 / (5 * 31.25**0.5))
    assert new["norm_after"] == pytest.approx(3**0.5)
    assert new["norm_source"] is None and new["cosine_to_source"] is None


def test_a_diverged_leaf_shows_as_nan_and_a_key_as_nothing():
    tree = {"w": jnp.array([jnp.nan]), "key": jax.random.key(0), "zero": jnp.zeros(2)}
    _, report = apply(Plan((Rule("**", "copy"),)), tree, tree)
    key, w, zero = report.records()
    assert np.isnan(w["norm_after"]) and np.isnan(w["cosine_to_source"])
    assert key["norm_after"] is None and key["norm_source"] is None
    assert zero["cosine_to_source"] == 0
    assert "nan" in str(report).splitlines()[3] and str(report).splitlines()[2].endswith("-")


def test_a_source_of_another_shape_has_a_norm_but_no_cosine():
    plan = Plan((Rule("b", "pad", {"axis": -1}),))
    _, report = apply(plan, {"b": jnp.zeros(3)}, {"b": jnp.array([3.0, 4.0])})
    assert report.records()[0]["norm_source"] == 5
    assert report.records()[0]["cosine_to_source"] is None
    assert report.records()[0]["parameters"] == {"axis": -1}


def test_records_are_data():
    for report in (
        apply(PLAN, TARGET, SOURCE, omega=0.5)[1],
        apply(
            PLAN,
            transfer.replicate(TARGET, size=2),
            transfer.source_leaves(PLAN, TARGET, SOURCE),
            omega=jnp.array([0.0, 0.5]),
            population=True,
        )[1],
    ):
        again = json.loads(json.dumps(report.records()))
        assert again[1]["parameters"]["omega"] in (0.5, [0.0, 0.5])


def test_the_table_is_aligned_and_counts_operations():
    _, report = apply(PLAN, TARGET, SOURCE, omega=0.5)
    assert str(report).splitlines() == [
        "leaf    shape  operation            before  after  source  cosine",
        "-----------------------------------------------------------------",
        "body/w  2      copy()                    0  1.414   1.414       1",
        "head/w  2      fraction(omega=0.5)       5   5.59       5  0.4472",
        "new     3      keep()                1.732  1.732       -       -",
        "-----------------------------------------------------------------",
        "3 leaves: 1 copy, 1 fraction, 1 keep",
        "not read of the source: new",
    ]


def test_the_table_of_a_population_shows_means_and_the_range_of_parameters():
    targets = transfer.stack(members(2))
    source = transfer.source_leaves(PLAN, TARGET, SOURCE)
    _, report = apply(PLAN, targets, source, omega=jnp.array([0.0, 0.5]), population=True)
    text = str(report)
    assert "fraction(omega=0..0.5)" in text and "means over 2 members" in text
    assert "fraction(omega=0.5)" in str(report.member(1))


def test_a_traced_report_says_that_it_has_no_values_yet():
    seen = []

    @jax.jit
    def run(omega):
        tree, report = apply(PLAN, TARGET, SOURCE, omega=omega)
        seen.append(str(report))
        with pytest.raises(ValueError, match="still traced"):
            report.records()
        return tree

    run(0.5)
    assert "still traced" in seen[0]


def test_frozen_rules_give_a_mask_and_show_in_the_report():
    plan = Plan((Rule("body/**", "copy", frozen=True),), default="keep")
    assert transfer.frozen(plan, TARGET) == transfer.select(TARGET, "body/**")
    _, report = apply(plan, TARGET, SOURCE)
    assert [record["frozen"] for record in report.records()] == [True, False, False]
    assert "copy(), frozen" in str(report)


# --- plans as data -------------------------------------------------------------------------------

RICH = Plan(
    (
        Rule(("a/**", "!a/b"), "copy", source="one", note="ω ∈ [0, 1]"),
        Rule("b", "fraction", {"omega": 0.25}, source="one", optional=True),
        Rule("c", "average", {"weights": [1, 2]}, source=("one", "two"), frozen=True),
        Rule("d", "splice", {"axis": "input", "indices": "0:30"}, source="two"),
        Rule("e", "reinitialise", {"initializer": {"name": "normal", "stddev": 0.1}}),
    ),
    default="keep",
    name="everything",
)


@pytest.mark.parametrize("suffix", ["json", "yaml", "yml"])
@pytest.mark.parametrize("plan", [PLAN, RICH], ids=["small", "rich"])
def test_a_plan_is_itself_again_after_a_file(tmp_path, plan, suffix):
    transfer.write_plan(plan, tmp_path / f"plan.{suffix}")
    assert transfer.read_plan(tmp_path / f"plan.{suffix}") == plan


def test_arrays_and_slices_become_plain_data():
    parameters = {"omega": jnp.array([0.0, 0.5]), "indices": slice(0, 3)}
    data = plan_files.to_dict(Plan((Rule("a", "x", parameters),)))
    assert data["rules"][0]["parameters"] == {"omega": [0.0, 0.5], "indices": "0:3"}


def test_what_is_no_data_is_not_written():
    plan = Plan((Rule("a", "reinitialise", {"initializer": jax.nn.initializers.zeros}),))
    with pytest.raises(ValueError, match="'initializer'.* cannot be written as data"):
        plan_files.to_dict(plan)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("rules: [{patterns: [a]}]", "a rule with 'operation'; got only patterns"),
        ("rules: [{patterns: [a], operation: copy, omega: 1}]", "Unknown entry 'omega' of a rule"),
        ("rules: a", "rules as a list"),
        ("[]", "a plan as a mapping"),
        ("rules: [", "holds no plan"),
        ("!!python/object/apply:os.getcwd []", "holds no plan"),
    ],
)
def test_files_that_hold_no_plan_are_refused(tmp_path, text, message):
    (tmp_path / "plan.yaml").write_text(text)
    with pytest.raises(ValueError, match=message):
        transfer.read_plan(tmp_path / "plan.yaml")


def test_other_suffixes_are_refused(tmp_path):
    with pytest.raises(ValueError, match=".json, .yaml or .yml"):
        transfer.write_plan(PLAN, tmp_path / "plan.txt")


def test_a_plan_prints_itself():
    assert str(PLAN).splitlines() == [
        "example",
        "body/**  copy()      features",
        "head/*   fraction()",
        "new      keep()",
    ]
    assert "(all others)" in str(Plan((), default="keep"))
