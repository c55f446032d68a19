"""Runs planned runs one after another: what was cut goes on, what fails is named, the rest goes on.

A run whose folder is damaged is set aside: renamed, never deleted. Those that need it are left for
the next time.
"""

import contextlib
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

import jax

import envs
from dreamer_jax.checkpoint import Checkpointer, CorruptCheckpointError, load_tree
from dreamer_jax.devices import Choice
from dreamer_jax.files import write_json_atomically
from dreamer_jax.locks import FolderInUseError, FolderLock
from dreamer_jax.record_checks import RecordsError
from dreamer_jax.training import NonFiniteError
from envs import SimulatorError
from experiments.runs.folder import CELLS, begun, set_aside
from experiments.runs.memory import OutOfMemoryError, in_memory
from experiments.runs.run import carry_out, make_run
from experiments.thesis.graph import DamagedRun, Graph, PlannedRun, due


@dataclass
class Progress:
    """What became of planned runs.

    Attributes:
      finished: names of the runs that were trained to their end.
      failed: those that were not, and why.
      skipped: those that need one of these, and which.
      stopped: whether Ctrl-C ended it.
    """

    finished: list[str] = field(default_factory=list)
    failed: dict[str, str] = field(default_factory=dict)
    skipped: dict[str, str] = field(default_factory=dict)
    stopped: bool = False

    @property
    def complete(self) -> bool:
        """Whether nothing failed and nothing is left."""
        return not (self.failed or self.skipped or self.stopped)


Train = Callable[[PlannedRun, Path, int | None], Literal["finished", "stopped"]]


def train(
    run: PlannedRun,
    root: Path,
    workers: int | None,
    *,
    accept_failed: bool = False,
    timeout: float = envs.SIMULATOR_TIMEOUT,
    devices: Choice = "all",
) -> Literal["finished", "stopped"]:
    """Begins a run or goes on with it, until it is done or stopped.

    Args:
      run: which one.
      root: the folder of all results.
      workers: simulator processes; by default one per core.
      accept_failed: transfer from agents that failed, as they were before.
      timeout: seconds after which a simulator that does not answer is given up.
      devices: how many to spread its members over.

    Raises:
      ValueError, CorruptCheckpointError: its folder is damaged, or a source does not fit.
      SimulatorError, NonFiniteError: see `dreamer_jax.training.Run.train`.
    """
    folder, spec = root / run.name, run.spec
    lock = FolderLock(folder)
    if not begun(folder):
        # Of a run that was stopped before anything was kept, perhaps one of other cells.
        (folder / "run.json").unlink(missing_ok=True)
        write_json_atomically(folder / CELLS, list(run.cells))
        spec = in_memory(spec, devices)
    try:
        begins = make_run(
            spec,
            folder,
            resume=True,
            workers=workers,
            base=root,
            accept_failed=accept_failed,
            timeout=timeout,
            devices=devices,
            lock=lock,
            cells=run.cells,
        )
        return carry_out(begins)
    finally:
        # The programs of its simulators serve no other run, and take up to 100 MiB a task.
        jax.clear_caches()


def carry_out_runs(
    runs: Graph,
    root: str | Path,
    *,
    workers: int | None = None,
    train: Train = train,
    say: Callable[[str], None] = print,
) -> Progress:
    """Trains what is missing and goes on with what was cut, in the order given.

    Args:
      runs: from `graph.plan_runs`.
      root: the folder of all results.
      workers: simulator processes; by default one per core.
      train: what trains one run.
      say: where messages go.

    Raises:
      ValueError: another process trains runs under the same root.
    """
    root, progress = Path(root), Progress()
    left = due(runs)
    with _alone(root) if left else contextlib.nullcontext():
        for run in runs:
            if isinstance(run, DamagedRun):
                progress.failed[run.name] = _aside(root / run.name, run.problem)
        _carry_out(left, root, progress, workers, train, say)
    return progress


@contextlib.contextmanager
def _alone(root: Path) -> Iterator[None]:
    """Keeps other processes from training runs under a root, until this one is done or dead."""
    try:
        lock = FolderLock(root)
    except FolderInUseError as error:
        raise ValueError(
            f"another command is training in {root} ({error.holder}): wait until it is done, or "
            "name another folder with --results"
        ) from None
    with lock:
        yield


def _carry_out(
    left: list[PlannedRun],
    root: Path,
    progress: Progress,
    workers: int | None,
    train: Train,
    say: Callable[[str], None],
) -> None:
    checked: set[str] = set()
    for number, run in enumerate(left, start=1):
        _check_needs(run, root, progress, checked)
        if broken := [name for name in run.needs if _lost(name, progress)]:
            progress.skipped[run.name] = f"it needs {', '.join(broken)}"
            continue
        verb = f"goes on at {run.progress:.0%}" if run.state == "cut" else "begins"
        say(f"run {number} of {len(left)}, {run.name}: {_described(run)}; it {verb}")
        try:
            outcome = train(run, root, workers)
        except FolderInUseError as error:
            progress.failed[run.name] = str(error)
        except (ValueError, CorruptCheckpointError) as error:
            damaged = begun(root / run.name)
            progress.failed[run.name] = (
                _aside(root / run.name, str(error)) if damaged else str(error)
            )
        except (
            SimulatorError,
            NonFiniteError,
            RecordsError,
            OutOfMemoryError,
            jax.errors.JaxRuntimeError,
        ) as error:
            progress.failed[run.name] = f"{error} (it is kept as it is; the same command goes on)"
        else:
            if outcome == "stopped":
                progress.stopped = True
                return
            progress.finished.append(run.name)


def _described(run: PlannedRun) -> str:
    agents = f"{len(run.cells)} agents" if len(run.cells) > 1 else "1 agent"
    return f"{agents} on {' + '.join(run.spec.tasks)}"


def _lost(name: str, progress: Progress) -> bool:
    return name in progress.failed or name in progress.skipped


def _aside(folder: Path, problem: str) -> str:
    return f"{problem}; it was set aside as {set_aside(folder).name}, and trains anew next time"


def _check_needs(run: PlannedRun, root: Path, progress: Progress, checked: set[str]) -> None:
    """Reads the newest checkpoint of what a run needs, so that a damaged one is set aside itself
    and not what would have been made from it."""
    for name in run.needs:
        checkpoints = Checkpointer(root / name / "checkpoints")
        latest = checkpoints.latest()
        if name in checked or _lost(name, progress) or latest is None:
            continue
        try:
            load_tree(checkpoints.path(latest), subtree="agent/params")
        except CorruptCheckpointError as error:
            progress.failed[name] = _aside(root / name, str(error))
        checked.add(name)
