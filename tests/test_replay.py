"""Replay: what is appended is what is sampled, for every member on its own, whatever is killed."""

import errno
import os
import sys
import threading
import time
from collections import Counter

import jax
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dreamer_jax import replay as replay_module
from dreamer_jax.prefetch import Prefetcher
from dreamer_jax.records import Records
from dreamer_jax.replay import Replay
from dreamer_jax.sampling import sample_indices
from dreamer_jax.stream_reader import Place, StreamReader

SIZE, ACTION = 8, 2


def phase(members, tasks, steps, start=0):
    """A phase whose rewards say where each record belongs: 1e6 member + 1e4 task + time."""
    member, task, t = np.meshgrid(
        np.arange(members), np.arange(tasks), np.arange(start, start + steps), indexing="ij"
    )
    reward = (1e6 * member + 1e4 * task + t).astype(np.float32)
    noise = np.random.default_rng([members, tasks, steps, start])
    return Records(
        image=noise.integers(0, 256, (*reward.shape, SIZE, SIZE, 3), dtype=np.uint8),
        action=noise.normal(size=(*reward.shape, ACTION)).astype(np.float32),
        reward=reward,
        first=t % 7 == 0,
        terminal=t % 7 == 6,
    )


def make(directory, members=2, tasks=2, steps=(30,), **settings):
    replay = Replay(directory, members, tasks, SIZE, ACTION, **settings)
    for count in steps:
        replay.append(phase(members, tasks, count, start=int(replay.lengths[0, 0])))
    return replay


def files(directory):
    paths = sorted(directory.rglob("*.records"))
    return {str(path.relative_to(directory)): path.read_bytes() for path in paths}


def assert_same(actual, expected):
    for values, wanted in zip(actual, expected, strict=True):
        np.testing.assert_array_equal(values, wanted, strict=True)


# --- storing --------------------------------------------------------------------------------------


def test_what_is_appended_is_read_back_with_its_dtypes(tmp_path):
    replay = Replay(tmp_path, 2, 3, SIZE, ACTION)
    parts = [phase(2, 3, 5), phase(2, 3, 9, start=5)]
    for part in parts:
        replay.append(part)
    for stream in np.ndindex(2, 3):
        expected = jax.tree.map(lambda *x: np.concatenate(x), *(x.at(*stream) for x in parts))
        assert_same(replay.read(*stream, 0, 14), expected)
        assert_same(replay.read(*stream, 4, 7), expected.at(slice(4, 7)))


def test_a_folder_opened_again_holds_the_same_records_and_grows_from_there(tmp_path):
    make(tmp_path / "twice", steps=[6])
    make(tmp_path / "twice", steps=[4])
    make(tmp_path / "once", steps=[6, 4])
    assert files(tmp_path / "twice") == files(tmp_path / "once")


def test_lengths_are_a_copy(tmp_path):
    replay = make(tmp_path, steps=[6])
    replay.lengths[:] = 0
    assert (replay.lengths == 6).all()


@pytest.mark.parametrize(
    ("change", "stored", "asked"),
    [
        ({"members": 3}, "members 2", "expected 3"),
        ({"tasks": 1}, "tasks 2", "expected 1"),
        ({"image_size": 16}, "image_size 8", "expected 16"),
        ({"action_size": 6}, "action_size 2", "expected 6"),
    ],
)
def test_a_folder_of_another_layout_is_refused_and_both_are_named(tmp_path, change, stored, asked):
    make(tmp_path)
    layout = {"members": 2, "tasks": 2, "image_size": SIZE, "action_size": ACTION}
    with pytest.raises(ValueError, match=f"{stored} .{asked}"):
        Replay(tmp_path, **{**layout, **change})


def test_a_missing_stream_is_named(tmp_path):
    replay = make(tmp_path)
    replay.path(1, 0).unlink()
    with pytest.raises(ValueError, match="member_001/task_0.records is missing"):
        make(tmp_path, steps=[])


@pytest.mark.parametrize(
    ("name", "wrong", "got", "expected"),
    [
        ("image", np.zeros((2, 2, 5, 9, 8, 3), np.uint8), "5, 9, 8, 3", "5, 8, 8, 3"),
        ("image", np.zeros((2, 2, 5, 8, 8, 3), np.float32), "is float32", "expected uint8"),
        ("action", np.zeros((2, 2, 5, 3), np.float32), "5, 3", "5, 2"),
        ("reward", np.zeros((2, 2, 5), np.float64), "is float64", "expected float32"),
        ("first", np.zeros((2, 2, 4), bool), "2, 2, 4", "2, 2, 5"),
        ("terminal", np.zeros((2, 2, 5), np.int32), "is int32", "expected bool"),
        ("reward", np.zeros((1, 2, 5), np.float32), "1, 2, 5", "2, 2, 5"),
    ],
)
def test_records_that_do_not_fit_are_refused_and_nothing_is_stored(
    tmp_path, name, wrong, got, expected
):
    replay = make(tmp_path, steps=[])
    with pytest.raises(ValueError, match=rf" {name} .*{got}.*{expected}"):
        replay.append(phase(2, 2, 5)._replace(**{name: wrong}))
    assert (replay.lengths == 0).all() and not any(files(tmp_path).values())


# --- failures -------------------------------------------------------------------------------------


@pytest.mark.parametrize("failing", range(4), ids=lambda n: f"stream_{n}")
def test_a_full_disk_costs_nothing_that_was_committed(tmp_path, monkeypatch, failing):
    replay = make(tmp_path / "full", steps=[6])
    before = files(tmp_path / "full")
    write, calls = replay_module._write, []

    def write_until_full(file, rows):
        calls.append(file.name)
        if len(calls) == failing + 1:
            write(file, rows[: len(rows) // 2])
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        write(file, rows)

    monkeypatch.setattr(replay_module, "_write", write_until_full)
    with pytest.raises(OSError, match="No space left on device") as raised:
        replay.append(phase(2, 2, 5, start=6))
    assert raised.value.errno == errno.ENOSPC
    assert calls[failing] in str(raised.value) and "MiB free" in str(raised.value)
    assert files(tmp_path / "full") == before
    assert (replay.lengths == 6).all()

    monkeypatch.setattr(replay_module, "_write", write)
    replay.append(phase(2, 2, 5, start=6))
    make(tmp_path / "whole", steps=[6, 5])
    assert files(tmp_path / "full") == files(tmp_path / "whole")


@pytest.mark.skipif(not os.path.exists("/dev/full"), reason="needs /dev/full")
def test_the_operating_systems_own_full_device_is_reported(tmp_path):
    replay = make(tmp_path, steps=[])
    replay.path(1, 1).unlink()
    replay.path(1, 1).symlink_to("/dev/full")
    with pytest.raises(OSError, match="task_1.records: No space left on device"):
        replay.append(phase(2, 2, 5))
    assert (replay.lengths == 0).all() and replay.path(0, 0).stat().st_size == 0


def test_an_interrupt_while_appending_leaves_what_was_committed(tmp_path, monkeypatch):
    replay = make(tmp_path, steps=[6])
    before = files(tmp_path)

    def interrupted(file, rows):
        file.write(rows.data[:3])
        raise KeyboardInterrupt

    monkeypatch.setattr(replay_module, "_write", interrupted)
    with pytest.raises(KeyboardInterrupt):
        replay.append(phase(2, 2, 5, start=6))
    assert files(tmp_path) == before


@given(torn=st.lists(st.integers(0, 3000), min_size=4, max_size=4))
@settings(max_examples=20, deadline=None)
def test_a_run_killed_while_appending_is_resumed_as_if_it_had_not_been(torn, tmp_path_factory):
    directory = tmp_path_factory.mktemp("killed")
    committed = make(directory / "killed", steps=[6]).lengths
    for stream, count in zip(np.ndindex(2, 2), torn, strict=True):
        with open(
            directory / "killed" / f"member_00{stream[0]}/task_{stream[1]}.records", "ab"
        ) as f:
            f.write(b"\xff" * count)

    replay = Replay(directory / "killed", 2, 2, SIZE, ACTION)
    assert_same(
        replay.sample([3, 4], 0, 2, 6, lengths=committed),
        make(directory / "whole", steps=[6]).sample([3, 4], 0, 2, 6),
    )
    replay.truncate(committed)
    replay.append(phase(2, 2, 5, start=6))
    make(directory / "whole", steps=[5])
    assert files(directory / "killed") == files(directory / "whole")


def test_truncation_brings_back_the_batches_of_that_moment(tmp_path):
    replay = make(tmp_path, steps=[20])
    lengths, before = replay.lengths, replay.sample([0, 1], 5, 4, 6)
    replay.append(phase(2, 2, 15, start=20))
    assert replay.path(0, 0).stat().st_size == 35 * replay.dtype.itemsize
    replay.truncate(lengths)
    assert replay.path(0, 0).stat().st_size == 20 * replay.dtype.itemsize
    assert_same(replay.sample([0, 1], 5, 4, 6), before)


def test_truncation_beyond_what_is_stored_names_the_file_and_both_lengths(tmp_path):
    replay = make(tmp_path, steps=[6])
    before, lengths = files(tmp_path), replay.lengths
    lengths[1, 0] = 8
    lengths[0, 0] = 2
    with pytest.raises(ValueError, match=r"member_001/task_0.records holds 6 records, 8 "):
        replay.truncate(lengths)
    assert (replay.lengths == 6).all() and files(tmp_path) == before
    with pytest.raises(ValueError, match=r"shape \[2\].*= \[2, 2\]"):
        replay.truncate([6, 6])


# --- the sampling law -----------------------------------------------------------------------------

STREAMS = st.lists(st.integers(0, 40), min_size=1, max_size=4)


@given(
    seed=st.integers(0, 2**32),
    update=st.integers(0, 10**7),
    lengths=STREAMS,
    batch=st.integers(1, 20),
    length=st.integers(1, 40),
    keep=st.none() | st.integers(1, 50),
)
def test_sequences_never_leave_a_stream_or_the_newest_records(
    seed, update, lengths, batch, length, keep
):
    available = [n if keep is None else min(n, keep) for n in lengths]
    if max(available) < length:
        with pytest.raises(ValueError, match=f"sequences of {length} records"):
            sample_indices(seed, update, lengths, batch, length, keep)
        return
    tasks, starts = sample_indices(seed, update, lengths, batch, length, keep)
    assert tasks.shape == starts.shape == (batch,)
    held = np.array(lengths)[tasks]
    assert (starts >= held - np.array(available)[tasks]).all()
    assert (starts + length <= held).all()
    again = sample_indices(seed, update, lengths, batch, length, keep)
    np.testing.assert_array_equal(again, (tasks, starts))


def test_streams_are_drawn_uniformly_whatever_their_lengths_and_starts_within_them_too():
    lengths, length, draws = [500, 12, 3, 29], 10, 40_000
    tasks, starts = sample_indices(0, 0, lengths, draws, length)
    drawn = Counter(zip(tasks.tolist(), starts.tolist(), strict=True))
    for task in (0, 1, 3):  # the third is shorter than a sequence
        possible = lengths[task] - length + 1
        counts = np.array([drawn[task, start] for start in range(possible)])
        assert abs(counts.sum() - draws / 3) < 5 * np.sqrt(draws * 2 / 9)
        expected = counts.sum() / possible
        chi_squared = ((counts - expected) ** 2 / expected).sum()
        assert chi_squared < possible - 1 + 5 * np.sqrt(2 * (possible - 1))
    assert sum(drawn.values()) == draws and not any(task == 2 for task, _ in drawn)


def test_every_update_and_every_seed_draws_anew():
    draws = {
        tuple(sample_indices(seed, update, [1000], 8, 10)[1].tolist())
        for seed in range(20)
        for update in range(20)
    }
    assert len(draws) == 400


def test_sampled_sequences_are_runs_of_one_members_own_records(tmp_path):
    replay = make(tmp_path, members=3, tasks=2, steps=[30, 25])
    batch = replay.sample([5, 6, 7], 11, batch=9, length=13)
    assert batch.image.shape == (3, 9, 13, SIZE, SIZE, 3)
    for member, row in np.ndindex(3, 9):
        rewards = batch.reward[member, row]
        owner, rest = divmod(int(rewards[0]), 10**6)
        task, start = divmod(rest, 10**4)
        assert owner == member
        expected = replay.read(member, task, start, start + 13)
        assert_same(batch.at(member, row), expected)
    # Sequences longer than an episode of 7 cross its end, with every reset marked.
    assert (batch.first.sum(-1) >= 1).all()


def test_a_members_batch_depends_only_on_its_own_seed_and_streams(tmp_path):
    small, large = make(tmp_path / "2", members=2), make(tmp_path / "4", members=4)
    # Give the two populations the same member 1.
    for task in range(2):
        large.path(3, task).write_bytes(small.path(1, task).read_bytes())
    alone = small.sample([42], 7, 5, 6, members=[1])
    beside = small.sample([9, 42], 7, 5, 6)
    elsewhere = large.sample([42, 1, 2, 3], 7, 5, 6, members=[3, 0, 1, 2])
    assert_same(alone.at(0), beside.at(1))
    assert_same(alone.at(0), elsewhere.at(0))


def test_sampling_as_of_earlier_lengths_ignores_what_came_later(tmp_path):
    replay = make(tmp_path, steps=[20])
    lengths, before = replay.lengths, replay.sample([0, 1], 5, 4, 6)
    replay.append(phase(2, 2, 15, start=20))
    assert_same(replay.sample([0, 1], 5, 4, 6, lengths=lengths), before)
    with pytest.raises(ValueError, match="not at most the committed"):
        replay.sample([0, 1], 5, 4, 6, lengths=lengths + 100)


def test_a_member_with_too_little_is_named_with_its_lengths(tmp_path):
    with pytest.raises(ValueError, match=r"member 0 .*sequences of 31 .*\[30, 30\]"):
        make(tmp_path).sample([0, 1], 0, 4, 31)


def test_seeds_and_members_must_match(tmp_path):
    with pytest.raises(ValueError, match="3 seeds for 2 members"):
        make(tmp_path).sample([0, 1, 2], 0, 4, 5)


# --- deleting the oldest --------------------------------------------------------------------------

needs_holes = pytest.mark.skipif(sys.platform != "linux", reason="needs Linux's fallocate")
BLOCK = 4096


def disk_use(replay):
    """Bytes on the disk of the first stream, however long its file says it is."""
    return replay.path(0, 0).stat().st_blocks * 512


@needs_holes
def test_deleting_gives_disk_space_back_and_leaves_what_is_sampled(tmp_path):
    replay = make(tmp_path, steps=[2000], keep=50)
    size, before = replay.dtype.itemsize, replay.sample([3, 4], 0, 5, 20)
    kept = replay.read(1, 1, 1950, 2000)
    assert disk_use(replay) >= 2000 * size
    replay.delete(replay.lengths)
    assert disk_use(replay) <= 50 * size + 2 * BLOCK
    assert (replay.deleted == 1950).all() and (replay.lengths == 2000).all()
    assert_same(replay.sample([3, 4], 0, 5, 20), before)
    assert_same(replay.read(1, 1, 1950, 2000), kept)
    with pytest.raises(ValueError, match=r"\[1949, 2000\).*it holds \[1950, 2000\)"):
        replay.read(1, 1, 1949, 2000)


@needs_holes
def test_a_stream_that_grows_and_grows_stays_small_on_the_disk(tmp_path):
    replay, lengths = make(tmp_path, steps=[500], keep=100), None
    for start in range(500, 5000, 500):
        lengths = replay.lengths  # what a checkpoint would name
        replay.append(phase(2, 2, 500, start=start))
        replay.delete(lengths)
        assert disk_use(replay) <= (100 + 500) * replay.dtype.itemsize + 2 * BLOCK
    assert replay.path(0, 0).stat().st_size == 5000 * replay.dtype.itemsize


@pytest.mark.parametrize("opened_again", [False, True])
def test_a_run_that_goes_back_finds_all_it_sampled_then(tmp_path, opened_again):
    replay = make(tmp_path / "cut", steps=[200], keep=60)
    lengths, before = replay.lengths, replay.sample([0, 1], 5, 40, 30)
    replay.append(phase(2, 2, 150, start=200))
    replay.delete(lengths)
    if opened_again:
        replay = make(tmp_path / "cut", steps=[], keep=60)
    replay.truncate(lengths)
    assert_same(replay.sample([0, 1], 5, 40, 30), before)
    replay.append(phase(2, 2, 150, start=200))
    whole = make(tmp_path / "whole", steps=[200, 150], keep=60)
    assert_same(replay.sample([0, 1], 6, 40, 30), whole.sample([0, 1], 6, 40, 30))


def test_going_back_to_where_deleted_records_were_sampled_is_refused(tmp_path):
    replay = make(tmp_path, steps=[200], keep=60)
    replay.delete(replay.lengths)
    with pytest.raises(ValueError, match="oldest 140 records .* those from 139 on were to be kept"):
        replay.truncate(replay.lengths - 1)
    assert (replay.lengths == 200).all()
    with pytest.raises(ValueError, match="oldest 140 records .* those from 0 on"):
        make(tmp_path, steps=[]).truncate(replay.lengths)
    # Nothing at all is needed by a run that starts again.
    replay.truncate(np.zeros((2, 2), int))
    replay.append(phase(2, 2, 70))
    assert_same(replay.read(0, 0, 0, 70), phase(2, 2, 70).at(0, 0))


def test_a_replay_opened_without_a_limit_never_samples_what_is_deleted(tmp_path):
    replay = make(tmp_path, steps=[200], keep=60)
    replay.delete(replay.lengths)
    everything = make(tmp_path, steps=[])
    times = everything.sample([0, 1], 0, 50, 20).reward % 10**4
    assert times.min() >= 140 and times.max() <= 199


@pytest.mark.parametrize("keep", [None, 60])
def test_nothing_is_deleted_without_a_limit_or_below_it(tmp_path, keep):
    replay = make(tmp_path, steps=[50], keep=keep)
    before = files(tmp_path)
    replay.delete(replay.lengths)
    assert files(tmp_path) == before and not replay.deleted.any()


def test_where_files_cannot_have_holes_a_warning_says_so_and_all_goes_on(tmp_path, monkeypatch):
    def unable(path, size):
        raise OSError(errno.EOPNOTSUPP, os.strerror(errno.EOPNOTSUPP))

    monkeypatch.setattr(replay_module, "free_beginning", unable)
    replay = make(tmp_path, steps=[200], keep=60)
    before, stored = replay.sample([0, 1], 5, 4, 30), files(tmp_path)
    with pytest.warns(UserWarning, match="no longer sampled stay on the disk"):
        replay.delete(replay.lengths)
    assert files(tmp_path) == stored
    assert_same(replay.sample([0, 1], 5, 4, 30), before)


# --- memory ---------------------------------------------------------------------------------------


def test_a_batch_handed_out_is_never_written_again(tmp_path):
    replay = make(tmp_path, steps=[20])
    batch = replay.sample([0, 1], 0, 4, 6)
    kept = batch.map(np.copy)
    others = [replay.sample([0, 1], update, 4, 6) for update in range(1, 4)]
    replay.truncate(np.zeros((2, 2), int))
    replay.append(phase(2, 2, 20, start=500))
    assert_same(batch, kept)
    for name, array in batch._asdict().items():
        assert type(array) is np.ndarray and array.flags.owndata
        assert not any(np.shares_memory(array, getattr(other, name)) for other in others)


@pytest.mark.parametrize("threads", [2, 3, 50])
def test_a_batch_is_the_same_however_many_threads_put_it_together(tmp_path, threads):
    expected = make(tmp_path, members=3, threads=1)
    replay = make(tmp_path, members=3, steps=(), threads=threads)
    for update in range(5):
        assert_same(
            replay.sample([3, 4, 5], update, 7, 6), expected.sample([3, 4, 5], update, 7, 6)
        )
    assert_same(replay.sample([4], 0, 1, 6, members=[2]), expected.sample([4], 0, 1, 6, [2]))
    replay.close()
    assert not [thread for thread in threading.enumerate() if thread.name.startswith("replay")]
    assert_same(replay.sample([3, 4, 5], 9, 7, 6), expected.sample([3, 4, 5], 9, 7, 6))
    replay.close()


def test_threads_are_as_many_as_cores_but_no_more_than_four(monkeypatch):
    cores = {1: 1, 3: 3, 64: 4}
    for there, expected in cores.items():
        monkeypatch.setattr(os, "sched_getaffinity", lambda _, n=there: set(range(n)), False)
        assert StreamReader(np.dtype("u1")).threads == expected


def mapped(directory):
    """The files in a folder that this process maps, as often as it does."""
    with open("/proc/self/maps") as maps:
        return [line.split()[-1] for line in maps if str(directory) in line]


needs_proc = pytest.mark.skipif(not os.path.exists("/proc/self/maps"), reason="needs Linux's /proc")


@needs_proc
def test_files_stay_mapped_once_each_and_no_map_outlives_a_truncation(tmp_path):
    replay = make(tmp_path)
    for update in range(5):
        replay.sample([0, 1], update, 8, 6)
    assert sorted(mapped(tmp_path)) == sorted(str(replay.path(*x)) for x in np.ndindex(2, 2))
    # What is appended is found through a map that reaches so far.
    replay.append(phase(2, 2, 9, start=30))
    assert_same(replay.read(1, 1, 30, 39), phase(2, 2, 9, start=30).at(1, 1))
    replay.truncate(replay.lengths - 1)
    assert not mapped(tmp_path)
    replay.sample([0, 1], 0, 8, 6)
    replay.close()
    assert not mapped(tmp_path)


@needs_proc
def test_of_many_files_those_that_were_read_last_stay_mapped(tmp_path):
    replay = make(tmp_path, members=3)
    reader = StreamReader(replay.dtype, threads=1, most_maps=2)
    streams = list(np.ndindex(3, 2)) + [(2, 0)]
    places = [Place(replay.path(*stream), 30, 4) for stream in streams]
    found = reader.sequences(places, 5, 7)
    for row, stream in enumerate(streams):
        assert_same(found.at(row), replay.read(*stream, 4, 9))
    replay.close()
    assert sorted(mapped(tmp_path)) == [str(replay.path(*x)) for x in ((2, 0), (2, 1))]
    reader.close()


def anonymous_bytes():
    with open("/proc/self/status") as status:
        line = next(line for line in status if line.startswith("RssAnon"))
    return int(line.split()[1]) * 1024


@pytest.mark.skipif(not os.path.exists("/proc/self/status"), reason="needs Linux's /proc")
def test_memory_does_not_grow_with_the_replay(tmp_path):
    # A million environment steps of three members, 18 GB, may take 4 GiB: here a hundredth.
    replay = Replay(tmp_path, 3, 1, 64, ACTION)
    steps = 500
    records = Records(
        image=np.ones((3, 1, steps, 64, 64, 3), np.uint8),
        action=np.ones((3, 1, steps, ACTION), np.float32),
        reward=np.ones((3, 1, steps), np.float32),
        first=np.zeros((3, 1, steps), bool),
        terminal=np.zeros((3, 1, steps), bool),
    )
    replay.append(records)
    replay.sample([0, 1, 2], 0, 4, 50)
    before = anonymous_bytes()
    while replay.lengths[0, 0] < 5000:
        replay.append(records)
    for update in range(20):
        replay.sample([0, 1, 2], update, 4, 50)
    assert replay.path(2, 0).stat().st_size > 60e6
    assert anonymous_bytes() - before < 4 * 2**30 / 100


# --- prefetching ----------------------------------------------------------------------------------


def prefetch_threads():
    return [thread for thread in threading.enumerate() if thread.name.startswith("prefetch")]


def test_batches_prepared_ahead_equal_those_sampled_in_turn(tmp_path):
    replay = make(tmp_path)
    with replay.batches([3, 4], range(10, 15), 4, 6) as batches:
        prepared = list(batches)
    assert len(prepared) == 5
    for update, batch in zip(range(10, 15), prepared, strict=True):
        assert_same(batch, replay.sample([3, 4], update, 4, 6))
    assert not prefetch_threads()


def test_batches_come_from_the_records_committed_when_they_were_asked_for(tmp_path):
    replay = make(tmp_path, steps=[20])
    expected = [replay.sample([3, 4], update, 4, 6) for update in range(6)]
    batches = replay.batches([3, 4], range(6), 4, 6)
    replay.append(phase(2, 2, 15, start=20))
    for batch, wanted in zip(batches, expected, strict=True):
        assert_same(batch, wanted)


def test_no_more_than_the_depth_is_prepared_ahead():
    prepared = []
    with Prefetcher(lambda item: prepared.append(item) or item, range(10), depth=2) as prefetcher:
        for taken in range(10):
            deadline = time.monotonic() + 5
            while len(prepared) < min(taken + 2, 10) and time.monotonic() < deadline:
                time.sleep(0.001)
            time.sleep(0.005)
            assert prepared == list(range(min(taken + 2, 10)))
            assert next(prefetcher) == taken


def test_preparing_goes_on_while_the_caller_works():
    started = threading.Event()

    def prepare(item):
        if item == 1:
            started.set()
        return item

    with Prefetcher(prepare, range(2)) as prefetcher:
        assert next(prefetcher) == 0
        assert started.wait(5)


def test_an_error_in_the_background_is_raised_where_its_result_was_due():
    def prepare(item):
        if item == 2:
            raise RuntimeError(f"no batch {item}")
        return item

    with Prefetcher(prepare, range(5)) as prefetcher:
        assert [next(prefetcher), next(prefetcher)] == [0, 1]
        with pytest.raises(RuntimeError, match="no batch 2"):
            next(prefetcher)
    assert not prefetch_threads()


def test_closing_early_prepares_no_more_and_ends_the_thread():
    prepared = []
    with Prefetcher(lambda item: prepared.append(item), iter(range(10**9))) as prefetcher:
        next(prefetcher)
    count = len(prepared)
    assert not prefetch_threads() and count <= 3
    assert list(prefetcher) == []
    prefetcher.close()
    assert len(prepared) == count
