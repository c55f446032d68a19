"""Whether a run's folder holds what was written into it. Reads, changes nothing, needs no JAX.

Axis letters: P population member, K task.
"""

from __future__ import annotations

import os
from collections.abc import Iterable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Literal, NamedTuple

import numpy as np

from dreamer_jax.checkpoint import Checkpointer, CorruptCheckpointError
from dreamer_jax.integrity import DamagedError, file_checksum, is_sealed, read_sealed_json
from dreamer_jax.logs import read_metrics
from dreamer_jax.replay import Replay
from dreamer_jax.schema import METADATA, REPLAY, check_shape

State = Literal["sound", "damaged", "unchecked"]


class Finding(NamedTuple):
    """What was found of one part of a folder.

    Attributes:
      part: such as "replay".
      state: "sound" (compared with checksums), "damaged", or "unchecked" (there are none).
      text: what was compared, or what is wrong.
    """

    part: str
    state: State
    text: str


def verify(directory: str | os.PathLike) -> list[Finding]:
    """Compares all of a run's folder that a resumed run reads with its checksums.

    A folder that is being trained in is best looked at when that is done.
    """
    directory = Path(directory)
    findings, committed = _checkpoints(Checkpointer(directory / "checkpoints"))
    for name, part in (("replay", _replay), ("metrics.jsonl", _metrics)):
        try:
            findings += part(directory, committed)
        except (OSError, ValueError, KeyError, TypeError) as error:
            findings.append(Finding(name, "damaged", str(error)))
    return findings


def _checkpoints(checkpoints: Checkpointer) -> tuple[list[Finding], list[dict]]:
    """Findings, and the metadata of the checkpoints that are sound, newest first."""
    findings, committed = [], []
    for step in checkpoints.steps()[::-1]:
        name = f"checkpoint {step}"
        try:
            sealed = checkpoints.check(step)
            path = checkpoints.path(step) / "metadata.json"
            committed.append(check_shape(checkpoints.metadata(step), METADATA, path))
        except (CorruptCheckpointError, DamagedError, OSError) as error:
            findings.append(Finding(name, "damaged", str(error)))
            continue
        files = sum(path.is_file() for path in checkpoints.path(step).rglob("*"))
        findings.append(
            Finding(name, "sound", f"{files} files")
            if sealed
            else Finding(name, "unchecked", "an earlier version wrote it, without checksums")
        )
    if not findings:
        findings.append(Finding("checkpoints", "unchecked", "there are none"))
    return findings, committed


def sealed_file(directory: Path, name: str) -> Finding:
    """What is found of a JSON file that carries its own checksum."""
    try:
        read_sealed_json(directory / name)
        if is_sealed(directory / name):
            return Finding(name, "sound", "its checksum")
        return Finding(name, "unchecked", "it has no checksum")
    except (OSError, ValueError) as error:
        return Finding(name, "damaged", str(error))


def _replay(directory: Path, committed: list[dict]) -> Iterable[Finding]:
    folder = directory / "replay"
    if not (folder / "replay.json").exists():
        if committed:
            yield Finding("replay", "unchecked", "there is none: the run cannot be resumed")
        return
    for name in ("replay.json", "deleted.json"):
        if (folder / name).exists():
            yield sealed_file(folder, name)
    layout = check_shape(read_sealed_json(folder / "replay.json"), REPLAY, folder / "replay.json")
    layout.pop("format", None)
    replay = Replay(folder, **layout)
    if committed:
        newest = committed[0]
        replay.check(np.asarray(newest["replay"]), newest.get("checksums", {}).get("replay"))
    lengths = np.asarray(committed[0]["replay"] if committed else replay.lengths)
    problems, unchecked = [], 0
    streams = list(np.ndindex(*lengths.shape))
    with ThreadPoolExecutor(os.cpu_count() or 1) as pool:
        for problem, missing in pool.map(
            lambda stream: replay.verify(stream[0], stream[1], int(lengths[stream])), streams
        ):
            problems += [problem] if problem else []
            unchecked += missing
    for problem in problems:
        yield Finding("replay", "damaged", problem)
    if unchecked:
        yield Finding("replay", "unchecked", f"{unchecked} records have no checksum")
    if not problems:
        records = int((lengths - np.minimum(replay.deleted, lengths)).sum()) - unchecked
        yield Finding("replay", "sound", f"{records} records in {len(streams)} streams")


def _metrics(directory: Path, committed: list[dict]) -> Iterable[Finding]:
    path = directory / "metrics.jsonl"
    if not path.exists():
        if committed and committed[0]["metrics"]:
            raise DamagedError(f"{path} is missing")
        return
    rows = read_metrics(path)
    checked = False
    for metadata in committed[::-1]:
        offset, checksum = metadata["metrics"], metadata.get("checksums", {}).get("metrics")
        if path.stat().st_size < offset:
            raise DamagedError(f"{path} has {path.stat().st_size} bytes, {offset} were written")
        if checksum is not None:
            checked = True
            if file_checksum(path, offset) != checksum:
                raise DamagedError(
                    f"{path} is not what was written: its first {offset} bytes differ"
                )
    yield Finding("metrics.jsonl", "sound" if checked else "unchecked", f"{len(rows)} rows")
