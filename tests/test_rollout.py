"""Phases: records, keys and episodes."""

import functools
import itertools

import jax
import jax.numpy as jnp
import numpy as np
from numpy.testing import assert_allclose, assert_array_equal

from dreamer_jax import rollout as rollouts
from dreamer_jax.agent import MODES, Agent
from dreamer_jax.config import preset
from dreamer_jax.randomness import Purpose, phase_key
from dreamer_jax.records import Records
from dreamer_jax.rollout import collect, episodes, rollout
from probes import Probe
from runs import random_members

T = 30
ENV = Probe()


def random_policy(carry, image, first, key):
    return jax.random.uniform(key, (2,), minval=-1, maxval=1), carry


@functools.cache
def run():
    played = jax.jit(lambda key: rollout(ENV, random_policy, (), 0, key, T))
    return jax.tree.map(np.asarray, played(jax.random.key(0)))


def test_a_phase_has_one_record_more_than_ticks():
    records = run()
    assert records.image.shape == (T + 1, 32, 32, 3)
    assert records.action.shape == (T + 1, 2)


def test_a_reset_record_has_zero_action_and_reward():
    records = run()
    assert records.first[0]
    assert records.first.sum() > 2
    assert_array_equal(records.action[records.first], 0.0)
    assert_array_equal(records.reward[records.first], 0.0)


def test_a_terminal_record_is_kept_and_followed_by_a_reset():
    records = run()
    ends = np.flatnonzero(records.terminal[:-1])
    assert ends.size
    assert records.first[ends + 1].all()
    assert not records.first[ends].any()


def test_a_record_holds_the_action_that_led_to_its_image():
    records = run()

    def column(image):
        return np.argmax(image[0, :, 0]) / 32 * 2 - 1

    for t in range(1, T + 1):
        if not records.first[t]:
            moved = column(records.image[t]) - column(records.image[t - 1])
            assert_allclose(moved, 0.1 * records.action[t, 0], atol=2 / 32)
            assert_allclose(records.reward[t], 1 - 4 * (records.action[t, 0] - 0.5) ** 2, rtol=1e-5)


class Beginning(Probe):
    """A probe that can be made to begin with its next step."""

    def before(self, slot, key):
        state = self._start(key, jnp.int32(-1))
        return state._replace(clock=state.limit)


def test_an_environment_that_begins_with_a_step_gives_the_same_records():
    def policy(carry, image, first, key):
        seen = image[0, :, 0].argmax() / 32.0
        carry = jnp.where(first, 0, carry) + 1
        return jax.random.uniform(key, (2,)) * seen - 0.1 * carry, carry

    found = [
        jax.jit(lambda key, env=env: rollout(env, policy, jnp.int32(7), 0, key, 30))(
            jax.random.key(3)
        )
        for env in (Probe(), Beginning())
    ]
    assert found[0].first.sum() > 2 and found[0].first[0]
    assert_array_equal(found[0].first, found[1].first)
    jax.tree.map(lambda one, two: assert_allclose(one, two, atol=1e-6), *found)


def test_episodes_add_up_to_the_phase():
    records = run()
    found = episodes(records)
    assert sum(episode.length + 1 for episode in found) == T + 1
    assert_allclose(sum(episode.score for episode in found), records.reward.sum(), rtol=1e-5)
    assert [episode.fell for episode in found[:-1]] == [True] * (len(found) - 1)


def test_episodes_by_hand():
    records = Records(
        image=None,
        action=None,
        reward=np.array([0, 1, 2, 0, 3, 4], np.float32),
        first=np.array([1, 0, 0, 1, 0, 0], bool),
        terminal=np.array([0, 0, 1, 0, 0, 0], bool),
    )
    assert episodes(records) == [(0, 2, 3.0, True), (3, 2, 7.0, False)]


def test_keys_of_phases_differ_by_member_task_mode_and_phase():
    purposes = Purpose.COLLECT, Purpose.EVALUATE
    every = np.array(list(itertools.product(range(3), purposes, range(2), range(3))))
    keys = jax.random.key_data(jax.jit(jax.vmap(phase_key))(*every.T)).tolist()
    assert len(set(map(tuple, keys))) == 3 * 2 * 2 * 3


AGENT = Agent(preset("debug"), 2)


def collected(mode, phase=0):
    """What members 0 to 2 collect of two tasks."""
    seeds, updates = np.arange(3, dtype=np.int32), np.zeros(3, np.int32)
    params = random_members(AGENT, range(3))
    records = collect(
        AGENT, ENV, params, seeds, updates, np.int32(phase), tasks=2, ticks=T, mode=mode
    )
    return jax.tree.map(np.asarray, records)


def test_members_and_tasks_collect_side_by_side():
    records = collected("random")
    assert records.image.shape == (3, 2, T + 1, 32, 32, 3)
    flat = records.action.reshape(6, -1)
    assert len(np.unique(flat, axis=0)) == 6


def test_a_policy_collects_the_same_again_and_other_things_in_another_phase():
    one, again, other = (collected("explore", phase) for phase in (3, 3, 4))
    for a, b in zip(one, again, strict=True):
        assert_array_equal(a, b)
    assert (one.action != other.action).any()


def test_modes_act_differently_in_one_compiled_program():
    before = rollouts._collect._cache_size()
    actions = [collected(mode).action.reshape(-1) for mode in MODES]
    assert len(np.unique(actions, axis=0)) == 3
    assert rollouts._collect._cache_size() <= before + 1
