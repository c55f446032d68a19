"""The host bridge: JAX's transformations, one callback a tick, and what happens on failure.

P member, K task, T ticks. The simulators are fakes whose outputs are known (`fake_simulators`).
"""

import functools
import gc
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from contextlib import contextmanager
from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_array_equal

from dreamer_jax import rollout
from dreamer_jax.config import preset
from dreamer_jax.records import Records
from envs import SimulatorError, TaskSpec
from envs.bridge import HostEnv, Token
from envs.pool import hosted_slots
from small_agent import Small

KEY = jax.random.key(0)


def keys_of(*shape) -> np.ndarray:
    """The words of keys, no two alike: uint32 [..., 2]."""
    return np.arange(2 * np.prod(shape), dtype=np.uint32).reshape(*shape, 2)


def fake(simulator: str, action_size: int = 2) -> TaskSpec:
    return TaskSpec(
        name=f"fake/{simulator.lower()}",
        title=simulator,
        action_size=action_size,
        simulator=f"fake_simulators:{simulator}",
        gymnasium_id="",
    )


@contextmanager
def env_of(*tasks: TaskSpec, members: int = 1, action_repeat: int = 1, workers=1, **options):
    action_size = max(task.action_size for task in tasks)
    env = HostEnv(tasks, members, 4, action_repeat, action_size, workers, **options)
    try:
        yield env
    finally:
        env.close()


@pytest.fixture(scope="module")
def population():
    """P = 3 members of K = 2 tasks of 2 and 3 actions, in 2 processes."""
    with env_of(fake("Counting", 2), fake("Falling", 3), members=3, workers=2) as env:
        yield env


class Programs(NamedTuple):
    """`reset` and `step` of an environment, compiled: of one slot, and mapped over several."""

    reset: Callable
    step: Callable
    resets: Callable
    steps: Callable


@functools.cache
def programs(env) -> Programs:
    return Programs(*map(jax.jit, (env.reset, env.step, jax.vmap(env.reset), jax.vmap(env.step))))


def member(state, *slots):
    """The states at these places of the leading axis."""
    return jax.tree.map(lambda x: np.asarray(x)[np.array(slots)], state)


def seed_pixels(images) -> np.ndarray:
    return np.asarray(images)[..., 0, 0, :]


def steps_shown(images) -> np.ndarray:
    return np.asarray(images)[..., 3, 3, 0]


@pytest.mark.parametrize("jit", [True, False], ids=["jitted", "eager"])
def test_one_slot_can_be_reset_and_stepped(population, jit):
    played = programs(population) if jit else population
    state, start = played.reset(np.int32(0), KEY)
    state, then = played.step(state, np.float32([0.25, 0.5, 9.0]))
    population.check()
    assert start.image.dtype == jnp.uint8 and start.image.shape == (4, 4, 3)
    assert start.reward.dtype == jnp.float32 and start.reward == 0.0
    assert bool(start.first) and not start.terminal
    assert then.reward == 0.75 and steps_shown(then.image) == 1
    assert not then.first and not then.terminal


def test_scan_makes_one_tick_after_another_in_order(population):
    @jax.jit
    def phase(key):
        state, _ = population.reset(jnp.int32(0), key)
        actions = jnp.arange(12.0).reshape(6, 2) @ jnp.eye(2, 3)
        return jax.lax.scan(population.step, state, actions)

    _, time_steps = phase(KEY)
    population.check()
    assert steps_shown(time_steps.image).tolist() == [1, 2, 3, 4, 5, 6]
    assert time_steps.reward.tolist() == [1, 5, 9, 13, 17, 21]


def test_what_a_callback_gives_is_kept_apart_from_what_keeps_it(population):
    """XLA for NVIDIA cards ends the process where a scan's array and a token share a fusion."""

    def play(slot, key):
        state, _ = population.reset(slot, key)
        return jax.lax.scan(lambda *x: population.step(x[0], jnp.zeros(3)), state, length=2)[1]

    lines = jax.jit(jax.vmap(play, (0, None))).lower(jnp.arange(6), KEY).as_text().splitlines()
    calls = [number for number, line in enumerate(lines) if "callback" in line and "call" in line]
    assert len(calls) == 2
    for number in calls:
        result = lines[number].split("=")[0].split(":")[0].strip()
        assert f"optimization_barrier {result}#1, {result}#2" in lines[number + 1]


def test_after_a_fall_the_next_tick_resets_and_ignores_its_action(population):
    @jax.jit
    def phase(key):
        state, start = population.reset(jnp.int32(1), key)
        _, then = jax.lax.scan(population.step, state, jnp.ones((8, 3)))
        return start, then

    start, then = phase(KEY)
    population.check()
    assert then.terminal.tolist() == [False, False, True, False, False, False, True, False]
    assert then.first.tolist() == [False, False, False, True, False, False, False, True]
    assert then.reward.tolist() == [3, 3, 3, 0, 3, 3, 3, 0]
    assert steps_shown(then.image).tolist() == [1, 2, 3, 0, 1, 2, 3, 0]
    seeds = seed_pixels(np.concatenate([start.image[None], then.image]))[[0, 4, 8]]
    assert len(np.unique(seeds, axis=0)) == 3, "each episode has a seed of its own"


def test_nested_vmap_inside_scan_makes_one_host_call_a_tick(population, monkeypatch):
    batches = []
    step = population._pool.step
    monkeypatch.setattr(
        population._pool,
        "step",
        lambda slots, actions: batches.append(slots.tolist()) or step(slots, actions),
    )

    @jax.jit
    def phase(keys):
        slots = jnp.arange(6).reshape(3, 2)
        state, _ = jax.vmap(jax.vmap(population.reset))(slots, keys)
        actions = jnp.broadcast_to(jnp.arange(6.0).reshape(3, 2, 1), (5, 3, 2, 3))
        return jax.lax.scan(jax.vmap(jax.vmap(population.step)), state, actions)

    _, time_steps = phase(keys_of(3, 2))
    population.check()
    assert batches == [[0, 1, 2, 3, 4, 5]] * 5
    assert time_steps.image.shape == (5, 3, 2, 4, 4, 3)
    # Task 0 reads two of three actions, task 1 all three.
    assert np.asarray(time_steps.reward)[0].tolist() == [[0, 3], [4, 9], [8, 15]]


def test_vmap_over_any_axis_reaches_the_same_simulators(population):
    slots, keys = np.arange(6).reshape(3, 2), keys_of(3, 2)

    @jax.jit
    def mapped(slots, keys):
        by_rows = jax.vmap(jax.vmap(population.reset))
        by_columns = jax.vmap(jax.vmap(population.reset), in_axes=1, out_axes=1)
        return by_rows(slots, keys)[0], *by_columns(slots, keys)

    rows, columns, start = mapped(slots, keys)
    population.check()
    assert columns.slot.tolist() == rows.slot.tolist() == slots.tolist()
    again = programs(population).resets(slots.ravel(), keys.reshape(6, 2))[1]
    np.testing.assert_array_equal(np.reshape(start.image, again.image.shape), again.image)


def test_slots_that_rest_are_not_simulated_and_the_others_go_on_as_before(population, monkeypatch):
    @jax.jit
    def phase(keys):
        state, start = jax.vmap(population.reset)(jnp.arange(6), keys)
        step = jax.vmap(population.step, in_axes=(0, None))
        return start, jax.lax.scan(lambda s, _: step(s, jnp.ones(3)), state, None, 4)[1]

    def chosen(found, slots):
        start, ticks = found
        return jax.tree.map(lambda x: x[slots], start), jax.tree.map(lambda x: x[:, slots], ticks)

    def played(keys):
        return jax.tree.map(np.asarray, phase(keys))

    keys, asked = keys_of(6), []
    whole = played(keys)
    request = population._pool._request
    monkeypatch.setattr(
        population._pool,
        "_request",
        lambda command, slots, rest: asked.append(slots.tolist()) or request(command, slots, rest),
    )
    population.rest(np.array([0, 0, 1, 1, 0, 0], bool))
    start, ticks = played(keys)
    population.check()
    assert asked == [[0, 1, 4, 5]] * 5
    others = np.array([0, 1, 4, 5])
    found = chosen((start, ticks), others)
    jax.tree.map(np.testing.assert_array_equal, found, chosen(whole, others))
    # A phase of one that rests has one episode, in which nothing happens.
    assert start.first.all() and not ticks.first[:, 2:4].any()
    for values in (ticks.image, ticks.reward, ticks.terminal):
        assert not values[:, 2:4].any()
    population.rest(np.ones(6, bool))
    assert not played(keys)[1].image.any() and len(asked) == 5
    population.rest(np.zeros(6, bool))
    jax.tree.map(np.testing.assert_array_equal, played(keys), whole)
    with pytest.raises(ValueError, match=r"\(5,\) slots, expected \(6,\)"):
        population.rest(np.zeros(5, bool))


def test_one_shared_key_still_gives_every_member_its_own_simulator(population):
    @jax.jit
    def phase(key):
        reset = jax.vmap(population.reset, in_axes=(0, None))
        state, start = reset(jnp.array([0, 2, 4]), key)
        state, _ = jax.vmap(population.step)(state, jnp.zeros((3, 3)))
        # Only the first member goes on.
        ahead, _ = population.step(jax.tree.map(lambda x: x[0], state), jnp.zeros(3))
        state = jax.tree.map(lambda x, y: x.at[0].set(y), state, ahead)
        return start, jax.vmap(population.step)(state, jnp.zeros((3, 3)))[1]

    start, last = phase(KEY)
    population.check()
    assert len(np.unique(seed_pixels(start.image), axis=0)) == 1, "one key, one seed"
    assert steps_shown(last.image).tolist() == [3, 2, 2], "three simulators"


def test_actions_alone_may_be_shared(population):
    state, _ = programs(population).resets(np.array([0, 2]), keys_of(2))
    step = jax.jit(jax.vmap(population.step, in_axes=(0, None)))
    _, time_step = step(state, np.float32([1, 2, 4]))
    population.check()
    assert time_step.reward.tolist() == [3, 3]


def test_a_subset_of_slots_leaves_the_others_where_they_were(population):
    _, _, resets, steps = programs(population)
    state, _ = resets(np.arange(6), keys_of(6))
    member_1 = member(state, 2, 3)
    for _ in range(2):
        member_1, _ = steps(member_1, np.zeros((2, 3)))
    state = jax.tree.map(
        lambda x, y: np.concatenate([x[:2], y, x[4:]]), member(state, *range(6)), member_1
    )
    _, time_step = steps(state, np.zeros((6, 3)))
    population.check()
    assert steps_shown(time_step.image).tolist() == [1, 1, 3, 3, 1, 1]


def test_of_several_programs_each_plays_its_own_members_and_what_is_beyond_them_rests():
    """P = 3 members, 2 programs: members 0 and 1, and member 2 with one that is none."""
    with env_of(fake("Counting"), members=3, workers=2, shards=2) as env:
        for first in (0, 2):
            state, _ = programs(env).resets(np.arange(first, first + 2), keys_of(2))
            _, step = programs(env).steps(state, np.ones((2, 2)))
            env.check()
            assert step.reward.tolist() == [2.0, 2.0 if first == 0 else 0.0]
            assert steps_shown(step.image).tolist() == [1, 1 if first == 0 else 0]
        env.rest(np.array([True, False, False]))
        with pytest.raises(ValueError, match=r"expected \(3,\) \(3 members x 1 tasks\)"):
            env.rest(np.zeros(4, bool))


@pytest.mark.parametrize("workers", [1, 2, 5])
def test_programs_have_workers_of_their_own_as_far_as_there_are_any(workers):
    tasks = [fake("Counting"), fake("Falling")] * 5
    hosted = [set(slots) for slots in hosted_slots(tasks, workers, share=4)]
    assert len(hosted) == workers and set().union(*hosted) == set(range(10))
    programs = [{slot // 4 for slot in slots} for slots in hosted]
    assert max(len(of_one) for of_one in programs) == {1: 3, 2: 2, 5: 1}[workers]


def test_no_worker_of_a_program_with_fewer_members_is_without_a_slot():
    hosted = hosted_slots([fake("Counting")] * 7, workers=7, share=3)
    assert hosted == [[0], [1], [2], [3, 5], [4], [6]]


def test_workers_host_what_is_said_and_programs_ask_for_the_slots_of_their_members():
    tasks = fake("Counting"), fake("Falling")
    with env_of(*tasks, members=3, workers=3, shards=2) as env:
        hosted = [sorted(worker.tasks) for worker in env._pool._workers]
    assert hosted == hosted_slots(tasks * 3, workers=3, share=4)
    assert [{slot // 4 for slot in slots} for slots in hosted] == [{0}, {0}, {1}]


@pytest.mark.parametrize("workers", [1, 2])
def test_programs_that_play_at_once_do_not_mix_up_replies(workers):
    with env_of(fake("Counting"), members=4, workers=workers, shards=2) as env:
        pool, seen = env._pool, {}

        def play(program):
            slots = np.arange(2 * program, 2 * program + 2)
            pool.reset(slots, np.zeros((2, 2), np.uint32))
            actions = np.full((2, 2), program, np.float32)
            seen[program] = [pool.step(slots, actions) for _ in range(50)]

        threads = [threading.Thread(target=play, args=(program,)) for program in (0, 1)]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
    for program in (0, 1):
        assert [x.reward.tolist() for x in seen[program]] == [[2.0 * program] * 2] * 50
        assert [steps_shown(x.image).tolist() for x in seen[program]] == [
            [count, count] for count in range(1, 51)
        ]


def test_a_phase_depends_on_its_key_alone(population):
    @jax.jit
    def phase(key):
        state, start = population.reset(jnp.int32(1), key)
        return start, jax.lax.scan(population.step, state, jnp.ones((9, 3)))[1]

    first, other, again = phase(KEY), phase(jax.random.key(1)), phase(KEY)
    population.check()
    jax.tree.map(np.testing.assert_array_equal, first, again)
    assert (seed_pixels(first[0].image) != seed_pixels(other[0].image)).any()


@pytest.mark.parametrize("make_key", [jax.random.PRNGKey, jax.random.key], ids=["raw", "typed"])
def test_raw_and_typed_keys_seed_alike(population, make_key):
    _, time_step = programs(population).reset(0, make_key(3))
    _, expected = programs(population).reset(0, jax.random.key(3))
    population.check()
    np.testing.assert_array_equal(time_step.image, expected.image)


def test_keys_of_another_generator_work_too(population):
    keys = jax.random.wrap_key_data(np.arange(8, dtype=np.uint32).reshape(2, 4), impl="rbg")
    _, time_step = programs(population).resets(np.array([0, 2]), keys)
    population.check()
    one, other = seed_pixels(time_step.image)
    assert (one != other).any()


def test_rewards_are_summed_over_the_action_repeat_up_to_a_fall():
    with env_of(fake("Falling"), action_repeat=2) as env:

        @jax.jit
        def phase(key):
            return jax.lax.scan(env.step, env.reset(0, key)[0], jnp.ones((4, 2)))[1]

        time_steps = phase(KEY)
        env.check()
        assert time_steps.reward.tolist() == [4, 2, 0, 4]
        assert time_steps.terminal.tolist() == [False, True, False, False]


def test_a_state_that_was_stepped_before_is_refused(population):
    reset, step, *_ = programs(population)
    state, _ = reset(0, KEY)
    step(state, np.zeros(3))
    step(state, np.zeros(3))
    with pytest.raises(SimulatorError, match=r"slot 0 \(fake/counting\).* state of tick \d+.*once"):
        population.check()


def test_a_state_from_before_a_reset_is_refused(population):
    reset, step, *_ = programs(population)
    old, _ = reset(0, KEY)
    reset(0, KEY)
    step(old, np.zeros(3))
    with pytest.raises(SimulatorError, match="can be stepped once"):
        population.check()


def test_a_slot_that_was_never_reset_is_refused():
    with env_of(fake("Counting")) as env:
        programs(env).step(Token(np.int32(0), np.int32(0)), np.zeros(2))
        with pytest.raises(SimulatorError, match="before any reset"):
            env.check()


def test_a_slot_that_does_not_exist_is_refused(population):
    programs(population).reset(6, KEY)
    with pytest.raises(SimulatorError, match=r"\[6\], expected 0 to 5 \(3 members x 2 tasks\)"):
        population.check()


def test_mapping_over_keys_but_not_over_slots_is_refused(population):
    jax.jit(jax.vmap(population.reset, in_axes=(None, 0)))(0, keys_of(2))
    with pytest.raises(SimulatorError, match="map over slots"):
        population.check()


def test_batches_without_vmap_are_refused(population):
    with pytest.raises(ValueError, match=r"slots of shape \(3,\).*jax.vmap"):
        population.reset(np.arange(3), keys_of(3))
    state, _ = programs(population).reset(0, KEY)
    with pytest.raises(ValueError, match=r"shape \(2,\), expected \(3,\)"):
        population.step(state, jnp.zeros(2))


def test_an_action_that_is_not_finite_is_an_error_naming_slot_and_task(population):
    state, _ = programs(population).resets(np.array([0, 3]), keys_of(2))
    _, time_step = programs(population).steps(state, np.array([[0, 0, 0], [0, 0, np.nan]]))
    with pytest.raises(SimulatorError, match=r"slot 3 \(fake/falling\).*not finite.*nan"):
        population.check()
    assert not np.any(time_step.image) and not np.any(time_step.reward)


def test_after_an_error_ticks_are_zero_until_check_and_a_reset_mends_it(population):
    reset = programs(population).reset
    reset(9, KEY)
    _, lost = reset(0, KEY)
    assert not np.any(lost.image) and not lost.first
    with pytest.raises(SimulatorError, match="expected 0 to 5"):
        population.check()
    population.check()
    _, found = reset(0, KEY)
    population.check()
    assert np.any(found.image) and found.first


def test_an_exception_in_a_worker_arrives_with_its_traceback():
    with env_of(fake("Counting"), fake("Failing"), workers=2) as env:
        _, _, resets, steps = programs(env)
        state, _ = resets(np.arange(2), keys_of(2))
        images = []
        for _ in range(4):
            state, time_step = steps(state, np.zeros((2, 2)))
            images.append(np.asarray(time_step.image))
        assert images[0].any() and not np.any(images[1:])
        with pytest.raises(SimulatorError) as error:
            env.check()
        assert "slot 1, fake/failing" in str(error.value)
        assert "ArithmeticError: the contact solver diverged" in str(error.value)
        # The processes live on: the other task, and this one anew.
        state, _ = resets(np.arange(2), keys_of(2))
        _, time_step = steps(state, np.ones((2, 2)))
        env.check()
        assert time_step.reward.tolist() == [2, 2]


def test_a_worker_that_ends_is_reported_with_its_task_and_last_words():
    with env_of(fake("Dying"), fake("Counting"), workers=2) as env:
        _, _, resets, steps = programs(env)
        state, _ = resets(np.arange(2), keys_of(2))
        for _ in range(3):
            state, _ = steps(state, np.zeros((2, 2)))
        with pytest.raises(SimulatorError) as error:
            env.check()
        assert "fake/dying (slots [0]) ended with exit code 7" in str(error.value)
        assert "corrupted contact list" in str(error.value)
        resets(np.arange(2), keys_of(2))
        with pytest.raises(SimulatorError, match="exit code 7"):
            env.check()


def test_a_worker_killed_between_ticks_is_reported_and_does_not_hang():
    with env_of(fake("Counting"), members=2, workers=1) as env:
        state, _ = programs(env).resets(np.arange(2), keys_of(2))
        os.kill(env._pool._workers[0].process.pid, signal.SIGKILL)
        programs(env).steps(state, np.zeros((2, 2)))
        with pytest.raises(SimulatorError, match=r"fake/counting \(slots \[0, 1\]\).*signal 9"):
            env.check()


def test_a_worker_killed_in_the_middle_of_a_tick_is_reported_and_does_not_hang():
    with env_of(fake("Stuck")) as env:
        state, _ = programs(env).reset(0, KEY)
        pid = env._pool._workers[0].process.pid
        killer = subprocess.Popen([sys.executable, "-c", KILL_AFTER_A_SECOND, str(pid)])
        began = time.monotonic()
        jax.block_until_ready(programs(env).step(state, np.zeros(2)))
        with pytest.raises(SimulatorError, match="fake/stuck.*signal 9"):
            env.check()
        assert time.monotonic() - began < 20
        killer.wait()


def test_a_worker_whose_connection_outlives_it_is_reported_too():
    with env_of(fake("Orphaning")) as env:
        state, _ = programs(env).reset(0, KEY)
        began = time.monotonic()
        programs(env).step(state, np.zeros(2))
        with pytest.raises(SimulatorError, match="fake/orphaning.*exit code 7"):
            env.check()
        assert time.monotonic() - began < 15


KILL_AFTER_A_SECOND = "import os, sys, time; time.sleep(1); os.kill(int(sys.argv[1]), 9)"


def test_workers_ignore_the_interrupt_that_is_meant_for_the_training():
    with env_of(fake("Counting")) as env:
        os.kill(env._pool._workers[0].process.pid, signal.SIGINT)
        time.sleep(0.1)
        programs(env).reset(0, KEY)
        env.check()
        assert env._pool._workers[0].process.poll() is None


def test_an_interrupted_wait_does_not_mix_up_later_replies(monkeypatch):
    def interrupted(*_, **__):
        raise KeyboardInterrupt

    with env_of(fake("Slow")) as env:
        reset, step, *_ = programs(env)
        state, _ = reset(0, KEY)
        env.check()
        with monkeypatch.context() as context:
            context.setattr("envs.pool.wait", interrupted)
            step(state, np.ones(2))
            with pytest.raises(KeyboardInterrupt):
                env.check()
        state, start = reset(0, KEY)
        _, then = step(state, 2 * np.ones(2))
        env.check()
        assert start.first and start.reward == 0
        assert not then.first and then.reward == 4


def test_workers_import_no_jax():
    with env_of(fake("Modules")) as env:
        state, _ = programs(env).reset(0, KEY)
        _, time_step = programs(env).step(state, np.zeros(2))
        env.check()
        assert time_step.reward == 0


def test_there_are_never_more_workers_than_slots_and_each_task_is_spread_over_them():
    tasks = [fake("Counting"), fake("Falling")] * 2
    for slots in hosted_slots(tasks, workers=2, share=4):
        assert sorted(tasks[slot].name for slot in slots) == ["fake/counting", "fake/falling"]
    with env_of(fake("Counting"), workers=8) as env:
        assert len(env._pool._workers) == 1


@pytest.mark.skipif(not Path("/proc/self/fd").exists(), reason="reads /proc")
def test_a_simulator_that_cannot_be_imported_is_an_error_and_leaves_nothing_open():
    gc.collect()  # of what earlier tests left
    files = len(os.listdir("/proc/self/fd"))
    with pytest.raises(SimulatorError, match="slot 0, fake/missing, .*no attribute 'Missing'"):
        HostEnv([fake("Missing")], 2, 4, 1, 2, workers=2)
    gc.collect()
    assert len(os.listdir("/proc/self/fd")) <= files


def test_workers_end_when_the_environment_is_closed_and_it_says_so_afterwards():
    with env_of(fake("Counting"), members=2, workers=2) as env:
        processes = [worker.process for worker in env._pool._workers]
    assert all(process.poll() == 0 for process in processes)
    env.close()
    programs(env).reset(0, KEY)
    with pytest.raises(SimulatorError, match="closed"):
        env.check()


def played(env) -> Records:
    """A phase of 4 ticks by 2 members."""
    agent, seeds = Small(preset("debug"), 2), jnp.arange(2, dtype=jnp.int32)
    records = rollout.collect(
        agent, env, {"actor": {"value": jnp.ones(2)}}, seeds, seeds, jnp.int32(0), tasks=1, ticks=4,
        mode="explore",
    )  # fmt: skip
    records = jax.tree.map(np.asarray, records)
    env.check()
    return records


def test_environments_made_one_after_the_other_share_the_program_of_a_phase():
    with env_of(fake("Counting"), members=2) as counting:
        assert not played(counting).terminal.any()
        with env_of(fake("Falling"), members=2) as beside:
            falls = played(beside).terminal
            assert falls[:, 0].tolist() == [[False, False, False, True, False]] * 2
            # Each has its own simulators, and so its own program, while both are open.
            assert not played(counting).terminal.any()
            assert counting.program is not beside.program
        programs = rollout._collect._cache_size()
    with env_of(fake("Falling"), members=2) as first, env_of(fake("Counting"), members=2) as second:
        assert_array_equal(played(first).terminal, falls)
        assert not played(second).terminal.any()
    assert rollout._collect._cache_size() == programs


def test_an_environment_that_is_closed_plays_no_other_ones_simulators():
    with env_of(fake("Counting"), members=2) as env:
        played(env)
    with env_of(fake("Falling"), members=2) as other:
        played(other)
        with pytest.raises(SimulatorError, match="closed"):
            played(env)
        assert played(other).terminal.any()


SCRIPT_WITHOUT_GUARD = """
import os, signal, sys, time
import jax, jax.numpy as jnp
from test_bridge import fake, keys_of
from envs.bridge import HostEnv
env = HostEnv([fake("Counting")], 2, 4, 1, 2, workers=2)

@jax.jit
def tick(keys):
    state, _ = jax.vmap(env.reset)(jnp.arange(2), keys)
    return jax.vmap(env.step)(state, jnp.ones((2, 2)))[1]

time_step = tick(keys_of(2))
env.check()
print(time_step.reward.tolist(), *(w.process.pid for w in env._pool._workers), flush=True)
if "fork" in sys.argv and os.fork() == 0:
    os.closerange(0, 3)
    time.sleep(20)  # holds the connections to the workers open
    os._exit(0)
if "die" in sys.argv:
    os.kill(os.getpid(), signal.SIGKILL)
"""


def is_running(pid: int) -> bool:
    try:
        status = Path(f"/proc/{pid}/stat").read_text()
    except FileNotFoundError:
        return False
    return status.rpartition(")")[2].split()[0] != "Z"


@pytest.mark.skipif(not Path("/proc/self/stat").exists(), reason="reads /proc")
@pytest.mark.parametrize("ending", ["exit", "die", "fork die"])
def test_a_script_without_main_guard_works_and_leaves_no_process_behind(ending):
    paths = os.pathsep.join(map(os.path.abspath, filter(None, sys.path)))
    script = subprocess.run(
        [sys.executable, "-W", "ignore", "-", *ending.split()],
        input=SCRIPT_WITHOUT_GUARD,
        capture_output=True,
        text=True,
        env=os.environ | {"PYTHONPATH": paths, "JAX_PLATFORMS": "cpu"},
        timeout=120,
    )
    rewards, _, pids = script.stdout.strip().rpartition("] ")
    assert rewards == "[2.0, 2.0", script.stderr
    deadline = time.monotonic() + 10
    while any(map(is_running, map(int, pids.split()))) and time.monotonic() < deadline:
        time.sleep(0.1)
    assert not any(map(is_running, map(int, pids.split())))
    assert script.stderr == ""
