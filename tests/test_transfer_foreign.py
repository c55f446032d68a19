"""Foreign checkpoints taken over by a plan alone: other names, other layouts."""

import importlib.util
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import linen

import transfer
from transfer import Plan, Rule, apply
from transfer.layout import arrange
from transfer_trees import bits

random = np.random.default_rng(0)


def array(*shape):
    return random.standard_normal(shape).astype(np.float32)


# --- names ---------------------------------------------------------------------------------------


def test_a_rule_reads_another_path_with_what_its_pattern_captured():
    source = {"blk": {str(i): {"attn": {"q": array(2), "k": array(2)}} for i in range(12)}}
    target = {
        "layers": {str(i): {"attention": {"q": jnp.zeros(2), "k": jnp.zeros(2)}} for i in range(12)}
    }
    plan = Plan((Rule("layers/{i}/attention/{rest}", "copy", source="blk/{i}/attn/{rest}"),))
    new, report = apply(plan, target, source, strict=True)
    for i in range(12):
        for name in "qk":
            np.testing.assert_array_equal(
                new["layers"][str(i)]["attention"][name], source["blk"][str(i)]["attn"][name]
            )
    assert report.records()[0]["source"] == "blk/0/attn/k"
    assert "from blk/0/attn/k" in str(report)
    assert set(transfer.source_leaves(plan, target, source)) == set(transfer.paths(source))


def test_several_parts_and_single_names_are_read_too():
    source = {"enc": {"a": {"w": array(1)}, "b": array(1)}, "weight": array(3), "x.y": array(2)}
    target = {
        "body": {"a": {"w": jnp.zeros(1)}, "b": jnp.zeros(1)},
        "w": jnp.zeros(3),
        "v": jnp.zeros(2),
    }
    plan = Plan(
        (
            Rule("body/{rest:**}", "copy", source="enc/{rest}"),
            Rule("w", "copy", source=":weight"),
            Rule("v", "copy", source=":x.y"),
        )
    )
    new, report = apply(plan, target, source)
    assert report.unread == ()
    np.testing.assert_array_equal(new["body"]["a"]["w"], source["enc"]["a"]["w"])
    np.testing.assert_array_equal(new["w"], source["weight"])
    two = Plan(
        (Rule("w", "copy", source="one:weight"), Rule("v", "copy", source="o/two:x.y")), "keep"
    )
    new, report = apply(two, target, {"one": source, "o/two": source})
    np.testing.assert_array_equal(new["v"], source["x.y"])
    assert "one/x.y" in report.unread and "o/two/x.y" not in report.unread


@pytest.mark.parametrize(
    ("rule", "message"),
    [
        (
            Rule("a", "copy", source="x/b"),
            "reads 'x/b', which the source has not; did you mean x/.",
        ),
        (Rule("a", "copy", source="x/*"), "reads 2 leaves, x/c, x/d, and its layout does not"),
        (Rule("a", "copy", source="y/*"), "has no leaf 'y/\\*'"),
        (Rule("a", "copy", source=("x/c", "x/d")), "reads 2 leaves"),
        (Rule("a", "copy", source="x/c", layout="transpose"), None),
        (Rule("a", "copy", source="x/c", layout={"reshape": [5]}), r"a: the step reshape.* \(3,\)"),
        (Rule("a", "copy", source="x/c", layout={"transpose": [1, 0]}), "a: the step transpose"),
        (
            Rule("a", "copy", source="x/c", layout={"split": {"axis": 0, "parts": 2, "index": 0}}),
            "no 2 equal",
        ),
        (
            Rule("a", "copy", source="x/c", layout={"reorder": {"axis": 0, "blocks": [0, 0, 1]}}),
            "no order",
        ),
        (Rule("a", "copy", source="x/c", layout={"take": {"axis": 0, "index": 9}}), "no slice 9"),
        (Rule("a", "copy", source="x/c", layout={"take": {"axs": 0}}), "axs"),
    ],
)
def test_what_cannot_be_read_is_named(rule, message):
    target, source = {"a": jnp.zeros(3)}, {"x": {"c": array(3), "d": array(3)}}
    if message is None:
        np.testing.assert_array_equal(
            apply(Plan((rule,)), target, source)[0]["a"], source["x"]["c"]
        )
        return
    for given in (source, {"x": {"c": jnp.ones(3), "d": jnp.ones(3)}}):
        with pytest.raises(ValueError, match=message):
            apply(Plan((rule,)), target, given)
    with pytest.raises(ValueError, match=message):
        apply(Plan((rule,)), jax.eval_shape(lambda: target), source)


# --- layouts -------------------------------------------------------------------------------------

Q, K, V = array(4, 3), array(4, 3), array(4, 3)


@pytest.mark.parametrize("library", [np.asarray, jnp.asarray])
@pytest.mark.parametrize(
    ("arrays", "layout", "expected"),
    [
        ([Q], "transpose", Q.T),
        ([Q], {"transpose": [1, 0]}, Q.T),
        ([Q], {"reshape": [2, -1]}, Q.reshape(2, 6)),
        ([Q, K, V], {"concatenate": {"axis": 0}}, np.concatenate([Q, K, V])),
        ([Q, K, V], [{"stack": {"axis": 1}}, {"transpose": [2, 1, 0]}], np.stack([Q, K, V], 1).T),
        ([Q, K], "add", Q + K),
        ([Q], {"split": {"axis": 0, "parts": 2, "index": 1}}, Q[2:]),
        ([Q], {"split": {"axis": -1, "parts": 3, "index": "{i}"}}, Q[:, 2:]),
        ([Q], {"take": {"axis": 0, "index": "{i}"}}, Q[2]),
        ([Q], {"reorder": {"axis": 0, "blocks": [1, 0]}}, np.concatenate([Q[2:], Q[:2]])),
        ([Q], {"flip": {"axis": -1}}, Q[:, ::-1]),
    ],
)
def test_each_step_does_what_it_says(library, arrays, layout, expected):
    found = arrange("w", [library(one) for one in arrays], layout, {"i": "2"})
    np.testing.assert_array_equal(found, expected)


def test_stacked_and_single_layers_go_both_ways_and_back():
    single = {"layers": {str(i): {"w": array(3, 2)} for i in range(11)}}
    stacked = {"layers": {"w": np.stack([single["layers"][str(i)]["w"] for i in range(11)])}}
    to_stack = Plan((Rule("layers/w", "copy", source="layers/*/w", layout={"stack": {"axis": 0}}),))
    to_single = Plan(
        (
            Rule(
                "layers/{i}/w",
                "copy",
                source="layers/w",
                layout=({"take": {"axis": 0, "index": "{i}"}},),
            ),
        )
    )
    zeros = lambda tree: jax.tree.map(jnp.zeros_like, tree)  # noqa: E731
    new, _ = apply(to_stack, zeros(stacked), single, strict=True)
    np.testing.assert_array_equal(new["layers"]["w"], stacked["layers"]["w"])
    again, _ = apply(to_single, zeros(single), new, strict=True)
    for i in range(11):
        np.testing.assert_array_equal(again["layers"][str(i)]["w"], single["layers"][str(i)]["w"])


def test_operations_other_than_copy_read_through_a_layout_too():
    plan = Plan(
        (
            Rule(
                "w",
                "fraction",
                {"omega": 0.5},
                source=("q/w", "k/w"),
                layout=[{"concatenate": {"axis": 0}}, "transpose"],
            ),
        )
    )
    target, source = {"w": jnp.ones((3, 8))}, {"q": {"w": Q}, "k": {"w": K}}
    expected = 1 + 0.5 * np.concatenate([Q, K]).T
    run = lambda source: apply(plan, target, source)[0]["w"]  # noqa: E731
    for found in (run(source), jax.jit(run)(source)):
        np.testing.assert_allclose(found, expected, rtol=1e-6)
    population = transfer.replicate(target, size=2)
    stacked, report = apply(plan, population, source, population=True)
    np.testing.assert_allclose(stacked["w"][1], expected, rtol=1e-6)
    assert report.records()[0]["source"] == "q/w, k/w"
    merged = Plan((Rule("w", "average", source=("one:q/w", "two:k/w"), layout="transpose"),))
    new, _ = apply(merged, {"w": jnp.zeros((3, 4))}, {"one": source, "two": source})
    np.testing.assert_allclose(new["w"], (Q + K).T / 2, rtol=1e-6)


# --- a PyTorch state_dict ------------------------------------------------------------------------


class Block(linen.Module):
    """A block of a transformer with fused q, k, v, as Flax would write it."""

    @linen.compact
    def __call__(self, x):
        q, k, v = jnp.split(linen.Dense(12, name="qkv")(linen.LayerNorm(name="norm")(x)), 3, -1)
        weights = jax.nn.softmax(q @ k.swapaxes(-1, -2) / 2)
        x = x + linen.Dense(4, name="out")(weights @ v)
        return linen.Conv(4, (3,), padding="SAME", name="conv")(x)


def torch_block(state, i, x):
    """The same from tensors in PyTorch's layout, in NumPy."""
    w = {name.removeprefix(f"h.{i}."): value for name, value in state.items()}
    mean, var = x.mean(-1, keepdims=True), x.var(-1, keepdims=True)
    normed = (x - mean) / np.sqrt(var + 1e-6) * w["ln.weight"] + w["ln.bias"]
    q, k, v = (normed @ w[f"attn.{n}.weight"].T + w[f"attn.{n}.bias"] for n in "qkv")
    scores = np.exp(q @ k.T / 2)
    x = x + (scores / scores.sum(-1, keepdims=True)) @ v @ w["proj.weight"].T + w["proj.bias"]
    padded = np.pad(x, ((1, 1), (0, 0)))
    windows = np.stack([padded[t : t + len(x)] for t in range(3)])
    return np.einsum("tsi,oit->so", windows, w["conv.weight"]) + w["conv.bias"]


TORCH_PLAN = """
name: a PyTorch transformer
rules:
- patterns: blocks_{i}/norm/scale
  operation: copy
  source: ":h.{i}.ln.weight"
- patterns: blocks_{i}/norm/bias
  operation: copy
  source: ":h.{i}.ln.bias"
- patterns: blocks_{i}/qkv/kernel
  operation: copy
  source: [":h.{i}.attn.q.weight", ":h.{i}.attn.k.weight", ":h.{i}.attn.v.weight"]
  layout: [concatenate: {axis: 0}, transpose]
- patterns: blocks_{i}/qkv/bias
  operation: copy
  source: [":h.{i}.attn.q.bias", ":h.{i}.attn.k.bias", ":h.{i}.attn.v.bias"]
  layout: [concatenate: {axis: 0}]
- patterns: blocks_{i}/out/kernel
  operation: copy
  source: ":h.{i}.proj.weight"
  layout: [transpose]
- patterns: blocks_{i}/conv/kernel
  operation: copy
  source: ":h.{i}.conv.weight"
  layout: [transpose: [2, 1, 0]]
- patterns: blocks_{i}/conv/bias
  operation: copy
  source: ":h.{i}.conv.bias"
- patterns: blocks_{i}/out/bias
  operation: copy
  source: ":h.{i}.proj.bias"
"""


def test_a_state_dict_of_pytorch_becomes_a_flax_model_by_a_plan_in_yaml(tmp_path):
    shapes = {
        "ln.weight": (4,),
        "ln.bias": (4,),
        **{f"attn.{n}.weight": (4, 4) for n in "qkv"},
        **{f"attn.{n}.bias": (4,) for n in "qkv"},
        "proj.weight": (4, 4),
        "proj.bias": (4,),
        "conv.weight": (4, 4, 3),
        "conv.bias": (4,),
    }
    state = {f"h.{i}.{name}": array(*shape) for i in range(2) for name, shape in shapes.items()}
    (tmp_path / "plan.yaml").write_text(TORCH_PLAN)
    plan = transfer.read_plan(tmp_path / "plan.yaml")
    transfer.write_plan(plan, tmp_path / "again.yaml")
    assert transfer.read_plan(tmp_path / "again.yaml") == plan
    x = array(5, 4)
    init, block = jax.jit(Block().init), jax.jit(Block().apply)
    params = {f"blocks_{i}": init(jax.random.key(i), x)["params"] for i in range(2)}
    transfer.save(tmp_path / "model.safetensors", state)
    with transfer.open_file(tmp_path / "model.safetensors") as source:
        new, report = apply(plan, params, source, strict=True)
    assert bits(new) == bits(apply(plan, params, state, strict=True)[0])
    assert len(report.rows) == 16
    for i in range(2):
        found = block({"params": new[f"blocks_{i}"]}, x)
        np.testing.assert_allclose(found, torch_block(state, i, x), rtol=1e-4, atol=1e-5)


def test_tensors_of_another_library_are_read_as_arrays():
    class Tensor:
        """What a PyTorch tensor on the CPU shows of itself."""

        def __init__(self, value):
            self.value, self.shape, self.dtype = value, value.shape, "torch.float32"

        def __array__(self, dtype=None, copy=None):
            return self.value

    new = transfer.copy({"w": jnp.zeros(3)}, {"w": Tensor(array(3))})
    assert new["w"].dtype == jnp.float32


# --- pretrained weights: Silero's detector of speech, as its package ships them ------------------


class EquinoxDetector(eqx.Module):
    """The 16 kHz detector: windowed Fourier transform, four convolutions, an LSTM, one output."""

    transform: eqx.nn.Conv1d
    convolutions: list
    cell: eqx.nn.LSTMCell
    out: eqx.nn.Conv1d

    def __init__(self, key):
        keys = jax.random.split(key, 7)
        conv = lambda i, o, s, key: eqx.nn.Conv1d(i, o, 3, s, padding=1, key=key)  # noqa: E731
        self.transform = eqx.nn.Conv1d(1, 258, 256, 128, use_bias=False, key=keys[0])
        sizes = ((129, 128, 1), (128, 64, 2), (64, 64, 2), (64, 128, 1))
        self.convolutions = [conv(*s, k) for s, k in zip(sizes, keys[1:5], strict=True)]
        self.cell = eqx.nn.LSTMCell(128, 128, key=keys[5])
        self.out = eqx.nn.Conv1d(128, 1, 1, key=keys[6])

    def __call__(self, samples, state):
        x = self.transform(jnp.pad(samples, (0, 64), mode="reflect")[None])
        x = jnp.sqrt(x[:129] ** 2 + x[129:] ** 2)
        for convolution in self.convolutions:
            x = jax.nn.relu(convolution(x))
        h, c = self.cell(x[:, 0], state)
        return jax.nn.sigmoid(self.out(jax.nn.relu(h)[:, None])).mean(), (h, c)


EQUINOX_PLAN = Plan(
    (
        Rule("transform/weight", "copy", source=":stft_conv.weight"),
        *(
            Rule(f"convolutions/{i}/{leaf}", "copy", source=f":conv{i + 1}.{leaf}", layout=layout)
            for i in range(4)
            for leaf, layout in (("weight", ()), ("bias", ({"reshape": [-1, 1]},)))
        ),
        Rule("cell/weight_{name}", "copy", source=":lstm_cell.weight_{name}"),
        Rule(
            "cell/bias", "copy", source=(":lstm_cell.bias_ih", ":lstm_cell.bias_hh"), layout="add"
        ),
        Rule("out/weight", "copy", source=":final_conv.weight"),
        Rule("out/bias", "copy", source=":final_conv.bias", layout={"reshape": [-1, 1]}),
    ),
    name="Silero's detector in Equinox",
)


class FlaxDetector(linen.Module):
    """The same in Flax: channels last, one kernel for each gate."""

    @linen.compact
    def __call__(self, samples, state):
        x = jnp.pad(samples, (0, 64), mode="reflect")[:, None]
        x = linen.Conv(258, (256,), 128, padding="VALID", use_bias=False, name="transform")(x)
        x = jnp.sqrt(x[:, :129] ** 2 + x[:, 129:] ** 2)
        for i, (size, stride) in enumerate(((128, 1), (64, 2), (64, 2), (128, 1)), start=1):
            x = jax.nn.relu(linen.Conv(size, (3,), stride, padding=1, name=f"conv{i}")(x))
        (c, h), _ = linen.LSTMCell(128, name="cell")(state[::-1], x[0])
        return jax.nn.sigmoid(linen.Dense(1, name="out")(jax.nn.relu(h))).mean(), (h, c)


GATES = {"i": 0, "f": 1, "g": 2, "o": 3}
FLAX_PLAN = Plan(
    (
        Rule(
            "transform/kernel", "copy", source=":stft_conv.weight", layout={"transpose": [2, 1, 0]}
        ),
        Rule("conv{i}/kernel", "copy", source=":conv{i}.weight", layout={"transpose": [2, 1, 0]}),
        Rule("conv{i}/bias", "copy", source=":conv{i}.bias"),
        *(
            Rule(
                f"cell/{side}{gate}/kernel",
                "copy",
                source=f":lstm_cell.weight_{side}h",
                layout=({"split": {"axis": 0, "parts": 4, "index": place}}, "transpose"),
            )
            for gate, place in GATES.items()
            for side in "ih"
        ),
        *(
            Rule(
                f"cell/h{gate}/bias",
                "copy",
                source=(":lstm_cell.bias_ih", ":lstm_cell.bias_hh"),
                layout=("add", {"split": {"axis": 0, "parts": 4, "index": place}}),
            )
            for gate, place in GATES.items()
        ),
        Rule(
            "out/kernel",
            "copy",
            source=":final_conv.weight",
            layout=({"take": {"axis": -1, "index": 0}}, "transpose"),
        ),
        Rule("out/bias", "copy", source=":final_conv.bias"),
    ),
    name="Silero's detector in Flax",
)

NAMES = {
    "stft_conv.weight": (258, 1, 256),
    **{
        f"conv{i}.{leaf}": shape
        for i, (o, n) in enumerate(((128, 129), (64, 128), (64, 64), (128, 64)), start=1)
        for leaf, shape in (("weight", (o, n, 3)), ("bias", (o,)))
    },
    **{f"lstm_cell.weight_{side}h": (512, 128) for side in "ih"},
    **{f"lstm_cell.bias_{side}h": (512,) for side in "ih"},
    "final_conv.weight": (1, 128, 1),
    "final_conv.bias": (1,),
}


def speechlike(count):
    """A tone whose pitch and loudness change, with noise: float32 [count, 576]."""
    time = np.arange(count * 512 + 64) / 16000
    sound = np.sin(2 * np.pi * (120 * time + 40 * np.sin(9 * time))) * (1 + np.sin(25 * time)) / 4
    sound += 0.05 * np.sin(2 * np.pi * 720 * time)
    return np.stack([sound[i * 512 : i * 512 + 576] for i in range(count)]).astype(np.float32)


def detect(step, count=6):
    """The probability of speech in each frame."""
    state = (np.zeros(128, np.float32), np.zeros(128, np.float32))
    found = []
    for frame in speechlike(count):
        probability, state = step(frame, state)
        found.append(float(probability))
    return np.array(found)


def both(source):
    """What the two models say with the weights of a source."""
    target = eqx.filter_jit(EquinoxDetector)(jax.random.key(0))
    model, report = apply(EQUINOX_PLAN, target, source, strict=True)
    module, state = FlaxDetector(), (jnp.zeros(128), jnp.zeros(128))
    shapes = jax.eval_shape(module.init, jax.random.key(0), jnp.zeros(576), state)["params"]
    params, _ = transfer.stream(FLAX_PLAN, shapes, source, strict=True)
    assert len(report.rows) == 14
    return (
        detect(eqx.filter_jit(model)),
        detect(jax.jit(lambda x, state: module.apply({"params": params}, x, state))),
    )


def in_numpy(weights):
    """The detector written out, in float64, from the weights under their own names."""
    w = {name: np.asarray(value, np.float64) for name, value in weights.items()}
    sigmoid = lambda x: 1 / (1 + np.exp(-x))  # noqa: E731

    def convolve(x, name, stride, padding):
        x, kernel = np.pad(x, ((0, 0), (padding, padding))), w[f"{name}.weight"]
        starts = range(0, x.shape[1] - kernel.shape[2] + 1, stride)
        windows = np.stack([x[:, start : start + kernel.shape[2]] for start in starts])
        return (
            np.einsum("tis,ois->ot", windows, kernel) + w.get(f"{name}.bias", np.zeros(1))[:, None]
        )

    h, c, found = np.zeros(128), np.zeros(128), []
    for frame in speechlike(6).astype(np.float64):
        x = convolve(np.pad(frame, (0, 64), mode="reflect")[None], "stft_conv", 128, 0)
        x = np.hypot(x[:129], x[129:])
        for name, stride in (("conv1", 1), ("conv2", 2), ("conv3", 2), ("conv4", 1)):
            x = np.maximum(convolve(x, name, stride, 1), 0)
        gates = w["lstm_cell.weight_ih"] @ x[:, 0] + w["lstm_cell.bias_ih"]
        gates += w["lstm_cell.weight_hh"] @ h + w["lstm_cell.bias_hh"]
        i, f, g, o = np.split(gates, 4)
        c = sigmoid(f) * c + sigmoid(i) * np.tanh(g)
        h = sigmoid(o) * np.tanh(c)
        out = w["final_conv.weight"][0, :, 0] @ np.maximum(h, 0) + w["final_conv.bias"]
        found.append(sigmoid(out)[0])
    return np.array(found)


def test_a_checkpoint_of_its_layout_becomes_models_of_two_libraries(tmp_path):
    made = {name: array(*shape) * 0.1 for name, shape in NAMES.items()}
    transfer.save(tmp_path / "made.safetensors", made)
    with transfer.open_file(tmp_path / "made.safetensors") as source:
        for probabilities in both(source):
            np.testing.assert_allclose(probabilities, in_numpy(made), rtol=1e-3)
    assert np.ptp(probabilities) > 1e-4


def test_the_pretrained_weights_become_models_of_two_libraries():
    found = importlib.util.find_spec("silero_vad")
    if found is None:
        pytest.skip("the package silero-vad, which ships the weights, is not installed")
    file = Path(found.submodule_search_locations[0]) / "data" / "silero_vad_16k.safetensors"
    with transfer.open_file(file) as source:
        assert {name: shape.shape for name, shape in source.shapes.items()} == NAMES
        for probabilities in both(source):
            np.testing.assert_allclose(probabilities, in_numpy(source), atol=1e-4)
    assert probabilities.max() > 0.3
