"""Small helpers for files that must survive a process killed at any moment."""

from __future__ import annotations

import errno
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
        sync_folder(path.parent)
    except BaseException:
        temporary.unlink(missing_ok=True)
        raise


def sync_folder(folder: str | os.PathLike) -> None:
    """Wait until the names in a folder are on the disk, so that no loss of power undoes them."""
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def read_json(path: str | os.PathLike) -> Any:
    """The value in a JSON file; `ValueError` naming the file if it is not JSON."""
    content = Path(path).read_bytes()
    try:
        return json.loads(content.decode("utf-8"))
    except (json.JSONDecodeError, UnicodeDecodeError) as error:
        raise ValueError(f"{path} is not valid JSON ({error}); delete it or restore it") from error


def explained(error: OSError, what: str, path: str | os.PathLike, advice: str = "") -> OSError:
    """`error` again, of the same kind, saying what failed, where, and the way out.

    Args:
      error: what the system reported.
      what: failed, with its name.
      path: a place on the disk that was written to.
      advice: what has become of everything else.
    """
    reason = error.strerror or str(error)
    if error.errno in (errno.EMFILE, errno.ENFILE):
        reason += "; allow more open files (ulimit -n) and resume"
    elif error.errno in (errno.ENOSPC, errno.EDQUOT):
        reason += f" ({_free_space(Path(path))}); make room and resume"
    else:
        reason += f" ({_free_space(Path(path))})"
    message = f"{what}: {reason}"
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
