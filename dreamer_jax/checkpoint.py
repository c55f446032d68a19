"""Checkpoints of a whole run: any pytree of arrays and a JSON object, bit for bit.

A checkpoint is a folder `step_000000001000/` with a stored tree (see `dreamer_jax.stored_tree`),
`metadata.json`, and `checksums.json` of all its files. It is written under a temporary name and
renamed when all of it is on the disk, so a folder of that name is whole unless the disk damaged it,
which its checksums tell before anything else is read.
"""

from __future__ import annotations

import os
import re
import shutil
import warnings
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import Any

import jax
import numpy as np

from dreamer_jax.files import explained, sync_folder, write_json_atomically
from dreamer_jax.integrity import CHECKSUMS, check_files, sync_all, write_checksums
from dreamer_jax.stored_tree import (
    CorruptCheckpointError,
    Tree,
    read_part,
    read_subtree,
    read_tree,
    write_tree,
)

__all__ = ["Checkpointer", "CorruptCheckpointError", "load_tree"]

_STEP = re.compile(r"step_(\d{12})$")
_TEMPORARY = ".tmp"
_SEALED = "has_checksums"  # in the metadata, so that checksums that are gone are missed


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
            write_tree(temporary, state)
            stored = {**_plain(metadata), _SEALED: True}
            write_json_atomically(temporary / "metadata.json", stored)
            write_checksums(temporary)
            sync_all(temporary)
            replaced = [_retired(self.path(later)) for later in self.steps() if later >= step]
            os.replace(temporary, target)
            sync_folder(self.directory)
        except OSError as error:
            shutil.rmtree(temporary, ignore_errors=True)
            kept = self.steps()
            raise explained(
                error,
                f"could not save the checkpoint {target}",
                self.directory,
                "the earlier checkpoints are intact" if kept else "there is no earlier one",
            ) from error
        except BaseException:
            shutil.rmtree(temporary, ignore_errors=True)
            raise
        replaced += [_retired(self.path(old)) for old in self.steps()[: -self.keep]]
        for folder in replaced:
            shutil.rmtree(folder, ignore_errors=True)

    def remove_later(self, step: int) -> None:
        """Remove the checkpoints after `step`, which belong to a continuation that is given up."""
        for later in self.steps():
            if later > step:
                shutil.rmtree(_retired(self.path(later)), ignore_errors=True)

    def _clean(self) -> None:
        """Remove what a process killed while saving or removing left behind."""
        if self.directory.is_dir():
            for path in self.directory.glob(f"step_*{_TEMPORARY}"):
                shutil.rmtree(path)

    def metadata(self, step: int | None = None) -> dict[str, Any]:
        """The metadata saved at `step` (the newest by default); see `restore` for errors."""
        step = self._existing(step)
        _check(self.path(step), ["metadata.json"])
        return self._metadata(step)

    def check(self, step: int) -> bool:
        """Compares a checkpoint's files with their checksums.

        Returns:
          Whether it has any; one of an earlier version has none.

        Raises:
          FileNotFoundError: there is no checkpoint of that step.
          CorruptCheckpointError: a file is missing or is not what was written.
        """
        return _check(self.path(self._existing(step)))

    def restore(
        self,
        template: Tree,
        step: int | None = None,
        put: Callable[[np.ndarray], jax.Array] | None = None,
    ) -> tuple[Tree, dict[str, Any], int]:
        """Read a checkpoint back.

        Args:
          template: pytree of arrays or `jax.ShapeDtypeStruct` (as `jax.eval_shape` gives) with
            the structure, shapes and dtypes of the saved state. Arrays committed to devices
            are restored to the same devices.
          step: which one; by default the newest that can be read, with a warning for each that
            cannot.
          put: brings the values of a leaf to where they are to lie, if not to the template's
            devices.

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
                self.check(candidate)
                state = read_tree(self.path(candidate), template, put)
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
        metadata = read_part(self.path(step), "metadata.json")
        metadata.pop(_SEALED, None)
        return metadata


def _check(folder: Path, names: Iterable[str] | None = None) -> bool:
    """Compares files of a checkpoint (by default all) with their checksums, if it has any."""
    sealed = (folder / CHECKSUMS).exists()
    if sealed:
        problem = check_files(folder, names)
    else:
        missing = read_part(folder, "metadata.json").get(_SEALED)
        problem = f"{CHECKSUMS} is missing" if missing else None
    if problem:
        raise CorruptCheckpointError(f"the checkpoint {folder} is damaged: {problem}")
    return sealed


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
        return _read_checked(directory, subtree)
    checkpoints = Checkpointer(directory)
    if not checkpoints.steps():
        raise FileNotFoundError(f"no checkpoint in {directory}")
    for step in checkpoints.steps()[::-1]:
        try:
            return _read_checked(checkpoints.path(step), subtree)
        except CorruptCheckpointError as error:
            if step == checkpoints.steps()[0]:
                raise
            warnings.warn(f"{error}; using the one before", stacklevel=2)
    raise AssertionError("unreachable")


def _read_checked(folder: Path, subtree: str) -> Any:
    _check(folder)
    return read_subtree(folder, subtree)


def _plain(value: Any) -> Any:
    """`value` with NumPy scalars and arrays, at any depth of mappings, as numbers and lists."""
    if isinstance(value, Mapping):
        return {name: _plain(item) for name, item in value.items()}
    return value.tolist() if isinstance(value, np.ndarray | np.generic) else value


def _retired(folder: Path) -> Path:
    """Take a checkpoint's name from it, so that one half deleted is not taken for whole."""
    return folder.rename(folder.with_name(f"{folder.name}.old{_TEMPORARY}"))
