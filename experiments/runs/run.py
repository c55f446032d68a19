"""One population: tasks, settings, seeds and perhaps a source -> a results folder.

A results folder holds run.json (what the run is), metrics.jsonl, timings.jsonl, tensorboard/,
checkpoints/, replay/, videos/ and, where knowledge was transferred, transfer.txt and
transfer.json.
"""

import importlib.metadata
import json
import platform
import subprocess
from pathlib import Path
from typing import Literal

import jax
import numpy as np

import transfer
from dreamer_jax.checkpoint import Checkpointer
from dreamer_jax.device_round import on_device
from dreamer_jax.files import write_json_atomically
from dreamer_jax.training import Run
from experiments.runs.agents import make_agent, make_env
from experiments.runs.spec import RunSpec, read_spec
from experiments.runs.start import load_sources, transferred_members


def _versions() -> dict[str, str]:
    names = ("jax", "jaxlib", "flax", "optax", "numpy", "pillow")
    names += ("gymnasium", "pygame", "pybullet", "brax", "mujoco")
    versions = {"python": platform.python_version(), "backend": jax.default_backend()}
    for name in names:
        try:
            versions[name] = importlib.metadata.version(name)
        except importlib.metadata.PackageNotFoundError:
            versions[name] = "not installed"
    return versions


def _revision() -> str:
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
) -> Run:
    """Prepares a run: simulators, agents, and the results folder.

    Args:
      spec: what to run.
      directory: the results folder.
      resume: continue what the folder holds.
      workers: simulator processes; by default one per core.
      base: the folder that the spec's relative paths start from; by default the working directory.

    Raises:
      ValueError: the folder holds another run, or a source does not fit.
      FileExistsError: the folder holds a run, and `resume` is False.
    """
    directory = Path(directory)
    header = directory / "run.json"
    if header.exists():
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
    state, report = None, None
    if spec.method.needs and Checkpointer(directory / "checkpoints").latest() is None:
        state, report = transferred_members(spec, load_sources(spec, base), workers=workers)
    agent = make_agent(spec)
    env = make_env(spec, workers=workers)
    try:
        # What cannot be had is refused before the folder is made.
        on_device(agent, env.has_host, len(spec.tasks), len(spec.members))
        directory.mkdir(parents=True, exist_ok=True)
        if report is not None:
            write_report(report, directory)
        # Written last: what has a header can be resumed.
        if not header.exists():
            made_with = {"versions": _versions(), "revision": _revision()}
            write_json_atomically(header, {"spec": spec.to_dict(), **made_with})
        return Run(agent, env, spec.tasks, spec.members, directory, state=state, resume=True)
    except BaseException:
        env.close()
        raise


def write_report(report: transfer.Report, directory: Path) -> None:
    """Writes what was transferred as transfer.txt (for people) and transfer.json."""
    (directory / "transfer.txt").write_text(f"{report}\n")
    records = json.dumps(report.records(), indent=1, default=_plain)
    (directory / "transfer.json").write_text(records + "\n")


def _plain(value):
    return np.asarray(value).tolist()


def carry_out(run: Run) -> Literal["finished", "stopped"]:
    """Trains to the end or to Ctrl-C, and closes the run and its simulators."""
    try:
        return run.train()
    finally:
        run.close()
        run.env.close()
