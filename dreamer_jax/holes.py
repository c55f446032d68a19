"""Disk space given back from within files, which keep their lengths. Linux only."""

from __future__ import annotations

import ctypes
import errno
import os
from pathlib import Path

_KEEP_SIZE, _PUNCH_HOLE = 1, 2  # flags of fallocate, from linux/falloc.h


def free_beginning(path: Path, size: int) -> None:
    """Free the disk blocks of a file's first `size` bytes, which are zeros from then on.

    Raises:
      OSError: among others with ENOTSUP, where the system or the file system cannot do it.
    """
    fallocate = getattr(ctypes.CDLL(None, use_errno=True), "fallocate", None)
    if fallocate is None:
        raise OSError(errno.ENOTSUP, os.strerror(errno.ENOTSUP), str(path))
    with open(path, "r+b") as file:
        flags = _KEEP_SIZE | _PUNCH_HOLE
        if fallocate(file.fileno(), flags, ctypes.c_int64(0), ctypes.c_int64(size)):
            code = ctypes.get_errno()
            raise OSError(code, os.strerror(code), str(path))
