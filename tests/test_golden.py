"""An update agrees with one written apart in PyTorch: tests/golden/pytorch_reference.py.

That file computes in float64 what this project computes in float32. Its parameters, batches, noise
and results are stored; the project's own draws are replaced by the stored noise.
"""

import functools
import json
from pathlib import Path

import jax
import numpy as np
import optax
import pytest
from numpy.testing import assert_allclose

from dreamer_jax.agent import Agent
from dreamer_jax.config import Config, LearningConfig, NetworkConfig
from dreamer_jax.records import Records

GOLDEN = Path(__file__).parent / "golden"
CASES = ("thesis", "options")
UPDATES = 3


def under(trace, prefix):
    """The arrays of a trace whose names begin with `prefix/`, by the rest of the name."""
    return {
        name[len(prefix) + 1 :]: x for name, x in trace.items() if name.startswith(f"{prefix}/")
    }


def nested(flat):
    """{"a/b": x} -> {"a": {"b": x}}."""
    tree = {}
    for name, x in flat.items():
        *parents, leaf = name.split("/")
        functools.reduce(lambda node, parent: node.setdefault(parent, {}), parents, tree)[leaf] = x
    return tree


def flat(tree):
    """{"a": {"b": x}} -> {"a/b": x}, masked leaves left out."""
    leaves = jax.tree_util.tree_leaves_with_path(tree)
    return {"/".join(str(part.key) for part in path): x for path, x in leaves}


class StoredDraws:
    """Stands in for jax.random.normal and permutation: what is asked for is known by its shape.

    Other shapes are drawn as ever. Flax asks for them as it checks those of parameters, and
    nothing else does, or the numbers would not agree.
    """

    def __init__(self, noise):
        self.original = jax.random.normal
        self.by_shape = {x.shape: name for name, x in noise.items()}
        assert len(self.by_shape) == len(noise)
        self.noise, self.drawn = noise, []

    def normal(self, key, shape=(), *arguments, **options):
        name = self.by_shape.get(tuple(shape))
        if name is None:
            return self.original(key, shape, *arguments, **options)
        self.drawn.append(name)
        return self.noise[name]

    def permutation(self, key, x, *arguments, **options):
        assert x == len(self.noise["starts"])
        self.drawn.append("starts")
        return self.noise["starts"]


@pytest.fixture(scope="module", params=CASES)
def trace(request):
    with np.load(GOLDEN / f"{request.param}.npz") as stored:
        return dict(stored)


@pytest.fixture(scope="module")
def updated(trace):
    """The project's state and metrics after each of the three updates."""
    settings = json.loads(str(trace["settings"]))
    config = Config(NetworkConfig(**settings["network"]), LearningConfig(**settings["learning"]))
    agent = Agent(config, settings["action_size"])
    expected_draws = ["posterior", "prior", "action"]
    if config.learning.imagination_starts is not None:
        expected_draws.append("starts")

    @jax.jit
    def update(state, batch, noise):
        draws = StoredDraws(noise)
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(jax.random, "normal", draws.normal)
            patch.setattr(jax.random, "permutation", draws.permutation)
            result = agent.update(state, batch)
        # All of the noise has a part, and none twice.
        assert sorted(draws.drawn) == sorted(expected_draws)
        return result

    state = jax.device_get(agent.start(nested(under(trace, "start")), seed=0))
    results = []
    for i in range(UPDATES):
        batch = Records(**under(trace, f"batch_{i}"))
        state, metrics = jax.device_get(update(state, batch, under(trace, f"noise_{i}")))
        results.append((state, metrics))
    return results


def test_the_parameters_of_the_trace_are_the_agents(trace, updated):
    shapes = {name: x.shape for name, x in flat(updated[0][0].params).items()}
    assert shapes == {name: x.shape for name, x in under(trace, "start").items()}


def test_losses_agree_to_a_millionth(trace, updated):
    stored = under(trace, "value_0")
    assert {"image_loss", "reward_loss", "kl", "actor_loss", "value_loss"} <= set(stored)
    _, metrics = updated[0]
    for name, value in stored.items():
        assert_allclose(metrics[name], value, rtol=2e-6, atol=2e-6, err_msg=name)


def test_gradients_agree_to_a_hundred_thousandth(trace, updated):
    """Adam's first moments after one update are a tenth of the clipped gradients."""
    settings = json.loads(str(trace["settings"]))["learning"]
    stored, values = under(trace, "gradient"), under(trace, "value_0")
    state, _ = updated[0]
    compared = set()
    for group, optimiser in state.optimisers.items():
        scale = min(1.0, settings["gradient_norm"] / values[f"{group}_gradient_norm"])
        for name, moment in flat(optax.tree.get(optimiser, "mu")).items():
            expected = scale * stored[name]
            error = np.abs(10 * moment - expected).max()
            assert error <= 1e-5 * np.abs(expected).max(), name
            compared.add(name)
    assert compared == set(stored)


def test_parameters_agree_after_three_updates(trace, updated):
    """Adam divides by a gradient's size: where that is next to nothing, its rounding shows."""
    start, end = under(trace, "start"), under(trace, "end")
    errors = []
    for name, x in flat(updated[-1][0].params).items():
        moved = np.abs(end[name] - start[name]).max()
        assert moved > 0, name
        error = np.abs(x - end[name]).ravel() / moved
        assert error.max() < 0.1, name
        errors.append(error)
    assert np.quantile(np.concatenate(errors), 0.999) < 1e-3


def test_losses_agree_in_the_second_and_third_update(trace, updated):
    for i in (1, 2):
        _, metrics = updated[i]
        for name, value in under(trace, f"value_{i}").items():
            assert_allclose(metrics[name], value, rtol=1e-5, atol=1e-5, err_msg=f"{name} {i}")
