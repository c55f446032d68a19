"""The six PyBullet tasks: reproducible to the bit, rewards, cameras, and how they are named."""

import hashlib
import subprocess
import sys
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import envs
from envs.base import Outcome
from envs.pool import SimulatorPool
from envs.wrappers import ActionPadding, ActionRepeat, TimeLimit, averaged

NAMES = [name for name in envs.task_names() if name.startswith("bullet/")]
LOCOMOTION = [name for name in NAMES if "pendulum" not in name]


@pytest.fixture
def simulator(request):
    """A simulator of the task that the test is parametrized with, after its first reset."""
    bullet = pytest.importorskip("envs.bullet")
    made = bullet.BulletSimulator(envs.spec(request.param).title, 32)
    made.reset(seed=5)
    yield made
    made.close()


def for_tasks(names):
    return pytest.mark.parametrize("simulator", names, indirect=True)


def client_of(simulator):
    return simulator._env._p


def joint_indices(client):
    """Body and joint index of every joint, by name."""
    return {
        client.getJointInfo(body, joint)[1].decode(): (body, joint)
        for body in range(client.getNumBodies())
        for joint in range(client.getNumJoints(body))
    }


# Names


def test_six_tasks_are_listed_with_their_action_sizes():
    assert {name: envs.spec(name).action_size for name in NAMES} == {
        "bullet/ant": 8,
        "bullet/halfcheetah": 6,
        "bullet/hopper": 3,
        "bullet/walker2d": 6,
        "bullet/inverted_pendulum": 1,
        "bullet/inverted_double_pendulum": 1,
    }


def test_an_unknown_task_is_refused_with_the_choices_and_the_nearest():
    with pytest.raises(ValueError, match="bullet/ant, .*Did you mean bullet/hopper") as error:
        envs.spec("bullet/hoper")
    assert all(name in str(error.value) for name in NAMES)
    with pytest.raises(ValueError, match="unknown task 'atari/pong'"):
        envs.make(["bullet/hopper", "atari/pong"])


@pytest.mark.parametrize(
    "arguments, message",
    [
        (dict(tasks="bullet/ant"), "string 'bullet/ant', expected a list"),
        (dict(tasks=[]), "at least one task"),
        (dict(tasks=["bullet/ant"], members=0), "members=0, expected at least 1"),
        (dict(tasks=["bullet/ant"], image_size=0), "image_size=0, expected at least 1"),
        (dict(tasks=["bullet/ant"], action_repeat=0), "action_repeat=0, expected at least 1"),
        (dict(tasks=["bullet/ant"], workers=0), "workers=0, expected at least 1"),
        (dict(tasks=["bullet/hopper", "bullet/ant"], action_size=3), "the largest needs 8"),
    ],
)
def test_bad_numbers_are_refused_before_any_process_is_started(arguments, message):
    with pytest.raises(ValueError, match=message):
        envs.make(**arguments)


def test_importing_the_package_imports_neither_jax_nor_pybullet():
    code = (
        "import sys, envs; assert envs.task_names(); "
        "assert not {'jax', 'pybullet', 'pybullet_envs_gymnasium'} & set(sys.modules)"
    )
    subprocess.run([sys.executable, "-c", code], check=True)


def test_without_pybullet_making_a_task_says_what_to_install(tmp_path, monkeypatch):
    missing = "raise ModuleNotFoundError(\"No module named 'pybullet'\", name='pybullet')"
    (tmp_path / "pybullet.py").write_text(missing)
    monkeypatch.syspath_prepend(tmp_path)
    with pytest.raises(ModuleNotFoundError, match=r"pip install 'dreamer-transfer\[bullet\]'"):
        envs.make(["bullet/ant"])


# Reproducible to the bit


def phase_digests(pool: SimulatorPool, seed: int, ticks: int = 24) -> list[str]:
    """For each slot, a digest of all that a phase of random actions gave."""
    slots = np.arange(len(pool.tasks))
    keys = np.full((len(slots), 2), seed, np.uint32)
    actions = np.random.default_rng(seed).uniform(-1, 1, (ticks, len(NAMES), 8))
    actions = actions.astype(np.float32)[:, slots % len(NAMES)]
    record = [pool.reset(slots, keys), *(pool.step(slots, action) for action in actions)]
    assert sum(time_step.first for time_step in record).min() >= 3, "every simulator fell twice"
    return [
        hashlib.sha256(
            b"".join(np.ascontiguousarray(leaf[slot]) for step in record for leaf in step)
        ).hexdigest()
        for slot in slots
    ]


def test_a_phase_with_falls_repeats_to_the_bit_in_fresh_processes_and_after_other_episodes():
    pytest.importorskip("envs.bullet")
    tasks = [replace(envs.spec(name), simulator="fake_simulators:falling_bullet") for name in NAMES]
    pools = [SimulatorPool(tasks, 32, 8, 2, workers=2), SimulatorPool(tasks * 2, 32, 8, 2, 1)]
    try:
        expected = phase_digests(pools[0], seed=1)
        assert len(set(expected)) == len(NAMES)
        others = phase_digests(pools[0], seed=2)
        assert not set(others) & set(expected)
        assert phase_digests(pools[0], seed=1) == expected, "after other episodes"
        assert phase_digests(pools[1], seed=1) == 2 * expected, "elsewhere, among others"
    finally:
        for pool in pools:
            pool.close()


# Rewards and ends


@for_tasks(["bullet/inverted_pendulum"])
def test_the_pendulum_starts_hanging_and_is_paid_the_cosine_of_its_angle(simulator):
    client = client_of(simulator)
    hinge = joint_indices(client)["hinge"]
    assert abs(client.getJointState(*hinge)[0] - np.pi) <= 0.1
    for _ in range(5):
        outcome = simulator.step([0.0])
        assert outcome == Outcome(pytest.approx(np.cos(client.getJointState(*hinge)[0])), False)
        assert -1 <= outcome.reward < -0.99
    client.resetJointState(*hinge, 0.0)
    assert simulator.step([0.0]).reward == pytest.approx(1.0, abs=1e-3)


@for_tasks(["bullet/inverted_double_pendulum"])
def test_the_double_pendulum_starts_hanging_and_is_paid_both_cosines(simulator):
    client = client_of(simulator)
    joints = joint_indices(client)
    starts = []
    for seed in range(200):
        simulator.reset(seed)
        starts.append([client.getJointState(*joints[name])[0] for name in ("hinge", "hinge2")])
    offsets = np.array(starts) - [np.pi, 0.0]
    assert np.abs(offsets).max() <= 0.1
    # The mean and deviation of U(-0.1, 0.1), within four standard errors.
    np.testing.assert_allclose(offsets.mean(0), 0.0, atol=4 * 0.1 / np.sqrt(3 * 200))
    np.testing.assert_allclose(offsets.std(0), 0.1 / np.sqrt(3), rtol=0.15)

    for hinge, hinge2, reward in [(np.pi, 0, 0), (0, 0, 2), (np.pi, np.pi, -2), (0, np.pi, 0)]:
        client.resetJointState(*joints["hinge"], hinge)
        client.resetJointState(*joints["hinge2"], hinge2)
        assert simulator.step([0.0]).reward == pytest.approx(reward, abs=0.01)


@for_tasks([name for name in NAMES if name not in LOCOMOTION])
def test_pendula_never_end_however_they_are_pushed(simulator):
    assert not any(simulator.step([(-1.0) ** (i // 7)]).terminal for i in range(1100))


@for_tasks(["bullet/hopper", "bullet/walker2d"])
def test_walkers_end_by_falling(simulator):
    rng = np.random.default_rng(0)
    actions = rng.uniform(-1, 1, (200, *simulator._env.action_space.shape))
    outcomes = [simulator.step(action) for action in actions]
    assert any(outcome.terminal for outcome in outcomes)
    assert not any(outcome.truncated for outcome in outcomes)


@pytest.mark.parametrize("name", NAMES)
def test_actions_are_clipped_to_one(name):
    bullet = pytest.importorskip("envs.bullet")
    task = envs.spec(name)
    rewards = []
    for size in (1.0, 5.0):
        simulator = bullet.BulletSimulator(task.title, 16)
        simulator.reset(seed=7)
        action = np.full(task.action_size, size)
        rewards.append([simulator.step(action).reward for _ in range(5)])
        simulator.close()
    assert rewards[0] == rewards[1]


@pytest.mark.parametrize("name", NAMES)
def test_the_declared_sizes_are_those_of_the_simulator(name):
    bullet = pytest.importorskip("envs.bullet")
    task = envs.spec(name)
    simulator = bullet.BulletSimulator(task.title, 16)
    simulator.reset(seed=0)
    assert simulator._env.action_space.shape == (task.action_size,)
    assert simulator._env.scene.dt == task.step_seconds
    simulator.close()


# Pictures


@for_tasks(NAMES)
def test_the_camera_looks_from_two_metres_along_y_at_its_target(simulator):
    import pybullet

    client = client_of(simulator)
    for _ in range(10):
        simulator.step(np.ones(simulator._env.action_space.shape))
    if simulator._env.action_space.shape == (1,):
        target = np.array(client.getBasePositionAndOrientation(1)[0])
    else:
        target = np.array(client.getLinkState(1, 0)[0])
    rgba = client.getCameraImage(
        32,
        32,
        viewMatrix=client.computeViewMatrix(target - [0, 2, 0], target, [0, 0, 1]),
        projectionMatrix=client.computeProjectionMatrixFOV(60, 1, 1, 25),
        shadow=1,
        lightDirection=[0, 1, 1],
        renderer=pybullet.ER_TINY_RENDERER,
    )[2].reshape(32, 32, 4)
    expected = np.where(rgba[..., 3:] > 0, rgba[..., :3], 255)
    image = simulator.render()
    assert image.dtype == np.uint8
    # The two view matrices differ by rounding, which may tip a pixel on an edge.
    assert (image != expected).any(-1).mean() < 0.01


@for_tasks(NAMES)
def test_the_picture_shows_a_body_before_a_white_sky(simulator):
    image = simulator.render()
    assert (image[0, 0] == 255).all() and (image[0, -1] == 255).all()
    saturated = np.ptp(image[10:22].astype(int), axis=-1) > 60
    assert 0.01 < saturated.mean() < 0.9


# Wrappers


class Script:
    """A simulator that follows a list of (reward, terminal) and remembers its actions."""

    def __init__(self, *outcomes):
        self.outcomes, self.actions, self.resets = list(outcomes), [], []

    def reset(self, seed):
        self.resets.append(seed)

    def step(self, action):
        self.actions.append(list(action))
        return Outcome(*self.outcomes.pop(0))


def test_action_repeat_holds_the_action_and_stops_at_the_end_of_the_episode():
    script = Script((1.0, False), (2.0, False), (4.0, True), (8.0, False))
    repeated = ActionRepeat(script, 2)
    assert repeated.step([0.5]) == Outcome(3.0, False)
    assert repeated.step([-1.0]) == Outcome(4.0, True)
    assert script.actions == [[0.5], [0.5], [-1.0]]


def test_a_time_limit_counts_environment_steps_inside_of_an_action_repeat():
    limited = ActionRepeat(TimeLimit(Script(*[(1.0, False)] * 6), 3), 2)
    for _ in range(2):
        limited.reset(0)
        assert limited.step([0.0]) == Outcome(2.0, False, truncated=False)
        assert limited.step([0.0]) == Outcome(1.0, False, truncated=True)


def test_padded_actions_reach_the_simulator_without_their_padding():
    script = Script((0.0, False))
    ActionPadding(script, 2).step(np.array([0.1, 0.2, 0.3]))
    assert script.actions == [[0.1, 0.2]]


# All of it, through the bridge


def test_a_population_of_two_tasks_runs_under_jit_scan_and_nested_vmap():
    pytest.importorskip("envs.bullet")
    members, ticks = 2, 30
    env = envs.make(["bullet/inverted_pendulum", "bullet/hopper"], members, image_size=32)
    assert (env.action_size, env.image_size, env.discrete) == (3, 32, False)

    @jax.jit
    def phase(key):
        slots = jnp.arange(2 * members).reshape(members, 2)
        state, start = jax.vmap(jax.vmap(env.reset))(slots, jax.random.split(key, slots.shape))
        actions = jax.random.uniform(key, (ticks, members, 2, 3), minval=-1, maxval=1)
        return start, jax.lax.scan(jax.vmap(jax.vmap(env.step)), state, actions)[1]

    start, record = jax.tree.map(np.asarray, phase(jax.random.key(0)))
    env.check()
    env.close()
    assert record.image.shape == (ticks, members, 2, 32, 32, 3)
    assert start.first.all() and not start.reward.any()
    pendulum = jax.tree.map(lambda x: x[:, :, 0], record)
    hopper = jax.tree.map(lambda x: x[:, :, 1], record)
    assert not pendulum.first.any() and not pendulum.terminal.any()
    assert (pendulum.reward[:3] < -1.97).all(), "hanging, two environment steps a tick"
    assert hopper.terminal.any(0).all(), "random hoppers fall"
    np.testing.assert_array_equal(hopper.first[1:], hopper.terminal[:-1])
    assert not hopper.reward[hopper.first].any()
    assert (start.image[0] != start.image[1]).any(), "members have keys of their own"


def test_no_time_limit_ends_a_phase():
    pytest.importorskip("envs.bullet")
    env = envs.make(["bullet/inverted_pendulum"], image_size=8)

    @jax.jit
    def phase(key):
        return jax.lax.scan(env.step, env.reset(0, key)[0], jnp.zeros((510, 1)))[1]

    record = phase(jax.random.key(0))
    env.check()
    env.close()
    assert not np.any(record.first) and not np.any(record.terminal)


# Supersampling


def test_a_block_of_pixels_becomes_its_mean_rounded_half_up():
    image = np.zeros((4, 2, 3), np.uint8)
    image[:2, :, 0] = [[255, 255], [255, 0]]
    image[2:, :, 1] = [[1, 1], [0, 0]]
    small = averaged(image, 2)
    assert small.shape == (2, 1, 3) and small.dtype == np.uint8
    assert small[:, 0].tolist() == [[191, 0, 0], [0, 1, 0]]
    np.testing.assert_array_equal(averaged(image, 1), image)


def test_supersampled_pictures_are_the_means_of_larger_ones():
    pytest.importorskip("envs.bullet")
    pictures = {}
    for size, factor in ((128, 1), (32, 4)):
        env = envs.make(["bullet/inverted_pendulum"], image_size=size, supersample=factor)
        try:
            _, start = jax.jit(env.reset)(0, jax.random.key(0))
            env.check()
        finally:
            env.close()
        pictures[factor] = np.asarray(start.image)
    assert pictures[4].shape == (32, 32, 3)
    np.testing.assert_array_equal(pictures[4], averaged(pictures[1], 4))
    assert len(np.unique(pictures[4])) > len(np.unique(averaged(pictures[1][::4, ::4], 1)))


def test_a_factor_below_one_is_refused():
    with pytest.raises(ValueError, match="got supersample=0, expected at least 1"):
        envs.make(["bullet/hopper"], supersample=0)


def test_the_pendulums_known_levels_are_what_constant_actions_bring():
    bullet = pytest.importorskip("envs.bullet")
    levels = dict(envs.spec("bullet/inverted_pendulum").levels)
    for name, action in (("no action", 0.0), ("constant action", 1.0)):
        simulator = bullet.BulletSimulator("InvertedPendulum", 32)
        simulator.reset(seed=3)
        total = sum(simulator.step(np.array([action])).reward for _ in range(1000))
        simulator.close()
        assert abs(total - levels[name]) < 15, name
