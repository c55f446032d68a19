"""Where runs of the grid are trained: options that commands share, and the command `work`.

What takes long to import is imported where it is used, so that bad input is told at once.
"""

import dataclasses
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import tyro

from dreamer_jax.ranges import setting
from experiments.cli.exits import FAILURE, STOPPED, usage_errors
from experiments.cli.options import AtOnce, Devices, Simulators

if TYPE_CHECKING:
    from experiments.thesis.engines import Engine
    from experiments.thesis.graph import Graph
    from experiments.thesis.jobs import Means
    from experiments.thesis.sweep import Progress


@dataclass(frozen=True)
class Execution:
    """Where runs are trained, and what each of them gets there."""

    executor: Literal["local", "ray", "slurm"] = "local"
    """Here, one after another; on a Ray cluster (that of RAY_ADDRESS, or else of this machine); or
    in a Slurm queue. With the last two each run is a process of its own."""
    run: str | None = None
    """Train only this one of the runs that `plan` shows, and make nothing of it."""
    gpus: float | None = setting(None, 0, 64)
    """ray, slurm: accelerators of each run, over which its members are spread, or a part of one on
    Ray. By default one on Ray, if the cluster has any, and none is asked of Slurm."""
    cpus: int = setting(1, 1, 1024)
    """ray, slurm: cores of each run, and simulator processes where --workers does not say."""
    memory: float | None = setting(None, 0, 65_536, above=True)
    """ray, slurm: memory of each run in GiB; by default as `plan` has estimated it on this machine,
    else not asked for."""
    hours: float | None = setting(None, 0, 8760, above=True)
    """slurm: how long a job may take at once; longer ones are requeued and go on. By default as
    `plan` has estimated it on this machine, else 4."""
    slurm: tuple[str, ...] = ()
    """slurm: further options of jobs, such as partition=gpu account=ours (sbatch's, as submitit
    names them); cluster=local tries it on this machine without Slurm."""


@dataclass(frozen=True)
class Work:
    """Train what other commands have planned in a folder of results, beside them, until it is done.

    For more processes, on machines that share the folder: each takes a run that is ready and that
    nobody trains, goes on with those that were cut, and waits for those it needs. Ctrl-C saves and
    stops.
    """

    results: tyro.conf.Positional[Path]
    """The folder that holds the runs, such as results/cpu."""
    devices: Devices = setting("all", 1, 10_000)
    """Devices to spread members over, each member on one of them."""
    at_once: tyro.conf.OmitArgPrefixes[AtOnce] = AtOnce()
    simulators: tyro.conf.OmitArgPrefixes[Simulators] = Simulators()
    accept_failed: bool = False
    """Transfer from agents whose losses were not finite any more, as they were before."""


def check_execution(execution: Execution) -> None:
    """Whether the engine is installed and takes its options.

    Raises:
      ModuleNotFoundError: it is not; says how to.
      ValueError: it does not, or options are given that are not the engine's.
    """
    plain = Execution()
    own = {"ray": ("gpus", "cpus", "memory"), "slurm": ("gpus", "cpus", "memory", "hours", "slurm")}
    for name in ("gpus", "cpus", "memory", "hours", "slurm"):
        if getattr(execution, name) != getattr(plain, name):
            owners = [engine for engine, names in own.items() if name in names]
            if execution.executor not in owners:
                raise ValueError(f"--{name} is for --executor {' or '.join(owners)}")
    if execution.executor != "local":
        engine_of(execution)


def engine_of(execution: Execution) -> "Engine":
    """The engine that options name; see `check_execution` for errors."""
    if execution.executor == "ray":
        from experiments.thesis.engines import on_ray

        on_ray.check()
        return on_ray.on_ray
    if execution.executor == "slurm":
        from experiments.thesis.engines.on_slurm import slurm_engine

        return slurm_engine(execution.slurm)
    from experiments.thesis.engines.local import one_by_one

    return one_by_one


def engine_options(execution: Execution, runs: "Graph", means: "Means") -> dict[str, Any]:
    """Keywords of `sweep.carry_out_runs`: the engine, and what runs get of it.

    Args:
      execution: the options.
      runs: from `graph.plan_runs`.
      means: how runs are trained; with an engine of several machines, those simulate in as many
        processes as a run has cores, if that is not said.
    """
    engine = engine_of(execution)
    if execution.executor == "local":
        return {"engine": engine, "means": means}
    from experiments.thesis.engines import Resources
    from experiments.thesis.engines.demands import demands

    asked = Resources(execution.gpus, execution.cpus, execution.memory, execution.hours)
    means = dataclasses.replace(means, workers=means.workers or execution.cpus)
    return {"engine": engine, "means": means, "resources": demands(runs, asked)}


def chosen_run(runs: "Graph", name: str | None) -> "Graph":
    """The runs that are to be trained: all, or one.

    Raises:
      ValueError: there is none of that name; names those there are.
    """
    if name is None:
        return runs
    if not (found := [run for run in runs if run.name == name]):
        known = ", ".join(run.name for run in runs)
        raise ValueError(f"there is no run {name!r} in this plan; its runs are {known}")
    return found


def tell_problems(progress: "Progress") -> int:
    """Names what was not trained.

    Returns:
      The exit code.
    """
    for kind, names in (("failed", progress.failed), ("skipped", progress.skipped)):
        for name, reason in names.items():
            print(f"{kind}: {name}: {reason}", file=sys.stderr)
    if progress.stopped:
        return STOPPED
    return 0 if progress.complete else FAILURE


def work(command: Work) -> int:
    """Trains what is planned."""
    with usage_errors():
        if not command.results.is_dir():
            raise ValueError(
                f"there is no folder {command.results}: table, figure or sweep make it as they plan"
            )
    from dreamer_jax.devices import check_devices
    from dreamer_jax.host_memory import keep_freed_memory
    from experiments.runs.ways_out import WORK
    from experiments.thesis import sweep
    from experiments.thesis.jobs import Means

    with usage_errors():
        check_devices(command.devices)
    keep_freed_memory()
    means = Means(
        command.simulators.workers,
        command.accept_failed,
        command.simulators.simulator_timeout,
        command.devices,
        command.at_once.mapping,
        command.at_once.mapping_chunk,
        WORK,
    )
    progress = sweep.work(command.results, means=means)
    if progress.stopped:
        print("stopped and saved: the same command goes on")
    else:
        print(f"{len(progress.finished)} runs were trained here; nothing is left to do")
    return tell_problems(progress)
