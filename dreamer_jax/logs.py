"""Metrics of a run, as JSON lines and for TensorBoard.

`metrics.jsonl` has one object per line, a row for one population member and one event. It holds
nothing that depends on the clock, so the file of a run that was killed and resumed is the same, to
the byte, as that of one that was not; clock times go to `timings.jsonl`. Numbers are written so
that they are read back exactly. JSON has no word for numbers that are not finite: they are the
strings "NaN", "Infinity" and "-Infinity", which `read_metrics` turns into floats again.
"""

from __future__ import annotations

import json
import math
import os
import re
import time
import zlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from dreamer_jax.files import explained
from dreamer_jax.integrity import DamagedError, file_checksum, sync_files

_NOT_FINITE = {"NaN": math.nan, "Infinity": math.inf, "-Infinity": -math.inf}
_NOT_PLOTTED = {"member", "seed", "env_steps", "updates"}


class MetricsWriter:
    """Rows of metrics into `directory/metrics.jsonl` and, for TensorBoard, `directory/tensorboard`.

    A row is a flat mapping such as::

        {"kind": "evaluation", "member": 0, "seed": 7, "task": "bullet/hopper",
         "env_steps": 10000, "updates": 1000, "return": 123.4}

    Its keys keep their order. `kind`, `member` and `env_steps` are needed. Numbers other than
    these are also TensorBoard scalars `kind/task/name` over environment steps (if finite), in a
    run of its own for each member, named after it and the row's `label`, if any.

    A row is handed to the operating system before `write` returns, so killing the process loses
    none. A file opened again is appended to; a half-written last line is dropped.

    Args:
      directory: the folder; made if absent.
      tensorboard: whether to write TensorBoard's files too.
    """

    def __init__(self, directory: str | os.PathLike, tensorboard: bool = True):
        self.directory = Path(directory)
        self.path = self.directory / "metrics.jsonl"
        self.directory.mkdir(parents=True, exist_ok=True)
        self._tensorboard = _TensorBoard(self.directory / "tensorboard") if tensorboard else None
        self._metrics = _Lines(self.path)
        self._timings = _Lines(self.directory / "timings.jsonl")
        if self._tensorboard and self._metrics.size:
            self._tensorboard.resume(read_metrics(self.path))

    def write(self, row: Mapping[str, Any]) -> None:
        """Add a row.

        Raises:
          ValueError: `kind`, `member` or `env_steps` is missing.
          TypeError: a value is not a number, a string, a truth value or None.
          OSError: the disk is full or not writable; the file keeps its whole lines.
        """
        missing = [name for name in ("kind", "member", "env_steps") if name not in row]
        if missing:
            raise ValueError(f"a row of metrics has the keys {list(row)}, it lacks {missing}")
        values = {name: _scalar(name, value) for name, value in row.items()}
        self._metrics.append(values)
        if self._tensorboard:
            self._tensorboard.write(values)

    def write_timing(self, row: Mapping[str, Any]) -> None:
        """Add a row to `timings.jsonl`, with `time` in seconds since 1970 in front."""
        values = {name: _scalar(name, value) for name, value in row.items()}
        self._timings.append({"time": round(time.time(), 3), **values})

    def offset(self) -> int:
        """Size of `metrics.jsonl` in bytes, for a checkpoint to commit."""
        return self._metrics.size

    def checksum(self) -> int:
        """CRC-32 of `metrics.jsonl` up to `offset()`, for a checkpoint to commit."""
        return self._metrics.checksum

    def sync(self) -> None:
        """Wait until all rows are on the disk, so that no loss of power takes them."""
        sync_files([self.path])

    def check(self, offset: int, checksum: int | None = None) -> None:
        """Whether the file holds the rows that a checkpoint committed.

        Args:
          offset: size of the rows in bytes.
          checksum: their CRC-32; None of a checkpoint that has none.

        Raises:
          DamagedError: it does not.
        """
        self._metrics.check(offset, checksum)

    def truncate(self, offset: int) -> None:
        """Drop the rows beyond a committed offset (0: all rows), in TensorBoard's view too.

        Raises:
          DamagedError: the file is shorter than that, or the offset is not the end of a line.
        """
        self._metrics.truncate(offset)
        if self._tensorboard:
            self._tensorboard.resume(read_metrics(self.path))

    def flush(self) -> None:
        """Hand to the operating system what TensorBoard's writers hold back."""
        if self._tensorboard:
            self._tensorboard.flush()

    def close(self) -> None:
        """Close all files; may be called twice."""
        self._metrics.close()
        self._timings.close()
        if self._tensorboard:
            self._tensorboard.close()

    def __enter__(self) -> MetricsWriter:
        return self

    def __exit__(self, *_) -> None:
        self.close()


def read_metrics(path: str | os.PathLike) -> list[dict[str, Any]]:
    """The rows of a `metrics.jsonl` (or `timings.jsonl`), or of the folder that holds one.

    A half-written last line is left out.

    Raises:
      FileNotFoundError: there is no such file.
      ValueError: a line before the last is not JSON; names the file and the line.
    """
    path = Path(path)
    if path.is_dir():
        path = path / "metrics.jsonl"
    lines = path.read_bytes().split(b"\n")[:-1]  # what follows the last newline is incomplete
    rows = []
    for number, line in enumerate(lines, start=1):
        try:
            row = json.loads(line)
        except ValueError as error:
            raise ValueError(f"line {number} of {path} is not JSON: {line[:80]!r}") from error
        rows.append(row)
    for number, row in enumerate(rows, start=1):
        if not isinstance(row, dict) or (path.name == "metrics.jsonl" and not _is_row(row)):
            raise DamagedError(
                f"line {number} of {path} lacks kind, member or env_steps, or they are not what "
                f"this program writes: {row!r:.80}"
            )
    rows = [{name: _parsed(value) for name, value in row.items()} for row in rows]
    return rows


def _is_row(row: Mapping[str, Any]) -> bool:
    """Whether a row has what all rows of metrics have (see `dreamer_jax.schema.METRICS_ROW`)."""
    numbers = (row.get("member"), row.get("env_steps"))
    return isinstance(row.get("kind"), str) and all(type(x) is int and x >= 0 for x in numbers)


def _parsed(value: Any) -> Any:
    return _NOT_FINITE.get(value, value) if isinstance(value, str) else value


def _scalar(name: str, value: Any) -> Any:
    """A Python scalar from one, or from a NumPy or JAX array of one element."""
    if hasattr(value, "item") and getattr(value, "size", 1) == 1:
        value = value.item()
    if value is not None and not isinstance(value, bool | int | float | str):
        raise TypeError(
            f"metric {name!r} is a {type(value).__name__}"
            f"{list(value.shape) if hasattr(value, 'shape') else ''}, expected one number, "
            "string or truth value"
        )
    return value


def _json_value(value: Any) -> Any:
    if isinstance(value, float) and not math.isfinite(value):
        return "NaN" if math.isnan(value) else "Infinity" if value > 0 else "-Infinity"
    return value


class _Lines:
    """A file of JSON lines that only ever holds whole ones."""

    def __init__(self, path: Path):
        self.path = path
        # Unbuffered: what a killed process had written is there, and nothing is written late.
        self._file = open(path, "ab", buffering=0)
        held = path.read_bytes()
        self.size = held.rfind(b"\n") + 1
        self.checksum = zlib.crc32(held[: self.size])
        if self.size < len(held):
            self._file.truncate(self.size)

    def append(self, row: Mapping[str, Any]) -> None:
        values = {name: _json_value(value) for name, value in row.items()}
        line = memoryview((json.dumps(values, allow_nan=False) + "\n").encode())
        written = 0
        try:
            while written < len(line):
                written += self._file.write(line[written:])
        except OSError as error:
            self._file.truncate(self.size)
            raise explained(error, f"could not write to {self.path}", self.path) from error
        self.size += len(line)
        self.checksum = zlib.crc32(line, self.checksum)

    def check(self, size: int, checksum: int | None) -> None:
        held = self.path.stat().st_size
        if not 0 <= size <= held:
            raise DamagedError(
                f"{self.path} has {held} bytes, {size} were to be kept: it does not belong to "
                "this checkpoint or has lost data; restore it, or resume from an older checkpoint"
            )
        if checksum is not None and file_checksum(self.path, size) != checksum:
            raise DamagedError(
                f"{self.path} is not what was written (the checksum of its first {size} bytes "
                "differs from its checkpoint's): restore it, or resume from an older checkpoint"
            )
        with open(self.path, "rb") as file:
            file.seek(max(size - 1, 0))
            if size and file.read(1) != b"\n":
                raise DamagedError(f"byte {size} of {self.path} is not the end of a line")

    def truncate(self, size: int) -> None:
        self.check(size, None)
        self._file.truncate(size)
        self.size = size
        self.checksum = file_checksum(self.path)

    def close(self) -> None:
        self._file.close()


class _TensorBoard:
    """One TensorBoard run per member, opened at its first row."""

    def __init__(self, directory: Path):
        self._directory = directory
        self._writers: dict[str, Any] = {}
        self._resumed = False
        self._last_step: dict[str, int] = {}

    def resume(self, rows: list[dict[str, Any]]) -> None:
        """Hide, from now on, what was plotted beyond the steps of `rows`."""
        self.close()
        self._resumed = True
        self._last_step = {}
        for row in rows:
            run = self._run(row)
            self._last_step[run] = max(row["env_steps"], self._last_step.get(run, 0))

    @staticmethod
    def _run(row: Mapping[str, Any]) -> str:
        label = re.sub(r"[^\w.=-]+", "_", str(row.get("label") or ""))
        return f"member_{row['member']:03d}" + (f"_{label}" if label else "")

    def write(self, row: Mapping[str, Any]) -> None:
        run = self._run(row)
        if run not in self._writers:
            from tensorboardX import SummaryWriter  # here: half a second to import

            purge_step = self._last_step.get(run, -1) + 1 if self._resumed else None
            self._writers[run] = SummaryWriter(str(self._directory / run), purge_step=purge_step)
        prefix = "/".join(str(row[name]) for name in ("kind", "task") if row.get(name))
        for name, value in row.items():
            number = isinstance(value, bool | int | float) and math.isfinite(value)
            if number and name not in _NOT_PLOTTED:
                self._writers[run].add_scalar(f"{prefix}/{name}", float(value), row["env_steps"])

    def flush(self) -> None:
        for writer in self._writers.values():
            writer.flush()

    def close(self) -> None:
        for writer in self._writers.values():
            writer.close()
        self._writers = {}
