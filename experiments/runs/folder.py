"""Where things are in results folders, and which of them hold what.

A run's folder holds cells.json beside what `runs.run` writes: the names of its cells, in the order
of its members. Nothing else says where a cell is, so that folders may be copied to another machine
and read there. A folder that cannot be read is warned of, and its cells count as missing.
"""

import contextlib
import math
import re
import warnings
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from dreamer_jax.checkpoint import Checkpointer
from dreamer_jax.files import read_json
from dreamer_jax.integrity import DamagedError, read_sealed_json
from dreamer_jax.logs import read_metrics

CELLS = "cells.json"

_SET_ASIDE = re.compile(r"\.corrupt-\d+$")


def run_folders(root: str | Path) -> list[Path]:
    """The folders under a root that hold a run of cells that has begun, set-aside ones left out."""
    found = sorted(path.parent for path in Path(root).glob(f"*/{CELLS}"))
    return [path for path in found if not _SET_ASIDE.search(path.name) and begun(path)]


def begun(folder: Path) -> bool:
    """Whether a folder holds more of a run than what it was going to be."""
    metrics = folder / "metrics.jsonl"
    if metrics.exists() and metrics.stat().st_size > 0:
        return True
    return Checkpointer(folder / "checkpoints").latest() is not None


def set_aside(folder: Path) -> Path:
    """Renames a folder that cannot be used, so that nothing reads it and its name is free.

    Returns:
      What it is called now.
    """
    number = 1
    while (path := folder.with_name(f"{folder.name}.corrupt-{number}")).exists():
        number += 1
    return folder.rename(path)


def read_cells(folder: Path) -> tuple[str, ...]:
    """The names of a run's cells, in the order of its members.

    Raises:
      ValueError: cells.json is damaged.
    """
    names = read_json(folder / CELLS)
    if not isinstance(names, list) or not all(isinstance(name, str) for name in names):
        raise ValueError(f"{folder / CELLS} is no list of names")
    with contextlib.suppress(OSError, DamagedError):  # of which `read_spec` tells
        header = read_sealed_json(folder / "run.json")
        if isinstance(header, dict) and header.get("cells", names) != names:
            raise ValueError(f"{folder / CELLS} names other cells than run.json: restore it")
    return tuple(names)


def folders(root: str | Path) -> dict[str, tuple[Path, int]]:
    """Where each cell is: its name -> (results folder, member)."""
    found: dict[str, tuple[Path, int]] = {}
    for folder in run_folders(root):
        try:
            names = read_cells(folder)
        except ValueError as error:
            warnings.warn(f"{error}: its cells count as missing", stacklevel=2)
            continue
        for member, name in enumerate(names):
            found.setdefault(name, (folder, member))
    return found


def sound(row: Mapping[str, Any]) -> bool:
    """Whether a row of metrics shows a member that has not failed: losses, gradients and returns
    are finite. Rows of evaluations did not always say so themselves."""
    return row.get("healthy", True) and math.isfinite(row.get("return", 0.0))


def failed_members(folder: str | Path) -> frozenset[int]:
    """The members of a run that met losses, gradients or returns that are not finite, by place.

    Such a member was frozen as it was before; its rows say so from then on.
    """
    folder = Path(folder)
    rows = read_metrics(folder) if (folder / "metrics.jsonl").exists() else []
    return frozenset(row["member"] for row in rows if not sound(row))


def latents_folder(root: str | Path, backend: str, seed: int) -> Path:
    """Where latent states of all tasks and what was told of them are."""
    return Path(root) / f"latents-{backend}-seed-{seed}"


def report_folder(root: str | Path, backend: str) -> Path:
    """Where tables, figures and the page are, each simulator's apart."""
    return Path(root) / ("report" if backend == "bullet" else f"report-{backend}")
