"""One population: tasks, settings, seeds and perhaps a source -> a results folder.

A results folder holds run.json (what the run is), metrics.jsonl, timings.jsonl, tensorboard/,
checkpoints/, replay/, videos/ and, where knowledge was transferred, transfer.txt and
transfer.json.
"""

import importlib.metadata
import json
import platform
import subprocess
from collections.abc import Sequence
from pathlib import Path
from typing import Literal

import jax
import numpy as np

import envs
import transfer
from dreamer_jax.checkpoint import Checkpointer
from dreamer_jax.device_round import on_device
from dreamer_jax.devices import Choice, place
from dreamer_jax.integrity import DamagedError, write_sealed_json
from dreamer_jax.locks import FolderLock
from dreamer_jax.training import Run
from experiments.runs.agents import make_agent, make_env
from experiments.runs.memory import is_exhausted, out_of_memory
from experiments.runs.spec import RunSpec, read_spec
from experiments.runs.start import load_sources, transferred_members
from experiments.runs.ways_out import TRAIN, WaysOut


def _versions() -> dict[str, str]:
    names = ["jax", "jaxlib", "flax", "optax", "numpy", "pillow"]
    names += ["gymnasium", "pygame", "pybullet", "brax", "mujoco"]
    versions = {"python": platform.python_version(), "backend": jax.default_backend()}
    for name in names:
        try:
            versions[name] = importlib.metadata.version(name)
        except importlib.metadata.PackageNotFoundError:
            versions[name] = "not installed"
    return versions


def revision() -> str:
    """The commit of the source tree, marked if it was changed since; else the package's version."""
    tree = Path(__file__).parents[2]
    if (tree / ".git").exists():
        command = ["git", "-C", str(tree), "describe", "--always", "--dirty"]
        try:
            done = subprocess.run(command, capture_output=True, text=True, check=True)
            return done.stdout.strip()
        except (OSError, subprocess.CalledProcessError):
            pass  # no git here, or a tree that is not its to read
    try:
        return importlib.metadata.version("dreamer-transfer")
    except importlib.metadata.PackageNotFoundError:
        return "unknown"


def make_run(
    spec: RunSpec,
    directory: str | Path,
    *,
    resume: bool = False,
    workers: int | None = None,
    base: str | Path = "",
    accept_failed: bool = False,
    timeout: float = envs.SIMULATOR_TIMEOUT,
    from_checkpoint: int | None = None,
    lock: FolderLock | None = None,
    cells: Sequence[str] = (),
    devices: Choice = "all",
) -> Run:
    """Prepares a run: simulators, agents, and the results folder.

    Args:
      spec: what to run.
      directory: the results folder.
      resume: continue what the folder holds.
      workers: simulator processes; by default one per core.
      base: the folder that the spec's relative paths start from; by default the working directory.
      accept_failed: take sources that failed, as they were before.
      timeout: seconds after which a simulator that does not answer is given up.
      from_checkpoint: step of an older checkpoint to go on from.
      lock: the folder's lock, if the caller holds it; released with the run, or when this raises.
      cells: names of the cells of the grid that the members are.
      devices: how many to spread the members over.

    Raises:
      FolderInUseError: another process works in the folder.
      DamagedError: the folder lacks files, or holds others than were written.
      ValueError: the folder holds another run, a source does not fit, or there are not so many
        devices.
      FileExistsError: the folder holds a run, and `resume` is False.
    """
    directory = Path(directory)
    placement = place(len(spec.members), devices)
    _check_folder(directory, spec, resume)
    # A new folder is made only when everything that may be wrong with the input has been looked at.
    if lock is None and directory.exists():
        lock = FolderLock(directory)
    env = None
    try:
        state, report = None, None
        if spec.method.needs and Checkpointer(directory / "checkpoints").latest() is None:
            sources = load_sources(spec, base, accept_failed=accept_failed)
            state, report = transferred_members(
                spec, sources, workers=workers, timeout=timeout, placement=placement
            )
        agent = make_agent(spec)
        env = make_env(spec, workers=workers, timeout=timeout, shards=placement.count)
        # What cannot be had is refused before the folder is made.
        on_device(agent, env.has_host, len(spec.tasks), placement.each)
        lock = lock or FolderLock(directory)
        _check_folder(directory, spec, resume)  # again, now that nobody else can change it
        if report is not None:
            write_report(report, directory)
        # Written last: what has a header can be resumed.
        if not (directory / "run.json").exists():
            named = {"cells": list(cells)} if cells else {}
            made_with = {"versions": _versions(), "revision": revision()}
            content = {"spec": spec.to_dict(), **named, **made_with}
            write_sealed_json(directory / "run.json", content)
        return Run(
            agent,
            env,
            spec.tasks,
            spec.members,
            directory,
            state=state,
            resume=True,
            from_checkpoint=from_checkpoint,
            lock=lock,
            placement=placement,
        )
    except BaseException:
        if lock is not None:
            lock.release()
        if env is not None:
            env.close()
        raise


def _check_folder(directory: Path, spec: RunSpec, resume: bool) -> None:
    """Whether a run of the spec may be begun in a folder, or resumed in it."""
    if directory.exists() and not directory.is_dir():
        raise NotADirectoryError(f"{directory} is a file: name a folder for the results")
    if not (directory / "run.json").exists():
        names = ("metrics.jsonl", "replay", "checkpoints")
        if held := [name for name in names if _holds(directory, name)]:
            raise DamagedError(
                f"{directory} holds {' and '.join(held)} of a run, but no run.json to say which: "
                "restore it, or choose another folder (or move this one away) to start again"
            )
        return
    different = read_spec(directory).differences(spec)
    if different:
        raise ValueError(
            f"{directory} holds another run (there / here: {'; '.join(map(str, different))}): "
            "give the same settings, or choose another folder"
        )
    if not resume:
        raise FileExistsError(
            f"{directory} already holds this run: add --resume, or choose another folder"
        )


def _holds(directory: Path, name: str) -> bool:
    """Whether something of a run is kept under that name."""
    path = directory / name
    if path.is_dir():
        records = any(file.stat().st_size for file in path.glob("member_*/*"))
        return records or Checkpointer(path).latest() is not None
    return path.exists() and path.stat().st_size > 0


def write_report(report: transfer.Report, directory: Path) -> None:
    """Writes what was transferred as transfer.txt (for people) and transfer.json."""
    (directory / "transfer.txt").write_text(f"{report}\n")
    records = json.dumps(report.records(), indent=1, default=_plain)
    (directory / "transfer.json").write_text(records + "\n")


def _plain(value):
    return np.asarray(value).tolist()


def carry_out(run: Run, ways: WaysOut = TRAIN) -> Literal["finished", "stopped"]:
    """Trains to the end or to Ctrl-C, and closes the run and its simulators.

    Args:
      run: the run.
      ways: what to do about a device without memory, in the words of what was called.

    Raises:
      OutOfMemoryError: a device has no memory left; names what may fit.
      Exception: others, see `dreamer_jax.training.Run.train`.
    """
    try:
        return run.train()
    except (jax.errors.JaxRuntimeError, MemoryError) as error:
        if not is_exhausted(error):
            raise
        raise out_of_memory(run, ways) from error
    finally:
        run.close()
        run.env.close()
