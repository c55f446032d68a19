"""Who is at work under a folder of results, and what they are going to train.

The folder `.work` in it holds the plan of the runs that have not begun: one file each, which is
written before anything is trained and says all that the run will be. So two commands never put the
same agent into two runs, and whoever claims a run knows what it is.

A plan binds for as long as somebody is at work. Who comes when nobody is takes back what the last
ones left undone, and may plan it anew, with other seeds or settings. `.work` may be deleted then.
"""

import contextlib
import time
import warnings
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path

from dreamer_jax.config import Config
from dreamer_jax.integrity import DamagedError, read_sealed_json, write_sealed_json
from dreamer_jax.locks import FolderInUseError, FolderLock, Presence
from experiments.runs.spec import RunSpec
from experiments.thesis.graph import Graph, PlannedRun, plan_runs
from experiments.thesis.grid import Cell

WORK = ".work"
"""The folder of plans and claims under a folder of results."""

_PRESENCE, _PLANNING, _PLAN = "presence", "planning", ".json"


@contextlib.contextmanager
def planned(cells: Iterable[Cell], config: Config, root: str | Path) -> Iterator[Graph]:
    """Plans the runs behind cells, beside what others plan there, and is at work until its end.

    Nothing is written if nothing is left to do.

    Args:
      cells: what is asked for.
      config: settings of all runs.
      root: the folder of all results.

    Yields:
      The runs, as `graph.plan_runs` has them.

    Raises:
      ValueError: a run was made, or is planned by somebody else, with other settings.
    """
    cells, root = tuple(cells), Path(root)
    runs = plan_runs(cells, config, root, standing(root))
    if all(run.state == "done" for run in runs):
        yield runs
        return
    with contextlib.ExitStack() as until_the_end:
        with _planning(root):
            presence = until_the_end.enter_context(at_work(root))
            if presence.alone:
                for path in _plans(root):
                    path.unlink()
            # First what is planned, then what is there: a run that begins meanwhile is in one.
            runs = plan_runs(cells, config, root, reservations(root))
            for run in runs:
                if isinstance(run, PlannedRun) and run.state == "missing":
                    _reserve(run, root)
        yield runs


def at_work(root: str | Path) -> Presence:
    """Being at work under a root; what is planned there binds others until it is released."""
    return Presence(Path(root) / WORK, _PRESENCE)


def claim(root: str | Path, name: str) -> FolderLock:
    """The sole right to train a run.

    Raises:
      FolderInUseError: another process has it; says which.
    """
    return FolderLock(Path(root) / WORK, f"{name}.claim")


def reservations(root: str | Path) -> dict[str, PlannedRun]:
    """What is planned under a root and perhaps has not begun, by name."""
    found = {}
    for path in _plans(Path(root)):
        try:
            found[path.stem] = _read(path)
        except FileNotFoundError:
            continue  # it was done meanwhile
        except (DamagedError, ValueError, KeyError, TypeError) as error:
            warnings.warn(f"{path} is no plan of a run ({error}): left out", stacklevel=2)
    return found


def standing(root: str | Path) -> Mapping[str, PlannedRun]:
    """What is planned under a root, if anybody is at work there: it binds all others."""
    if not (Path(root) / WORK / _PRESENCE).exists():
        return {}
    try:
        with at_work(root) as presence:
            return {} if presence.alone else reservations(root)
    except OSError:  # a folder that may only be read
        return {}


def reserved(root: str | Path, name: str) -> PlannedRun | None:
    """What a run of that name is planned to be, if it is."""
    try:
        return _read(_path(Path(root), name))
    except FileNotFoundError:
        return None


def forget(root: str | Path, name: str) -> None:
    """Takes back the plan of a run."""
    _path(Path(root), name).unlink(missing_ok=True)


def _read(path: Path) -> PlannedRun:
    values = read_sealed_json(path)
    spec = RunSpec.from_dict(values["spec"])
    return PlannedRun(path.stem, tuple(values["cells"]), spec, tuple(values["needs"]))


def _reserve(run: PlannedRun, root: Path) -> None:
    path = _path(root, run.name)
    if not path.exists():
        values = {"spec": run.spec.to_dict(), "needs": run.needs, "cells": run.cells}
        write_sealed_json(path, values)


def _path(root: Path, name: str) -> Path:
    return root / WORK / f"{name}{_PLAN}"


def _plans(root: Path) -> list[Path]:
    return sorted((root / WORK).glob(f"*{_PLAN}"))


@contextlib.contextmanager
def _planning(root: Path) -> Iterator[None]:
    """The sole right to plan under a root; others have it for seconds only, and are waited for."""
    while True:
        try:
            lock = FolderLock(root / WORK, _PLANNING)
        except FolderInUseError:
            time.sleep(0.1)
            continue
        with lock:
            yield
        return
