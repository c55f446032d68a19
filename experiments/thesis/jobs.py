"""One run of the graph, trained by whoever claims it: this process, another, another machine.

A job names a run and no more: what the run is stands in its folder, or in the plan of what has not
begun. So a job can be done again, later or elsewhere, and goes on with what is there.

What fails is named. A folder that is damaged is set aside: renamed, never deleted.
"""

import contextlib
import time
import traceback
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

import jax

import envs
from dreamer_jax.checkpoint import Checkpointer, CorruptCheckpointError, load_tree
from dreamer_jax.devices import Choice, check_devices
from dreamer_jax.files import write_json_atomically
from dreamer_jax.host_memory import keep_freed_memory
from dreamer_jax.locks import FolderInUseError, FolderLock
from dreamer_jax.record_checks import RecordsError
from dreamer_jax.training import NonFiniteError
from envs import SimulatorError
from experiments.runs.folder import CELLS, begun, set_aside
from experiments.runs.memory import OutOfMemoryError, in_memory, mapped
from experiments.runs.run import carry_out, make_run
from experiments.runs.spec import Mapped
from experiments.runs.ways_out import GRID, WaysOut
from experiments.thesis.graph import DamagedRun, PlannedRun, inspect_run
from experiments.thesis.reservations import at_work, claim, forget, reserved
from experiments.thesis.speeds import cache_folder

POLL_SECONDS = 5.0
"""How often whoever waits for others looks whether they are done."""

Say = Callable[[str], None]


@dataclass(frozen=True)
class Means:
    """How whoever claims a run trains it; it changes no result but by rounding.

    Attributes:
      workers: simulator processes; by default one per core.
      accept_failed: take sources whose losses were not finite any more, as they were before.
      timeout: seconds after which a simulator that does not answer is given up.
      devices: how many, of those there, to spread members over.
      mapping, mapping_chunk: how they are mapped there; "auto" asks the device's memory, whatever
        was right where the run was begun.
      ways: what to do about a device without memory, in the words of what was called.
    """

    workers: int | None = None
    accept_failed: bool = False
    timeout: float = envs.SIMULATOR_TIMEOUT
    devices: Choice = "all"
    mapping: Mapped = "auto"
    mapping_chunk: int = 1
    ways: WaysOut = GRID


PLAIN = Means()
"""As whoever does not say how has it."""

Train = Callable[[PlannedRun, Path, Means], Literal["finished", "stopped"]]


@dataclass(frozen=True)
class Job:
    """A run to train, told so that any process on any machine that sees its folder can.

    Attributes:
      root: the folder of all results.
      name: of the run.
      means: how.
    """

    root: Path
    name: str
    means: Means = PLAIN


@dataclass(frozen=True)
class Ending:
    """What became of a job.

    Attributes:
      name: of the run.
      kind: "finished"; "there" (somebody else had finished it); "stopped" (and saved, it can go
        on); "busy" (another process trains it); "failed"; "skipped" (what it needs is not there);
        or "left" (it is with a queue that goes on by itself).
      message: why, or who, in words.
      damaged: other runs that were set aside, and why.
    """

    name: str
    kind: Literal["finished", "there", "stopped", "busy", "failed", "skipped", "left"]
    message: str = ""
    damaged: dict[str, str] = field(default_factory=dict)


def failed_but_kept(name: str, why: str) -> Ending:
    """The ending of a run that failed, and whose folder is in order."""
    return Ending(name, "failed", f"{why} (it is kept as it is; the same command goes on)")


def train(run: PlannedRun, root: Path, means: Means = PLAIN) -> Literal["finished", "stopped"]:
    """Begins a run or goes on with it, until it is done or stopped.

    Args:
      run: which one.
      root: the folder of all results.
      means: how.

    Raises:
      ValueError, CorruptCheckpointError: its folder is damaged, or a source does not fit.
      OutOfMemoryError: a device has no memory left.
      SimulatorError, NonFiniteError: see `dreamer_jax.training.Run.train`.
    """
    folder = root / run.name
    lock = FolderLock(folder)
    if not begun(folder):
        # Of a run that was stopped before anything was kept, perhaps one of other cells.
        (folder / "run.json").unlink(missing_ok=True)
        write_json_atomically(folder / CELLS, list(run.cells))
    try:
        begins = make_run(
            in_memory(mapped(run.spec, means.mapping, means.mapping_chunk), means.devices),
            folder,
            resume=True,
            workers=means.workers,
            base=root,
            accept_failed=means.accept_failed,
            timeout=means.timeout,
            devices=means.devices,
            lock=lock,
            cells=run.cells,
        )
        return carry_out(begins, means.ways)
    finally:
        # The programs of its simulators take up to 100 MiB a task, and serve other runs only where
        # sizes are the same.
        jax.clear_caches()


def perform(
    job: Job,
    *,
    train: Train | None = None,
    begins: Callable[[PlannedRun], None] = lambda run: None,
    wait: bool = False,
    say: Say = print,
) -> Ending:
    """Claims a run and trains it, if it is not done and all that it needs is.

    Args:
      job: the run.
      train: what trains it; by default `train`.
      begins: called with the run as it is found, before it is trained.
      wait: for another process that trains it, instead of ending as "busy".
      say: where messages of waiting go.
    """
    told = ""
    while True:
        with at_work(job.root):
            try:
                with _claimed(job.root, job.name):
                    return _perform(job, train, begins)
            except _BusyError as error:
                busy = str(error)
        if not wait:
            return Ending(job.name, "busy", busy)
        if busy != told:
            say(f"waiting: {busy}")
        told = busy
        time.sleep(POLL_SECONDS)


def perform_elsewhere(job: Job) -> Ending:
    """Performs a job for an engine in a process of its own: waits for others who train its run,
    and tells whatever happens, with the trace in the process's own log."""
    keep_freed_memory()
    if jax.config.values["jax_compilation_cache_dir"] is None:  # as the command line says it
        jax.config.update("jax_compilation_cache_dir", str(cache_folder().with_name("jax")))
    try:
        return perform(job, wait=True)
    except Exception as error:
        traceback.print_exc()
        return Ending(job.name, "failed", f"{type(error).__name__}: {error}")


class _BusyError(Exception):
    """Another process trains a run; says which."""


@contextlib.contextmanager
def _claimed(root: Path, name: str) -> Iterator[None]:
    """The sole right to train a run.

    Raises:
      _BusyError: another process has it.
    """
    try:
        with claim(root, name):
            yield
    except FolderInUseError as error:
        raise _BusyError(f"{name} is trained by {error.holder}") from None


def set_aside_damaged(root: Path, name: str) -> Ending | None:
    """Sets aside the folder of a run that was found to be damaged, if it is and nobody trains it.

    Returns:
      How the run failed; none if it did not.
    """
    with contextlib.suppress(FolderInUseError), at_work(root), claim(root, name):
        if (root / name).exists() and isinstance(run := inspect_run(root / name), DamagedRun):
            return Ending(name, "failed", _aside(root, name, run.problem))
    return None


def _perform(job: Job, train: Train | None, begins: Callable[[PlannedRun], None]) -> Ending:
    """The run is claimed.

    Raises:
      FolderInUseError: another process works in its folder, without a claim.
      _BusyError: another process trains what it needs.
    """
    root, name = Path(job.root), job.name
    run = inspect_run(root / name) if begun(root / name) else reserved(root, name)
    if run is None:
        told = "it is planned no more: the same command plans it anew"
        return Ending(name, "failed", told)
    if isinstance(run, DamagedRun):
        return Ending(name, "failed", _aside(root, name, run.problem))
    if run.state == "done":
        return Ending(name, "there")
    done = [needed for needed in run.needs if _is_done(root, needed)]
    damaged = _damaged(done, root)
    if lacking := [needed for needed in run.needs if needed not in done or needed in damaged]:
        return Ending(name, "skipped", f"it needs {', '.join(lacking)}", damaged)
    if train is None:
        try:
            check_devices(job.means.devices)
        except ValueError as error:
            return Ending(name, "failed", str(error))
        train = _train
    begins(run)
    try:
        kind = train(run, root, job.means)
    except FolderInUseError:
        raise
    except (ValueError, CorruptCheckpointError) as error:
        kept = begun(root / name)
        return Ending(name, "failed", _aside(root, name, str(error)) if kept else str(error))
    except OutOfMemoryError as error:  # which says how it goes on
        return Ending(name, "failed", f"{error} (it is kept as it is)")
    except (SimulatorError, NonFiniteError, RecordsError, jax.errors.JaxRuntimeError) as error:
        return failed_but_kept(name, str(error))
    if kind == "finished":
        forget(root, name)
    return Ending(name, kind)


_train = train  # which a parameter of that name hides


def _aside(root: Path, name: str, problem: str) -> str:
    """Sets a run's folder aside, and takes back its plan: it is planned anew another time."""
    with FolderLock(root / name):
        forget(root, name)
        kept = set_aside(root / name).name
    return f"{problem}; it was set aside as {kept}, and trains anew next time"


def _is_done(root: Path, name: str) -> bool:
    """Whether what is needed is done.

    Raises:
      _BusyError: it is not, but another process is at it.
    """

    def done() -> bool:
        return begun(root / name) and inspect_run(root / name).state == "done"

    if done() and Checkpointer(root / name / "checkpoints").latest() is not None:
        return True
    # One without a checkpoint was copied without; or all of it is evaluated, and it is being saved.
    with _claimed(root, name):
        return done()


def _damaged(names: Iterable[str], root: Path) -> dict[str, str]:
    """Reads the newest checkpoint of runs that are needed, so that a damaged one is set aside
    itself, and not what would have been made from it.

    Returns:
      Those that were, and why.
    """
    found = {}
    for name in names:
        checkpoints = Checkpointer(root / name / "checkpoints")
        if (newest := checkpoints.latest()) is None:
            continue
        try:
            load_tree(checkpoints.path(newest), subtree="agent/params")
        except CorruptCheckpointError as error:
            with contextlib.suppress(FolderInUseError), claim(root, name):
                found[name] = _aside(root, name, str(error))
    return found
