"""Metrics, progress and videos: exact, the same after a resume, and readable half-written."""

import errno
import io
import json
import math
import os
import re
import struct
import subprocess
import sys
import textwrap

import imageio.v3 as imageio
import imageio_ffmpeg
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from tensorboardX.proto.event_pb2 import Event

from dreamer_jax import logs as logs_module
from dreamer_jax import progress as progress_module
from dreamer_jax.logs import MetricsWriter, Progress, read_metrics, tile, write_video


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


# --- progress -------------------------------------------------------------------------------------


@pytest.fixture
def clock(monkeypatch):
    class Clock:
        now = 0.0

        def monotonic(self):
            return self.now

    clock = Clock()
    monkeypatch.setattr(progress_module, "time", clock)
    return clock


def test_rates_count_the_time_of_their_own_work_and_the_time_left_counts_all(clock):
    stream = io.StringIO()
    with Progress(4000, 40, stream=stream, interval=0, description="run") as progress:
        for done in (1, 2):
            progress.update(phase="collecting")
            clock.now += 2.0
            progress.update(env_steps=1000 * done, last_return=-838.25)
            clock.now += 1.0  # something else
            progress.update(phase="updating")
            for update in range(10):
                clock.now += 0.25
                progress.update(updates=10 * (done - 1) + update + 1)
        assert progress.seconds_left() == pytest.approx(11.0)
    last = stream.getvalue().splitlines()[-1]
    assert last == (
        "run · updating 50% · 2,000/4,000 steps · return -838.2 · 500 steps/s · 4 updates/s"
        " · 0:11 left"
    )


def test_the_time_left_of_a_resumed_run_goes_by_what_it_did_itself(clock):
    with Progress(1000, 0, env_steps=800, stream=io.StringIO()) as progress:
        assert progress.seconds_left() is None
        clock.now += 10.0
        progress.update(env_steps=900)
        assert progress.seconds_left() == pytest.approx(10.0)
        progress.update(env_steps=1000)
        assert progress.seconds_left() == 0.0


def test_where_there_is_no_terminal_plain_lines_come_now_and_then(clock):
    stream = io.StringIO()
    with Progress(1000, 0, stream=stream, interval=30.0) as progress:
        for second in range(100):
            clock.now = float(second)
            progress.update(env_steps=second)
        progress.message("[bold] stays as it is")
    lines = stream.getvalue().splitlines()
    assert len(lines) == 4 + 1 + 1  # at 0, 30, 60 and 90 seconds, the message, the end
    assert "[bold] stays as it is" in lines
    assert "\x1b" not in stream.getvalue() and "\r" not in stream.getvalue()


def test_on_a_terminal_there_is_a_live_bar_that_fits_it(monkeypatch):
    monkeypatch.setenv("COLUMNS", "60")
    monkeypatch.setenv("TERM", "xterm")

    class Terminal(io.StringIO):
        def isatty(self):
            return True

    stream = Terminal()
    with Progress(1000, 10, stream=stream, description="hopper") as progress:
        progress.update(phase="collecting")
        progress.update(env_steps=500, updates=5, last_return=3.0)
        progress.message("a simulator was slow")
    shown = stream.getvalue()
    assert "hopper · collecting" in shown and "50%" in shown and "500/1,000 steps" in shown
    assert "a simulator was slow" in shown and "\x1b[2K" in shown


def test_a_run_without_updates_or_steps_is_no_division_by_zero():
    with Progress(0, 0, stream=io.StringIO()) as progress:
        progress.update(env_steps=0, updates=0)


# --- videos ---------------------------------------------------------------------------------------


def frames(count=6, height=32, width=48):
    """Each frame of one grey level, with a red left half."""
    video = np.repeat(np.arange(count, dtype=np.uint8) * 40, height * width * 3)
    video = video.reshape(count, height, width, 3)
    video[:, :, : width // 2] = [200, 0, 0]
    return video


def read_mp4(path):
    """The frames, and what ffmpeg says of the file."""
    command = [
        imageio_ffmpeg.get_ffmpeg_exe(),
        "-i",
        path,
        "-f",
        "rawvideo",
        "-pix_fmt",
        "rgb24",
        "-",
    ]
    read = subprocess.run(command, capture_output=True, check=True)
    description = read.stderr.decode()
    width, height = map(int, re.search(r"Video: h264.* (\d+)x(\d+)", description).groups())
    return description, np.frombuffer(read.stdout, np.uint8).reshape(-1, height, width, 3)


def test_an_mp4_shows_the_frames_enlarged_by_a_whole_factor(tmp_path):
    path = write_video(tmp_path / "videos" / "episode.mp4", frames(), fps=10)
    description, shown = read_mp4(path)
    assert "yuv420p" in description and ", 10 fps," in description
    assert shown.shape == (6, 256, 384, 3)
    for index in range(6):
        np.testing.assert_allclose(shown[index, 128, 300], 40 * index, atol=12)
        np.testing.assert_allclose(shown[index, 128, 100], [200, 0, 0], atol=25)
    assert [file.name for file in path.parent.iterdir()] == ["episode.mp4"]


def test_odd_sides_are_made_even_by_repeating_the_last_pixels(tmp_path):
    _, shown = read_mp4(write_video(tmp_path / "odd.mp4", frames(2, 301, 257)))
    assert shown.shape == (2, 302, 258, 3)
    np.testing.assert_allclose(shown[1, -1, -1], 40, atol=12)


def test_a_gif_shows_the_same_frames(tmp_path):
    path = write_video(tmp_path / "episode.gif", frames(), fps=10)
    shown = imageio.imread(path)
    assert shown.shape == (6, 256, 384, 3)
    assert imageio.immeta(path)["duration"] == 100
    expected = frames().repeat(8, axis=1).repeat(8, axis=2)
    np.testing.assert_allclose(shown.astype(int), expected, atol=8)


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        (np.zeros((4, 8, 8), np.uint8), r"uint8 \[4, 8, 8\], expected uint8 \[frames, height"),
        (np.zeros((4, 8, 8, 4), np.uint8), r"uint8 \[4, 8, 8, 4\]"),
        (np.zeros((4, 8, 8, 3), np.float32), r"float32 \[4, 8, 8, 3\]"),
        (np.zeros((0, 8, 8, 3), np.uint8), r"uint8 \[0, 8, 8, 3\]"),
    ],
)
def test_frames_that_are_no_video_are_refused(tmp_path, wrong, message):
    with pytest.raises(ValueError, match=message):
        write_video(tmp_path / "x.mp4", wrong)
    assert not list(tmp_path.iterdir())


def test_a_suffix_or_rate_that_cannot_be_written_is_refused(tmp_path):
    with pytest.raises(ValueError, match=r"'.avi', expected one of \['.gif', '.mp4'\]"):
        write_video(tmp_path / "x.avi", frames())
    with pytest.raises(ValueError, match="fps must be positive, got 0"):
        write_video(tmp_path / "x.mp4", frames(), fps=0)


def test_a_video_that_cannot_be_written_is_an_error_that_says_why_and_leaves_nothing(tmp_path):
    (tmp_path / "x.tmp.mp4").symlink_to(tmp_path / "absent" / "x.mp4")
    with pytest.raises(OSError, match="x.tmp.mp4: ffmpeg says .*No such file or directory"):
        write_video(tmp_path / "x.mp4", np.concatenate([frames()] * 20))
    assert not list(tmp_path.iterdir())


def test_tiles_stand_side_by_side_with_a_border_between():
    videos = np.stack([np.full((4, 5, 6, 3), level, np.uint8) for level in (10, 20, 30)])
    tiled = tile(videos, border=2, colour=255)
    assert tiled.shape == (4, 5, 6 * 3 + 2 * 2, 3)
    expected = [10] * 6 + [255] * 2 + [20] * 6 + [255] * 2 + [30] * 6
    np.testing.assert_array_equal(tiled[2, 3, :, 1], expected)
    np.testing.assert_array_equal(tile(videos[:1]), videos[0])
    np.testing.assert_array_equal(tile(videos, border=0)[0, 0, :, 0], np.repeat([10, 20, 30], 6))
    with pytest.raises(ValueError, match=r"\[4, 5, 6, 3\], expected \[videos, frames"):
        tile(videos[0])
