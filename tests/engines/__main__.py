"""python -m tests.engines: tables made by several processes, some of which are killed.

Tables 7 (a part of it) and 13 are made at the preset debug by one process, and then

  ray      on a Ray cluster of two nodes: Ctrl-C in the middle of a run, the same command again, and
           the node that a run is on killed in the middle of it;
  slurm    by submitit's own engine, with a job told in the middle of a run that its time is up;
  workers  by three processes that share a folder, one of them killed in the middle of a run.

All that is left must be the same to the byte. Exit code 1 if it is not. Ray and submitit must be
installed for their parts.
"""

import argparse
import contextlib
import json
import os
import re
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path

from dreamer_jax.checkpoint import Checkpointer
from experiments.runs.folder import begun, run_folders
from experiments.thesis.graph import inspect_run
from experiments.thesis.reservations import WORK

ROOT = Path(__file__).parents[2]
PARTS = ("ray", "slurm", "workers")
TABLES = ("7", "13")
LENGTH = ("--environment-steps", "320", "--evaluate-every", "80", "--checkpoint-every", "80")
SHARED = ("--preset", "debug", "--seeds", "0", "1", "--counts", "2", "--omegas", "0.1", "0.2")
COMMAND = ("table", *TABLES, *SHARED, *LENGTH, "--workers", "1")
RESULTS = Path("results") / "debug"
PATIENCE = 1800.0
"""Seconds after which what is waited for will not come."""


def main() -> int:
    """Runs the parts asked for."""
    parser = argparse.ArgumentParser(
        prog="python -m tests.engines",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("parts", nargs="*", choices=[[], *PARTS], help="by default all")
    parser.add_argument("--folder", type=Path, help="kept; by default a temporary one")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as temporary:
        folder = (options.folder or Path(temporary)).absolute()
        _prepare(folder)
        _finish(start(folder / "one", *COMMAND), folder / "one")
        print("one process: the tables are there", flush=True)
        bad = 0
        for part in options.parts or PARTS:
            told = _PARTS[part](folder / part)
            different = differences(folder / "one" / "results", folder / part / "results")
            bad += len(different)
            count = len(kept_files(folder / part / "results"))
            print(
                f"{part}: {told}; {count - len(different)} of {count} files are the same to the "
                "byte",
                flush=True,
            )
            for name in different:
                print(f"FAILED: {part}: {name} differs", flush=True)
    return 1 if bad else 0


def _prepare(folder: Path) -> None:
    """What all processes, those of Ray too, find in their environment."""
    os.environ["PYTHONPATH"] = str(ROOT)
    os.environ["XDG_CACHE_HOME"] = str(folder / "cache")
    os.environ["RAY_USAGE_STATS_ENABLED"] = "0"
    os.environ["OMP_NUM_THREADS"] = "1"
    os.environ["RAY_worker_niceness"] = "0"  # on a machine that does other work, too
    # Where this was started in the background, which leaves no Ctrl-C to those that it starts.
    signal.signal(signal.SIGINT, signal.default_int_handler)
    os.environ.setdefault("XLA_FLAGS", "--xla_backend_optimization_level=0")


# --- parts ---------------------------------------------------------------------------------------


def on_ray(folder: Path) -> str:
    """Ctrl-C, and a node that is lost."""
    from ray.cluster_utils import Cluster

    # What tasks leave in Ray's own memory is next to nothing.
    each = {"object_store_memory": 80 * 2**20}
    head = {"num_cpus": 0, "include_dashboard": False}
    cluster = Cluster(initialize_head=True, head_node_args=head | each)
    nodes = [cluster.add_node(num_cpus=1, **each) for _ in range(2)]
    cluster.wait_for_nodes()
    os.environ["RAY_ADDRESS"] = cluster.address
    words = (*COMMAND, "--executor", "ray")
    try:
        process = start(folder, *words)
        name, _ = in_the_middle(folder, lambda name: "+" in name)
        process.send_signal(signal.SIGINT)
        assert process.wait(PATIENCE) == 130, output(folder)
        state, left = states(folder)[name], unfinished(folder)
        assert state in ("cut", "done"), state
        process = start(folder, *words)
        lost, pid = in_the_middle(folder, lambda name: "fractional" in name)
        (node,) = [node for node in nodes if raylet(node) in ancestors(pid)]
        cluster.remove_node(node, allow_graceful=False)
        cut = states(folder)[lost]
        _finish(process, folder)
    finally:
        os.environ.pop("RAY_ADDRESS")
        cluster.shutdown()
    return (
        f"Ctrl-C during {name} ({state} then, {left} runs were left), the same command again, and "
        f"a node killed during {lost} ({cut} then)"
    )


def raylet(node) -> int:
    """The id of the process of a node that starts those of its tasks."""
    return node.all_processes["raylet"][0].process.pid


def on_slurm(folder: Path) -> str:
    """A job that is told that its time is up."""
    process = start(folder, *COMMAND, "--executor", "slurm", "--slurm", "cluster=local")
    name, pid = in_the_middle(folder, lambda name: "fractional" in name)
    os.kill(pid, signal.SIGUSR2)
    _finish(process, folder)
    logs = [path.read_text() for path in folder.glob(f"results/debug/{WORK}/slurm/*_log.out")]
    requeued = sum("Requeued job" in log for log in logs)
    assert requeued, "no job was requeued"
    return f"SIGUSR2 during {name}, {requeued} job requeued and gone on with"


def by_workers(folder: Path) -> str:
    """Workers started by hand, one of which is lost."""
    process = start(folder, *COMMAND)
    while not list((folder / RESULTS / WORK).glob("*.json")):
        time.sleep(0.1)
    others = [start(folder, "work", str(RESULTS), "--workers", "1") for _ in range(2)]
    name, pid = in_the_middle(folder, lambda name: "+" in name, [each.pid for each in others])
    os.kill(pid, signal.SIGKILL)
    _finish(process, folder)
    codes = sorted(each.wait(PATIENCE) for each in others)
    assert codes == [-9, 0], codes
    return f"one of two others killed during {name}"


_PARTS: dict[str, Callable[[Path], str]] = {
    "ray": on_ray,
    "slurm": on_slurm,
    "workers": by_workers,
}


# --- processes -----------------------------------------------------------------------------------


def start(folder: Path, *words: str) -> subprocess.Popen:
    """Starts a command in a folder; what it says goes to a file there."""
    folder.mkdir(parents=True, exist_ok=True)
    with open(folder / "output.txt", "ab") as file:
        return subprocess.Popen(
            [sys.executable, "-m", "experiments", *words],
            cwd=folder,
            stdin=subprocess.DEVNULL,
            stdout=file,
            stderr=subprocess.STDOUT,
        )


def output(folder: Path) -> str:
    """What the commands in a folder have said."""
    return (folder / "output.txt").read_text()


def _finish(process: subprocess.Popen, folder: Path) -> None:
    if code := process.wait(PATIENCE):
        raise RuntimeError(f"exit code {code} in {folder}:\n{output(folder)}")


def in_the_middle(
    folder: Path, wanted: Callable[[str], bool], of: list[int] | None = None
) -> tuple[str, int]:
    """Waits until a run of a wanted name has begun and is not done.

    Args:
      folder: where the command was started.
      wanted: whether a run's name is.
      of: process ids, of one of which it must be; by default any.

    Returns:
      Its name, and the id of the process that trains it.
    """
    deadline = time.monotonic() + PATIENCE
    while time.monotonic() < deadline:
        for path in (folder / RESULTS / WORK).glob("*.claim"):
            run = folder / RESULTS / path.stem
            with contextlib.suppress(ValueError, KeyError):  # which is being written
                pid = json.loads(path.read_text())["pid"]
                if wanted(path.stem) and begun(run) and (of is None or pid in of):
                    if inspect_run(run).state == "cut" and Path(f"/proc/{pid}").exists():
                        return path.stem, pid
        time.sleep(0.02)
    raise TimeoutError(f"no such run has begun in {folder}:\n{output(folder)}")


def ancestors(pid: int) -> list[int]:
    """The ids of the process that started another, of that which started it, and so on."""
    found = re.search(r"^PPid:\s*(\d+)", Path(f"/proc/{pid}/status").read_text(), re.MULTILINE)
    assert found is not None
    return [int(found[1]), *ancestors(int(found[1]))] if int(found[1]) else []


def states(folder: Path) -> dict[str, str]:
    """The state of each run that has begun, by name."""
    return {path.name: inspect_run(path).state for path in run_folders(folder / RESULTS)}


def unfinished(folder: Path) -> int:
    """How many of the runs that are planned are not done."""
    done = {name for name, state in states(folder).items() if state == "done"}
    return len({path.stem for path in (folder / RESULTS / WORK).glob("*.json")} - done)


# --- files ---------------------------------------------------------------------------------------


def kept_files(results: Path) -> dict[str, Path]:
    """What is compared, by name: metrics, last checkpoints, accuracies, and all of the report but
    its pictures of vectors and its page, which say when they were made."""
    found = list(_kept(results))
    return {str(path.relative_to(results)): path for path in found}


def _kept(results: Path) -> Iterator[Path]:
    root = results / "debug"
    for run in run_folders(root):
        checkpoints = Checkpointer(run / "checkpoints")
        newest = checkpoints.latest()
        assert newest is not None
        # Every leaf's checksum is in it.
        yield checkpoints.path(newest) / "leaves.json"
        yield run / "metrics.jsonl"
        yield run / "cells.json"
    yield from sorted(root.glob("latents-*/*.json"))
    for ending in ("txt", "csv", "png"):
        yield from sorted((root / "report").glob(f"*.{ending}"))


def differences(one: Path, other: Path) -> list[str]:
    """Names of what is kept of two and differs, or is in one of them only."""
    left, right = kept_files(one), kept_files(other)
    return [
        name
        for name in sorted({**left, **right})
        if name not in left
        or name not in right
        or left[name].read_bytes() != right[name].read_bytes()
    ]


if __name__ == "__main__":
    sys.exit(main())
