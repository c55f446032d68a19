"""What was damaged is told, wherever the damage is."""

import json
import zlib

import numpy as np
import pytest

from dreamer_jax.checkpoint import Checkpointer, CorruptCheckpointError
from dreamer_jax.integrity import (
    DamagedError,
    file_checksum,
    is_sealed,
    read_sealed_json,
    write_sealed_json,
)
from dreamer_jax.logs import MetricsWriter
from dreamer_jax.records import Records
from dreamer_jax.replay import Replay
from dreamer_jax.run_folder import RunFolder

LAYOUT = {"members": 2, "tasks": 1, "image_size": 4, "action_size": 2}


def counters(rounds):
    return {"rounds": rounds, "updates": 0, "evaluations": 0, "averaged": 0}


def phase(steps, seed):
    random = np.random.default_rng(seed)
    shape = (2, 1, steps)
    return Records(
        image=random.integers(0, 256, (*shape, 4, 4, 3), dtype=np.uint8),
        action=random.normal(size=(*shape, 2)).astype(np.float32),
        reward=random.normal(size=shape).astype(np.float32),
        first=np.zeros(shape, bool),
        terminal=np.zeros(shape, bool),
    )


def flip(path, place, bit=0):
    data = bytearray(path.read_bytes())
    data[place % len(data)] ^= 1 << bit
    path.write_bytes(data)


def open_folder(directory):
    return RunFolder(directory, lock=None, resume=True, layout=LAYOUT)


def fill(directory, phases=3):
    """A folder with a checkpoint after every phase."""
    folder = open_folder(directory)
    for number in range(phases):
        folder.replay.append(phase(10, number))
        row = {"kind": "collect", "member": 0, "env_steps": 10 * number, "return": 0.5}
        folder.writer.write(row)
        folder.save(number + 1, {"weights": np.full(50, number)}, counters(number + 1))
    folder.close()


def restore(directory, step=None):
    folder = open_folder(directory)
    try:
        tree, found = folder.restore({"weights": np.zeros(50, int)}, step)
        folder.replay.sample([0, 1], 0, 50, 3)
        return tree, found
    finally:
        folder.close()


def test_a_sealed_object_is_read_back_and_any_other_value_is_damage(tmp_path):
    path = tmp_path / "values.json"
    write_sealed_json(path, {"seeds": (1, 2), "rate": 0.1})
    assert is_sealed(path)
    assert read_sealed_json(path) == {"seeds": [1, 2], "rate": 0.1}
    content = path.read_bytes()
    for place in range(len(content)):
        flip(path, place)
        try:
            values = read_sealed_json(path)
            assert values == {"seeds": [1, 2], "rate": 0.1} or "crc32" not in path.read_text()
        except DamagedError as error:
            assert str(path) in str(error)
        path.write_bytes(content)
    path.write_text(json.dumps({"seeds": [3]}))
    assert read_sealed_json(path) == {"seeds": [3]} and not is_sealed(path)


def test_a_checksum_of_a_files_beginning_is_that_of_a_shorter_file(tmp_path):
    path = tmp_path / "file"
    content = np.random.default_rng(0).bytes(3 << 20)
    path.write_bytes(content)
    assert file_checksum(path) == zlib.crc32(content)
    for size in (0, 1, 1 << 20, (1 << 20) + 1):
        assert file_checksum(path, size) == zlib.crc32(content[:size])


@pytest.mark.parametrize("place", [0, 61, 62 * 10 - 1, 62 * 15, -1])
def test_a_flipped_bit_in_a_record_is_named_when_it_is_read(tmp_path, place):
    Replay(tmp_path, **LAYOUT).append(phase(10, 0))
    replay = Replay(tmp_path, **LAYOUT)
    replay.append(phase(10, 1))
    assert replay.dtype.itemsize == 62
    flip(replay.path(1, 0), place)
    # What this process wrote or has read is not read again for that.
    with pytest.raises(DamagedError, match=r"member_001/task_0.records is damaged: the records \["):
        Replay(tmp_path, **LAYOUT).sample([0, 1], 0, 60, 3)
    Replay(tmp_path, **LAYOUT).read(0, 0, 0, 20)


def test_a_piece_is_checked_alone_also_after_old_records_are_gone(tmp_path):
    replay = Replay(tmp_path, **LAYOUT, keep=7)
    for number in range(3):
        replay.append(phase(10, number))
    replay.delete(replay.lengths)
    again = Replay(tmp_path, **LAYOUT, keep=7)
    again.check(replay.lengths, replay.checksums())
    again.sample([0, 1], 0, 50, 3)
    flip(replay.path(0, 0), 62 * 25)
    with pytest.raises(DamagedError, match=r"records \[23, 30\)"):
        Replay(tmp_path, **LAYOUT, keep=7).sample([0, 1], 0, 50, 3)


def test_cutting_within_a_piece_leaves_the_rest_checked(tmp_path):
    replay = Replay(tmp_path, **LAYOUT)
    replay.append(phase(10, 0))
    replay.truncate(np.full((2, 1), 4))
    replay.append(phase(10, 1))
    again = Replay(tmp_path, **LAYOUT)
    again.read(0, 0, 0, 14)
    flip(replay.path(0, 0), 62 * 3)
    with pytest.raises(DamagedError, match=r"records \[0, 4\)"):
        Replay(tmp_path, **LAYOUT).read(0, 0, 0, 14)


def test_a_folder_of_an_earlier_version_goes_on_and_new_records_are_checked(tmp_path):
    fill(tmp_path, phases=1)
    checksums = list((tmp_path / "replay").rglob("*.checksums"))
    for path in (*checksums, *(tmp_path / "checkpoints").rglob("checksums.json")):
        path.unlink()
    (metadata,) = (tmp_path / "checkpoints").rglob("metadata.json")
    values = json.loads(metadata.read_text())
    kept = {name: values[name] for name in ("counters", "replay", "metrics")}
    metadata.write_text(json.dumps(kept))
    assert restore(tmp_path)[1] == counters(1)
    folder = open_folder(tmp_path)
    folder.restore({"weights": np.zeros(50, int)})
    folder.replay.append(phase(10, 1))
    folder.save(2, {"weights": np.zeros(50, int)}, counters(2))
    folder.close()
    assert restore(tmp_path)[1] == counters(2)
    flip(tmp_path / "replay" / "member_000" / "task_0.records", 62 * 12)
    with pytest.raises(DamagedError, match=r"records \[10, 20\)"):
        restore(tmp_path)


DAMAGE = {
    "metadata": "checkpoints/step_000000000003/metadata.json",
    "table": "checkpoints/step_000000000003/leaves.json",
    "checksums": "checkpoints/step_000000000003/checksums.json",
}


@pytest.mark.parametrize("name", DAMAGE.values(), ids=DAMAGE)
def test_a_damaged_newest_checkpoint_is_told_and_the_one_before_goes_on(tmp_path, name):
    fill(tmp_path)
    path = tmp_path / name
    flip(path, path.read_bytes().index(b"3"))
    with pytest.warns(UserWarning, match="step_000000000003 is damaged"):
        _, found = restore(tmp_path)
    assert found == counters(2)


def test_checksums_that_are_gone_are_missed(tmp_path):
    fill(tmp_path)
    (tmp_path / DAMAGE["checksums"]).unlink()
    with pytest.raises(CorruptCheckpointError, match="checksums.json is missing"):
        Checkpointer(tmp_path / "checkpoints").check(3)
    (tmp_path / "replay/member_000/task_0.checksums").unlink()
    with (
        pytest.warns(UserWarning, match="checksums.json is missing"),
        pytest.raises(DamagedError, match="task_0.checksums is missing.*no checkpoint before"),
    ):
        restore(tmp_path)


def test_a_changed_digit_of_the_metrics_is_told_with_the_older_checkpoints(tmp_path):
    fill(tmp_path)
    path = tmp_path / "metrics.jsonl"
    lines = path.read_text().splitlines(keepends=True)
    path.write_text("".join([*lines[:2], lines[2].replace("0.5", "0.6")]))
    with pytest.raises(DamagedError, match="metrics.jsonl is not what was.*--from-checkpoint 2$"):
        restore(tmp_path)
    assert restore(tmp_path, step=2)[1] == counters(2)
    # The later one is gone, so that nothing goes on from it by mistake.
    assert restore(tmp_path)[1] == counters(2)


def test_records_without_a_checkpoint_are_not_thrown_away(tmp_path):
    fill(tmp_path)
    (tmp_path / "checkpoints").rename(tmp_path / "elsewhere")
    with pytest.raises(DamagedError, match="no checkpoint to go on from.*choose another folder"):
        restore(tmp_path)
    assert (tmp_path / "replay/member_000/task_0.records").stat().st_size == 30 * 62


def test_the_checksum_of_the_metrics_goes_on_after_a_cut(tmp_path):
    row = {"kind": "collect", "member": 0, "env_steps": 1}
    with MetricsWriter(tmp_path / "one", tensorboard=False) as one:
        one.write(row)
        offset = one.offset()
        one.write({**row, "more": 1})
        one.truncate(offset)
        one.write({**row, "more": 2})
    assert one.checksum() == zlib.crc32((tmp_path / "one/metrics.jsonl").read_bytes())
