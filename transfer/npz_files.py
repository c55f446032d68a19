"""Arrays in `.npz` files: zip archives of NumPy's own format, compressed or not."""

import io
import json
import math
import zipfile
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any, cast

import jax
import jax.numpy as jnp
import numpy as np

from transfer.file_tools import ArrayFile, DamagedFile, check_size, damage, replacing

# Kept beside the arrays: NumPy's own format forgets the dtypes of ml_dtypes (bfloat16).
_DTYPES = "__dtypes__"
_LONGEST_DTYPES = 2**24
# The record at the end of a zip archive, with the longest comment.
_LONGEST_END = 22 + 2**16
_HEADERS = {
    (1, 0): np.lib.format.read_array_header_1_0,
    (2, 0): np.lib.format.read_array_header_2_0,
}


def write(path: Path, arrays: Mapping[str, np.ndarray]) -> None:
    """Write arrays by name; the file is replaced whole or not at all."""
    if _DTYPES in arrays:
        raise ValueError(f"The name {_DTYPES!r} is taken; rename that leaf.")
    dtypes = {
        name: array.dtype.name for name, array in arrays.items() if array.dtype.isbuiltin != 1
    }
    entries = {
        name: array.view(f"u{array.itemsize}") if name in dtypes else array
        for name, array in arrays.items()
    }
    if dtypes:
        entries[_DTYPES] = np.array(json.dumps(dtypes))
    # np.savez would take a leaf named "file" for its own argument.
    with replacing(path) as temporary, zipfile.ZipFile(temporary, "w") as archive:
        for name, array in entries.items():
            with archive.open(f"{name}.npy", "w", force_zip64=True) as file:
                np.lib.format.write_array(file, array, allow_pickle=False)


class NpzFile(ArrayFile):
    """An `.npz` file. Zip's own checksum of an array is compared whenever it is read."""

    def __init__(self, path: Path, max_bytes: int | None):
        super().__init__(path, max_bytes)
        if not zipfile.is_zipfile(path):
            raise DamagedFile(f"{path} is damaged, or no .npz file.")
        with damage(path):
            self._archive = zipfile.ZipFile(path)
            self._entries: dict[str, zipfile.ZipInfo] = {}
            for entry in self._archive.infolist():
                name = entry.filename.removesuffix(".npy")
                if name == entry.filename or name in self._entries:
                    raise ValueError(f"its entry {entry.filename} is no array, or comes twice")
                self._entries[name] = entry
            self._check_directory()
            dtypes = self._entries.pop(_DTYPES, None)
            self._dtypes = {} if dtypes is None else self._read_dtypes(dtypes)
            self._shapes: dict[str, jax.ShapeDtypeStruct] | None = None

    def _check_directory(self) -> None:
        """Raise if the archive's directory does not list what the archive says it holds.

        zipfile passes over entries that a damaged directory hides.
        """
        entries = self._archive.infolist()
        with self._path.open("rb") as file:
            file.seek(max(0, self.disk_bytes - _LONGEST_END))
            end = file.read()
        stored = int.from_bytes(end[(place := end.rfind(b"PK\5\6")) + 10 : place + 12], "little")
        many = 0xFFFF  # stands for a number that does not fit
        first = min((entry.header_offset for entry in entries), default=0)
        if first or stored not in (len(entries), many):
            raise ValueError(f"its directory lists {len(entries)} entries, and it has others")

    def _read_dtypes(self, entry: zipfile.ZipInfo) -> dict[str, Any]:
        if entry.file_size > _LONGEST_DTYPES:
            raise ValueError(f"its entry {entry.filename} is too long")
        with self._archive.open(entry) as file:
            found = json.loads(str(np.lib.format.read_array(file, allow_pickle=False)))
        return {name: jnp.dtype(dtype) for name, dtype in found.items()}

    def _header(self, name: str, file: Any) -> tuple[tuple[int, ...], bool, np.dtype]:
        """Shape, whether columns come first, and dtype; compared with the entry's length."""
        entry = self._entries[name]
        version = np.lib.format.read_magic(file)
        if version not in _HEADERS:
            raise ValueError(f"version {version} of the format is not known")
        shape, columns_first, dtype = _HEADERS[version](file)
        if dtype.hasobject:
            raise DamagedFile(
                f"{name} in {self._path} holds Python objects, which are never loaded."
            )
        expected = math.prod(shape) * dtype.itemsize
        if any(size < 0 for size in shape) or expected != entry.file_size - file.tell():
            raise ValueError(f"shape {shape} of {dtype} is not what its length holds")
        return shape, columns_first, dtype

    @property
    def shapes(self) -> Mapping[str, jax.ShapeDtypeStruct]:
        if self._shapes is None:
            found = {}
            for name, entry in self._entries.items():
                with damage(self._path, name), self._archive.open(entry) as file:
                    shape, _, dtype = self._header(name, file)
                    found[name] = jax.ShapeDtypeStruct(shape, self._dtypes.get(name, dtype))
            self._shapes = found
        return self._shapes

    def __iter__(self) -> Iterator[str]:
        return iter(self._entries)

    def read(self, names: Iterable[str]) -> dict[str, np.ndarray]:
        names = list(names)
        check_size(self, names)
        return {name: self._read_one(name) for name in names}

    def _read_one(self, name: str) -> np.ndarray:
        with damage(self._path, name), self._archive.open(self._entries[name]) as opened:
            # The hints of zipfile promise less than it gives.
            file = cast(io.BufferedIOBase, opened)
            shape, columns_first, dtype = self._header(name, file)
            data = np.empty(math.prod(shape) * dtype.itemsize, np.uint8)
            view, filled = data.data, 0
            while filled < len(data) and (count := file.readinto(view[filled:])):
                filled += count
            # To read on at the end is what makes zipfile compare the checksum.
            if filled < len(data) or file.read(1):
                raise ValueError("its length is not what its header says")
            array = data.view(dtype) if dtype.itemsize else np.empty(0, dtype)
            array = array.reshape(shape, order="F" if columns_first else "C")
            return array.view(self._dtypes[name]) if name in self._dtypes else array

    def close(self) -> None:
        self._archive.close()
