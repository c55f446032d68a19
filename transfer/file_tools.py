"""What the readers of all formats share: one kind of error, limits of size, whole files."""

import math
import os
import tempfile
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path

import jax
import numpy as np

from transfer.leaves import find
from transfer.select import Leaves

LEAST_LIMIT = 2**28
"""256 MiB: arrays of less are read from any file, however well it is compressed."""

GREATEST_RATIO = 20
"""How many times the bytes on disk arrays may take by default."""


class DamagedFile(ValueError):
    """A file that is not what its name says; the message says why."""


class ArrayFile(Leaves):
    """Arrays in a file, read when they are asked for.

    A subclass has `shapes`, `__iter__` and `read`.
    """

    def __init__(self, path: Path, max_bytes: int | None):
        self._path = path
        self.max_bytes = max_bytes

    @property
    def disk_bytes(self) -> int:
        """What the file takes on disk."""
        return self._path.stat().st_size

    def read(self, names: Iterable[str]) -> dict[str, np.ndarray]:
        """Some of the arrays.

        Raises:
          ValueError: a name that is not in the file, a damaged file, or arrays of more bytes than
            the limit.
        """
        raise NotImplementedError

    def __getitem__(self, name: str) -> np.ndarray:
        if name not in self.shapes:
            raise KeyError(name)
        return self.read([name])[name]

    def __contains__(self, name: object) -> bool:
        return name in self.shapes

    def __len__(self) -> int:
        return len(self.shapes)

    def close(self) -> None:
        """Close the file; no array can be read afterwards."""

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self.close()

    def __repr__(self) -> str:
        return f"<{len(self)} arrays in {self._path}>"


@contextmanager
def damage(path: Path, what: str = "") -> Iterator[None]:
    """Whatever goes wrong inside is a `DamagedFile` that names the file."""
    try:
        yield
    except DamagedFile:
        raise
    except Exception as error:
        where = f"{what} in {path}" if what else f"{path}"
        reason = str(error) or type(error).__name__
        raise DamagedFile(f"{where} is damaged or cannot be read: {reason}") from error


def array_bytes(shape: jax.ShapeDtypeStruct) -> int:
    """The memory that an array takes."""
    return math.prod(shape.shape) * shape.dtype.itemsize


def check_size(file: ArrayFile, names: Iterable[str]) -> None:
    """Raise if some arrays of a file take more memory than its limit."""
    wanted = sum(array_bytes(find(file.shapes, name)) for name in names)
    on_disk = file.disk_bytes
    limit = file.max_bytes
    if limit is None:
        limit = max(LEAST_LIMIT, GREATEST_RATIO * on_disk)
    if wanted > limit:
        raise DamagedFile(
            f"{file._path} takes {_bytes(on_disk)} on disk, and its arrays {_bytes(wanted)} in "
            f"memory: more than the limit of {_bytes(limit)}. If that is right, give max_bytes."
        )


def _bytes(count: int) -> str:
    """A number of bytes for people."""
    amount = float(count)
    for unit in ("bytes", "KiB", "MiB", "GiB"):
        if amount < 1024:
            return f"{amount:.4g} {unit}"
        amount /= 1024
    return f"{amount:.4g} TiB"


@contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """A temporary file that takes the place of `path` when, and only when, it is complete."""
    path.parent.mkdir(parents=True, exist_ok=True)
    handle, name = tempfile.mkstemp(dir=path.parent, prefix=f".{path.name}.")
    os.close(handle)
    temporary = Path(name)
    try:
        yield temporary
        temporary.chmod(0o666 & ~_umask())
        os.replace(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)


def _umask() -> int:
    mask = os.umask(0)
    os.umask(mask)
    return mask
