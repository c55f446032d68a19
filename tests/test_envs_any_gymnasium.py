"""Gymnasium environments as tasks: their images, actions, rewards and ends; and what is refused."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import envs
from envs.base import Outcome
from envs.gymnasium_simulator import GymnasiumSimulator, resize


def scripted(name):
    return f"gymnasium/fake_gymnasium:Scripted/{name}-v0"


def phase(names, actions, image_size=4, **settings):
    """A phase with actions [T, K, A] of one member; the first reset's time step comes first."""
    env = envs.make(names, image_size=image_size, action_repeat=1, workers=1, **settings)
    assert env.discrete == envs.specs(names)[0].discrete
    keys = jax.random.split(jax.random.key(0), len(names))

    @jax.jit
    def run(actions):
        state, start = jax.vmap(env.reset)(jnp.arange(len(names)), keys)
        _, steps = jax.lax.scan(jax.vmap(env.step), state, actions)
        return jax.tree.map(lambda x, xs: jnp.concatenate([x[None], xs]), start, steps)

    try:
        record = jax.tree.map(np.asarray, run(jnp.asarray(actions, jnp.float32)))
        env.check()
    finally:
        env.close()
    return record


def one_hot(*choices, size):
    return np.eye(size)[list(choices)][:, None]


# Spaces


@pytest.mark.parametrize(
    ("name", "action_size", "discrete", "time_limit"),
    [
        ("Choices", 3, True, 1000),
        ("Cut", 2, True, 3),
        ("Drawn", 2, False, 1000),
        ("Matrix", 6, False, 1000),
    ],
)
def test_a_task_is_described_by_the_environments_spaces(name, action_size, discrete, time_limit):
    task = envs.spec(scripted(name))
    assert (task.action_size, task.discrete, task.time_limit) == (action_size, discrete, time_limit)
    assert task.name == scripted(name) and task.step_seconds == 0.1


def test_a_one_hot_action_is_the_choice_of_its_index_and_a_termination_is_terminal():
    record = phase([scripted("Choices")], one_hot(0, 2, 1, 0, 1, size=3))
    # Choices count from 5; the tick after the end is a reset and ignores its action.
    assert record.reward[:, 0].tolist() == [0, 5, 7, 6, 0, 6]
    assert record.terminal[:, 0].tolist() == [False, False, False, True, False, False]
    assert record.first[:, 0].tolist() == [True, False, False, False, True, False]
    assert record.image[:, 0, 0, 0, 0].tolist() == [0, 10, 20, 30, 0, 10]


def test_an_episode_that_the_environment_truncates_is_cut_and_not_terminal():
    record = phase([scripted("Cut")], one_hot(1, 1, 1, 1, 0, size=2))
    assert not record.terminal.any()
    assert record.first[:, 0].tolist() == [True, False, False, False, True, False]
    assert record.reward[:, 0].tolist() == [0, 1, 1, 1, 0, 0]
    assert record.image[:, 0, 0, 0, 0].tolist() == [0, 10, 20, 30, 0, 10]


def test_continuous_actions_are_scaled_to_the_environments_bounds():
    actions = np.array([[-1, -1], [1, 1], [0, 0], [0.5, -0.5], [7, -7]])[:, None]
    record = phase([scripted("Drawn")], actions)
    # Bounds are [-2, 2] and [0, 10]; beyond them actions are clipped.
    assert record.reward[:, 0].tolist() == [0, -2 + 0, 2 + 10, 0 + 5, 1 + 2.5, 2 + 0]
    assert record.image[:, 0, 0, 0, 0].tolist() == [0, 10, 20, 30, 40, 50], "its pictures"


def test_actions_of_any_shape_are_given_as_one_row():
    simulator = GymnasiumSimulator("fake_gymnasium:Scripted/Matrix-v0", 4)
    simulator.reset(2**100)
    assert simulator.step(np.arange(6) / 8) == Outcome(15 / 8, False, False)
    simulator.close()


def test_a_smaller_discrete_task_reads_its_own_entries_of_a_longer_action():
    names = [scripted("Choices"), scripted("Cut")]
    actions = np.concatenate([one_hot(2, 1, 0, size=3)] * 2, axis=1)
    record = phase(names, actions)
    assert record.reward[1:, 0].tolist() == [7, 6, 5]
    # The second task has two choices: beyond them it takes its first.
    assert record.reward[1:, 1].tolist() == [0, 1, 0]


# Images


def test_an_image_is_resized_by_the_means_of_areas():
    image = np.zeros((4, 8, 3), np.uint8)
    image[:2, :4] = [[[10, 20, 30]]]
    image[0, 0] = [90, 20, 30]
    image[2:, 4:] = 200
    expected = np.zeros((2, 2, 3))
    expected[0, 0] = [(7 * 10 + 90) / 8, 20, 30]
    expected[1, 1] = 200
    np.testing.assert_array_equal(resize(image, 2), expected)


def test_a_small_image_is_enlarged_pixel_by_pixel_and_a_fitting_one_is_left_alone():
    image = np.random.default_rng(0).integers(0, 256, (3, 3, 3), dtype=np.uint8)
    np.testing.assert_array_equal(resize(image, 3), image)
    np.testing.assert_array_equal(resize(image, 6), image.repeat(2, 0).repeat(2, 1))


@pytest.mark.parametrize("shape", [(5, 7), (5, 7, 1)])
def test_grey_images_get_three_equal_channels(shape):
    image = np.random.default_rng(0).integers(0, 256, shape, dtype=np.uint8)
    resized = resize(image, 4)
    assert resized.shape == (4, 4, 3) and resized.dtype == np.uint8
    np.testing.assert_array_equal(resized, resized[..., :1].repeat(3, -1))


# Those that come with gymnasium


@pytest.mark.parametrize("id", ["CartPole-v1", "Pendulum-v1"])
def test_classic_control_is_drawn_without_a_display_and_repeats_itself(id, monkeypatch):
    pytest.importorskip("pygame")
    for name in ("SDL_VIDEODRIVER", "DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(name, raising=False)
    name = f"gymnasium/{id}"
    task = envs.spec(name)
    actions = np.random.default_rng(0).uniform(-1, 1, (40, 1, task.action_size))
    one, other = (phase([name], actions, image_size=32) for _ in range(2))
    for got, again in zip(one, other, strict=True):
        np.testing.assert_array_equal(got, again)
    assert len(np.unique(one.image.reshape(41, -1), axis=0)) > 20, "the pictures move"
    if task.discrete:
        assert one.terminal.any(), "a random pole falls"
        np.testing.assert_array_equal(one.reward, ~one.first)
    else:
        assert (one.reward[1:] < 0).all()


# What is refused


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("gymnasium/CartPol-v1", "Environment `CartPol` doesn't exist.*gymnasium/CartPole-v1"),
        ("gymnasium/CartPole-v9", "version `v9`.*Did you mean gymnasium/CartPole-v1"),
        ("gymnasium/nothing/Here-v0", "Namespace nothing not found"),
        ("gymnasium/", "expected one of bullet/ant, .* or gymnasium/ID"),
        (scripted("Blind"), r"shows no images.*'rgb_array', not \['human'\]"),
        (scripted("Unbounded"), "expected finite bounds"),
        (scripted("Several"), "MultiDiscrete.* expected a Box of floats, or Discrete"),
    ],
)
def test_what_cannot_be_trained_on_is_refused_with_the_way_out(name, message):
    with pytest.raises(ValueError, match=message):
        envs.spec(name)


def test_tasks_of_both_kinds_are_refused_by_name():
    names = ["bullet/hopper", scripted("Choices"), scripted("Drawn")]
    with pytest.raises(
        ValueError, match="Choices-v0 are discrete, those of bullet/hopper, .*Drawn"
    ):
        envs.make(names)


def test_a_missing_module_is_named():
    with pytest.raises(ModuleNotFoundError, match="no_such_module"):
        envs.spec("gymnasium/no_such_module:Thing-v0")


def test_what_an_environment_lacks_for_drawing_is_known_before_any_phase():
    with pytest.raises(ModuleNotFoundError, match='Undrawable.* not installed.*install "brushes"'):
        envs.make([scripted("Undrawable")])
