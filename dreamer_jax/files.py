"""Small helpers for files that must survive a process killed at any moment."""

from __future__ import annotations

import json
import os
import shutil
from pathlib import Path
from typing import Any


def write_json_atomically(path: str | os.PathLike, value: Any) -> None:
    """Write `value` as JSON so that `path` holds either the old content or the new one, whole.

    Raises:
        ValueError: `value` holds NaN or an infinity, which JSON has no words for.
        OSError: the disk is full or not writable.
    """
    path = Path(path)
    text = json.dumps(value, indent=2, allow_nan=False) + "\n"
    temporary = path.with_name(path.name + ".tmp")
    try:
        with open(temporary, "w", encoding="utf-8") as file:
            file.write(text)
            file.flush()
            os.fsync(file.fileno())
        os.replace(temporary, path)
    except BaseException:
        temporary.unlink(missing_ok=True)
        raise


def read_json(path: str | os.PathLike) -> Any:
    """The value in a JSON file; `ValueError` naming the file if it is not JSON."""
    text = Path(path).read_text(encoding="utf-8")
    try:
        return json.loads(text)
    except json.JSONDecodeError as error:
        raise ValueError(f"{path} is not valid JSON ({error}); delete it or restore it") from error


def explained(error: OSError, what: str, path: str | os.PathLike, advice: str = "") -> OSError:
    """`error` again, of the same kind, saying what failed, where, and how full that disk is."""
    reason = error.strerror or str(error)
    message = f"{what}: {reason} ({_free_space(Path(path))})"
    if advice:
        message += f"; {advice}"
    # Three arguments would append the path to a message that names it already.
    return OSError(error.errno, message) if error.errno is not None else OSError(message)


def _free_space(path: Path) -> str:
    for place in (path, *path.absolute().parents):
        try:
            return f"{shutil.disk_usage(place).free / 2**20:,.0f} MiB free on its disk"
        except OSError:
            continue
    return "free space unknown"
