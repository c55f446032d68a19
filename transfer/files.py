"""Parameters in files: `.npz`, `.safetensors` and Orbax checkpoints, under '/'-joined names.

`load` gives a flat `{path: array}`, which every operation and plan takes as a source:
`transfer.copy(target, load("source.npz", "encoder/**"), where="encoder/**")`. `open_file`
gives the same without reading it: each array is read when it is asked for. No structure is stored
but the names, so any tree with the same paths can take the arrays.

Nothing that is loaded can execute code: pickles are refused, and no class is looked up by name.
What a file says of itself (shapes, sizes, offsets) is compared with its size before any memory is
asked for, and whatever is wrong with it is a `ValueError` that names the file.
"""

import os
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from transfer import npz_files, safetensors_files
from transfer.file_tools import ArrayFile, check_size, damage
from transfer.patterns import match_paths
from transfer.select import PyTree, Where, flatten, selected


def save(path: str | os.PathLike, tree: PyTree, where: Where = None) -> None:
    """Write the arrays of a tree, or those selected, to a file.

    Args:
      path: ends in `.npz` or `.safetensors`, which are replaced if they exist; without a
        suffix it is a folder for a new Orbax checkpoint (which needs the package
        orbax-checkpoint). A `.safetensors` file holds a SHA-256 of every array beside the
        names, which `load` compares.
      tree: any pytree.
      where: the leaves to write; all by default.

    Raises:
      ValueError: another suffix, leaves that the format cannot hold, or no leaves.
      FileExistsError: an Orbax checkpoint, or anything else, is there already.
    """
    path = Path(path)
    write = _WRITERS.get(path.suffix.lower())
    if write is None:
        if path.suffix:
            raise ValueError(_unknown_suffix(path))
        write = _write_orbax
    chosen = selected(tree, where)
    arrays = {name: _to_numpy(name, leaf) for name, leaf in flatten(tree).items() if name in chosen}
    if not arrays:
        raise ValueError(f"There is no array to write to {path}.")
    write(path, arrays)


def load(
    path: str | os.PathLike, *patterns: Any, max_bytes: int | None = None
) -> dict[str, np.ndarray]:
    """Read arrays by name; what is not selected is not read.

    Args:
      path: as in `save`; the format is told by the suffix, and a folder is an Orbax
        checkpoint.
      *patterns: which names to read (see `transfer.select`); all by default.
      max_bytes: the most memory that the arrays read may take. By default 20 times what the file
        takes on disk, and 256 MiB at least, which only compressed files can exceed.

    Returns:
      `{path: array}`, with the dtypes that were written.

    Raises:
      FileNotFoundError: nothing is there.
      ValueError: the suffix is unknown; the file is damaged, holds Python objects, or takes more
        than `max_bytes`; or a pattern matches no name in it.
    """
    with open_file(path, max_bytes=max_bytes) as file:
        names = list(file)
        chosen = match_paths(names, *patterns) if patterns else set(names)
        return file.read([name for name in names if name in chosen])


def open_file(path: str | os.PathLike, *, max_bytes: int | None = None) -> ArrayFile:
    """The arrays of a file as a mapping that reads each when it is asked for.

    It is a source for every operation and plan; `transfer.apply` and
    `transfer.stream` take it leaf by leaf. Close it, or use it in `with`.

    Args:
      path: as for `load`.
      max_bytes: as for `load`, of each array and of each call that reads several.

    Raises:
      FileNotFoundError: nothing is there.
      ValueError: the suffix is unknown, or the file is damaged.
    """
    path = Path(path)
    if not path.exists():
        raise FileNotFoundError(f"There is no file or folder {path}.")
    if path.is_dir():
        return _OrbaxFolder(path, max_bytes)
    reader = _READERS.get(path.suffix.lower())
    if reader is None:
        raise ValueError(_unknown_suffix(path))
    return reader(path, max_bytes)


def _unknown_suffix(path: Path) -> str:
    suffix = f"The suffix {path.suffix!r} of {path}" if path.suffix else f"The file {path}"
    return (
        f"{suffix} names no known format: {' and '.join(_READERS)} are files, and a path without a "
        "suffix is a folder for an Orbax checkpoint."
    )


def _to_numpy(name: str, leaf: Any) -> np.ndarray:
    if not name:
        raise ValueError("A bare array has no name to be stored under; put it in a dictionary.")
    if isinstance(leaf, jax.ShapeDtypeStruct):
        raise ValueError(f"{name} is a shape without values, which no file holds.")
    if jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key):
        raise ValueError(
            f"{name} is a typed PRNG key, which no file holds; leave it out, or store "
            "jax.random.key_data of it."
        )
    return np.asarray(leaf)


# --- Orbax -----------------------------------------------------------------------------------


def _orbax() -> Any:
    try:
        import orbax.checkpoint
    except ImportError:
        raise ImportError(
            "Orbax checkpoints need the package orbax-checkpoint: "
            "pip install 'dreamer-transfer[files]'. .npz and .safetensors need nothing."
        ) from None
    return orbax.checkpoint


def _write_orbax(path: Path, arrays: Mapping[str, np.ndarray]) -> None:
    ocp = _orbax()
    if path.exists():
        raise FileExistsError(f"{path} exists; choose another folder for the checkpoint.")
    if empty := [name for name, array in arrays.items() if not array.size]:
        raise ValueError(f"Orbax holds no empty arrays; leave out {', '.join(empty)}.")
    with ocp.PyTreeCheckpointer() as checkpointer:
        checkpointer.save(path.absolute(), _nest(arrays))


def _nest(arrays: Mapping[str, Any]) -> dict[str, Any]:
    """`{"a/b": x}` as `{"a": {"b": x}}`."""
    nested: dict[str, Any] = {}
    for name, array in arrays.items():
        *branches, last = name.split("/")
        node = nested
        for branch in branches:
            node = node.setdefault(branch, {})
            if not isinstance(node, dict):
                break
        if not isinstance(node, dict) or last in node:
            raise ValueError(f"{name}: one leaf lies below another, which Orbax cannot hold.")
        node[last] = array
    return nested


class _OrbaxFolder(ArrayFile):
    """An Orbax checkpoint of a pytree."""

    def __init__(self, path: Path, max_bytes: int | None):
        if not (path / "_METADATA").exists():
            raise ValueError(_no_checkpoint(path))
        ocp = _orbax()
        super().__init__(path, max_bytes)
        with damage(path), ocp.PyTreeCheckpointer() as checkpointer:
            self._stored = checkpointer.metadata(path.absolute()).item_metadata.tree
            self._names = list(flatten(self._stored))
            leaves = flatten(self._stored).values()
            self._shapes = {
                name: jax.ShapeDtypeStruct(leaf.shape, leaf.dtype)
                for name, leaf in zip(self._names, leaves, strict=True)
            }

    @property
    def disk_bytes(self) -> int:
        return sum(file.stat().st_size for file in self._path.rglob("*") if file.is_file())

    @property
    def shapes(self) -> Mapping[str, jax.ShapeDtypeStruct]:
        return self._shapes

    def __iter__(self) -> Iterator[str]:
        return iter(self._names)

    def read(self, names) -> dict[str, np.ndarray]:
        ocp = _orbax()
        names = set(names)
        check_size(self, names)
        places, structure = jax.tree.flatten(self._stored)
        wanted = [
            place if name in names else ocp.PLACEHOLDER
            for name, place in zip(self._names, places, strict=True)
        ]
        # As NumPy arrays, so that a checkpoint from other devices needs no sharding here.
        kind = [ocp.RestoreArgs(restore_type=np.ndarray)] * len(places)
        with damage(self._path), ocp.PyTreeCheckpointer() as checkpointer:
            restored = checkpointer.restore(
                self._path.absolute(),
                args=ocp.args.PyTreeRestore(
                    item=jax.tree.unflatten(structure, wanted),
                    restore_args=jax.tree.unflatten(structure, kind),
                ),
            )
            leaves = jax.tree.leaves(restored)
            return {
                name: leaf for name, leaf in zip(self._names, leaves, strict=True) if name in names
            }


def _no_checkpoint(path: Path) -> str:
    inside = [found.parent for depth in ("*", "*/*") for found in path.glob(f"{depth}/_METADATA")]
    steps = [found for found in inside if found.relative_to(path).parts[0].isdigit()]
    hint = f" Other formats are told by the suffix, {' or '.join(_READERS)}."
    if steps:
        steps.sort(key=lambda found: int(found.relative_to(path).parts[0]))
        numbers = ", ".join(dict.fromkeys(found.relative_to(path).parts[0] for found in steps))
        hint = f": it holds the checkpoints of steps {numbers}. The latest is {steps[-1]}."
    elif inside:
        listed = ", ".join(sorted(map(str, inside)))
        hint = f"; there is one in {listed}."
    elif path.suffix:
        hint = "."
    return f"{path} is no Orbax checkpoint" + (hint if hint[0] in ":;." else "." + hint)


_READERS = {
    ".npz": npz_files.NpzFile,
    ".safetensors": safetensors_files.SafetensorsFile,
}
_WRITERS = {".npz": npz_files.write, ".safetensors": safetensors_files.write}
