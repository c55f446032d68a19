"""Plans carried out leaf by leaf, and fractions that are learned."""

import subprocess
import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest

import transfer
from transfer import Plan, Rule, apply, stream
from transfer_trees import bits

KEY = jax.random.key(0)
random = np.random.default_rng(0)
TREE = {
    "a": random.standard_normal((4, 3)).astype(np.float32),
    "b": {"c": random.standard_normal(5).astype(np.float32), "d": np.ones(2, np.float32)},
}
TARGET = jax.tree.map(lambda x: jnp.full(x.shape, 0.5), TREE)
PLAN = Plan(
    (
        Rule("a", "fraction"),
        Rule("b/c", "splice", {"axis": -1, "indices": "0:2"}),
        Rule("b/d", "shrink_perturb", {"shrink": 0.5, "noise": 0.1}),
    )
)


@pytest.mark.parametrize("name", ["x.npz", "x.safetensors", "x"])
def test_leaf_by_leaf_from_a_file_is_what_apply_does_at_once(tmp_path, name):
    transfer.save(tmp_path / name, TREE)
    expected, report = apply(PLAN, TARGET, TREE, omega=0.25, key=KEY)
    with transfer.open_file(tmp_path / name) as source:
        for run in (apply, stream):
            new, streamed = run(PLAN, TARGET, source, omega=0.25, key=KEY)
            assert bits(new) == bits(expected)
            for one, other in zip(streamed.records(), report.records(), strict=True):
                assert one.keys() == other.keys() and one["leaf"] == other["leaf"]
                for column in ("norm_before", "norm_after", "norm_source", "cosine_to_source"):
                    np.testing.assert_allclose(one[column], other[column], rtol=1e-5)
        omegas = {"a": 0.25}
        assert bits(stream(PLAN, TARGET, source, omega=omegas, key=KEY)[0]) == bits(expected)


def test_leaf_by_leaf_reads_each_leaf_once_and_no_other(tmp_path, monkeypatch):
    transfer.save(tmp_path / "x.safetensors", TREE | {"more": np.ones(3)})
    with transfer.open_file(tmp_path / "x.safetensors") as source:
        read, original = [], type(source)._read_one
        monkeypatch.setattr(
            type(source), "_read_one", lambda self, name: read.append(name) or original(self, name)
        )
        _, report = stream(PLAN, TARGET, source, omega=0.25, key=KEY)
    assert sorted(read) == ["a", "b/c", "b/d"] and report.unread == ("more",)


def test_shapes_become_arrays_where_the_plan_does_not_read_them():
    shapes = jax.eval_shape(lambda: {"w": jnp.zeros(2, jnp.bfloat16), "new": jnp.zeros(3)})
    plan = Plan((Rule("w", "copy"), Rule("new", "reinitialise", {"initializer": "normal"})))
    new, report = stream(plan, shapes, {"w": np.ones(2, np.float32)}, key=KEY)
    assert new["w"].dtype == jnp.bfloat16 and new["new"].shape == (3,)
    assert report.records()[1]["norm_before"] is None
    assert report.records()[1]["norm_after"] == pytest.approx(2**0.5)
    for operation, message in (("fraction", "reads the target's values"), ("keep", "keeps the")):
        plan = Plan((Rule("w", operation), Rule("new", "reinitialise", {"initializer": "zeros"})))
        given = {"omega": 0.5} if operation == "fraction" else {}
        with pytest.raises(ValueError, match=f"w: .*{message}"):
            stream(plan, shapes, {"w": np.ones(2, np.float32)}, key=KEY, **given)


def test_populations_are_streamed_too():
    population = transfer.replicate(TARGET, size=3)
    omegas = jnp.array([0.0, 0.5, 1.0])
    arguments = {"omega": omegas, "key": KEY, "population": True}
    expected, report = apply(PLAN, population, TREE, **arguments)
    new, streamed = stream(PLAN, population, TREE, **arguments)
    assert bits(new) == bits(expected)
    np.testing.assert_allclose(streamed.norm_after, report.norm_after, rtol=1e-6)


PEAK = """
import re, sys, jax, jax.numpy as jnp, transfer

def peak():
    return int(re.search(r"VmHWM:\\s*(\\d+) kB", open("/proc/self/status").read())[1])

plan = transfer.Plan((transfer.Rule("{i}", "copy"),))
shapes = {str(i): jax.ShapeDtypeStruct((2**20,), jnp.bfloat16) for i in range(48)}
with transfer.open_file(sys.argv[1]) as source:
    transfer.stream(plan, {"0": shapes["0"]}, source, measure=False)
    before = peak()
    new, _ = transfer.stream(plan, shapes, source, measure=False)
print(peak() - before)
"""


@pytest.mark.skipif(not Path("/proc/self/status").exists(), reason="peak memory is read on Linux")
def test_a_source_is_never_in_memory_whole(tmp_path):
    path = tmp_path / "large.safetensors"
    # 48 leaves of 4 MiB, 192 MiB; the result is half of that.
    ones = np.ones(2**20, np.float32)
    transfer.save(path, {str(i): ones for i in range(48)})
    run = [sys.executable, "-c", PEAK, str(path)]
    root = Path(__file__).parent.parent
    found = subprocess.run(run, capture_output=True, text=True, check=True, cwd=root)
    mebibytes = int(found.stdout) / 1024
    assert 80 < mebibytes < 96 + 40


# --- learned fractions ---------------------------------------------------------------------------

FRACTION = Plan((Rule("**", "fraction"),))
WEIGHTS = {"l0": {"w": jnp.zeros(2)}, "l1": {"w": jnp.zeros(2), "b": jnp.zeros(1)}}
KNOWN = jax.tree.map(jnp.ones_like, WEIGHTS)


@pytest.mark.parametrize(
    "omega",
    [
        {"l0": {"w": 0.25}, "l1": {"w": 0.5, "b": 0.75}},
        {"l0/w": 0.25, "l1/w": 0.5, "l1/b": 0.75},
        {"l0": 0.25, "**/b": 0.75, "l1/w": 0.5},
        {"l0/**": jnp.array(0.25), "l1/w": np.float32(0.5), "*/b": 0.75},
    ],
    ids=["tree", "paths", "branches", "patterns"],
)
def test_each_leaf_may_have_a_fraction_of_its_own(omega):
    for new in (
        transfer.fraction(WEIGHTS, KNOWN, omega=omega),
        apply(FRACTION, WEIGHTS, KNOWN, omega=omega)[0],
        jax.jit(lambda omega: apply(FRACTION, WEIGHTS, KNOWN, omega=omega)[0])(omega),
    ):
        values = [float(leaf[0]) for leaf in (new["l0"]["w"], new["l1"]["w"], new["l1"]["b"])]
        assert values == [0.25, 0.5, 0.75]
    _, report = apply(FRACTION, WEIGHTS, KNOWN, omega=omega)
    assert [r["parameters"]["omega"] for r in report.records()] == [0.25, 0.75, 0.5]


@pytest.mark.parametrize(
    ("omega", "message"),
    [
        ({"l0": 0.5}, "l1/b: expected one entry of omega for it, found none"),
        ({"l0": 0.5, "l1": 0.5, "**/b": 0.5}, r"l1/b: .* found '\*\*/b' and 'l1'"),
        ({"l0": 0.5, "l1": 0.5, "l2": 0.5}, "omega has an entry 'l2' for no leaf"),
        ({"l0": 0.5, "l1": 1.5}, "omega of l1.* is 1.5; expected numbers in"),
        ({"l0": jnp.ones(2), "l1": 0.5}, "say population=True"),
    ],
)
def test_fractions_that_do_not_fit_the_leaves_are_named(omega, message):
    for call in (
        lambda: transfer.fraction(WEIGHTS, KNOWN, omega=omega),
        lambda: apply(FRACTION, WEIGHTS, KNOWN, omega=omega),
    ):
        with pytest.raises(ValueError, match=message):
            call()


def test_members_may_have_fractions_for_each_leaf():
    population = transfer.replicate(WEIGHTS, size=2)
    omega = {"l0": jnp.array([0.0, 1.0]), "l1": 0.5}
    new, report = apply(FRACTION, population, KNOWN, omega=omega, population=True)
    assert new["l0"]["w"][:, 0].tolist() == [0, 1] and new["l1"]["b"][:, 0].tolist() == [0.5, 0.5]
    assert report.member(1).records()[0]["parameters"] == {"omega": 1.0}


def test_fractions_of_a_plan_may_differ_between_leaves_and_go_through_yaml(tmp_path):
    plan = Plan((Rule("**", "fraction", {"omega": {"l0": 0.25, "l1": 0.5}}),))
    transfer.write_plan(plan, tmp_path / "plan.yaml")
    again = transfer.read_plan(tmp_path / "plan.yaml")
    assert again == plan and hash(again) == hash(plan)
    for run in (apply, stream):
        new, report = run(again, WEIGHTS, KNOWN)
        assert (new["l0"]["w"][0], new["l1"]["w"][0]) == (0.25, 0.5)
        assert [r["parameters"]["omega"] for r in report.records()] == [0.25, 0.5, 0.5]


def test_the_gradient_finds_the_fraction_of_each_layer():
    """Layer 0 of the source is right for the task and layer 1 is wrong: ω goes to 1 and to 0."""
    x = jnp.asarray(random.standard_normal((64, 4)), jnp.float32)
    right = {"l0": jnp.asarray(random.standard_normal((4, 4)), jnp.float32), "l1": jnp.ones((4, 1))}
    model = lambda p: jnp.tanh(x @ p["l0"]) @ p["l1"]  # noqa: E731
    source = {"l0": right["l0"], "l1": -3 * jnp.ones((4, 1))}
    target = {"l0": jnp.zeros((4, 4)), "l1": right["l1"]}
    plan = Plan((Rule("*", "fraction"),))

    def loss(logits):
        omega = jax.tree.map(jax.nn.sigmoid, logits)
        new, _ = apply(plan, target, source, omega=omega, measure=False)
        return ((model(new) - model(right)) ** 2).mean()

    adam = optax.adam(0.3)

    @jax.jit
    def step(carry, _):
        logits, state = carry
        updates, state = adam.update(jax.grad(loss)(logits), state)
        return (optax.apply_updates(logits, updates), state), None

    start = {"l0": jnp.zeros(()), "l1": jnp.zeros(())}
    (logits, _), _ = jax.lax.scan(step, (start, adam.init(start)), length=150)
    omega = jax.tree.map(jax.nn.sigmoid, logits)
    assert omega["l0"] > 0.95 and omega["l1"] < 0.05 and loss(logits) < 0.05 * loss(start)
