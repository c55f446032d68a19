"""Checkpoints of a whole run: any pytree of arrays and a JSON object, bit for bit.

A checkpoint is a folder `step_000000001000/` with a stored tree (see `dreamer_jax.stored_tree`) and
`metadata.json`. It is written under a temporary name and renamed when complete, so a folder of that
name is whole unless the disk damaged it, which its checksums tell.
"""

from __future__ import annotations

import os
import re
import shutil
import warnings
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from dreamer_jax.files import explained, write_json_atomically
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

    def restore(self, template: Tree, step: int | None = None) -> tuple[Tree, dict[str, Any], int]:
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
                state = read_tree(self.path(candidate), template)
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
        return read_part(self.path(step), "metadata.json")


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
        return read_subtree(directory, subtree)
    checkpoints = Checkpointer(directory)
    if not checkpoints.steps():
        raise FileNotFoundError(f"no checkpoint in {directory}")
    for step in checkpoints.steps()[::-1]:
        try:
            return read_subtree(checkpoints.path(step), subtree)
        except CorruptCheckpointError as error:
            if step == checkpoints.steps()[0]:
                raise
            warnings.warn(f"{error}; using the one before", stacklevel=2)
    raise AssertionError("unreachable")


def _plain(value: Any) -> Any:
    """`value` with NumPy scalars and arrays, at any depth of mappings, as numbers and lists."""
    if isinstance(value, Mapping):
        return {name: _plain(item) for name, item in value.items()}
    return value.tolist() if isinstance(value, np.ndarray | np.generic) else value


def _retired(folder: Path) -> Path:
    """Take a checkpoint's name from it, so that one half deleted is not taken for whole."""
    return folder.rename(folder.with_name(f"{folder.name}.old{_TEMPORARY}"))
