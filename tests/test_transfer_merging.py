"""Merging, by hand and against NumPy; and mergekit's configurations as plans."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import transfer
from transfer import Plan, Rule, apply
from transfer.mergekit import from_mergekit

KEY = jax.random.key(0)
random = np.random.default_rng(0)
SHAPES = {"a": (7, 5), "b": (11,), "c": ()}


def model():
    # Multiples of 1/64, so that sums of a few are exact.
    return {
        name: np.asarray(random.integers(-64, 64, s) / 64, np.float32) for name, s in SHAPES.items()
    }


BASE, MODELS = model(), [model(), model(), model()]
WEIGHTS = [0.5, 1.0, -0.25]


# --- the methods written again, in NumPy and float64 --------------------------------------------


def kept(vector, count, skip=0):
    order = np.argsort(-np.abs(vector), axis=None, kind="stable")[skip : skip + count]
    mask = np.zeros(vector.size, bool)
    mask[order] = True
    return np.where(mask.reshape(vector.shape), vector, 0)


def combined(vectors, weights, normalise):
    total = sum(w * v for w, v in zip(weights, vectors, strict=True))
    return total / sum(weights) if normalise else total


def elected(vectors, weights, normalise):
    total, share = np.zeros(vectors[0].shape), np.zeros(vectors[0].shape)
    sign = np.where(sum(w * v for w, v in zip(weights, vectors, strict=True)) >= 0, 1, -1)
    for weight, vector in zip(weights, vectors, strict=True):
        agrees = np.sign(weight * vector) == sign
        total += np.where(agrees, weight * vector, 0)
        share += np.where(agrees, weight, 0)
    return total / np.where(share == 0, 1, share) if normalise else total


def oracle(name, base, models, density=0.4, outliers=0.2, weights=WEIGHTS, scale=0.8, t=0.3):
    base, models = base.astype(np.float64), [m.astype(np.float64) for m in models]
    vectors, size = [m - base for m in models], base.size
    if name == "task_arithmetic":
        return base + scale * combined(vectors, weights, False)
    if name == "ties":
        return base + scale * elected(
            [kept(v, int(density * size)) for v in vectors], weights, True
        )
    if name in ("breadcrumbs", "breadcrumbs with signs"):
        count = int(density * size)
        skip = min(int(outliers * size), size - count)
        vectors = [kept(v, count, skip) for v in vectors]
        merge = elected if "signs" in name else combined
        return base + scale * merge(vectors, weights, False)
    if name == "average":
        return combined(models, np.abs(weights), True)
    if name == "model_stock":
        flat = [v.ravel() for v in vectors]
        pairs = [(0, 1), (0, 2), (1, 2)]
        cosines = [
            flat[i] @ flat[j] / np.linalg.norm(flat[i]) / np.linalg.norm(flat[j]) for i, j in pairs
        ]
        cosine = np.clip(np.mean(cosines), 0, 1)
        share = 3 * cosine / (1 + 2 * cosine)
        return share * sum(models) / 3 + (1 - share) * base
    assert name == "slerp"
    other = models[0]
    lengths = np.linalg.norm(base) * np.linalg.norm(other)
    cosine = (base * other).sum() / lengths
    if abs(cosine) > 0.9995:
        return (1 - t) * base + t * other
    angle = np.arccos(cosine)
    return (np.sin((1 - t) * angle) * base + np.sin(t * angle) * other) / np.sin(angle)


MERGES = {
    "task_arithmetic": lambda b, m: transfer.task_arithmetic(b, m, weights=WEIGHTS, scale=0.8),
    "ties": lambda b, m: transfer.ties(b, m, weights=WEIGHTS, scale=0.8, density=0.4),
    "breadcrumbs": lambda b, m: transfer.breadcrumbs(
        b, m, weights=WEIGHTS, scale=0.8, density=0.4, outliers=0.2
    ),
    "breadcrumbs with signs": lambda b, m: transfer.breadcrumbs(
        b, m, weights=WEIGHTS, scale=0.8, density=0.4, outliers=0.2, elect_sign=True
    ),
    "average": lambda b, m: transfer.average(b, m, weights=np.abs(WEIGHTS)),
    "model_stock": transfer.model_stock,
    "slerp": lambda b, m: transfer.slerp(b, m[0], weight=0.3),
}


@pytest.mark.parametrize("name", MERGES)
def test_merges_agree_with_numpy(name):
    found = jax.jit(MERGES[name])(BASE, MODELS)
    for path in SHAPES:
        expected = oracle(name, BASE[path], [one[path] for one in MODELS])
        np.testing.assert_allclose(found[path], expected, rtol=2e-6, atol=2e-7)


@pytest.mark.parametrize("name", MERGES)
def test_a_population_merges_each_member_by_itself(name):
    bases, models = [BASE, MODELS[0]], [MODELS, [MODELS[1], BASE, MODELS[2]]]
    stacked = transfer.stack(bases), [transfer.stack(pair) for pair in zip(*models, strict=True)]
    keywords = {
        "task_arithmetic": {"weights": WEIGHTS, "scale": 0.8},
        "ties": {"weights": WEIGHTS, "scale": 0.8, "density": 0.4},
        "average": {"weights": np.abs(WEIGHTS)},
        "slerp": {"weight": 0.3},
        "model_stock": {},
    }.get(name, {"weights": WEIGHTS, "scale": 0.8, "density": 0.4, "outliers": 0.2})
    if "signs" in name:
        keywords |= {"elect_sign": True}
    operation = getattr(transfer, name.split()[0])
    sources = stacked[1][0] if name == "slerp" else stacked[1]
    merge = jax.jit(lambda b, s: operation(b, s, population=True, **keywords))
    found = transfer.unstack(merge(stacked[0], sources))
    for member, base, ones in zip(found, bases, models, strict=True):
        for path in SHAPES:
            expected = oracle(name, np.asarray(base[path]), [np.asarray(m[path]) for m in ones])
            np.testing.assert_allclose(member[path], expected, rtol=2e-6, atol=2e-7)


def test_54_merges_are_one_mapped_program():
    weights = jnp.linspace(0, 1, 54 * 3).reshape(54, 3)
    densities = jnp.linspace(0.1, 1, 54)
    calls = []

    def merge(weights, density):
        calls.append(None)
        merged = transfer.ties(BASE, MODELS, weights=weights, density=density)
        return transfer.dare(merged, MODELS, weights=weights, density=density, key=KEY)

    mapped = jax.jit(jax.vmap(merge))(weights, densities)
    assert len(calls) == 1 and mapped["a"].shape == (54, 7, 5)
    for member in (0, 30, 53):
        alone = jax.jit(merge)(weights[member], densities[member])
        for path in SHAPES:
            np.testing.assert_allclose(mapped[path][member], alone[path], rtol=1e-5, atol=1e-6)


def test_ties_by_hand():
    # Trim, elect, and the mean of those that agree.
    base = {"w": jnp.zeros(4)}
    models = [{"w": jnp.array([4.0, -3.0, 0.1, 2.0])}, {"w": jnp.array([-1.0, -5.0, 0.2, 6.0])}]
    new = transfer.ties(base, models, density=0.75)["w"]
    # 0.1 and 0.2 are trimmed; in the first place +4 outweighs -1 and stands alone.
    np.testing.assert_allclose(new, [4, -4, 0, 4])


def test_dare_drops_and_rescales():
    base, one = {"w": jnp.ones((200, 100))}, {"w": jnp.full((200, 100), 3.0)}
    new = transfer.dare(base, [one], density=0.25, key=KEY)["w"] - 1
    values, counts = np.unique(np.asarray(new), return_counts=True)
    np.testing.assert_array_equal(values, [0, 8])
    assert abs(counts[1] / new.size - 0.25) < 0.01
    whole = transfer.dare(base, [one], density=1.0, key=KEY)
    np.testing.assert_array_equal(whole["w"], one["w"])
    none = transfer.dare(base, [one], density=0.0, key=KEY)
    np.testing.assert_array_equal(none["w"], base["w"])
    # Two sources are drawn apart.
    both = transfer.dare(base, [one, one], density=0.25, key=KEY)["w"]
    assert set(np.unique(np.asarray(both))) == {1, 9, 17}


def test_the_karcher_mean_is_the_middle_of_an_arc():
    ends = [{"w": jnp.array([1.0, 0.0])}, {"w": jnp.array([0.0, 1.0])}]
    arc = transfer.slerp(ends[0], ends[1], weight=0.25)["w"]
    mean = transfer.karcher_mean(ends[0], ends, weights=[3, 1])["w"]
    np.testing.assert_allclose(mean, arc, atol=1e-6)
    # The first variation is zero there: tangents towards the points cancel.
    points = [m["a"].ravel() / np.linalg.norm(m["a"]) for m in MODELS]
    mean = np.asarray(transfer.karcher_mean(BASE, MODELS, iterations=60)["a"], np.float64).ravel()
    np.testing.assert_allclose(
        np.linalg.norm(mean), np.mean([np.linalg.norm(m["a"]) for m in MODELS]), rtol=1e-5
    )
    mean /= np.linalg.norm(mean)
    sides = [p - (p @ mean) * mean for p in points]
    tangents = [
        np.arccos(p @ mean) * s / np.linalg.norm(s) for p, s in zip(points, sides, strict=True)
    ]
    assert np.linalg.norm(sum(tangents)) < 1e-5


def test_slerp_keeps_ends_and_lengths():
    a, b = {"w": jnp.array([2.0, 0.0])}, {"w": jnp.array([0.0, 2.0])}
    np.testing.assert_allclose(transfer.slerp(a, b, weight=0.0)["w"], a["w"], atol=1e-6)
    np.testing.assert_allclose(transfer.slerp(a, b, weight=1.0)["w"], b["w"], atol=1e-6)
    assert np.linalg.norm(transfer.slerp(a, b, weight=0.3)["w"]) == pytest.approx(2, rel=1e-6)
    zero = transfer.slerp({"w": jnp.zeros(2)}, b, weight=0.25)["w"]
    np.testing.assert_allclose(zero, [0, 0.5])
    gradient = jax.grad(lambda w: transfer.slerp(a, b, weight=w)["w"].sum())(0.5)
    assert np.isfinite(gradient)


def test_merges_name_what_does_not_fit():
    for call, message in (
        (lambda: transfer.ties(BASE, [], density=0.5), "ties needs at least one source"),
        (lambda: transfer.model_stock(BASE, MODELS[:1]), "two sources or more, got 1"),
        (lambda: transfer.ties(BASE, MODELS, density=[0.5, 0.5]), "each of 3 sources"),
        (lambda: transfer.task_arithmetic(BASE, [{"a": np.ones(3)}]), "nothing is broadcast"),
        (
            lambda: transfer.task_arithmetic(BASE, MODELS, weights=np.ones((2, 3))),
            "say population=True",
        ),
    ):
        with pytest.raises(ValueError, match=message):
            call()


# --- per depth and per selection ---------------------------------------------------------------

DEEP = {"embed": jnp.zeros(1), "layers": {str(i): {"w": jnp.zeros(1)} for i in range(11)}}
ONES = jax.tree.map(jnp.ones_like, DEEP)


def test_a_gradient_spreads_values_over_the_layers():
    plan = Plan(
        (
            Rule("embed", "keep"),
            Rule(
                "layers/{layer}/*",
                "interpolate",
                {"weight": {"values": [0, 1.0, 0.5], "over": "layer"}},
            ),
        )
    )
    new, report = apply(plan, DEEP, ONES)
    found = [new["layers"][str(i)]["w"][0] for i in range(11)]
    # Layer 10 comes last, although as text it comes after 1.
    np.testing.assert_allclose(
        found, [0, 0.2, 0.4, 0.6, 0.8, 1, 0.9, 0.8, 0.7, 0.6, 0.5], rtol=1e-6
    )
    by_leaf = {r["leaf"]: r["parameters"].get("weight") for r in report.records()}
    assert by_leaf["layers/10/w"] == pytest.approx(0.5)
    jitted = jax.jit(lambda tree: apply(plan, tree, ONES)[0])(DEEP)
    assert jitted["layers"]["10"]["w"] == pytest.approx(0.5)
    with pytest.raises(ValueError, match=r"uses \{depth\}, which its pattern .* not capture"):
        Rule("layers/{layer}/*", "interpolate", {"weight": {"values": [0, 1], "over": "depth"}})


MERGEKIT = """
merge_method: ties
base_model: org/base
models:
  - model: org/base
  - model: org/one
    parameters:
      density: [0.0, 1.0]
      weight: 1.0
  - model: org/two
    parameters:
      density: 1.0
      weight:
        - filter: mlp
          value: 0.0
        - value: [1.0, 0.5, 0.0]
parameters:
  normalize: false
  lambda: 2.0
dtype: bfloat16
"""


def test_a_mergekit_configuration_is_a_plan(tmp_path):
    (tmp_path / "merge.yaml").write_text(MERGEKIT)
    plan = transfer.read_mergekit(tmp_path / "merge.yaml")
    layer = lambda x: {"attn": {"w": jnp.full(4, x)}, "mlp": {"w": jnp.full(4, x)}}  # noqa: E731
    tree = lambda x: {  # noqa: E731
        "embed": {"w": jnp.full(4, x)},
        "layers": [layer(x) for _ in range(3)],
        "norm": {"w": jnp.full(4, x)},
    }
    new, report = apply(plan, tree(0.0), {"org/one": tree(1.0), "org/two": tree(10.0)}, strict=True)
    # Of "one" 0, 2 and 4 of 4 numbers are kept in layers 0, 1 and 2; of "two" all, with weights
    # 1, 0.5 and 0 outside of mlp; the sum is doubled.
    expected = {
        "embed/w": [20] * 4,
        "layers/0/attn/w": [20] * 4,
        "layers/0/mlp/w": [0] * 4,
        "layers/1/attn/w": [12, 12, 10, 10],
        "layers/1/mlp/w": [2, 2, 0, 0],
        "layers/2/attn/w": [2] * 4,
        "layers/2/mlp/w": [2] * 4,
        "norm/w": [2] * 4,
    }
    for path, leaf in transfer.flatten(new).items():
        np.testing.assert_allclose(leaf, expected[path], err_msg=path)
    transfer.write_plan(plan, tmp_path / "plan.yaml")
    assert transfer.read_plan(tmp_path / "plan.yaml") == plan


@pytest.mark.parametrize(
    ("method", "operation", "sources"),
    [
        ("linear", "average", ("a:", "b:")),
        ("slerp", "slerp", "b:"),
        ("task_arithmetic", "task_arithmetic", ("b:",)),
        ("dare_ties", "dare", ("b:",)),
        ("dare_linear", "dare", ("b:",)),
        ("breadcrumbs", "breadcrumbs", ("b:",)),
        ("breadcrumbs_ties", "breadcrumbs", ("b:",)),
        ("karcher", "karcher_mean", ("a:", "b:")),
    ],
)
def test_every_method_in_common_is_carried_out(method, operation, sources):
    data = {
        "merge_method": method,
        "base_model": "a",
        "models": [{"model": "a"}, {"model": "b"}],
        "parameters": {"t": 0.5} if method == "slerp" else {"weight": 0.5},
    }
    if method in ("linear", "karcher"):
        del data["base_model"]
    if method == "karcher":
        del data["parameters"]
    (rule,) = from_mergekit(data).rules
    assert (rule.operation, rule.source) == (operation, sources)
    new, _ = apply(from_mergekit(data), ONES, {"a": ONES, "b": ONES}, key=KEY)
    np.testing.assert_allclose(new["embed"], 1, rtol=1e-6)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"merge_method": "passthrough"}, "'passthrough' is not read; those are linear, slerp"),
        ({"tokenizer_source": "union"}, "the entry 'tokenizer_source' is not read"),
        ({"parameters": {"t": 0.5, "epsilon": 1}}, "the parameter 'epsilon' of slerp is not read"),
        ({"parameters": {}}, "the parameter 't' is not given"),
        ({"base_model": None}, "slerp needs a base_model"),
        ({"models": [{"model": "a"}]}, "slerp merges 0 models beside its base"),
        ({"models": None, "slices": [{}, {}]}, "only a single one"),
    ],
)
def test_what_a_configuration_says_beyond_that_is_an_error(change, message):
    data = {
        "merge_method": "slerp",
        "base_model": "a",
        "models": [{"model": "a"}, {"model": "b"}],
        "parameters": {"t": 0.5},
    }
    with pytest.raises(ValueError, match=message):
        from_mergekit(data | change)


def test_slices_of_whole_models_are_models():
    source = lambda name: {"model": name, "layer_range": [0, 3]}  # noqa: E731
    data = {
        "merge_method": "slerp",
        "base_model": "a",
        "slices": [{"sources": [source("a"), source("b")]}],
        "parameters": {"t": [{"filter": "w", "value": [0, 1]}, {"value": 0.5}]},
    }
    assert [rule.note for rule in from_mergekit(data).rules].count("filter w") == 2
    data["slices"][0]["sources"][1]["layer_range"] = [1, 3]
    with pytest.raises(ValueError, match="different layers"):
        from_mergekit(data)
