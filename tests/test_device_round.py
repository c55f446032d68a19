"""Rounds with the replay on the device, beside the same rounds with files: as one program each, and
with simulators on the host. By agents of one number, but for the comparison with files.

P = 2 members, K = 2 tasks, 4 rounds; of each stream's 84 records the newest 25 are sampled, and the
device has room for two phases of 21.
"""

import dataclasses
import math
import signal

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from accidents import Killed, full_disk, in_call, raising
from dreamer_jax import device_replay, device_round
from dreamer_jax.agent import Agent
from dreamer_jax.config import preset
from dreamer_jax.device_round import on_device, store_and_update, whole_round
from dreamer_jax.logs import read_metrics
from dreamer_jax.population import Member
from dreamer_jax.records import Records
from dreamer_jax.replay import Replay
from dreamer_jax.schedule import Schedule
from dreamer_jax.training import Run
from probes import BrokenProbe, Inside, Probe
from small_agent import Small

pytestmark = pytest.mark.usefixtures("small_agents_are_diagnosed")


def config_with(**settings):
    config = preset("debug")
    settings = {"environment_steps": 320, "replay_keep": 25, "replay": "device"} | settings
    return dataclasses.replace(config, schedule=dataclasses.replace(config.schedule, **settings))


# Shared, so that all runs of these tests share their compiled functions.
AGENT = Small(config_with(), 2)
ENVS = {"one program": Inside(), "host": Probe()}
FILES = Small(config_with(replay="files"), 2)
MEMBERS = (Member(0, "one"), Member(7, "two"))
TASKS = ("probe/left", "probe/right")


def run_in(directory, env, agent=AGENT, members=MEMBERS, **options):
    return Run(agent, env, TASKS, members, directory, **({"videos": 0} | options))


def trained(directory, env, **options):
    run = run_in(directory, env, **options)
    outcome = run.train()
    run.close()
    return run, outcome


def metrics(directory):
    return (directory / "metrics.jsonl").read_bytes()


@pytest.fixture(scope="module", params=ENVS, ids=lambda name: name.replace(" ", "_"))
def env(request):
    return ENVS[request.param]


@pytest.fixture(scope="module")
def finished(tmp_path_factory, env):
    directory = tmp_path_factory.mktemp("device")
    program = store_and_update if env.has_host else whole_round
    before = program._cache_size()
    run, outcome = trained(directory, env)
    assert outcome == "finished"
    # All rounds share one program, perhaps with runs of earlier tests.
    assert program._cache_size() - before <= 1
    return directory, run


def assert_same(directory, other, rel):
    """Both folders' metrics have the same rows, and the same numbers to a relative error."""
    rows, others = read_metrics(directory), read_metrics(other)
    assert len(rows) == len(others)
    for one, two in zip(rows, others, strict=True):
        assert list(one) == list(two)
        for name, value in one.items():
            if isinstance(value, float):
                value = pytest.approx(value, rel=rel, abs=rel, nan_ok=True)
            assert two[name] == value, (one["kind"], name)


def assert_same_run(run, other):
    """Of a replay on the device and one in files: the same rows, and records of the same rounds."""
    assert run.device_rounds and not other.device_rounds and run.counters.updates == 16
    kinds = {row["kind"] for row in read_metrics(run.directory)}
    assert kinds == {"collect", "update", "evaluation"}
    assert_same(run.directory, other.directory, rel=1e-3)
    # What no update has touched is the same to the bit: the round of random actions, all rows of it
    # and the records of every stream.
    streams = run.replay.lengths.shape
    random = [metrics(x.directory).splitlines()[: math.prod(streams)] for x in (run, other)]
    assert random[0] == random[1]
    for stream in np.ndindex(streams):
        held = [x.replay.path(*stream).read_bytes() for x in (run, other)]
        size = 21 * run.replay.dtype.itemsize
        assert held[0][:size] == held[1][:size] and len(held[0]) == len(held[1])


def test_a_replay_on_the_device_gives_the_metrics_of_the_path_with_files(finished, env, tmp_path):
    other, outcome = trained(tmp_path, env, agent=FILES)
    assert outcome == "finished"
    assert_same_run(finished[1], other)


def test_so_it_does_for_agents_of_networks(tmp_path):
    runs = []
    for replay in ("device", "files"):
        agent = Agent(config_with(replay=replay), 2)
        # Of one member, whose programs compile a little sooner.
        options = {"agent": agent, "members": MEMBERS[:1]}
        run, outcome = trained(tmp_path / replay, ENVS["one program"], **options)
        assert outcome == "finished"
        runs.append(run)
    assert_same_run(*runs)


def test_all_rounds_share_one_program(finished, env, tmp_path):
    program = store_and_update if env.has_host else whole_round
    before = program._cache_size()
    trained(tmp_path, env)
    assert program._cache_size() == before
    assert metrics(tmp_path) == metrics(finished[0])


def stopping_in(patch, env, rounds, what):
    """Does something in the midst of the updates of the round of that number."""
    name = "store_and_update" if env.has_host else "whole_round"
    in_call(patch, device_round, name, rounds, what)


@pytest.mark.parametrize("agent", [AGENT, FILES], ids=["device", "files"])
def test_a_run_stopped_by_ctrl_c_goes_on_with_either_replay(
    finished, env, tmp_path, agent, monkeypatch
):
    directory, whole = finished
    run = run_in(tmp_path, env)
    with monkeypatch.context() as patch:
        stopping_in(patch, env, 3, lambda: signal.raise_signal(signal.SIGINT))
        assert run.train() == "stopped"
    run.close()
    assert (run.counters.rounds, run.counters.updates) == (3, 12)
    resumed, outcome = trained(tmp_path, env, agent=agent, resume=True)
    assert outcome == "finished"
    if agent is FILES:
        assert_same(directory, tmp_path, rel=1e-3)
        return
    assert metrics(tmp_path) == metrics(directory)
    chex.assert_trees_all_equal(resumed.state, whole.state)


def test_a_run_killed_between_checkpoints_equals_one_that_was_not(
    finished, env, tmp_path, monkeypatch
):
    directory, whole = finished
    run = run_in(tmp_path, env)
    with monkeypatch.context() as patch, pytest.raises(Killed):
        stopping_in(patch, env, 3, raising(Killed()))
        run.train()
    run.close()
    resumed, _ = trained(tmp_path, env, resume=True)
    assert metrics(tmp_path) == metrics(directory)
    chex.assert_trees_all_equal(resumed.state, whole.state)


def test_a_round_whose_records_cannot_be_written_ends_before_it(
    finished, env, tmp_path, monkeypatch
):
    directory, whole = finished
    run = run_in(tmp_path, env)
    with monkeypatch.context() as patch, pytest.raises(OSError, match="no space left"):
        full_disk(patch, 42)
        run.train()
    run.close()
    assert run.counters.updates == run.state.updates[0] == 8
    resumed, _ = trained(tmp_path, env, resume=True)
    assert metrics(tmp_path) == metrics(directory)
    chex.assert_trees_all_equal(resumed.state, whole.state)


def test_a_device_without_room_for_the_round_names_the_ways_out(env, tmp_path, monkeypatch):
    error = jax.errors.JaxRuntimeError("RESOURCE_EXHAUSTED: out of memory")
    stopping_in(monkeypatch, env, 1, raising(error))
    run = run_in(tmp_path, env)
    with pytest.raises(MemoryError, match="replay's .* MiB.*replay_keep.*mapping=chunks.*files"):
        run.train()
    run.close()


def test_a_failed_phase_loses_nothing_of_what_was_before_it(finished, env, tmp_path):
    directory, whole = finished
    broken = BrokenProbe(phases=4)  # two of rounds, two of evaluations
    broken.has_host = env.has_host
    run = run_in(tmp_path, broken)
    with pytest.raises(RuntimeError, match="probe/point died"):
        run.train()
    run.close()
    assert (run.counters.rounds, run.counters.updates) == (2, 8)
    resumed, _ = trained(tmp_path, env, resume=True)
    assert metrics(tmp_path) == metrics(directory)
    chex.assert_trees_all_equal(resumed.state, whole.state)


def test_a_member_that_turns_not_finite_is_frozen_and_the_other_goes_on(
    finished, env, tmp_path, capsys
):
    directory, whole = finished
    run = run_in(tmp_path, env)
    run.state.params["loss"]["shift"] = jnp.array([0.0, jnp.nan])
    assert run.train() == "finished"
    run.close()
    message = " ".join(capsys.readouterr().out.split())
    assert "member 1 (two, seed 7) met a loss or gradient that is not finite by update 4" in message
    np.testing.assert_array_equal(run.state.healthy, [True, False])
    rows, others = ([r for r in read_metrics(d)] for d in (tmp_path, directory))
    assert [r for r in rows if r["member"] == 0] == [r for r in others if r["member"] == 0]
    chex.assert_trees_all_equal(*(jax.tree.map(lambda x: x[0], r.state) for r in (run, whole)))


def test_the_replay_is_updated_in_place_and_read_without_a_copy(finished, env):
    """With room for many more records than a round looks at, the program's memory beside its
    arguments stays below that of the replay."""
    _, run = finished
    held, records = (
        jax.eval_shape(lambda count=count: device_replay.empty(2, 2, count, 32, 2))
        for count in (21 * 200, 21)
    )
    size = sum(x.size * x.dtype.itemsize for x in held)
    drawn = jax.ShapeDtypeStruct((4, 2, 2), jnp.int32)
    scalar = jax.ShapeDtypeStruct((), jnp.int32)
    taken, options = (run.state, run.sums, held), {"length": 5, "mapping": "auto", "chunk": 1}
    if env.has_host:
        program = store_and_update.lower(
            AGENT, *taken, records, scalar, scalar, (drawn, drawn), **options
        )
    else:
        program = whole_round.lower(
            AGENT, env, *taken, run.seeds, scalar, scalar, scalar, (drawn, drawn),
            ticks=20, **options,
        )  # fmt: skip
    assert "callback" not in program.as_text()
    memory = program.compile().memory_analysis()
    assert memory.alias_size_in_bytes > size
    assert memory.temp_size_in_bytes < size / 2


def test_a_full_replay_forgets_its_oldest_phase_and_reads_across_its_end(tmp_path):
    files = Replay(tmp_path, members=2, tasks=2, image_size=4, action_size=3)
    random = np.random.default_rng(0)
    held = device_replay.empty(2, 2, 3 * 5, 4, 3)
    for phase in range(5):
        records = Records(
            image=random.integers(0, 256, (2, 2, 5, 4, 4, 3), np.uint8),
            action=random.normal(size=(2, 2, 5, 3)).astype(np.float32),
            reward=random.normal(size=(2, 2, 5)).astype(np.float32),
            first=random.random((2, 2, 5)) < 0.5,
            terminal=random.random((2, 2, 5)) < 0.5,
        )
        files.append(records)
        held = device_replay.write(held, records, jnp.int32(phase))
    chex.assert_trees_all_equal(held, device_replay.filled(files, 15, 5))
    # Records 10 to 24 are held, number 15 in the first place.
    tasks, starts = np.array([[0, 1], [1, 0]]), np.array([[10, 13], [21, 16]])
    batch = device_replay.read(held, tasks, starts % 15, 4)
    for p, b in np.ndindex(2, 2):
        expected = files.read(p, tasks[p, b], starts[p, b], starts[p, b] + 4)
        chex.assert_trees_all_equal(batch.at(p, b), expected)


def test_a_replay_of_other_phases_is_refused(tmp_path):
    files = Replay(tmp_path, members=1, tasks=1, image_size=4, action_size=1)
    record = np.zeros((1, 1, 7), bool)
    zeros = np.zeros((1, 1, 7), np.float32)
    images = np.zeros((1, 1, 7, 4, 4, 3), np.uint8)
    files.append(Records(images, zeros[..., None], zeros, record, record))
    with pytest.raises(ValueError, match=r"hold \[\[7\]\] records, no whole number of phases of 5"):
        device_replay.filled(files, 10, 5)


# Which it is


def choice(setting, has_host=False):
    return on_device(Agent(config_with(replay=setting), 2), has_host, 2, 2)


def test_only_an_environment_without_a_host_makes_a_round_one_program():
    for has_host in (True, False):
        assert choice("device", has_host)[:2] == (True, not has_host)
        assert choice("files", has_host) == (False, False, "")


def test_an_environment_that_does_not_say_is_taken_to_have_a_host(tmp_path, monkeypatch):
    monkeypatch.delattr(Probe, "has_host")
    run = run_in(tmp_path, Probe())
    assert run.device_rounds is not None
    monkeypatch.setattr(device_round, "whole_round", raising(AssertionError("one program")))
    assert run.train() == "finished"
    run.close()


def test_the_cpu_keeps_files_unless_told_otherwise():
    assert choice("auto") == choice("auto", True) == (False, False, "")
    # 168 records of 32 * 32 * 3 pixels, two actions, a reward and two flags.
    size = 2 * 2 * 42 * (3072 + 8 + 4 + 2) / 2**20
    assert choice("device").note == (
        f"replay on the device: {size:.1f} MiB (members 2, tasks 2, records 42 of 32 x 32 pixels)"
    )


@pytest.mark.parametrize("has_host", [False, True])
def test_accelerators_hold_a_replay_that_takes_half_of_their_memory_at_most(monkeypatch, has_host):
    size = 2 * 2 * 42 * 3086
    monkeypatch.setattr(jax, "default_backend", lambda: "gpu")
    for memory, outcome in ((2 * size, True), (2 * size - 2, False)):
        monkeypatch.setattr(device_round, "_memory", lambda memory=memory: memory)
        chosen = choice("auto", has_host)
        assert chosen.device is outcome
        told = "in files" in chosen.note and "more than half of its" in chosen.note
        assert told is not outcome
    monkeypatch.setattr(device_round, "_memory", lambda: size - 1)
    with pytest.raises(ValueError, match=r"would take 0.5 MiB.*has 0.5 MiB.*replay_keep, less th"):
        choice("device", has_host)


def test_the_capacity_is_whole_phases_of_what_is_sampled():
    def records(**settings):
        return device_replay.capacity(Schedule(config_with(**settings).schedule, 1))

    assert records(replay_keep=None) == 8 * 21
    assert [records(replay_keep=keep) for keep in (21, 22, 10**6)] == [21, 42, 8 * 21]
