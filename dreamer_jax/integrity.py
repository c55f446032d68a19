"""Checksums: whether what is read is what was written.

They tell what disks, copies and hands damage, not what somebody forges. CRC-32, as checksums go on
from one piece to the next, and take a thousandth of the time in which a phase is collected.
"""

from __future__ import annotations

import json
import os
import sys
import zlib
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

from dreamer_jax.files import read_json, sync_folder, write_json_atomically

CHECKSUMS = "checksums.json"
"""File with the checksums of the other files in a folder."""

_KEY = "crc32"
_PIECE = 1 << 20


class DamagedError(ValueError):
    """A file is not what was written; names it, and the way out."""


def file_checksum(path: str | os.PathLike, size: int | None = None) -> int:
    """CRC-32 of a file, or of its first `size` bytes, read piece by piece."""
    checksum, left = 0, sys.maxsize if size is None else size
    with open(path, "rb", buffering=0) as file:
        while left > 0 and (piece := file.read(min(_PIECE, left))):
            checksum = zlib.crc32(piece, checksum)
            left -= len(piece)
    return checksum


# A JSON object that carries its own checksum.


def _object_checksum(values: Mapping[str, Any]) -> int:
    text = json.dumps({name: x for name, x in values.items() if name != _KEY}, sort_keys=True)
    return zlib.crc32(text.encode())


def write_sealed_json(path: str | os.PathLike, values: Mapping[str, Any]) -> None:
    """Write a JSON object with a checksum of its other values; see `write_json_atomically`."""
    plain = json.loads(json.dumps(values, allow_nan=False))
    write_json_atomically(path, {**plain, _KEY: _object_checksum(plain)})


def read_sealed_json(path: str | os.PathLike) -> Any:
    """The value in a JSON file, an object's checksum taken off; without one it is not checked.

    Raises:
      DamagedError: it is not JSON, or not what was written.
    """
    try:
        values = read_json(path)
    except ValueError as error:  # of undecodable text too
        raise DamagedError(f"{path} is damaged ({error})") from error
    if not isinstance(values, dict) or _KEY not in values:
        return values
    if values[_KEY] != _object_checksum(values):
        raise DamagedError(
            f"{path} was changed after it was written (its checksum differs): restore it; if the "
            f'change is meant, take its line "{_KEY}" out'
        )
    return {name: value for name, value in values.items() if name != _KEY}


def is_sealed(path: str | os.PathLike) -> bool:
    """Whether a JSON file carries a checksum (which `read_sealed_json` checks)."""
    values = read_json(path)
    return isinstance(values, dict) and _KEY in values


# A folder of files with their checksums beside them.


def _files(folder: Path) -> dict[str, Path]:
    paths = sorted(path for path in folder.rglob("*") if path.is_file())
    return {path.relative_to(folder).as_posix(): path for path in paths}


def write_checksums(folder: Path) -> None:
    """Write size and checksum of every file in a folder into its checksums.json."""
    table = {
        name: [path.stat().st_size, file_checksum(path)]
        for name, path in _files(folder).items()
        if name != CHECKSUMS
    }
    write_json_atomically(folder / CHECKSUMS, {"files": table})


def check_files(folder: Path, names: Iterable[str] | None = None) -> str | None:
    """Compares files with the checksums beside them.

    Args:
      folder: holds the files, and checksums.json.
      names: which files; by default all that checksums.json lists.

    Returns:
      What is wrong with the first file that is missing or is not what was written; None if there
      is nothing.

    Raises:
      FileNotFoundError: there is no checksums.json.
    """
    try:
        table = read_json(folder / CHECKSUMS)["files"]
        sizes = {name: (int(size), int(checksum)) for name, (size, checksum) in table.items()}
    except (ValueError, KeyError, TypeError, AttributeError):
        return f"{CHECKSUMS} is damaged"
    for name in sizes if names is None else names:
        if name not in sizes:
            return f"{CHECKSUMS} does not list {name}"
        size, checksum = sizes[name]
        try:
            held = (folder / name).stat().st_size
            if held != size:
                return f"{name} has {held} bytes, {size} were written"
            if file_checksum(folder / name) != checksum:
                return f"{name} is not what was written (its checksum differs)"
        except OSError as error:
            return f"{name} cannot be read ({error.strerror})"
    return None


# What must survive a loss of power, not only of the process.


def sync_files(paths: Iterable[Path]) -> None:
    """Wait until the contents of files are on the disk."""
    for path in paths:
        descriptor = os.open(path, os.O_RDONLY)
        try:
            os.fsync(descriptor)
        finally:
            os.close(descriptor)


def sync_all(folder: Path) -> None:
    """Wait until everything under a folder is on the disk."""
    for place, _, names in os.walk(folder):
        sync_files(Path(place) / name for name in names)
        sync_folder(place)
