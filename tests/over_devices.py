"""Populations on several devices: run by tests/test_devices.py in a process of its own, for the
number of devices is chosen before JAX starts.

The agents are small ones that learn a mean, so that many programs compile in seconds; one law is
held by the real update too. Axis letters as in dreamer_jax.
"""

import dataclasses
import functools
import json
import sys
from contextlib import contextmanager
from pathlib import Path
from types import SimpleNamespace

import jax
import numpy as np
import pytest
from jax.sharding import NamedSharding, PartitionSpec

from accidents import Killed
from dreamer_jax import training
from dreamer_jax.agent import Agent
from dreamer_jax.checkpoint import load_tree
from dreamer_jax.config import preset
from dreamer_jax.device_round import DeviceRounds
from dreamer_jax.devices import Placement, place
from dreamer_jax.logs import read_metrics
from dreamer_jax.population import Member, Population
from dreamer_jax.training import Run
from envs.base import TaskSpec
from envs.bridge import HostEnv
from experiments.runs import evaluate as evaluation
from experiments.runs import start as beginning
from experiments.runs.evaluate import Agents
from experiments.runs.start import load_sources, transferred_members
from probes import Inside
from runs import batch_for, random_members, spec_of, write_run
from small_agent import Small

DEBUG = preset("debug")
TASKS = ("probe/left", "probe/right")


@functools.cache
def population(agent, env, tasks, seeds, placement):
    return Population(agent, env, tasks, seeds, placement)


def shared_population(agent, env, tasks, seeds, placement):
    """Runs whose members lie alike share a population, and so what it has compiled: their agents
    differ in what a population does not ask about."""
    assert agent.on_any_schedule() == AGENT.on_any_schedule()
    return population(AGENT, env, tasks, tuple(seeds), placement)


def config_with(**schedule):
    # No evaluation: what looks into an agent needs a real one.
    settings = {
        "environment_steps": 240,
        "evaluate_every": 10**6,
        "checkpoint_every": 10**6,
        "replay": "files",
    } | schedule
    return dataclasses.replace(DEBUG, schedule=dataclasses.replace(DEBUG.schedule, **settings))


AGENT = Small(config_with(), 2)


def made(directory, members, devices, agent, make_env, resume=False):
    """A run of members on as many devices."""
    placement = place(members, devices)
    names = tuple(Member(seed, f"agent {seed}") for seed in range(members))
    env = make_env(members, placement.count)
    options = {"videos": 0, "placement": placement, "resume": resume}
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(training, "Population", shared_population)
        return Run(agent, env, TASKS, names, directory, **options)


@contextmanager
def killed(owner, name, calls):
    """Within, the given call of a method is where the process is killed."""
    method, left = getattr(owner, name), [calls]

    def killing(self, *arguments):
        left[0] -= 1
        if left[0] == 0:
            raise Killed
        return method(self, *arguments)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(owner, name, killing)
        with pytest.raises(Killed):
            yield


# Runs on as many devices share their environment, and so the programs that have it inside.
@functools.cache
def probe(members, shards):
    env = Inside()
    env.shards = shards
    return env


@functools.cache
def counting(members, shards):
    """Simulators on the host that count, and fall."""
    task = TaskSpec("fake/falling", "Falling", 2, "fake_simulators:Falling", "")
    return HostEnv([task, task], members, 32, 2, 2, workers=2, shards=shards)


def trained(*arguments, **options):
    run = made(*arguments, **options)
    assert run.train() == "finished"
    run.close()
    return run


def assert_alike(directory, other, count=None):
    """The same rows and numbers within rounding, of the first so many members of `other`."""
    rows, others = read_metrics(directory), read_metrics(other)
    if count is not None:
        others = [row for row in others if row["member"] < count]
    assert len(rows) == len(others) > 0
    for one, two in zip(rows, others, strict=True):
        assert list(one) == list(two)
        for name, value in one.items():
            if isinstance(value, float):
                np.testing.assert_allclose(two[name], value, rtol=1e-5, atol=1e-6, err_msg=name)
            else:
                assert two[name] == value, (name, value, two[name])


def assert_spread(tree, placement):
    """Each device holds its own members of every leaf, and no others."""
    expected = NamedSharding(placement.mesh, PartitionSpec("members"))
    for leaf in jax.tree.leaves(tree):
        assert leaf.sharding.is_equivalent_to(expected, leaf.ndim), leaf.sharding
        assert leaf.shape[0] == placement.padded
        parts = {part.data.shape[0] for part in leaf.addressable_shards}
        assert parts == {placement.each} and not leaf.is_fully_replicated


def the_number_of_devices_does_not_matter(folder):
    """In files, on the device, both with simulators on the host, and these beside updates."""
    for name, replay, make_env, collect in (
        ("files", "files", probe, "before"),
        ("device", "device", probe, "before"),
        ("host", "files", counting, "before"),
        ("host-device", "device", counting, "before"),
        ("host-beside", "device", counting, "beside"),
    ):
        agent = Small(config_with(replay=replay, collect=collect), 2)
        for devices in {"files": (1, 2, 8), "device": (1, 4)}.get(name, (1, 8)):
            run = trained(folder / f"{name}-{devices}", 8, devices, agent, make_env)
            assert run.placement.count == devices and run.counters.updates == 12
            if devices > 1:
                assert_spread((run.state, run.sums, run.seeds), run.placement)
            if devices > 1 and replay == "device":
                assert_spread(run.device_rounds._held, run.placement)
            assert_alike(folder / f"{name}-1", folder / f"{name}-{devices}")


def a_device_trains_its_members_as_if_there_were_no_others(folder):
    """The program of one of two devices is that of its members alone: the same to the bit."""
    agent = Small(config_with(), 2)
    trained(folder / "alone", 4, 1, agent, probe)
    both = read_metrics(folder / "files-2")
    alone = read_metrics(folder / "alone")
    assert json.dumps([row for row in both if row["member"] < 4]) == json.dumps(alone)


def padding_is_nowhere_to_be_seen(folder):
    """7 members on 4 devices, 2 on each: nothing but the 7 is trained, counted or written."""
    for name, replay, make_env in (
        ("files", "files", probe),
        ("host", "files", counting),
        ("host-device", "device", counting),
    ):
        agent = Small(config_with(replay=replay), 2)
        run = trained(folder / f"padded-{name}", 7, 4, agent, make_env)
        assert str(run.placement) == "7 members on 4 of 8 devices, at most 2 on each"
        assert_alike(folder / f"padded-{name}", folder / f"{name}-1", count=7)
        assert_spread((run.state, run.sums, run.seeds), run.placement)
        np.testing.assert_array_equal(np.asarray(run.state.healthy), [True] * 7 + [False])
        # What makes up the last device stays as it began.
        first = np.asarray(run.population.fresh().params["actor"]["value"])
        last = np.asarray(run.state.params["actor"]["value"])
        assert (first != last).tolist() == [True] * 7 + [False]
        streams = sorted(path.name for path in (run.directory / "replay").glob("member_*"))
        assert streams == [f"member_00{member}" for member in range(7)]
        tree = load_tree(run.directory / "checkpoints")
        assert {leaf.shape[0] for leaf in jax.tree.leaves(tree)} == {7}


def killed_on_many_devices_a_run_goes_on_with_fewer(folder):
    """To one of eight; and to two of four, which both are made up to an eighth member."""
    for members, many, fewer in ((8, 8, 1), (7, 4, 2)):
        agent = Small(config_with(checkpoint_every=40), 2)
        directory = folder / f"killed-{members}"
        run = made(directory, members, many, agent, probe)
        with killed(Population, "update", 9):
            run.train()
        run.close()
        resumed = trained(directory, members, fewer, agent, probe, resume=True)
        assert resumed.counters.updates == 12
        assert_alike(directory, folder / "files-1", count=members)


def a_replay_on_the_devices_is_filled_from_files_of_another_number(folder):
    agent = Small(config_with(replay="device", checkpoint_every=40), 2)
    for before, after in ((4, 1), (1, 4)):
        directory = folder / f"filled-{after}"
        run = made(directory, 8, before, agent, probe)
        with killed(DeviceRounds, "run", 3):
            run.train()
        run.close()
        resumed = trained(directory, 8, after, agent, probe, resume=True)
        assert resumed.counters.updates == 12
        assert_alike(directory, folder / "device-1")


def the_real_update_is_the_same_on_a_device_of_its_own(folder):
    """Of two members, each on a device, as of each where there is no other."""
    agent = Agent(DEBUG, 2)
    fresh = jax.tree.map(lambda x: np.zeros((2, *x.shape), x.dtype), jax.eval_shape(agent.init, 0))
    states = dataclasses.replace(
        fresh,
        params=random_members(agent, range(2)),
        seed=np.arange(2, dtype=np.int32),
        healthy=np.ones(2, bool),
    )
    given = (states, batch_for(agent, 2))

    def updated(numbers, devices):
        count = len(numbers)
        members = Population(agent, None, 1, [3, 4][:count], place(count, devices))
        state, batch = jax.tree.map(lambda x: x[numbers], given)
        state = members.put(state if devices > 1 else jax.device_put(state))
        return members.update(state, members.zero_sums(state), batch)

    both = updated([0, 1], 2)
    assert both[0].healthy.all() and both[0].updates.tolist() == [1, 1]
    assert_spread(both, place(2, 2))
    for member in range(2):
        alone = updated([member], 1)
        for one, two in zip(*map(jax.tree.leaves, (alone, both)), strict=True):
            two, one = np.asarray(two)[member], np.asarray(one)[0]
            np.testing.assert_allclose(two, one, rtol=1e-3, atol=1e-5)


def agents_are_evaluated_on_their_devices_as_on_one(folder):
    """5 members on 1 and on 3 devices, 2 on each: the same episodes, and padding in none."""
    spec, played = spec_of("inverted_pendulum", seeds=(0, 1, 2, 3, 4)), []
    agents = Agents(folder, spec, {"actor": {"value": np.arange(5, dtype=np.float32)}})
    task = TaskSpec("fake/falling", "Falling", 1, "fake_simulators:Falling", "")

    def make_env(spec, workers, timeout, shards):
        played.append(HostEnv([task], 5, 32, 2, 1, workers=2, shards=shards))
        return played[-1]

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(evaluation, "make_agent", lambda spec: Small(spec.config, 1))
        patch.setattr(evaluation, "make_env", make_env)
        one, three = (evaluation.evaluate(agents, 1, devices=devices) for devices in (1, 3))
    assert [env.shards for env in played] == [1, 3]
    assert len(one) == len(three) == len({row["return"] for row in one}) == 5
    for row, other in zip(one, three, strict=True):
        assert other.pop("return") == pytest.approx(row.pop("return"), rel=1e-3)
        assert other == row


def targets_begin_on_their_own_devices_as_on_one(folder):
    """Each device makes its own members: of two sources with agents from scratch beside them, and
    of stored models that each target has of its own."""
    for seed, name in enumerate(("one", "two")):
        write_run(folder / name, spec_of("hopper"), seed)
    sources = (folder / "one", folder / "two")
    write_run(folder / "uae", spec_of("hopper", "ant"))
    for task in ("hopper", "ant"):
        write_run(folder / task, spec_of(task, sources=(folder / "uae",), method="uae"))
    stored = (folder / "hopper", folder / "ant")
    meta = {"sources": (folder / "uae",), "reward_sources": stored, "method": "meta"}
    for spec in (
        spec_of("walker2d", sources=sources, omegas=(0.0, 0.2), baseline=True),
        spec_of("walker2d", seeds=(0, 1, 2), **meta),
    ):
        read, placement = load_sources(spec), place(len(spec.members), 2)
        assert placement.padded == len(spec.members) + 1
        (state, report), _ = transferred_and_made(spec, read, place(len(spec.members), 1))
        (other, told), made = transferred_and_made(spec, read, placement)
        # What devices made was divided among them before it came to the host.
        assert_spread(made, placement)
        assert told.members == report.members == len(spec.method.targets(spec.seeds))
        assert told.rows == report.rows
        for one, two in zip(*map(jax.tree.leaves, ((state, report), (other, told))), strict=True):
            np.testing.assert_allclose(np.asarray(two), np.asarray(one), rtol=1e-5, atol=1e-6)


def transferred_and_made(spec, sources, placement):
    """The members of a transfer and its report, and what the devices made of them."""
    made, own = [], Placement.own

    def fresh(agent, seeds):
        # Drawn by NumPy: the program that draws takes seconds to compile, and is one device's.
        return SimpleNamespace(params=random_members(agent, seeds))

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Placement, "own", lambda self, tree: made.append(tree) or own(self, tree))
        patch.setattr(beginning, "init_members", fresh)
        found = transferred_members(spec, sources, placement=placement)
    (tree,) = made
    return found, tree


def members_that_are_few_leave_devices_alone(folder):
    told = {(3, "all"): (3, 1), (9, "all"): (5, 2), (8, 3): (3, 3), (16, "all"): (8, 2)}
    for (members, choice), (count, each) in told.items():
        placement = place(members, choice)
        assert (placement.count, placement.each) == (count, each)
        assert 0 <= placement.padded - members < each


LAWS = (
    members_that_are_few_leave_devices_alone,
    the_number_of_devices_does_not_matter,
    a_device_trains_its_members_as_if_there_were_no_others,
    padding_is_nowhere_to_be_seen,
    killed_on_many_devices_a_run_goes_on_with_fewer,
    a_replay_on_the_devices_is_filled_from_files_of_another_number,
    the_real_update_is_the_same_on_a_device_of_its_own,
    agents_are_evaluated_on_their_devices_as_on_one,
    targets_begin_on_their_own_devices_as_on_one,
)

if __name__ == "__main__":
    assert jax.local_device_count() == 8
    for law in LAWS:
        law(Path(sys.argv[1]))
        print(law.__name__, flush=True)
    for members, shards in ((8, 1), (8, 8), (7, 4)):
        counting(members, shards).close()
