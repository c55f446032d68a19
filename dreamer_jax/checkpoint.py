"""Checkpoints of a whole run: any pytree of arrays and a JSON object, bit for bit.

A checkpoint is a folder `step_000000001000/` with the arrays (`state/`, written by Orbax, readable
with it alone), `leaves.json` (path, shape, dtype and checksum of every leaf) and `metadata.json`.
It is written under a temporary name and renamed when complete, so a folder of that name is whole
unless the disk damaged it; checksums are compared when it is read.
"""

from __future__ import annotations

import contextlib
import logging
import os
import re
import shutil
import warnings
import zlib
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
import orbax.checkpoint as ocp

from dreamer_jax.files import explained, read_json, write_json_atomically

State = TypeVar("State")
_STEP = re.compile(r"step_(\d{12})$")
_TEMPORARY = ".tmp"
_FORMAT = 1
_SHOWN = 5  # differences listed in an error


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


class Checkpointer:
    """The checkpoints of one run, newest last.

    Args:
        directory: the folder that holds them; made by the first `save`.
        keep: how many of the newest are kept. With 2, one that the disk damaged costs the steps
            since the one before it, not the run.
    """

    def __init__(self, directory: str | os.PathLike, keep: int = 2):
        if keep < 1:
            raise ValueError(f"keep must be at least 1 checkpoint, got {keep}")
        self.directory = Path(directory)
        self.keep = keep

    def steps(self) -> list[int]:
        """Steps of the complete checkpoints, in rising order."""
        if not self.directory.is_dir():
            return []
        matches = (_STEP.match(path.name) for path in self.directory.iterdir())
        return sorted(int(match[1]) for match in matches if match)

    def latest(self) -> int | None:
        """Step of the newest complete checkpoint; None if there is none."""
        return max(self.steps(), default=None)

    def path(self, step: int) -> Path:
        """Folder of one checkpoint."""
        return self.directory / f"step_{step:012d}"

    def save(self, step: int, state: Any, metadata: Mapping[str, Any]) -> None:
        """Write a checkpoint; then remove all but the newest `keep`.

        Checkpoints of `step` itself or later are removed too: they belong to a continuation that
        this one replaces.

        Args:
            step: a count that grows during the run.
            state: pytree of JAX or NumPy arrays, scalars and typed PRNG keys.
            metadata: what JSON can hold, and NumPy scalars and arrays (stored as lists).

        Raises:
            OSError: the disk is full or not writable. The earlier checkpoints are untouched.
            ValueError: two leaves have the same path, or metadata holds NaN.
        """
        target = self.path(step)
        temporary = target.with_name(target.name + _TEMPORARY)
        try:
            self._clean()
            temporary.mkdir(parents=True)
            _write_state(temporary, state)
            write_json_atomically(temporary / "metadata.json", _plain(metadata))
            replaced = [_retired(self.path(later)) for later in self.steps() if later >= step]
            os.replace(temporary, target)
        except OSError as error:
            shutil.rmtree(temporary, ignore_errors=True)
            raise explained(
                error,
                f"could not save the checkpoint {target}",
                self.directory,
                "the earlier checkpoints are intact: make room and resume",
            ) from error
        except BaseException:
            shutil.rmtree(temporary, ignore_errors=True)
            raise
        replaced += [_retired(self.path(old)) for old in self.steps()[: -self.keep]]
        for folder in replaced:
            shutil.rmtree(folder, ignore_errors=True)

    def _clean(self) -> None:
        """Remove what a process killed while saving or removing left behind."""
        if self.directory.is_dir():
            for path in self.directory.glob(f"step_*{_TEMPORARY}"):
                shutil.rmtree(path)

    def metadata(self, step: int | None = None) -> dict[str, Any]:
        """The metadata saved at `step` (the newest by default); see `restore` for errors."""
        return self._metadata(self._existing(step))

    def restore(
        self, template: State, step: int | None = None
    ) -> tuple[State, dict[str, Any], int]:
        """Read a checkpoint back.

        Args:
            template: pytree of arrays or `jax.ShapeDtypeStruct` (as `jax.eval_shape` gives) with
                the structure, shapes and dtypes of the saved state. Arrays committed to devices
                are restored to the same devices.
            step: which one; by default the newest that can be read, with a warning for each that
                cannot.

        Returns:
            state, metadata and step.

        Raises:
            FileNotFoundError: there is no checkpoint, or none of that step.
            ValueError: the template does not fit the checkpoint; names the leaves and both sides.
            CorruptCheckpointError: `step`, or every checkpoint there is, is damaged.
        """
        candidates = [self._existing(step)] if step is not None else self.steps()[::-1]
        self._existing(step)
        problems = []
        for candidate in candidates:
            try:
                state = _read_state(self.path(candidate), template)
                return state, self._metadata(candidate), candidate
            except CorruptCheckpointError as error:
                problems.append(str(error))
                if candidate != candidates[-1]:
                    warnings.warn(
                        f"{error}; going back to the one before, step {candidates[len(problems)]}",
                        stacklevel=2,
                    )
        raise CorruptCheckpointError(
            "; ".join(problems) + "; delete what is damaged, and start again if nothing is left"
        )

    def _existing(self, step: int | None) -> int:
        steps = self.steps()
        if step is None and steps:
            return steps[-1]
        if step not in steps:
            asked = "" if step is None else f" of step {step}"
            raise FileNotFoundError(
                f"no checkpoint{asked} in {self.directory}; there are steps {steps}"
            )
        return step

    def _metadata(self, step: int) -> dict[str, Any]:
        return _read(self.path(step), "metadata.json")


def load_tree(directory: str | os.PathLike, subtree: str = "") -> dict[str, Any]:
    """The arrays of a checkpoint without a template: nested dicts of NumPy arrays.

    Fields of dataclasses and named tuples become keys, as do positions in sequences ("0", "1");
    typed PRNG keys become their uint32 data.

    Args:
        directory: a folder of checkpoints (the newest that can be read is used, with a warning
            for each that cannot) or one checkpoint in it.
        subtree: path such as "params/encoder"; only what lies under it is read.

    Raises:
        FileNotFoundError: no checkpoint is there.
        KeyError: nothing lies under `subtree`; names what there is at that level.
        CorruptCheckpointError: the checkpoint is damaged.
    """
    directory = Path(directory)
    if _STEP.match(directory.name):
        if not directory.is_dir():
            raise FileNotFoundError(f"there is no checkpoint {directory}")
        return _read_subtree(directory, subtree)
    checkpoints = Checkpointer(directory)
    if not checkpoints.steps():
        raise FileNotFoundError(f"no checkpoint in {directory}")
    for step in checkpoints.steps()[::-1]:
        try:
            return _read_subtree(checkpoints.path(step), subtree)
        except CorruptCheckpointError as error:
            if step == checkpoints.steps()[0]:
                raise
            warnings.warn(f"{error}; using the one before", stacklevel=2)
    raise AssertionError("unreachable")


# --- reading and writing one checkpoint -----------------------------------------------------------


def _write_state(folder: Path, state: Any) -> None:
    paths_and_leaves = jax.tree_util.tree_flatten_with_path(state)[0]
    table, values = [], {}
    for path, leaf in paths_and_leaves:
        description = _describe(path, leaf)
        key_impl = str(jax.random.key_impl(leaf)) if _is_key(leaf) else None
        value = np.asarray(jax.random.key_data(leaf) if key_impl else jax.device_get(leaf))
        if description.path in values:
            raise ValueError(f"two leaves of the state have the path {description.name!r}")
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
    try:
        with _orbax() as checkpointer:
            checkpointer.save((folder / "state").absolute(), args=ocp.args.PyTreeSave(stored))
    except Exception as error:
        # TensorStore reports what the system refused as text in errors of several kinds.
        if code := re.search(r"os_error_code='(\d+)'", str(error)):
            raise OSError(int(code[1]), os.strerror(int(code[1]))) from error
        raise
    write_json_atomically(folder / "leaves.json", {"format": _FORMAT, "leaves": table})


def _read_state(folder: Path, template: State) -> State:
    paths_and_leaves, structure = jax.tree_util.tree_flatten_with_path(template)
    table = _read_table(folder)
    expected = [_describe(path, leaf) for path, leaf in paths_and_leaves]
    _compare(folder, [_Leaf(row["path"], row["shape"], row["dtype"]) for row in table], expected)
    values = {row["path"]: value for row, value in _read_values(folder, table)}
    key_impls = {row["path"]: row["key_impl"] for row in table}
    leaves = []
    for description, (_, leaf) in zip(expected, paths_and_leaves, strict=True):
        # Copied, so that no leaf shares memory with NumPy: updates may donate their buffers.
        value = jnp.array(values[description.path])
        if key_impls[description.path]:
            value = jax.random.wrap_key_data(value, impl=key_impls[description.path])
        if getattr(leaf, "committed", False):
            value = jax.device_put(value, leaf.sharding)
        leaves.append(value)
    return jax.tree_util.tree_unflatten(structure, leaves)


def _read_subtree(folder: Path, subtree: str) -> dict[str, Any]:
    prefix = tuple(part for part in subtree.split("/") if part)
    table = _read_table(folder)
    chosen = [row for row in table if row["path"][: len(prefix)] == prefix]
    if not chosen:
        depth = next(
            (
                n
                for n in range(len(prefix), -1, -1)
                if any(_under(row, prefix[:n]) for row in table)
            ),
            0,
        )
        names = {row["path"][depth] for row in table if _under(row, prefix[:depth])}
        place = "/".join(prefix[:depth]) or "the top"
        raise KeyError(f"{folder} has no {subtree!r}; at {place} there are {sorted(names)}")
    tree = _nested({row["path"]: value for row, value in _read_values(folder, chosen)})
    for part in prefix:
        tree = tree[part]
    return tree


def _under(row: Mapping[str, Any], prefix: tuple[str, ...]) -> bool:
    return len(row["path"]) > len(prefix) and row["path"][: len(prefix)] == prefix


def _read_values(
    folder: Path, table: list[dict[str, Any]]
) -> Iterator[tuple[dict[str, Any], np.ndarray]]:
    """The stored array of every row of the table, checked against it."""
    wanted = {row["path"]: 0 for row in table if 0 not in row["stored_shape"]}
    try:
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
    table = _read(folder, "leaves.json")
    if table.get("format") != _FORMAT:
        raise ValueError(
            f"{folder} has format {table.get('format')}, this version reads {_FORMAT}; "
            "use the version that wrote it"
        )
    shapes = ("path", "shape", "stored_shape")
    return [row | {name: tuple(row[name]) for name in shapes} for row in table["leaves"]]


def _read(folder: Path, name: str) -> dict[str, Any]:
    try:
        return read_json(folder / name)
    except (OSError, ValueError) as error:
        raise CorruptCheckpointError(
            f"the checkpoint {folder} cannot be read ({_first_line(error)})"
        ) from error


def _compare(folder: Path, saved: list[_Leaf], expected: list[_Leaf]) -> None:
    saved_by_path = {leaf.path: leaf for leaf in saved}
    expected_by_path = {leaf.path: leaf for leaf in expected}
    differences = []
    for path in sorted(saved_by_path.keys() | expected_by_path.keys()):
        there, wanted = saved_by_path.get(path), expected_by_path.get(path)
        if there != wanted:
            name = (there or wanted).name
            differences.append(
                f"{name}: saved {there or 'nothing'}, expected {wanted or 'nothing'}"
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
    return zlib.crc32(np.ascontiguousarray(value).view(np.uint8)) if value.size else 0


def _plain(metadata: Mapping[str, Any]) -> Any:
    """`metadata` with NumPy scalars and arrays as numbers and lists."""
    return {
        name: _plain(value)
        if isinstance(value, Mapping)
        else value.tolist()
        if isinstance(value, np.ndarray | np.generic)
        else value
        for name, value in metadata.items()
    }


def _retired(folder: Path) -> Path:
    """Take a checkpoint's name from it, so that one half deleted is not taken for whole."""
    return folder.rename(folder.with_name(f"{folder.name}.old{_TEMPORARY}"))


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
