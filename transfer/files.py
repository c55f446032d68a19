"""Parameters in files: ``.npz``, ``.safetensors`` and Orbax checkpoints, under '/'-joined names.

:func:`load` gives a flat ``{path: array}``, which every operation and plan takes as a source:
``transfer.copy(target, load("source.npz", "encoder/**"), where="encoder/**")``. No structure is
stored but the names, so any tree with the same paths can take the arrays.

Nothing that is loaded can execute code: pickles are refused, and no class is looked up by name.
"""

import json
import os
import tempfile
import zipfile
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from transfer.select import PyTree, Where, flatten, match_paths, selected

# Kept beside the arrays in an .npz: NumPy's own format forgets the dtypes of ml_dtypes (bfloat16).
_DTYPES = "__dtypes__"


def save(path: str | os.PathLike, tree: PyTree, where: Where = None) -> None:
    """Write the arrays of a tree, or those selected, to a file.

    Args:
        path: ends in ``.npz`` or ``.safetensors``, which are replaced if they exist; anything else
            is a folder for a new Orbax checkpoint.
        tree: any pytree.
        where: the leaves to write; all by default.

    Raises:
        ValueError: leaves that the format cannot hold, or no leaves.
        FileExistsError: an Orbax checkpoint, or anything else, is there already.
    """
    path = Path(path)
    chosen = selected(tree, where)
    arrays = {name: _to_numpy(name, leaf) for name, leaf in flatten(tree).items() if name in chosen}
    if not arrays:
        raise ValueError(f"There is no array to write to {path}.")
    _, write = _FORMATS.get(path.suffix, _ORBAX)
    write(path, arrays)


def load(path: str | os.PathLike, *patterns: str) -> dict[str, np.ndarray]:
    """Read arrays by name; what is not selected is not read.

    Args:
        path: as in :func:`save`; the format is told by the suffix.
        *patterns: which names to read (see :func:`transfer.select`); all by default.

    Returns:
        ``{path: array}``, with the dtypes that were written.

    Raises:
        FileNotFoundError: nothing is there.
        ValueError: the file is damaged, holds Python objects, or a pattern matches no name in it.
    """
    path = Path(path)
    if not path.exists():
        raise FileNotFoundError(f"There is no file or folder {path}.")
    read, _ = _FORMATS.get(path.suffix, _ORBAX)
    return read(path, lambda names: match_paths(names, *patterns) if patterns else set(names))


Choose = Callable[[list[str]], Any]


def _to_numpy(name: str, leaf: Any) -> np.ndarray:
    if not name:
        raise ValueError("A bare array has no name to be stored under; put it in a dictionary.")
    if jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key):
        raise ValueError(
            f"{name} is a typed PRNG key, which no file holds; leave it out, or store "
            "jax.random.key_data of it."
        )
    return np.asarray(leaf)


@contextmanager
def _replacing(path: Path) -> Iterator[Path]:
    """A temporary file that takes the place of ``path`` when, and only when, it is complete."""
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


# --- .npz ------------------------------------------------------------------------------------


def _write_npz(path: Path, arrays: Mapping[str, np.ndarray]) -> None:
    if _DTYPES in arrays:
        raise ValueError(f"The name {_DTYPES!r} is taken; rename that leaf.")
    dtypes = {name: array.dtype.name for name, array in arrays.items() if array.dtype.kind == "V"}
    entries = {
        name: array.view(f"u{array.itemsize}") if name in dtypes else array
        for name, array in arrays.items()
    }
    if dtypes:
        entries[_DTYPES] = np.array(json.dumps(dtypes))
    # np.savez would take a leaf named "file" for its own argument.
    with _replacing(path) as temporary, zipfile.ZipFile(temporary, "w") as archive:
        for name, array in entries.items():
            with archive.open(f"{name}.npy", "w", force_zip64=True) as file:
                np.lib.format.write_array(file, array, allow_pickle=False)


def _read_npz(path: Path, choose: Choose) -> dict[str, np.ndarray]:
    if not zipfile.is_zipfile(path):
        raise ValueError(f"{path} is damaged, or no .npz file.")
    with np.load(path, allow_pickle=False) as archive:
        dtypes = json.loads(str(archive[_DTYPES])) if _DTYPES in archive else {}
        names = [name for name in archive if name != _DTYPES]
        chosen = choose(names)
        arrays = {name: _read_entry(path, archive, name) for name in names if name in chosen}
    return {
        name: array.view(jnp.dtype(dtypes[name])) if name in dtypes else array
        for name, array in arrays.items()
    }


def _read_entry(path: Path, archive: Any, name: str) -> np.ndarray:
    try:
        return archive[name]
    except (ValueError, zipfile.BadZipFile) as error:
        raise ValueError(
            f"{name} in {path} is damaged or holds Python objects, which are never loaded."
        ) from error


# --- .safetensors ----------------------------------------------------------------------------


def _write_safetensors(path: Path, arrays: Mapping[str, np.ndarray]) -> None:
    from safetensors.numpy import save_file

    for name, array in arrays.items():
        if array.dtype.kind == "V" and array.dtype != jnp.bfloat16:
            raise ValueError(
                f"{name} is {array.dtype}, which .safetensors cannot give back to NumPy; "
                "use .npz or an Orbax checkpoint."
            )
    with _replacing(path) as temporary:
        save_file({name: np.asarray(a, order="C") for name, a in arrays.items()}, temporary)


def _read_safetensors(path: Path, choose: Choose) -> dict[str, np.ndarray]:
    from safetensors import SafetensorError, safe_open

    try:
        with safe_open(path, framework="numpy") as file:
            names = list(file.keys())
            chosen = choose(names)
            return {name: file.get_tensor(name) for name in names if name in chosen}
    except (SafetensorError, AttributeError) as error:  # AttributeError: a dtype NumPy lacks
        raise ValueError(f"{path} cannot be read: {error}") from error


# --- Orbax -----------------------------------------------------------------------------------


def _write_orbax(path: Path, arrays: Mapping[str, np.ndarray]) -> None:
    import orbax.checkpoint as ocp

    if path.exists():
        raise FileExistsError(f"{path} exists; choose another folder for the checkpoint.")
    if empty := [name for name, array in arrays.items() if not array.size]:
        raise ValueError(f"Orbax holds no empty arrays; leave out {', '.join(empty)}.")
    with ocp.PyTreeCheckpointer() as checkpointer:
        checkpointer.save(path.absolute(), _nest(arrays))


def _nest(arrays: Mapping[str, Any]) -> dict[str, Any]:
    """``{"a/b": x}`` as ``{"a": {"b": x}}``."""
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


def _read_orbax(path: Path, choose: Choose) -> dict[str, np.ndarray]:
    import orbax.checkpoint as ocp

    if not (path / "_METADATA").exists():
        inside = sorted(str(found.parent) for found in path.glob("*/_METADATA"))
        hint = f"; there is one in {', '.join(inside)}" if inside else ""
        raise ValueError(
            f"{path} is no Orbax checkpoint{hint}. Other formats are told by the suffix, "
            f"{' or '.join(_FORMATS)}."
        )
    with ocp.PyTreeCheckpointer() as checkpointer:
        stored = checkpointer.metadata(path.absolute()).item_metadata.tree
        names = list(flatten(stored))
        chosen = choose(names)
        places, structure = jax.tree.flatten(stored)
        wanted = [
            place if name in chosen else ocp.PLACEHOLDER
            for name, place in zip(names, places, strict=True)
        ]
        # As NumPy arrays, so that a checkpoint from other devices needs no sharding here.
        kind = [ocp.RestoreArgs(restore_type=np.ndarray)] * len(places)
        restored = checkpointer.restore(
            path.absolute(),
            args=ocp.args.PyTreeRestore(
                item=structure.unflatten(wanted), restore_args=structure.unflatten(kind)
            ),
        )
    leaves = jax.tree.leaves(restored)
    return {name: leaf for name, leaf in zip(names, leaves, strict=True) if name in chosen}


_FORMATS = {
    ".npz": (_read_npz, _write_npz),
    ".safetensors": (_read_safetensors, _write_safetensors),
}
_ORBAX = (_read_orbax, _write_orbax)
