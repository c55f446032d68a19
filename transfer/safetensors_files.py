"""Arrays in `.safetensors` files: a length, a JSON header, and the bytes of all arrays.

The format is read and written here, not by the package of that name, for what that cannot do: give
NumPy 8-bit floating-point numbers, read one array without mapping the whole file, and keep a
checksum. Files of either are read by the other.
"""

import hashlib
import json
import math
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from transfer.file_tools import ArrayFile, DamagedFile, check_size, damage, replacing

_DTYPES = {
    "BOOL": np.bool_,
    "U8": np.uint8,
    "I8": np.int8,
    "U16": np.uint16,
    "I16": np.int16,
    "U32": np.uint32,
    "I32": np.int32,
    "U64": np.uint64,
    "I64": np.int64,
    "F8_E4M3": jnp.float8_e4m3fn,
    "F8_E5M2": jnp.float8_e5m2,
    "F16": np.float16,
    "BF16": jnp.bfloat16,
    "F32": np.float32,
    "F64": np.float64,
    "C64": np.complex64,
}
_NAMES = {jnp.dtype(dtype): name for name, dtype in _DTYPES.items()}
_LONGEST_HEADER = 100_000_000
_CHECKSUMS = "sha256"


def _checksum(name: str, array: np.ndarray) -> str:
    """SHA-256 of an array with its name, dtype and shape, in hexadecimal."""
    digest = hashlib.sha256(json.dumps([name, _NAMES[array.dtype], list(array.shape)]).encode())
    digest.update(array.reshape(-1).view(np.uint8).data)
    return digest.hexdigest()


def write(path: Path, arrays: Mapping[str, np.ndarray]) -> None:
    """Write arrays by name, with a checksum each; the file is replaced whole or not at all."""
    for name, array in arrays.items():
        if array.dtype not in _NAMES or name == "__metadata__":
            raise ValueError(
                f"{name} is {array.dtype}, which .safetensors cannot hold under that name; "
                "use .npz or an Orbax checkpoint."
            )
    # Larger numbers first, so that every array begins at a multiple of its itemsize.
    ordered = sorted(arrays.items(), key=lambda item: (-item[1].dtype.itemsize, item[0]))
    packed = [(name, np.ascontiguousarray(array).reshape(array.shape)) for name, array in ordered]
    checksums = {name: _checksum(name, array) for name, array in packed}
    header: dict[str, Any] = {"__metadata__": {_CHECKSUMS: json.dumps(checksums)}}
    end = 0
    for name, array in packed:
        start, end = end, end + array.nbytes
        header[name] = {
            "dtype": _NAMES[array.dtype],
            "shape": list(array.shape),
            "data_offsets": [start, end],
        }
    text = json.dumps(header).encode()
    text += b" " * (-len(text) % 8)
    with replacing(path) as temporary, temporary.open("wb") as file:
        file.write(len(text).to_bytes(8, "little") + text)
        for _, array in packed:
            file.write(array.reshape(-1).view(np.uint8).data)


def _without_repetition(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    found = dict(pairs)
    if len(found) < len(pairs):
        raise ValueError("a name comes twice in its header")
    return found


class SafetensorsFile(ArrayFile):
    """A `.safetensors` file. The checksum of an array is compared whenever it is read."""

    def __init__(self, path: Path, max_bytes: int | None):
        super().__init__(path, max_bytes)
        self._file = path.open("rb")
        try:
            with damage(path):
                self._read_header()
        except ValueError:
            self._file.close()
            raise

    def _read_header(self) -> None:
        size = self.disk_bytes
        length = int.from_bytes(self._file.read(8), "little")
        if size < 8 or not 2 <= length <= min(_LONGEST_HEADER, size - 8):
            raise ValueError(f"its header of {length} bytes does not fit its {size}")
        header = json.loads(self._file.read(length).decode(), object_pairs_hook=_without_repetition)
        metadata = header.pop("__metadata__", {})
        self._checksums = json.loads(metadata[_CHECKSUMS]) if _CHECKSUMS in metadata else None
        self._start = 8 + length
        self._shapes: dict[str, jax.ShapeDtypeStruct] = {}
        self._offsets: dict[str, int] = {}
        end = 0
        for name, entry in sorted(header.items(), key=lambda item: item[1]["data_offsets"]):
            if entry["dtype"] not in _DTYPES:
                raise ValueError(f"{name} is {entry['dtype']}, which NumPy has not")
            dtype, shape = jnp.dtype(_DTYPES[entry["dtype"]]), tuple(entry["shape"])
            start, stop = entry["data_offsets"]
            whole = all(isinstance(number, int) and number >= 0 for number in (*shape, start, stop))
            if not whole or start != end or stop - start != math.prod(shape) * dtype.itemsize:
                raise ValueError(f"the place of {name} is not what its shape {shape} takes")
            self._shapes[name], self._offsets[name] = jax.ShapeDtypeStruct(shape, dtype), start
            end = stop
        if end != size - self._start:
            raise ValueError(f"its arrays take {end} bytes, and it has {size - self._start}")

    @property
    def shapes(self) -> Mapping[str, jax.ShapeDtypeStruct]:
        return self._shapes

    def __iter__(self) -> Iterator[str]:
        return iter(self._shapes)

    def read(self, names: Iterable[str]) -> dict[str, np.ndarray]:
        names = list(names)
        check_size(self, names)
        return {name: self._read_one(name) for name in names}

    def _read_one(self, name: str) -> np.ndarray:
        shape = self._shapes[name]
        with damage(self._path, name):
            array = np.empty(shape.shape, shape.dtype)
            self._file.seek(self._start + self._offsets[name])
            if self._file.readinto(array.reshape(-1).view(np.uint8).data) != array.nbytes:
                raise ValueError("the file ends before it")
            if self._checksums is None:
                return array
            if self._checksums.get(name) != _checksum(name, array):
                raise DamagedFile(
                    f"{name} in {self._path} is damaged: its SHA-256 is not the one written."
                )
            return array

    def close(self) -> None:
        self._file.close()
