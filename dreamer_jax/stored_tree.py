"""A pytree of arrays in a folder, by Orbax, with a table of its leaves.

`state/` holds the arrays and can be read with Orbax alone; `leaves.json` holds path, shape, dtype
and checksum of every leaf. The table says what does not fit a template before any array is read,
and whether what is read is what was written, to the bit.
"""

from __future__ import annotations

import contextlib
import errno
import logging
import os
import re
import shutil
import zlib
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
import orbax.checkpoint as ocp

from dreamer_jax.files import read_json, write_json_atomically
from dreamer_jax.integrity import DamagedError
from dreamer_jax.schema import LEAVES, check_shape

Tree = TypeVar("Tree")
_FORMAT = 1
_SHOWN = 5  # differences listed in an error
_FILES_ROOM = 256 * 1024  # bytes that some forty files take in whole blocks, beside what they hold


class CorruptCheckpointError(Exception):
    """A checkpoint cannot be read back as it was written."""


class _Leaf(NamedTuple):
    """What is known of a leaf without its values."""

    path: tuple[str, ...]
    shape: tuple[int, ...]
    dtype: str  # of a typed PRNG key: "key<fry>" and the like

    @property
    def name(self) -> str:
        return "/".join(self.path)

    def __str__(self) -> str:
        return f"{self.dtype} {list(self.shape)}"


def write_tree(folder: Path, tree: Any) -> None:
    """Write a pytree of arrays, scalars and typed PRNG keys into a folder that exists.

    Raises:
      ValueError: two leaves have the same path.
      OSError: the disk is full or not writable.
    """
    paths_and_leaves = jax.tree_util.tree_flatten_with_path(tree)[0]
    table, values = [], {}
    for path, leaf in paths_and_leaves:
        description = _describe(path, leaf)
        key_impl = str(jax.random.key_impl(leaf)) if _is_key(leaf) else None
        value = np.asarray(jax.random.key_data(leaf) if key_impl else jax.device_get(leaf))
        if description.path in values:
            raise ValueError(f"two leaves have the path {description.name!r}")
        values[description.path] = value
        table.append(
            {
                **description._asdict(),
                "key_impl": key_impl,
                "stored_shape": value.shape,
                "stored_dtype": str(value.dtype),
                "crc32": _checksum(value),
            }
        )
    # Orbax stores no empty arrays; their shapes are in the table.
    stored = _nested({path: value for path, value in values.items() if value.size})
    _require_room(folder, sum(value.nbytes for value in values.values()))
    try:
        if stored:
            with _orbax() as checkpointer:
                checkpointer.save((folder / "state").absolute(), args=ocp.args.PyTreeSave(stored))
    except Exception as error:
        # TensorStore reports what the system refused as text in errors of several kinds.
        if code := re.search(r"os_error_code='(\d+)'", str(error)):
            raise OSError(int(code[1]), os.strerror(int(code[1]))) from error
        raise
    write_json_atomically(folder / "leaves.json", {"format": _FORMAT, "leaves": table})


def _require_room(folder: Path, size: int) -> None:
    """Refuses a disk that is full before anything is written: of one that gets full, TensorStore's
    threads tell in traces of their own."""
    disk = shutil.disk_usage(folder)
    if disk.total and disk.free < 1.05 * size + _FILES_ROOM:  # some file systems do not say
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))


def read_tree(
    folder: Path, template: Tree, put: Callable[[np.ndarray], jax.Array] | None = None
) -> Tree:
    """The pytree in a folder, with the structure of the template and on its devices.

    Args:
      folder: what `write_tree` has written.
      template: of arrays or their shapes.
      put: brings the values of a leaf to where they are to lie, if not to the template's devices.

    Raises:
      ValueError: structure, shapes or dtypes differ from the template's.
      CorruptCheckpointError: the tree is not there as it was written.
    """
    paths_and_leaves, structure = jax.tree_util.tree_flatten_with_path(template)
    table = _read_table(folder)
    expected = [_describe(path, leaf) for path, leaf in paths_and_leaves]
    _compare(folder, [_Leaf(row["path"], row["shape"], row["dtype"]) for row in table], expected)
    values = {row["path"]: value for row, value in _read_values(folder, table)}
    key_impls = {row["path"]: row["key_impl"] for row in table}
    leaves = []
    for description, (_, leaf) in zip(expected, paths_and_leaves, strict=True):
        # Copied, so that no leaf shares memory with NumPy: updates may donate their buffers.
        value = (put or jnp.array)(values[description.path])
        if key_impls[description.path]:
            value = jax.random.wrap_key_data(value, impl=key_impls[description.path])
        if put is None and getattr(leaf, "committed", False):
            value = jax.device_put(value, leaf.sharding)
        leaves.append(value)
    return jax.tree_util.tree_unflatten(structure, leaves)


def read_subtree(folder: Path, subtree: str) -> Any:
    """The arrays under a path such as "params/encoder": nested dicts of NumPy arrays.

    Raises:
      KeyError: nothing lies there; names what there is at the level where the path ends.
      CorruptCheckpointError: it is not there as it was written.
    """
    prefix = tuple(part for part in subtree.split("/") if part)
    table = _read_table(folder)
    names = _nested({row["path"]: {} for row in table})
    for depth, part in enumerate(prefix):
        if part not in names:
            place = "/".join(prefix[:depth]) or "the top"
            raise KeyError(f"{folder} has no {subtree!r}; at {place} there are {sorted(names)}")
        names = names[part]
    chosen = [row for row in table if row["path"][: len(prefix)] == prefix]
    tree = _nested({row["path"]: value for row, value in _read_values(folder, chosen)})
    for part in prefix:
        tree = tree[part]
    return tree


def read_part(folder: Path, name: str) -> dict[str, Any]:
    """One of the JSON files in a checkpoint; `CorruptCheckpointError` if it cannot be read."""
    try:
        return read_json(folder / name)
    except (OSError, ValueError) as error:
        raise CorruptCheckpointError(
            f"the checkpoint {folder} cannot be read ({_first_line(error)})"
        ) from error


def _read_values(
    folder: Path, table: list[dict[str, Any]]
) -> Iterator[tuple[dict[str, Any], np.ndarray]]:
    """The stored array of every row of the table, checked against it."""
    wanted = {row["path"]: 0 for row in table if 0 not in row["stored_shape"]}
    try:
        if wanted:
            with _orbax() as checkpointer:
                arguments = ocp.args.PyTreeRestore(item=_nested(wanted), partial_restore=True)
                tree = checkpointer.restore((folder / "state").absolute(), args=arguments)
    except Exception as error:  # Orbax and TensorStore raise many kinds for a damaged file.
        raise CorruptCheckpointError(
            f"the checkpoint {folder} cannot be read ({_first_line(error)})"
        ) from error
    for row in table:
        if row["path"] in wanted:
            value = tree
            for part in row["path"]:
                value = value[part]
            value = np.asarray(value)
        else:
            value = np.empty(row["stored_shape"], row["stored_dtype"])
        held = (value.shape, str(value.dtype), _checksum(value))
        if held != (row["stored_shape"], row["stored_dtype"], row["crc32"]):
            raise CorruptCheckpointError(
                f"the checkpoint {folder} is damaged: {'/'.join(row['path'])} "
                "is not what was written"
            )
        yield row, value


def _read_table(folder: Path) -> list[dict[str, Any]]:
    table = read_part(folder, "leaves.json")
    if isinstance(table, dict) and table.get("format", _FORMAT) != _FORMAT:
        raise ValueError(
            f"{folder} has format {table.get('format')}, this version reads {_FORMAT}; "
            "use the version that wrote it"
        )
    try:
        check_shape(table, LEAVES, folder / "leaves.json")
    except DamagedError as error:
        raise CorruptCheckpointError(str(error)) from error
    shapes = ("path", "shape", "stored_shape")
    return [row | {name: tuple(row[name]) for name in shapes} for row in table["leaves"]]


def _compare(folder: Path, saved: list[_Leaf], expected: list[_Leaf]) -> None:
    saved_by_path = {leaf.path: leaf for leaf in saved}
    expected_by_path = {leaf.path: leaf for leaf in expected}
    differences = []
    for path in sorted(saved_by_path.keys() | expected_by_path.keys()):
        there, wanted = saved_by_path.get(path), expected_by_path.get(path)
        if there != wanted:
            names = {leaf.name for leaf in (there, wanted) if leaf is not None}
            differences.append(
                f"{names.pop()}: saved {there or 'nothing'}, expected {wanted or 'nothing'}"
            )
    if differences:
        more = len(differences) - _SHOWN
        raise ValueError(
            f"the checkpoint {folder} does not fit the state to be restored. "
            + "; ".join(differences[:_SHOWN])
            + (f"; and {more} more" if more > 0 else "")
            + ". Use the settings that it was made with"
        )


def _describe(path: tuple, leaf: Any) -> _Leaf:
    names = tuple(jax.tree_util.keystr((entry,), simple=True) for entry in path)
    if not hasattr(leaf, "dtype"):
        leaf = np.asarray(leaf)
    return _Leaf(names, tuple(leaf.shape), str(leaf.dtype))


def _is_key(leaf: Any) -> bool:
    return isinstance(leaf, jax.Array) and jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key)


def _nested(values: Mapping[tuple[str, ...], Any]) -> dict[str, Any]:
    tree: dict[str, Any] = {}
    for path, value in values.items():
        node = tree
        for part in path[:-1]:
            node = node.setdefault(part, {})
        node[path[-1]] = value
    return tree


def _checksum(value: np.ndarray) -> int:
    return zlib.crc32(np.ascontiguousarray(value).view(np.uint8).data) if value.size else 0


def _first_line(error: Exception) -> str:
    return f"{type(error).__name__}: {str(error).splitlines()[0] if str(error) else ''}"


@contextlib.contextmanager
def _orbax() -> Iterator[ocp.Checkpointer]:
    """Orbax, writing uncompressed (weights do not compress), and quiet: its errors are raised."""
    logger = logging.getLogger("absl")
    level = logger.level
    logger.setLevel(logging.CRITICAL)
    try:
        with ocp.Checkpointer(ocp.PyTreeCheckpointHandler(use_compression=False)) as checkpointer:
            yield checkpointer
    finally:
        logger.setLevel(level)
