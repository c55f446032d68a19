"""The PyBullet tasks under their gymnasium ids, for any other agent to train on."""

import hashlib
import subprocess
import sys
import warnings

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

import envs

pytest.importorskip("pybullet_envs_gymnasium")

NAMES = [name for name in envs.task_names() if name.startswith("bullet/")]
IDS = [envs.spec(name).gymnasium_id for name in NAMES]


def test_the_ids_are_those_of_the_readme():
    assert IDS == [
        "bullet_pixels/Ant-v0",
        "bullet_pixels/HalfCheetah-v0",
        "bullet_pixels/Hopper-v0",
        "bullet_pixels/Walker2D-v0",
        "bullet_pixels/InvertedPendulum-v0",
        "bullet_pixels/InvertedDoublePendulum-v0",
    ]


@pytest.mark.parametrize("id", IDS)
def test_gymnasiums_checker_has_nothing_to_say(id):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        env = gymnasium.make(id, image_size=32, render_mode="rgb_array")
        check_env(env.unwrapped)


@pytest.mark.parametrize("id", IDS)
def test_spaces_are_pixels_and_actions_of_the_task(id):
    with gymnasium.make(id) as env:
        task = next(t for t in map(envs.spec, NAMES) if t.gymnasium_id == id)
        assert env.observation_space == gymnasium.spaces.Box(0, 255, (64, 64, 3), np.uint8)
        assert env.action_space == gymnasium.spaces.Box(-1, 1, (task.action_size,), np.float32)


def episode_digest(env: gymnasium.Env, seed: int, steps: int = 12) -> str:
    """A digest of the images and rewards of two episodes from `reset(seed=seed)` on."""
    digest = hashlib.sha256()
    rng = np.random.default_rng(seed)
    for episode in range(2):
        image, _ = env.reset(seed=seed if episode == 0 else None)
        digest.update(image.tobytes())
        for _ in range(steps):
            action = rng.uniform(-1, 1, env.action_space.shape).astype(np.float32)
            image, reward, terminated, _, _ = env.step(action)
            digest.update(image.tobytes() + np.float64(reward).tobytes())
            if terminated:
                break
    return digest.hexdigest()


FRESH_PROCESS = """
import gymnasium, envs
from test_envs_gymnasium import IDS, episode_digest
for id in reversed(IDS):
    print(id, episode_digest(gymnasium.make(id, image_size=32), seed=1))
"""


def test_seeded_episodes_repeat_to_the_bit_after_other_episodes_and_in_a_fresh_process():
    made = {id: gymnasium.make(id, image_size=32) for id in IDS}
    first = {id: episode_digest(env, seed=1) for id, env in made.items()}
    other = {id: episode_digest(env, seed=2) for id, env in made.items()}
    again = {id: episode_digest(env, seed=1) for id, env in made.items()}
    for env in made.values():
        env.close()
    assert again == first
    assert all(other[id] != first[id] for id in IDS)
    path = f"import sys; sys.path[:0] = {[p for p in sys.path if p]}\n"
    fresh = subprocess.run(
        [sys.executable, "-c", path + FRESH_PROCESS], capture_output=True, text=True, check=True
    )
    lines = [line.split() for line in fresh.stdout.splitlines() if line.startswith("bullet_pixels")]
    assert dict(lines) == first


def test_an_action_is_held_and_its_rewards_are_summed():
    twice = gymnasium.make("bullet_pixels/HalfCheetah-v0", image_size=16)
    once = gymnasium.make("bullet_pixels/HalfCheetah-v0", image_size=16, action_repeat=1)
    twice.reset(seed=0), once.reset(seed=0)
    for _ in range(5):
        action = twice.action_space.sample()
        image, reward, *_ = twice.step(action)
        (_, reward_1, *_), (image_2, reward_2, *_) = once.step(action), once.step(action)
        assert reward == reward_1 + reward_2
        np.testing.assert_array_equal(image, image_2)
    twice.close(), once.close()


@pytest.mark.parametrize("action_repeat, steps", [(2, 500), (3, 334)])
def test_episodes_are_truncated_after_a_thousand_environment_steps(action_repeat, steps):
    id = "bullet_pixels/InvertedPendulum-v0"
    with gymnasium.make(id, image_size=4, action_repeat=action_repeat) as env:
        env.reset(seed=0)
        ends = [env.step(env.action_space.sample())[2:4] for _ in range(steps)]
    assert ends == [(False, False)] * (steps - 1) + [(False, True)]


def test_a_fall_terminates_and_the_next_reset_starts_over():
    with gymnasium.make("bullet_pixels/Hopper-v0", image_size=16) as env:
        env.reset(seed=0)
        ends = [False]
        while not ends[-1]:
            *_, terminated, truncated, _ = env.step(np.ones(3, np.float32))
            assert not truncated
            ends.append(terminated)
        assert len(ends) < 100
        env.reset()
        assert not env.step(np.zeros(3, np.float32))[2]


def test_an_action_that_is_not_finite_is_refused():
    with gymnasium.make("bullet_pixels/Hopper-v0", disable_env_checker=True) as env:
        env.reset(seed=0)
        with pytest.raises(ValueError, match="bullet/hopper got an action that is not finite"):
            env.step(np.array([0, np.nan, 0], np.float32))
