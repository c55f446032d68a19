"""The six Brax tasks: Brax's physics and rewards, swing-ups, pictures, reproducible to the bit.

P member, K task, T ticks. Physics is compiled here for the pendula and the Hopper; of the other
tasks only models and pictures are looked at (tests/test_ray_casting.py compares both renderers).
"""

import functools
import hashlib
import importlib.util
import os
import signal
import subprocess
import sys
import warnings
from dataclasses import replace
from typing import NamedTuple

import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

import envs
from compilation import QUICK_CODE
from dreamer_jax import device_replay
from dreamer_jax.agent import Agent
from dreamer_jax.config import preset
from dreamer_jax.device_round import whole_round
from dreamer_jax.diagnosis import diagnose
from dreamer_jax.population import update_members, zero_sums
from dreamer_jax.rollout import collect
from envs import SimulatorError, TaskSpec
from envs.bridge import HostEnv
from envs.mixed import MixedEnv
from envs.scene import Geometry, Scene
from golden import brax_reference
from phases import phase_of
from pictures import psnr
from probes import Probe
from runs import random_members
from small_agent import Small
from traces import equations

NAMES = [name for name in envs.task_names() if name.startswith("brax/")]
TITLES = [envs.spec(name).title for name in NAMES]
SWINGUP = "brax/inverted_pendulum"


@pytest.fixture(scope="module")
def brax_pixels():
    return pytest.importorskip("envs.brax_pixels", reason="brax is not installed")


@pytest.fixture(scope="module")
def brax_physics():
    return pytest.importorskip("envs.brax_physics", reason="brax is not installed")


@pytest.fixture(scope="module")
def drawing(brax_pixels):
    """MuJoCo's pictures, where it can draw: looked for after Brax has imported MuJoCo."""
    import envs.mujoco_pictures as module

    try:
        module.pictures("InvertedPendulum", 8)
    except SimulatorError as error:
        pytest.skip(str(error))
    return module


@pytest.fixture(scope="module")
def env(brax_pixels):
    """P = 2 members of the swing-up."""
    made = envs.make([SWINGUP], members=2, image_size=16)
    yield made
    made.close()


@pytest.fixture(scope="module")
def hosted(drawing):
    """The same, in one process that draws."""
    made = envs.make([f"{SWINGUP}:mujoco"], members=2, image_size=16, workers=1)
    yield made
    made.close()


FRESH_PROCESS = f"""
import sys
import envs.brax_pixels
envs.brax_pixels.physics_of("Walker2D", "generalized")
for stream in (sys.stdout, sys.stderr):
    print("imported", file=stream, flush=True)

import hashlib, jax
from phases import phase_of
from pictures import psnr
events = []
jax.monitoring.register_event_listener(lambda event, **_: events.append(event))
env = envs.make([{SWINGUP!r}], members=2, image_size=16)
run = phase_of(env, tasks=1, ticks=30)
leaves = jax.tree.leaves(run(0))
print(hashlib.sha256(b"".join(leaf.tobytes() for leaf in leaves)).hexdigest())
print("from disk:", "/jax/compilation_cache/cache_hits" in events)
# What is not found there, and takes as long as is worth keeping.
print("compiled:", "/jax/compilation_cache/cache_misses" in events)
"""


class Fresh(NamedTuple):
    """What a process told: its status, its lines on both streams, and the files it wrote."""

    status: int
    said: list
    complaints: list
    written: list


@pytest.fixture(scope="module")
def fresh(env, tmp_path_factory) -> Fresh:
    """A process that imports Brax, and then plays a phase that this one has compiled."""
    phase_of(env, tasks=1, ticks=30)(0)
    folder = tmp_path_factory.mktemp("fresh")
    paths = os.pathsep.join(map(os.path.abspath, filter(None, sys.path)))
    process = subprocess.run(
        [sys.executable, "-c", FRESH_PROCESS],
        capture_output=True,
        text=True,
        env=os.environ | {"PYTHONPATH": paths, "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "2"},
        cwd=folder,
    )
    lines = process.stdout.splitlines(), process.stderr.splitlines()
    return Fresh(process.returncode, *lines, list(folder.iterdir()))


def same(one, two) -> bool:
    return jax.tree.all(jax.tree.map(np.array_equal, one, two))


# Names


def test_six_tasks_have_the_sizes_of_pybullets():
    assert [name.replace("brax", "bullet") for name in NAMES] == [
        name for name in envs.task_names() if name.startswith("bullet/")
    ]
    for name in NAMES:
        other = envs.spec(name.replace("brax", "bullet"))
        assert envs.spec(name).action_size == other.action_size
        assert envs.spec(name).time_limit == other.time_limit


def test_engine_and_renderer_are_parts_of_the_name():
    kinds = {
        "brax/hopper": ("generalized", "jax"),
        "brax/hopper@spring": ("spring", "jax"),
        "brax/hopper:mujoco": ("generalized", "mujoco"),
        "brax/hopper@mjx:mujoco": ("mjx", "mujoco"),
        "brax/hopper@mjx:jax": ("mjx", "jax"),
    }
    for name, kind in kinds.items():
        task = envs.spec(name)
        assert (task.physics, task.renderer, task.title) == (*kind, "Hopper")
        assert (task.name, task.gymnasium_id) == (name, "brax_pixels/Hopper-v0")


@pytest.mark.parametrize(
    "name, message",
    [
        ("brax/hopper@sprng", "unknown physics engine 'sprng'.*expected one of generalized, sp"),
        ("brax/hopper@", "unknown physics engine ''"),
        ("brax/hopper:opengl", "unknown renderer 'opengl'.*jax, mujoco: brax/NAME@ENGINE:REND"),
        ("brax/hopper@spring:", "unknown renderer ''"),
        ("brax/hopper:mujoco@spring", "unknown renderer 'mujoco@spring'"),
        ("bullet/hopper@spring", "unknown task 'bullet/hopper@spring'"),
        ("bullet/hopper:mujoco", "unknown task 'bullet/hopper:mujoco'"),
        ("brax/hoper:mujoco", "Did you mean brax/hopper"),
    ],
)
def test_wrong_choices_are_refused(name, message):
    with pytest.raises(ValueError, match=message):
        envs.spec(name)


def test_without_brax_making_a_task_says_what_to_install(tmp_path):
    missing = "raise ModuleNotFoundError(\"No module named 'mujoco'\", name='mujoco')"
    (tmp_path / "mujoco.py").write_text(missing)
    code = (
        f"import sys; sys.path[:0] = [{str(tmp_path)!r}, '.']\n"
        "import envs; assert 'brax/ant' in envs.task_names()\n"
        "try: envs.make(['brax/ant'])\n"
        "except ModuleNotFoundError as error: print(error)"
    )
    said = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert "pip install 'dreamer-transfer[brax]'" in said.stdout, said.stderr


def test_where_nothing_draws_the_error_names_the_packages():
    # Not imported here: MuJoCo reads MUJOCO_GL once, and other tests draw.
    if not all(map(importlib.util.find_spec, ("brax", "mujoco"))):
        pytest.skip("brax is not installed")
    # A platform on which OpenGL is not found, as on a machine without EGL.
    environment = os.environ | {"MUJOCO_GL": "egl", "PYOPENGL_PLATFORM": "osmesa"}
    code = (
        "import envs; from dataclasses import replace; from envs.pool import SimulatorPool\n"
        f"task = replace(envs.spec({SWINGUP!r}), simulator='envs.mujoco_pictures:Drawing')\n"
        "try: SimulatorPool([task], 8, 2, 1, workers=1)\n"
        "except envs.SimulatorError as error: print(error)"
    )
    said = subprocess.run(
        [sys.executable, "-c", code], env=environment, capture_output=True, text=True
    )
    assert said.returncode == 0, said.stderr
    assert "apt-get install libegl1" in said.stdout and "libosmesa6" in said.stdout
    assert "without ':mujoco'" in said.stdout and SWINGUP in said.stdout
    assert "Traceback" not in said.stdout + said.stderr


def test_importing_brax_says_nothing(fresh):
    status, said, complaints, written = fresh
    assert status == 0, complaints
    assert (said[0], complaints[0]) == ("imported", "imported"), "nothing before it"
    assert not written, "no log"


# Physics


@pytest.mark.parametrize("title, name", list(zip(TITLES, NAMES, strict=True)))
def test_an_agent_step_is_about_as_long_as_pybullets(brax_physics, title, name):
    physics = brax_physics.physics_of(title, "generalized")
    task = envs.spec(name)
    assert physics.seconds == pytest.approx(task.step_seconds)
    assert physics.action_size == task.action_size
    bullet = envs.spec(name.replace("brax", "bullet"))
    assert 0.9 <= task.step_seconds / bullet.step_seconds <= 1.25


def test_the_hopper_is_brax_own(brax_physics):
    """The same states, rewards and falls as Brax's environment with actions held as long, in the
    engine that compiles soonest. It is asked once, by Brax's; what ours asks of it is the same."""
    from brax.envs import get_environment

    own = get_environment("hopper", backend="spring", n_frames=8)
    physics = brax_physics.physics_of("Hopper", "spring")
    assert type(physics.env) is type(own)
    assert (physics.env._n_frames, physics.seconds) == (own._n_frames, own.dt)
    assert same(*map(jax.tree.leaves, (physics.env.sys, own.sys)))

    def both(part, brax, ours):
        """What Brax's and our functions return, and what they ask of a part of the engine."""
        engine, asked = getattr(own, part), []

        def ask(*arguments):
            asked.append(arguments)
            return engine(*arguments) if len(asked) == 1 else answer

        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(own, part, ask)
            patch.setattr(physics.env, part, ask)
            theirs = brax()
            answer = theirs.pipeline_state
            mine = ours()
        return theirs, mine, asked

    @jax.jit
    def played(key, actions):
        started = both("pipeline_init", lambda: own.reset(key), lambda: physics.start(key))

        def step(carry, action):
            theirs, mine = carry
            theirs, (mine, reward, terminal), asked = both(
                "pipeline_step",
                lambda: own.step(theirs, action),
                lambda: physics.step(mine, action),
            )
            told = (theirs.pipeline_state.q, theirs.reward, theirs.done), (mine.q, reward, terminal)
            return (theirs, mine), (told, asked)

        return started[2], jax.lax.scan(step, started[:2], actions)[1]

    actions = np.random.default_rng(0).uniform(-1, 1, (30, 3)).astype(np.float32)
    (first, second), ((theirs, mine), (asked, ours)) = played(jax.random.key(0), actions)
    assert same(first, second) and same(asked, ours) and same(theirs, mine)
    falls = np.asarray(mine[2])
    assert falls.any() and not falls.all()


class Moving(NamedTuple):
    """Positions and velocities of joints."""

    q: jax.Array
    qd: jax.Array


@pytest.mark.parametrize("title", ["InvertedPendulum", "InvertedDoublePendulum"])
def test_pendula_start_hanging_and_are_paid_the_cosines(brax_physics, title):
    from envs.brax_episodes import episodes_of

    physics = brax_physics.physics_of(title, "generalized")
    episodes = episodes_of(physics, 1)
    starts = jax.jit(episodes.begin)(jax.random.split(jax.random.key(0), 200))
    assert not np.any(starts.qd)
    offsets = np.asarray(starts.q) - np.array([0, np.pi, 0])[: physics.positions]
    assert not offsets[:, 0].any() and np.abs(offsets).max() <= 0.1
    # The mean and deviation of U(-0.1, 0.1), within four standard errors.
    np.testing.assert_allclose(offsets[:, 1:].mean(0), 0.0, atol=4 * 0.1 / np.sqrt(3 * 200))
    np.testing.assert_allclose(offsets[:, 1:].std(0), 0.1 / np.sqrt(3), rtol=0.15)

    hinges = np.array([[0.0, 0.0], [np.pi, 0.0], [np.pi, np.pi], [np.pi / 2, 0.0]])
    # From each of these, pushed with all there is to one side, then to and fro between the ends of
    # the rail, with periods of 0.3, 0.6, 0.8 and 1 s: as hard as any policy can.
    to_and_fro = (-1.0) ** (np.arange(240) // np.array([[9], [18], [24], [30]]))
    actions = np.concatenate([np.zeros((4, 1)), np.ones((4, 60)), to_and_fro], axis=1)
    actions = np.tile(actions, (4, 1)).T[:, :, None].astype(np.float32)
    positions = np.pad(hinges.repeat(4, axis=0), ((0, 0), (1, 0)))[:, : physics.positions]
    keys, none = jax.random.split(jax.random.key(0), 16), np.zeros(16, bool)

    @functools.partial(jax.jit, compiler_options=QUICK_CODE)
    def pushed(states, actions):
        def step(states, actions):
            states, rewards, terminal = episodes.tick(states, actions, none, keys)
            return states, (states.q, rewards, terminal)

        return jax.lax.scan(step, states, actions)[1]

    at_rest = jax.tree.map(lambda x: np.zeros_like(x[:16]), starts)
    at_rest = at_rest._replace(q=positions.astype(np.float32))
    positions, rewards, terminal = map(np.asarray, pushed(at_rest, actions))
    carts, angles = positions[..., 0], positions[..., 1:]
    np.testing.assert_allclose(rewards, np.cos(angles).sum(-1), atol=1e-3)
    np.testing.assert_allclose(rewards[0], np.cos(at_rest.q[:, 1:]).sum(-1), atol=0.05)
    assert np.abs(angles[:61, 4] - np.pi).max() > 1.6, "the hinge has no stops"
    assert not terminal.any(), "the engine follows, however hard the cart meets the rail's ends"
    assert 1.0 < np.abs(carts).max() < 1.2


@pytest.mark.parametrize("diverged", ["q", "qd"])
def test_a_state_that_is_not_finite_ends_the_episode_before_it(brax_physics, monkeypatch, diverged):
    physics = brax_physics.physics_of("InvertedPendulum", "generalized")
    before = Moving(np.ones(2, np.float32), np.ones(2, np.float32))

    def engine(state, action):
        return state._replace(**{diverged: getattr(state, diverged) * jnp.array([1, jnp.inf])})

    monkeypatch.setattr(physics.env, "pipeline_step", engine)
    after, reward, terminal = jax.jit(physics.step)(before, np.ones(1, np.float32))
    assert terminal and reward == 0
    assert same(after, before)


@pytest.mark.parametrize("title", TITLES)
def test_links_are_where_brax_has_them_and_a_step_moves_them_as_there(brax_physics, title):
    """At random positions and velocities."""
    from envs.brax_chain import Chain
    from envs.brax_forces import Forces

    system = brax_physics.physics_of(title, "generalized").env.sys
    chain = Chain(system)
    forces = Forces(system, chain)

    @jax.jit
    def ours(q, qd, controls):
        places = chain.places(q)
        motions = chain.motions(places, qd)
        return places, motions, forces.moved(q, qd, places, motions, controls)

    q, qd, controls = brax_reference.inputs_of(system)
    brax = brax_reference.reference(title, system)
    places, motions, moved = jax.device_get(ours(q, qd, controls))
    assert len(set(brax["held"].tolist())) > 1, "some are held by what others are not"
    found = {**places._asdict(), **motions._asdict(), "centre": motions.centre[:, None]}
    compared = set(brax) & set(found)
    assert set(brax) - compared == {"held", "q", "qd"}
    for name in compared:
        np.testing.assert_allclose(found[name], brax[name], rtol=1e-4, atol=5e-5, err_msg=name)
    # In units of what a step brings about.
    scale = np.abs(brax["qd"] - qd).max()
    assert scale > 0.1
    np.testing.assert_allclose(moved[1], brax["qd"], rtol=2e-4, atol=2e-4 * scale)
    step = 2e-4 * scale * system.opt.timestep
    np.testing.assert_allclose(moved[0], brax["q"], atol=step + 1e-5)


def test_the_numbers_of_brax_that_are_stored_are_its_own(brax_physics):
    """Of one task: those of the others were written by the same lines."""
    system = brax_physics.physics_of("InvertedPendulum", "generalized").env.sys
    stored = brax_reference.reference("InvertedPendulum", system)
    computed = brax_reference.computed(system)
    assert set(stored) == set(computed)
    for name, numbers in computed.items():
        np.testing.assert_allclose(stored[name], numbers, rtol=1e-4, atol=5e-5, err_msg=name)


@pytest.mark.parametrize("trials", [3, 15])
def test_the_solver_of_constraints_is_that_of_brax(brax_physics, trials):
    """With lengths of a step tried at once that are more or fewer than it may try."""
    import jaxopt

    from envs.brax_forces import solved

    random = np.random.default_rng(0)
    roots = random.normal(size=(6, 10, 7)).astype(np.float32)
    matrices = roots @ roots.swapaxes(1, 2) * np.float32([0.01, 0.1, 1, 5, 5, 20])[:, None, None]
    offsets = random.normal(size=(6, 10)).astype(np.float32)
    # Nothing holds here, so that it is done at once.
    matrices[0], offsets[0] = 0, 0

    @jax.jit
    @jax.vmap
    def brax(matrix, offset):
        return (
            jaxopt.ProjectedGradient(
                lambda x: jnp.sum(0.5 * (matrix @ x + offset) ** 2),
                jaxopt.projection.projection_non_negative,
                maxiter=4,
                implicit_diff=False,
                maxls=trials,
            )
            .run(jnp.zeros(10))
            .params
        )

    found = np.asarray(solved(matrices, offsets, 4, trials))
    expected = np.asarray(brax(matrices, offsets))
    assert (found >= 0).all() and not found[0].any() and np.count_nonzero(found) > 9
    np.testing.assert_allclose(found, expected, rtol=1e-3, atol=1e-5 * np.abs(expected).max())


def test_what_forces_are_not_known_for_is_refused(brax_physics):
    from envs.brax_chain import Chain
    from envs.brax_forces import Forces

    system = brax_physics.physics_of("Hopper", "generalized").env.sys
    chain = Chain(system)
    springs = system.actuator.replace(bias_q=1 + system.actuator.bias_q)
    with pytest.raises(ValueError, match="actuators that are no motors.*expected motors"):
        Forces(system.replace(actuator=springs), chain)
    uneven = system.geom_solref + np.arange(len(system.geom_solref))[:, None]
    with pytest.raises(ValueError, match="2 points of contact, of which 2 .*one set of the solver"):
        Forces(system.tree_replace({"geom_solref": uneven}), chain)


def test_trees_of_other_kinds_are_refused(brax_physics):
    from envs.brax_chain import Chain

    system = brax_physics.physics_of("Hopper", "generalized").env.sys
    with pytest.raises(ValueError, match="links 31f1 with .*expected one root, free or with"):
        Chain(system.replace(link_types="31f1"))


@pytest.mark.parametrize("title", ["InvertedPendulum"])
def test_a_step_written_out_once_is_brax_own(brax_physics, title):
    """Starts, held actions and new starts, against Brax's functions one after another. Falls are
    made up, for a pendulum has none: each of n = 3 slots ends at ticks of its own."""
    from envs.brax_episodes import Episodes, episodes_of

    physics = brax_physics.physics_of(title, "generalized")
    shared, plain = episodes_of(physics, 2), Episodes(physics, 2)
    assert type(shared) is not Episodes
    plain.begin = jax.jit(plain.begin)  # traced once
    # The first tick starts all of them.
    ended = np.array([[1, 1, 1], [0, 0, 0], [0, 1, 0], [1, 0, 0], [1, 0, 0], [0, 0, 0]]) != 0
    keys = jax.random.split(jax.random.key(0), (6, 3))
    actions = np.random.default_rng(0).uniform(-1, 1, (6, 3, physics.action_size))
    actions = actions.astype(np.float32)

    def phase(episodes):
        def tick(states, inputs):
            states, rewards, terminal = episodes.tick(states, *inputs)
            state = episodes.physics_state(states)
            return states, (state.q, state.qd, *jax.vmap(physics.poses)(state), rewards, terminal)

        nothing = jax.tree.map(jnp.zeros_like, jax.eval_shape(episodes.begin, keys[0]))
        return jax.lax.scan(tick, nothing, (actions, ended, keys))[1]

    results = [
        jax.tree.map(np.asarray, jax.jit(phase, static_argnums=0)(x)) for x in (shared, plain)
    ]
    jax.tree.map(lambda x, y: np.testing.assert_allclose(x, y, atol=2e-4), *results)
    *_, rewards, terminal = results[0]
    assert not terminal.any() and not rewards[ended].any() and rewards[~ended].all()


# The environment


def test_a_phase_hangs_at_first_and_repeats_to_the_bit_after_others(env):
    phase = phase_of(env, tasks=1, ticks=30)
    start, record = phase(0)
    assert start.first.all() and not start.reward.any()
    assert not record.first.any() and not record.terminal.any()
    assert (record.reward[:2] < -1.97).all(), "hanging, two environment steps a tick"
    assert (record.reward[:, 0] != record.reward[:, 1]).any(), "members have keys of their own"
    others = phase(1)
    assert not same(others, (start, record))
    assert same(phase(0), (start, record))


def test_a_step_from_before_a_phase_is_its_reset(env):
    """Whatever the action; the tick after it too."""
    slots, keys = np.arange(2), jax.random.split(jax.random.key(0), 2)
    actions = np.array([[0.5], [-1.0]], np.float32)
    reset, before, step = (jax.jit(jax.vmap(x)) for x in (env.reset, env.before, env.step))
    state, start = reset(slots, keys)
    other, begun = step(before(slots, keys), actions)
    after, later = (step(x, actions)[1] for x in (state, other))
    for name in ("slot", "key", "episode", "ended"):
        np.testing.assert_array_equal(getattr(state, name), getattr(other, name))
    assert start.first.all() and not after.first.any()
    for one, two in ((start, begun), (after, later)):
        np.testing.assert_array_equal(one.first, two.first)
        np.testing.assert_allclose(one.reward, two.reward, atol=1e-5)
        assert psnr(one.image, two.image).min() > 40


def test_both_renderers_show_the_same_phase(env, hosted):
    one, other = (
        jax.tree.map(lambda x: x[:10], phase_of(made, tasks=1, ticks=30)(0)[1])
        for made in (env, hosted)
    )
    np.testing.assert_allclose(one.reward, other.reward, atol=1e-4)
    assert psnr(one.image, other.image).mean() > 35


def test_environments_say_whether_they_have_a_host(env, hosted):
    assert not env.has_host and hosted.has_host
    assert MixedEnv([env, hosted], [[0], [1]], 2).has_host
    assert not MixedEnv([env, env], [[0], [1]], 2).has_host


@pytest.fixture(scope="module")
def programs(brax_pixels):
    """What a run of P = 1 compiles, by name: of both pendula the round that is one program, by an
    agent of one number; of agents with networks the phase of the four other tasks, the update and
    the diagnosis."""
    pendula = [SWINGUP, "brax/inverted_double_pendulum"]
    made = envs.make(pendula, members=1, image_size=32)
    held = jax.eval_shape(lambda: device_replay.empty(1, 2, 42, 32, 1))
    drawn, number = (jax.ShapeDtypeStruct(shape, jnp.int32) for shape in ((4, 1, 2), ()))
    seeds, mapped = np.arange(1), {"mapping": "auto", "chunk": 1}

    def started(kind):
        agent = kind(preset("debug"), 1)
        state = jax.eval_shape(jax.vmap(agent.init), seeds)
        return agent, state, jax.eval_shape(lambda: zero_sums(agent, state, 2, 5))

    def records(*lead):
        return jax.tree.map(lambda x: jax.ShapeDtypeStruct((*lead, *x.shape[3:]), x.dtype), held)

    others = [name for name in NAMES if name not in pendula]
    walkers = envs.make(others, members=1, image_size=32)
    padded = Agent(preset("debug"), walkers.action_size)
    params = random_members(padded, [0])

    def phases(params, updates, number, mode):
        return collect(
            padded, walkers, params, seeds, updates, number, tasks=4, ticks=20, mode=mode
        )

    agent, *state = started(Agent)
    small, *smalls_state = started(Small)
    return {
        "round": whole_round.trace(
            small, made, *smalls_state, held, seeds, number, number, number, (drawn, drawn),
            ticks=20, length=5, **mapped,
        ),
        "collect": jax.jit(phases).trace(params, state[0].updates, number, number),
        "update": update_members.trace(agent, *state, records(1, 2, 5), **mapped),
        "diagnose": diagnose.trace(agent, state[0].params, records(1, 2, 21), seeds, number),
    }  # fmt: skip


@pytest.mark.parametrize("name", ["round", "collect", "update", "diagnose"])
def test_no_program_of_a_run_calls_the_host(programs, name):
    found = [x.primitive.name for x in equations(programs[name].jaxpr.jaxpr)]
    assert not [name for name in found if "callback" in name] and len(found) > 100


def test_a_whole_round_of_several_tasks_is_one_program_that_reuses_its_memory(programs):
    """Collecting, storing, sampling and updating."""
    program = programs["round"].lower().as_text()
    assert program.count("func.func public") == 1
    assert "jax.buffer_donor" in program or "tf.aliasing_output" in program


def test_no_host_is_part_of_a_phase_unless_mujoco_draws(env, hosted):
    def program(made):
        return phase_of(made, tasks=1, ticks=30).phase.lower(jax.random.key(0))

    assert "callback" in program(hosted).as_text()
    assert "callback" not in program(env).compile().as_text()


@pytest.mark.parametrize("renderer", ["jax", "mujoco"])
@pytest.mark.parametrize("size", [7, 32.0], ids=str)
def test_image_sizes_that_nothing_can_be_seen_in_are_refused(brax_pixels, renderer, size):
    with pytest.raises(ValueError, match=f"image size of {size}, expected a whole number of at l"):
        envs.make([f"{SWINGUP}:{renderer}"], image_size=size)


@pytest.mark.parametrize("size", [7, 32.0, True], ids=str)
def test_gymnasium_environments_refuse_them_as_they_are_made(size):
    with pytest.raises(ValueError, match=f"image size of {size}, expected a whole number of at l"):
        gymnasium.make("brax_pixels/Hopper-v0", image_size=size)


def test_a_phase_is_the_same_in_a_fresh_process_which_finds_it_on_disk(env, fresh):
    leaves = jax.tree.leaves(phase_of(env, tasks=1, ticks=30)(0))
    expected = hashlib.sha256(b"".join(leaf.tobytes() for leaf in leaves)).hexdigest()
    lines = ["imported", expected, "from disk: True", "compiled: False"]
    assert fresh.said == lines, fresh.complaints


@pytest.fixture
def counting(brax_pixels, brax_physics, monkeypatch):
    """Environments of physics known by hand: an episode of task "Ant" ends with its 3rd step, of
    any other with its 5th; the reward is the first action, what is drawn moves with the steps."""

    class State(NamedTuple):
        q: jax.Array
        steps: jax.Array

    class Counting(brax_physics.Physics):
        action_size, positions, backend = 1, 2, "counted"

        def __init__(self, title, backend):
            self.end = 3 if title == "Ant" else 5

        def start(self, key):
            return State(jax.random.uniform(key, (2,)), jnp.int32(0))

        def step(self, state, action):
            steps = state.steps + 1
            return State(jnp.array([0.0, 1.0]) * steps, steps), action[0], steps == self.end

        def poses(self, state):
            return jnp.zeros((1, 3)).at[0, 2].set(0.2 * state.steps), jnp.array([[1.0, 0, 0, 0]])

    monkeypatch.setattr(brax_pixels, "physics_of", Counting)
    ball = Scene((Geometry("sphere", (0.4, 0.0, 0.0), (1.0, 0.0, 0.0), link=0),))
    monkeypatch.setattr(brax_pixels, "task_scene", lambda title: ball)
    pendulum = replace(envs.spec(SWINGUP), simulator="envs.mujoco_pictures:Drawing")
    monkeypatch.setattr(brax_pixels, "_drawing", lambda task: replace(pendulum, action_size=2))
    made = []

    def make(kind, *names, members=1, repeat=1, size=8, supersample=1):
        tasks = [replace(envs.spec(name), supersample=supersample) for name in names]
        made.append(getattr(brax_pixels, kind)(tasks, members, size, repeat, 2, workers=1))
        return made[-1]

    yield make
    for one in made:
        one.close()


KINDS = ["BraxEnv", "HostDrawnBraxEnv"]


@pytest.fixture(params=KINDS)
def kind(request):
    if request.param == "HostDrawnBraxEnv":
        request.getfixturevalue("drawing")
    return request.param


def test_the_action_is_held_up_to_a_fall_and_the_next_tick_resets(counting, kind):
    env = counting(kind, "brax/ant", repeat=2)
    actions = np.array([[1.0, 9], [0.5, 9], [7.0, 9], [-2.0, 9]], np.float32)

    @jax.jit
    def phase(key):
        return jax.lax.scan(env.step, env.reset(0, key)[0], actions)

    state, record = phase(jax.random.key(0))
    env.check()
    assert record.reward.tolist() == [2.0, 0.5, 0.0, -4.0]
    assert record.terminal.tolist() == [False, True, False, False]
    assert record.first.tolist() == [False, False, True, False]
    assert (state.episode, state.ended) == (1, 0)


def test_each_slot_plays_its_own_task_in_any_order_and_number(counting, kind):
    env = counting(kind, "brax/ant", "brax/hopper", members=2)

    @jax.jit
    def phase(slots, keys):
        state, _ = jax.vmap(env.reset)(slots, keys)
        actions = jnp.broadcast_to(slots[:, None] + 1.0, (6, len(slots), 2))
        return jax.lax.scan(jax.vmap(env.step), state, actions)[1]

    for slots in ([2, 1, 3, 0], [1, 2]):
        record = phase(np.array(slots), jax.random.split(jax.random.key(0), len(slots)))
        record = jax.tree.map(np.asarray, record)
        env.check()
        for column, slot in enumerate(slots):
            ends = 3 if slot % 2 == 0 else 5
            assert np.argmax(record.terminal[:, column]) == ends - 1
            assert np.argmax(record.first[:, column]) == ends
            np.testing.assert_array_equal(record.reward[:ends, column], slot + 1.0)


def test_pictures_show_the_state_after_a_tick_and_after_a_reset(counting):
    env = counting("BraxEnv", "brax/ant")

    @jax.jit
    def phase(key):
        state, start = env.reset(0, key)
        return start.image, *jax.lax.scan(env.step, state, jnp.zeros((5, 2)))[1].image

    start, *images = map(np.asarray, phase(jax.random.key(0)))
    rows = [np.flatnonzero((image < 255).any((1, 2))).mean() for image in (start, *images)]
    assert rows[0] > rows[1] > rows[2] > rows[3] < rows[4] == rows[0], "it rises, and is put back"
    assert rows[5] == rows[1]


def test_pictures_are_averaged_from_larger_ones(counting):
    def image(**sizes):
        env = counting("BraxEnv", "brax/ant", **sizes)
        return np.asarray(jax.jit(lambda key: env.reset(0, key)[1].image)(jax.random.key(0)))

    blocks = image(size=16).reshape(8, 2, 8, 2, 3).astype(int).sum((1, 3))
    np.testing.assert_array_equal(image(size=8, supersample=2), (blocks + 2) // 4)


def test_without_a_host_what_cannot_be_simulated_gives_no_numbers(counting):
    env = counting("BraxEnv", "brax/ant", "brax/hopper", members=1)
    keys = jax.random.split(jax.random.key(0), 2)
    reset = jax.jit(jax.vmap(env.reset))
    for slots, spoilt in [([1, 1], True), ([0, 2], True), ([1, 0], False)]:
        assert np.isnan(reset(np.array(slots), keys)[1].reward).all() == spoilt
    states, _ = reset(np.arange(2), keys)
    actions = np.array([[np.nan, 0.0], [0.5, 0.0]], np.float32)
    stepped = jax.jit(jax.vmap(env.step))(states, actions)[1]
    np.testing.assert_array_equal(stepped.reward, [np.nan, 0.5])


def test_slots_that_are_alike_or_missing_are_refused(hosted):
    env = hosted
    keys = jax.random.split(jax.random.key(0), 2)
    reset = jax.jit(jax.vmap(env.reset))
    for slots, message in [([1, 1], "some are alike"), ([0, 2], "expected 0 to 1")]:
        reset(np.array(slots), keys)
        with pytest.raises(SimulatorError, match=message):
            env.check()


def test_an_action_that_is_not_finite_is_an_error_naming_slot_and_task(counting, drawing):
    env = counting("HostDrawnBraxEnv", "brax/ant")

    @jax.jit
    def played(key):
        return env.step(env.reset(0, key)[0], jnp.array([jnp.nan, 0.0]))

    played(jax.random.key(0))
    with pytest.raises(SimulatorError, match=r"slot 0 \(brax/ant\) got an action that is not fin"):
        env.check()


def test_a_dead_renderer_is_reported_and_does_not_hang(counting, drawing):
    env = counting("HostDrawnBraxEnv", "brax/ant", members=2)
    process = env._pool._workers[0].process
    process.kill()
    process.wait()
    jax.jit(jax.vmap(env.reset))(np.arange(2), jax.random.split(jax.random.key(0), 2))
    with pytest.raises(SimulatorError, match=f"{process.pid} .*signal {signal.SIGKILL:d}"):
        env.check()


# Beside other simulators


@pytest.mark.parametrize("slots", [[5, 0, 4, 1, 3, 2], [4, 2, 3]], ids=str)
def test_tasks_of_several_kinds_play_as_they_do_alone(slots):
    """K = 3 tasks by P = 2 members: a probe, a simulator on the host, and another probe."""
    fake = TaskSpec("fake/falling", "Falling", 2, "fake_simulators:Falling", "")
    probes, host = Probe(2, 4), HostEnv([fake], 2, 4, 1, 2, workers=1)
    mixed = MixedEnv([probes, host], [[0, 2], [1]], members=2)
    # The words of keys.
    keys = np.array([[0, slot] for slot in slots], np.uint32)

    @functools.partial(jax.jit, static_argnums=0)
    def played(env, slots, keys):
        state, start = jax.vmap(env.reset)(slots, keys)
        actions = jnp.full((12, len(slots), 2), 0.25)
        return start, jax.lax.scan(jax.vmap(env.step), state, actions)[1]

    def phase(env, slots, keys):
        start, record = played(env, np.array(slots), keys)
        return envs.TimeStep(
            *(np.concatenate([x[None], xs]) for x, xs in zip(start, record, strict=True))
        )

    together = phase(mixed, slots, keys)
    mixed.check()
    for column, slot in enumerate(slots):
        env = host if slot % 3 == 1 else probes
        alone = phase(env, [slot // 3], keys[column : column + 1])
        assert same(jax.tree.map(lambda x, c=column: x[:, c], together), _first(alone))
    host.check()
    host.close()


def _first(record):
    return jax.tree.map(lambda x: np.asarray(x)[:, 0], record)


def test_an_error_of_one_kind_is_raised_by_check():
    class Broken(Probe):
        def check(self):
            raise SimulatorError("broken")

    mixed = MixedEnv([Probe(2, 4), Broken(2, 4)], [[0], [1]], members=1)
    with pytest.raises(SimulatorError, match="broken"):
        mixed.check()


# Pictures


def silhouette(image) -> np.ndarray:
    """Left, right, top and bottom of what is not white, as shares of the picture's size."""
    drawn = (image < 200).any(-1)
    rows, columns = np.flatnonzero(drawn.any(1)), np.flatnonzero(drawn.any(0))
    return np.array([columns[0], columns[-1], rows[0], rows[-1]]) / len(image)


@pytest.mark.parametrize("title", TITLES)
def test_pictures_are_drawn_as_the_joints_say_before_a_white_sky(drawing, title):
    pictures = drawing.pictures(title, 64)
    rest = pictures.draw(pictures.positions)
    assert rest.shape == (64, 64, 3) and rest.dtype == np.uint8
    assert (rest[0, 0] == 255).all() and (rest[0, -1] == 255).all()
    bent = pictures.positions + 0.3 * (np.arange(len(pictures.positions)) >= 3)
    bent[1] += 0.3 * ("Pendulum" in title)
    assert (pictures.draw(bent) != rest).any()
    assert (pictures.draw(pictures.positions) == rest).all(), "whatever was drawn before"


@pytest.mark.parametrize("title", ["Hopper", "Walker2D", "InvertedPendulum"])
def test_the_camera_follows_a_walker_and_stays_with_a_pendulum(drawing, title):
    pictures = drawing.pictures(title, 64)
    away = pictures.positions.copy()
    away[0] = 0.5
    moved = silhouette(pictures.draw(away)) - silhouette(pictures.draw(pictures.positions))
    if "Pendulum" in title:
        assert moved[0] == 0 and np.abs(moved).max() <= 2 / 64, "the rail stays where it is"
        # A row of pixels just above the rail.
        cart = np.flatnonzero((pictures.draw(away)[30] < 200).any(-1)).mean()
        # Half a metre at a distance of 2 m, where the picture is 2.31 m wide.
        assert cart / 64 == pytest.approx(0.5 + 0.5 / 2.31, abs=0.06)
    else:
        assert np.abs(moved).max() <= 1 / 64


@pytest.mark.parametrize("title", ["Hopper", "Walker2D", "InvertedPendulum"])
def test_bodies_are_where_pybullet_shows_them(drawing, title):
    bullet = pytest.importorskip("envs.bullet").BulletSimulator(title, 64)
    bullet.reset(0)
    pictures = drawing.pictures(title, 64)
    positions = pictures.positions.copy()
    positions[1] += np.pi * (title == "InvertedPendulum")
    brax = silhouette(pictures.draw(positions))
    np.testing.assert_allclose(brax, silhouette(bullet.render()), atol=4 / 64)
    bullet.close()


# Gymnasium


def test_the_pendulums_known_levels_are_what_constant_actions_bring(brax_pixels):
    levels = dict(envs.spec(SWINGUP).levels)
    simulator = brax_pixels.BraxSimulator("InvertedPendulum", 32, "generalized", "jax")
    for name, action in (("no action", 0.0), ("constant action", 1.0)):
        simulator.reset(seed=3)
        total = sum(simulator.step(np.array([action])).reward for _ in range(1000))
        assert abs(total - levels[name]) < 15, name
    assert envs.spec(f"{SWINGUP}:mujoco").levels == envs.spec(SWINGUP).levels
    assert not envs.spec(f"{SWINGUP}@spring").levels, "another engine brings other returns"


@pytest.mark.parametrize("title", TITLES)
def test_gymnasium_ids_have_the_spaces_of_the_task(brax_physics, title):
    with gymnasium.make(f"brax_pixels/{title}-v0", image_size=32) as env:
        size = brax_physics.physics_of(title, "generalized").action_size
        assert env.observation_space == gymnasium.spaces.Box(0, 255, (32, 32, 3), np.uint8)
        assert env.action_space == gymnasium.spaces.Box(-1, 1, (size,), np.float32)


def test_gymnasium_simulators_of_both_renderers_look_alike(drawing):
    def image(renderer):
        task = envs.spec(f"{SWINGUP}:{renderer}")
        env = gymnasium.make(task.gymnasium_id, task=task, image_size=64)
        return env.reset(seed=0)[0]

    assert psnr(image("jax"), image("mujoco")) > 28


def test_gymnasiums_checker_has_nothing_to_say_and_seeds_repeat(brax_pixels):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        env = gymnasium.make("brax_pixels/InvertedPendulum-v0", image_size=32)
        check_env(env.unwrapped, skip_render_check=True)

    def episode(seed):
        images, rewards = [env.reset(seed=seed)[0]], []
        for step in range(10):
            image, reward, *_ = env.step(np.float32([(-1) ** step]))
            images.append(image)
            rewards.append(reward)
        return np.array(images), np.array(rewards)

    first = episode(0)
    assert not same(episode(1), first)
    assert same(episode(0), first)
    env.close()
