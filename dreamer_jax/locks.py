"""One process at a time in a folder, or many that know of one another: locks that end with their
process, however that ends.

A lock is `flock` on a file in the folder. The file of a sole right also says who holds it, for the
message to whoever comes second. Files are left behind, empty of meaning, when locks are given back.
Between machines locks hold where the file system they share knows `flock` (NFS of version 4 does).
"""

from __future__ import annotations

import errno
import fcntl
import json
import os
import socket
import warnings
from datetime import datetime
from pathlib import Path
from typing import IO

from dreamer_jax.files import explained

_UNSUPPORTED = (errno.ENOLCK, errno.ENOTSUP, errno.EOPNOTSUPP, errno.ENOSYS)


class FolderInUseError(ValueError):
    """Another process works in the folder.

    Attributes:
      holder: which one, in words.
    """

    def __init__(self, directory: Path, holder: str):
        super().__init__(
            f"{directory} is in use by {holder}: wait until it is done or stop it, or choose "
            "another folder"
        )
        self.holder = holder


class FolderLock:
    """The sole right to write a folder, from its making to `release` or the process's end.

    A context manager too. A second lock of the same name in one process is refused like any other.

    Args:
      directory: the folder; made if absent.
      name: of the lock's file. Work that does not disturb other work has a lock of its own.

    Raises:
      FolderInUseError: another process (named, with its host and since when) holds it.
      NotADirectoryError: there is a file in the folder's place.
      OSError: the folder cannot be written.
    """

    def __init__(self, directory: str | os.PathLike, name: str = ".lock"):
        directory = Path(directory)
        self.path = directory / name
        self._file = _opened(self.path)
        if not _locked(self._file, directory, fcntl.LOCK_EX | fcntl.LOCK_NB):
            holder = self._holder()
            self._file.close()
            raise FolderInUseError(directory, holder)
        self._say_who()

    def _say_who(self) -> None:
        since = datetime.now().astimezone().isoformat(sep=" ", timespec="seconds")
        self._file.truncate(0)
        json.dump({"pid": os.getpid(), "host": socket.gethostname(), "since": since}, self._file)
        self._file.flush()

    def _holder(self) -> str:
        try:
            self._file.seek(0)
            who = json.load(self._file)
            return f"process {who['pid']} on {who['host']}, since {who['since']}"
        except (ValueError, KeyError, TypeError, OSError):
            return "another process"  # which has not yet said who it is

    def release(self) -> None:
        """Give the lock back; may be called twice."""
        self._file.close()

    def __enter__(self) -> FolderLock:
        return self

    def __exit__(self, *_) -> None:
        self.release()


class Presence:
    """Being at work in a folder beside others, from its making to `release` or the process's end.

    A context manager too.

    Args:
      directory: the folder; made if absent.
      name: of the lock's file.

    Attributes:
      alone: whether nobody else was at work there as this one came.

    Raises:
      NotADirectoryError: there is a file in the folder's place.
      OSError: the folder cannot be written.
    """

    def __init__(self, directory: str | os.PathLike, name: str = ".presence"):
        directory = Path(directory)
        self._file = _opened(directory / name)
        self.alone = _locked(self._file, directory, fcntl.LOCK_EX | fcntl.LOCK_NB)
        # Who comes at the same moment waits here until this one holds no more than its share.
        _locked(self._file, directory, fcntl.LOCK_SH)

    def release(self) -> None:
        """Leave; may be called twice."""
        self._file.close()

    def __enter__(self) -> Presence:
        return self

    def __exit__(self, *_) -> None:
        self.release()


def _opened(path: Path) -> IO[str]:
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        return open(path, "a+")
    except (FileExistsError, NotADirectoryError):
        raise NotADirectoryError(
            f"{path.parent} is, or lies in, a file, and a folder is needed: choose another place"
        ) from None
    except OSError as error:
        raise explained(error, f"could not lock {path.parent}", path.parent) from error


def _locked(file: IO[str], directory: Path, operation: int) -> bool:
    """Whether a lock was had; also where there are none, with a warning."""
    try:
        fcntl.flock(file, operation)
    except BlockingIOError:
        return False
    except OSError as error:
        if error.errno not in _UNSUPPORTED:
            file.close()
            raise
        warnings.warn(
            f"the file system of {directory} knows no locks: take care that no second process "
            "writes this folder",
            stacklevel=3,
        )
    return True
