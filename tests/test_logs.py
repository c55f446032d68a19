"""Metrics: exact, the same after a resume, and readable half-written."""

import errno
import json
import math
import os
import struct
import subprocess
import sys
import textwrap

import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from tensorboardX.proto.event_pb2 import Event

from dreamer_jax import logs as logs_module
from dreamer_jax.logs import MetricsWriter, read_metrics


def row(env_steps=1000, member=0, **values):
    return {"kind": "update", "member": member, "env_steps": env_steps, **values}


def write(directory, rows, **settings):
    with MetricsWriter(directory, **{"tensorboard": False, **settings}) as writer:
        for values in rows:
            writer.write(values)
    return (directory / "metrics.jsonl").read_bytes()


# --- rows -----------------------------------------------------------------------------------------


def test_rows_are_read_back_as_written_in_their_order(tmp_path):
    rows = [
        row(1000, 0, label="ω = 0.2", task="bullet/hopper", loss=0.1, healthy=True, note=None),
        row(1000, 1, loss=-3, healthy=False),
    ]
    write(tmp_path, rows)
    assert read_metrics(tmp_path) == read_metrics(tmp_path / "metrics.jsonl") == rows
    assert [list(values) for values in read_metrics(tmp_path)] == [list(values) for values in rows]


@given(values=st.lists(st.floats(width=64) | st.floats(width=32), min_size=1))
@settings(max_examples=50, deadline=None)
def test_every_float_is_read_back_to_the_bit_and_every_line_is_strict_json(
    tmp_path_factory, values
):
    directory = tmp_path_factory.mktemp("floats")
    content = write(directory, [row(value=value) for value in values])

    def refuse(constant):
        raise AssertionError(f"{constant} is not JSON")

    for line in content.splitlines():
        json.loads(line, parse_constant=refuse)
    for written, read in zip(values, read_metrics(directory), strict=True):
        if math.isnan(written):
            assert math.isnan(read["value"])
        else:
            assert struct.pack("d", read["value"]) == struct.pack("d", written)


@pytest.mark.parametrize(
    "value", [np.float32(0.1), jnp.float32(0.1), np.array([0.1], np.float32), jnp.bfloat16(0.1)]
)
def test_array_scalars_keep_their_exact_value(tmp_path, value):
    write(tmp_path, [row(value=value)])
    read = read_metrics(tmp_path)[0]["value"]
    assert isinstance(read, float) and read == float(np.asarray(value).reshape(()))


def test_rows_that_do_not_fit_are_refused_and_named(tmp_path):
    with MetricsWriter(tmp_path, tensorboard=False) as writer:
        with pytest.raises(ValueError, match=r"lacks \['member', 'env_steps'\]"):
            writer.write({"kind": "update", "loss": 1.0})
        with pytest.raises(TypeError, match=r"'loss' is a ndarray\[3\], expected one number"):
            writer.write(row(loss=np.zeros(3)))
        with pytest.raises(TypeError, match="'loss' is a list"):
            writer.write(row(loss=[1.0]))
        assert writer.offset() == 0


# --- killed and resumed ---------------------------------------------------------------------------

ROWS = [row(1000 * (i // 2), i % 2, label=f"ω {i}", loss=math.exp(i)) for i in range(8)]


@pytest.mark.parametrize("committed", [0, 3, 8])
@pytest.mark.parametrize("tensorboard", [False, True])
def test_a_resumed_file_is_the_same_to_the_byte(tmp_path, committed, tensorboard):
    expected = write(tmp_path / "whole", ROWS)
    with MetricsWriter(tmp_path / "resumed", tensorboard=tensorboard) as writer:
        for values in ROWS[:committed]:
            writer.write(values)
        offset = writer.offset()
        for values in ROWS[committed:6]:
            writer.write({**values, "loss": -1.0})
    with open(tmp_path / "resumed" / "metrics.jsonl", "ab") as file:
        file.write(b'{"kind": "upd')  # killed while writing

    with MetricsWriter(tmp_path / "resumed", tensorboard=tensorboard) as writer:
        writer.truncate(offset)
        assert writer.offset() == offset
        for values in ROWS[committed:]:
            writer.write(values)
    assert (tmp_path / "resumed" / "metrics.jsonl").read_bytes() == expected


def test_the_offset_is_the_size_of_the_file_in_bytes(tmp_path):
    with MetricsWriter(tmp_path, tensorboard=False) as writer:
        for values in ROWS:  # with a label that is longer in bytes than in letters
            writer.write(values)
            assert writer.offset() == writer.path.stat().st_size


def test_truncation_that_does_not_fit_is_refused(tmp_path):
    size = len(write(tmp_path, ROWS))
    with MetricsWriter(tmp_path, tensorboard=False) as writer:
        with pytest.raises(ValueError, match=f"metrics.jsonl has {size} bytes, {size + 1} were"):
            writer.truncate(size + 1)
        with pytest.raises(ValueError, match=f"byte {size - 5} .* not the end of a line"):
            writer.truncate(size - 5)
    assert read_metrics(tmp_path) == ROWS


def test_a_half_written_last_line_is_left_out_and_written_over(tmp_path):
    content = write(tmp_path, ROWS[:2])
    (tmp_path / "metrics.jsonl").write_bytes(content[:-4])
    assert read_metrics(tmp_path) == ROWS[:1]
    write(tmp_path, ROWS[1:2])
    assert (tmp_path / "metrics.jsonl").read_bytes() == content


def test_a_broken_line_before_the_last_is_an_error_that_names_it(tmp_path):
    content = write(tmp_path, ROWS)
    (tmp_path / "metrics.jsonl").write_bytes(b"{}\n{broken\n" + content)
    with pytest.raises(ValueError, match="line 2 of .*metrics.jsonl is not JSON: b'{broken'"):
        read_metrics(tmp_path)


def test_a_killed_process_loses_no_row_that_was_written(tmp_path):
    script = """
        import os, signal, sys
        from pathlib import Path
        from dreamer_jax.logs import MetricsWriter
        writer = MetricsWriter(Path(sys.argv[1]), tensorboard=False)
        for step in range(5):
            writer.write({"kind": "update", "member": 0, "env_steps": step})
        os.kill(os.getpid(), signal.SIGKILL)
    """
    subprocess.run([sys.executable, "-c", textwrap.dedent(script), str(tmp_path)])
    assert [values["env_steps"] for values in read_metrics(tmp_path)] == list(range(5))


def test_a_full_disk_leaves_whole_lines_and_says_so(tmp_path):
    with MetricsWriter(tmp_path, tensorboard=False) as writer:
        writer.write(ROWS[0])

        class Full:
            def __init__(self, file):
                self.file = file

            def write(self, line):
                if len(line) < 20:
                    raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
                return self.file.write(line[: len(line) - 10])

            def __getattr__(self, name):
                return getattr(self.file, name)

        writer._metrics._file = Full(writer._metrics._file)
        with pytest.raises(OSError, match="metrics.jsonl: No space left .* MiB free"):
            writer.write(ROWS[1])
        writer._metrics._file = writer._metrics._file.file
        writer.write(ROWS[2])
    assert (tmp_path / "metrics.jsonl").read_bytes().count(b"\n") == 2
    assert read_metrics(tmp_path) == [ROWS[0], ROWS[2]]


def test_clock_times_go_to_a_file_of_their_own(tmp_path, monkeypatch):
    monkeypatch.setattr(logs_module.time, "time", lambda: 1234.5678)
    with MetricsWriter(tmp_path, tensorboard=False) as writer:
        writer.write_timing({"kind": "collect", "seconds": 0.5})
        assert writer.offset() == 0
    assert read_metrics(tmp_path / "timings.jsonl") == [
        {"time": 1234.568, "kind": "collect", "seconds": 0.5}
    ]


# --- TensorBoard ----------------------------------------------------------------------------------


def events(run):
    """The events of a TensorBoard run: length, checksum, message, checksum, and so on."""
    found = []
    for path in sorted(run.iterdir()):
        data, position = path.read_bytes(), 0
        while position < len(data):
            (length,) = struct.unpack_from("<Q", data, position)
            found.append(Event.FromString(data[position + 12 : position + 12 + length]))
            position += 16 + length
    return found


def scalars(run):
    return [
        (value.tag, event.step, value.simple_value)
        for event in events(run)
        for value in event.summary.value
    ]


def test_each_member_is_a_tensorboard_run_with_its_numbers_over_environment_steps(tmp_path):
    rows = [
        row(1000, 0, seed=3, updates=10, loss=0.5, healthy=True, norm=math.nan),
        {"kind": "evaluation", "member": 1, "label": "ω = 0.2/x", "env_steps": 2000,
         "task": "bullet/hopper", "return": 7.0},
    ]  # fmt: skip
    write(tmp_path, rows, tensorboard=True)
    board = tmp_path / "tensorboard"
    assert sorted(path.name for path in board.iterdir()) == ["member_000", "member_001_ω_=_0.2_x"]
    assert scalars(board / "member_000") == [
        ("update/loss", 1000, 0.5),
        ("update/healthy", 1000, 1),
    ]
    assert scalars(board / "member_001_ω_=_0.2_x") == [
        ("evaluation/bullet/hopper/return", 2000, 7.0)
    ]


def test_after_a_resume_tensorboard_hides_what_was_beyond_the_committed_rows(tmp_path):
    with MetricsWriter(tmp_path) as writer:
        writer.write(row(1000, loss=1.0))
        offset = writer.offset()
        writer.write(row(2000, loss=2.0))
    with MetricsWriter(tmp_path) as writer:
        writer.truncate(offset)
        writer.write(row(2000, loss=3.0))
    purges = [
        e.step for e in events(tmp_path / "tensorboard" / "member_000") if e.session_log.status
    ]
    assert purges == [1001]
