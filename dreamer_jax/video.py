"""Videos of episodes: frames uint8 [T, height, width, 3] to mp4 or gif.

Axis letters: T frames, N videos side by side.
"""

from __future__ import annotations

import contextlib
import os
import subprocess
from collections.abc import Sequence
from pathlib import Path

import numpy as np

_SMALLEST_SIDE = 256  # pixels; smaller frames are enlarged to at least this


def write_video(path: str | os.PathLike, frames: np.ndarray, fps: float = 25.0) -> Path:
    """Write frames as a video; small ones enlarged by a whole factor, pixels staying squares.

    Args:
      path: ends in .mp4 (H.264) or .gif; its folder is made if absent.
      frames: uint8 [T, height, width, 3].
      fps: frames per second.

    Returns:
      the path.

    Raises:
      ValueError: the frames have another shape or dtype, there are none, or the suffix is
        another.
      OSError: the file cannot be written; with the reason.
    """
    path = Path(path)
    frames = np.asarray(frames)
    if frames.ndim != 4 or frames.shape[-1] != 3 or 0 in frames.shape or frames.dtype != np.uint8:
        raise ValueError(
            f"frames are {frames.dtype} {list(frames.shape)}, "
            "expected uint8 [frames, height, width, 3]"
        )
    writers = {".mp4": _write_mp4, ".gif": _write_gif}
    if path.suffix not in writers:
        raise ValueError(f"{path} ends in {path.suffix!r}, expected one of {sorted(writers)}")
    if not fps > 0:
        raise ValueError(f"fps must be positive, got {fps}")
    path.parent.mkdir(parents=True, exist_ok=True)
    # Under another name first: a video that is there is whole.
    temporary = path.with_name(f"{path.stem}.tmp{path.suffix}")
    try:
        writers[path.suffix](temporary, frames, fps)
        os.replace(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)
    return path


def tile(videos: np.ndarray, border: int = 2, colour: int = 255) -> np.ndarray:
    """Videos side by side: uint8 [N, T, height, width, 3] -> [T, height, wider, 3].

    `border` columns of grey level `colour` stand between neighbours.
    """
    videos = np.asarray(videos)
    if videos.ndim != 5 or videos.shape[-1] != 3 or not len(videos):
        raise ValueError(
            f"videos have shape {list(videos.shape)}, expected [videos, frames, height, width, 3]"
        )
    bordered = np.pad(videos, ((0, 0), (0, 0), (0, 0), (0, border), (0, 0)), constant_values=colour)
    row = np.concatenate(list(bordered), axis=2)
    return row[:, :, : row.shape[2] - border]


def captioned(videos: np.ndarray, captions: Sequence[str], border: int = 8) -> np.ndarray:
    """Videos side by side, enlarged, each with its caption above it: black on white.

    Args:
      videos: uint8 [N, T, height, width, 3].
      captions: one for each video, in Latin letters; a line break begins a new line.
      border: white pixels around every video.

    Returns:
      uint8 [T, taller, wider, 3].

    Raises:
      ValueError: the videos have another shape, or there are more or fewer captions.
    """
    from PIL import Image, ImageDraw, ImageFont

    videos = np.asarray(videos)
    if videos.ndim != 5 or videos.shape[-1] != 3 or len(videos) != len(captions) or not captions:
        raise ValueError(
            f"videos have shape {list(videos.shape)} and there are {len(captions)} captions, "
            "expected [videos, frames, height, width, 3] and one for each video"
        )
    factor = -(-_SMALLEST_SIDE // min(videos.shape[2:4]))
    height, width = (factor * side for side in videos.shape[2:4])
    font = ImageFont.load_default(size=16)
    lines = max(caption.count("\n") + 1 for caption in captions)
    top = 22 * lines + border
    strip = Image.new("RGB", (len(captions) * (width + border) + border, top), "white")
    for i, caption in enumerate(captions):
        centre = border + i * (width + border) + width / 2
        ImageDraw.Draw(strip).multiline_text(
            (centre, border / 2), caption, fill="black", font=font, anchor="ma", align="center"
        )
    frames = np.full((videos.shape[1], top + height + border, strip.width, 3), 255, dtype=np.uint8)
    frames[:, :top] = np.asarray(strip)
    for i, video in enumerate(videos):
        left = border + i * (width + border)
        large = video.repeat(factor, axis=1).repeat(factor, axis=2)
        frames[:, top : top + height, left : left + width] = large
    return frames


def _enlarged(frame: np.ndarray, even: bool) -> np.ndarray:
    """The frame by a whole factor, its sides made even where the video format asks for it."""
    factor = -(-_SMALLEST_SIDE // min(frame.shape[:2]))
    if factor > 1:
        frame = frame.repeat(factor, axis=0).repeat(factor, axis=1)
    if even and (frame.shape[0] % 2 or frame.shape[1] % 2):
        odd = ((0, frame.shape[0] % 2), (0, frame.shape[1] % 2), (0, 0))
        frame = np.pad(frame, odd, mode="edge")
    return np.ascontiguousarray(frame)


def _write_mp4(path: Path, frames: np.ndarray, fps: float) -> None:
    # imageio's own writer forks with Python code in between, which JAX's threads can deadlock.
    import imageio_ffmpeg

    height, width = _enlarged(frames[0], even=True).shape[:2]
    source = f"-f rawvideo -pix_fmt rgb24 -s {width}x{height} -r {fps} -i -"
    encoding = "-an -c:v libx264 -pix_fmt yuv420p -crf 18 -threads 1 -movflags +faststart"
    command = [imageio_ffmpeg.get_ffmpeg_exe(), "-y", "-loglevel", "error"]
    with subprocess.Popen(
        [*command, *source.split(), *encoding.split(), str(path)],
        stdin=subprocess.PIPE,
        stderr=subprocess.PIPE,
        process_group=0,  # Ctrl-C is for the run, which finishes its videos
    ) as process:
        assert process.stdin is not None
        with contextlib.suppress(BrokenPipeError):  # its own message is better
            for frame in frames:
                process.stdin.write(_enlarged(frame, even=True).data)
        message = process.communicate()[1].decode(errors="replace").strip()
    if process.returncode:
        raise OSError(f"could not write {path}: ffmpeg says {message or process.returncode}")


def _write_gif(path: Path, frames: np.ndarray, fps: float) -> None:
    import imageio.v3 as imageio

    images = [_enlarged(frame, even=False) for frame in frames]
    imageio.imwrite(path, images, extension=".gif", duration=1000.0 / fps, loop=0)
