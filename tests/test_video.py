"""Videos show the frames they were given, read back by ffmpeg and Pillow."""

import re
import subprocess

import imageio.v3 as imageio
import imageio_ffmpeg
import numpy as np
import pytest

from dreamer_jax.video import captioned, tile, write_video


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


def test_captions_stand_above_enlarged_videos_on_white():
    videos = np.stack([frames(height=32, width=32), 255 - frames(height=32, width=32)])
    shown = captioned(videos, ["one", "another\nwith two lines"])
    # Two lines of 22 pixels and a border of 8 above, 8 below; 8 around each of two times 256.
    assert shown.shape == (6, 52 + 256 + 8, 8 + 2 * (256 + 8), 3)
    assert (shown[:, 52 : 52 + 256, 8:264] == videos[0].repeat(8, axis=1).repeat(8, axis=2)).all()
    assert (shown[:, 52 : 52 + 256, 272:528] == videos[1].repeat(8, axis=1).repeat(8, axis=2)).all()
    assert (shown[:, 52:, 264:272] == 255).all() and (shown[:, :52] < 128).any()
    # A caption stands above its own video.
    assert (captioned(videos, ["one", ""])[:, :30, 264:] == 255).all()


@pytest.mark.parametrize("captions", ([], ["one"], ["one", "two", "three"]))
def test_captions_that_are_not_one_for_each_video_are_refused(captions):
    with pytest.raises(ValueError, match=rf"\[2, 6, 32, 48, 3\] and there are {len(captions)}"):
        captioned(np.stack([frames(), frames()]), captions)
