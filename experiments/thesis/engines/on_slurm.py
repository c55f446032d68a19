"""Runs in a Slurm queue: an array of jobs for each level of the graph, after the level before.

Submitit makes and watches the jobs. Slurm signals a job that is to be preempted or whose time is
up, and it is requeued and goes on from its newest checkpoint.
"""

import math
import signal
import time
from collections.abc import Iterator, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

from experiments.thesis.engines import Engine, Resources, Task
from experiments.thesis.jobs import (
    POLL_SECONDS,
    Ending,
    Job,
    Say,
    failed_but_kept,
    perform_elsewhere,
)
from experiments.thesis.reservations import WORK

HOURS = 4.0
"""How long a job may take at once where nothing is asked for or measured; it is requeued then."""

REQUEUES = 1000
"""How often a job whose time is up goes on."""


class Perform:
    """A run as submitit calls it: picklable, and resumed where it was cut."""

    def __call__(self, job: Job) -> Ending:
        """Trains the run."""
        # Slurm says SIGTERM before it preempts or cancels. A run would save and be done with it;
        # it is the signal after it that requeues a job, and what is on the disk suffices to go on.
        signal.signal(signal.SIGTERM, signal.SIG_IGN)
        return perform_elsewhere(job)

    def checkpoint(self, job: Job):
        """What submitit submits in the place of a job that is interrupted: the same again."""
        from submitit.helpers import DelayedSubmission

        return DelayedSubmission(self, job)


def slurm_engine(options: Sequence[str] = ()) -> Engine:
    """The engine, with options of a job as `sbatch` knows them.

    Args:
      options: such as "partition=gpu", see `submitit.SlurmExecutor`; "cluster=local" tries jobs as
        processes of this machine, with submitit's own engine.

    Raises:
      ModuleNotFoundError: submitit is not installed; says how to.
      ValueError: there is no Slurm here, or no such option.
    """
    try:
        import submitit  # noqa: F401
    except ModuleNotFoundError:
        raise ModuleNotFoundError(
            "--executor slurm needs submitit: pip install 'dreamer-transfer[slurm]'"
        ) from None
    given = dict(_pair(option) for option in options)
    cluster = str(given.pop("cluster", "slurm"))
    if "dependency" in given:
        raise ValueError("--slurm dependency=… is this program's to say: leave it out")
    _executor(Path(), cluster, {f"slurm_{name}": value for name, value in given.items()})
    return partial(_on_slurm, cluster=cluster, given=given)


def _pair(option: str) -> tuple[str, str | int]:
    name, equals, value = option.partition("=")
    if not (name and equals and value):
        raise ValueError(f"--slurm {option!r} is no option of a job: expected NAME=VALUE")
    return name.replace("-", "_"), int(value) if value.isdecimal() else value


def _executor(folder: Path, cluster: str, parameters: Mapping[str, Any]) -> Any:
    import submitit

    try:
        executor = submitit.AutoExecutor(folder, cluster, slurm_max_num_timeout=REQUEUES)
        executor.update_parameters(**parameters)
    except (NameError, ValueError, RuntimeError) as error:
        raise ValueError(
            f"{error} (--executor slurm submits from a machine that has Slurm's commands; "
            "--slurm cluster=local tries it without)"
        ) from error
    return executor


def _on_slurm(
    tasks: Sequence[Task], say: Say, *, cluster: str, given: Mapping[str, str | int]
) -> Iterator[Ending]:
    """Submits tasks and tells their ends. Ctrl-C leaves the jobs in the queue.

    Args:
      tasks: each after those it needs.
      say: where messages go.
      cluster: "slurm", or another of submitit's.
      given: options of all jobs.

    Yields:
      What became of each, in the order in which they end.
    """
    if not tasks:
        return
    folder = tasks[0].job.root / WORK / "slurm"
    jobs: dict[str, Any] = {}
    try:
        after: dict[str, str | int] = {}
        for number, level in enumerate(levels(tasks)):
            parameters = _parameters([task.resources for task in level])
            parameters |= {f"slurm_{name}": value for name, value in {**given, **after}.items()}
            executor = _executor(folder, cluster, parameters)
            submitted = executor.map_array(Perform(), [task.job for task in level])
            for task, job in zip(level, submitted, strict=True):
                say(f"{task.described()}; it is job {job.job_id}")
                jobs[task.name] = job
            queue = submitted[0].job_id.partition("_")[0]
            if cluster == "slurm":
                # However they end: whether what a run needs is there, it sees for itself.
                after = {"dependency": f"afterany:{queue}"}
            elif number < len(tasks):  # it knows no dependencies
                yield from _ends(jobs, say)
        yield from _ends(jobs, say)
    except KeyboardInterrupt:
        numbers = " ".join(dict.fromkeys(job.job_id.partition("_")[0] for job in jobs.values()))
        cancel = f"scancel {numbers}" if cluster == "slurm" else f"kill {numbers}"
        say(f"the jobs go on without this command; to cancel them: {cancel}")
        for name in jobs:
            yield Ending(name, "left")


def levels(tasks: Sequence[Task]) -> list[list[Task]]:
    """Tasks in levels: each needs only tasks of those before its own."""
    depth: dict[str, int] = {}
    for task in tasks:
        depth[task.name] = max((depth[name] + 1 for name in task.needs), default=0)
    found: list[list[Task]] = [[] for _ in range(max(depth.values(), default=-1) + 1)]
    for task in tasks:
        found[depth[task.name]].append(task)
    return found


def _parameters(resources: Sequence[Resources]) -> dict[str, Any]:
    """Of the jobs of one array, which all get what the largest needs."""
    hours = max(each.hours or HOURS for each in resources)
    parameters = {
        "name": "dreamer-transfer",
        "timeout_min": math.ceil(60 * hours),
        "cpus_per_task": max(each.cpus for each in resources),
    }
    if any(each.gpus for each in resources):
        parameters["gpus_per_node"] = math.ceil(max(each.gpus or 0 for each in resources))
    if all(each.memory for each in resources):
        parameters["mem_gb"] = math.ceil(max(each.memory or 0 for each in resources))
    return parameters


def _ends(jobs: dict[str, Any], say: Say) -> Iterator[Ending]:
    """Waits for jobs and takes them out as they end."""
    while jobs:
        for name in [name for name, job in jobs.items() if job.done()]:
            ending = _ending(name, jobs.pop(name))
            say(f"{name}: {ending.kind}" + (f": {ending.message}" if ending.message else ""))
            yield ending
        if jobs:
            time.sleep(POLL_SECONDS)


def _ending(name: str, job: Any) -> Ending:
    import submitit

    try:
        return job.result()
    except (submitit.core.utils.UncompletedJobError, submitit.core.utils.FailedJobError):
        told = f"job {job.job_id} ended without a word: see {job.paths.stderr}"
        return failed_but_kept(name, told)
