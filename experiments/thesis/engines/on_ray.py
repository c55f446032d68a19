"""Runs on a Ray cluster: a task and a process each, ordered by the references that tasks need.

The folder of results must be one that all machines share, and this package must be installed on
all of them.
"""

import os
from collections.abc import Iterator, Sequence
from typing import Any

from experiments.thesis.engines import Resources, Task
from experiments.thesis.jobs import Ending, Job, Say, failed_but_kept, perform_elsewhere

RETRIES = 10
"""How often a run whose process or machine was lost is begun again; each time it goes on."""


def check() -> None:
    """Whether Ray is installed.

    Raises:
      ModuleNotFoundError: it is not; says how to.
    """
    try:
        import ray  # noqa: F401
    except ModuleNotFoundError:
        raise ModuleNotFoundError(
            "--executor ray needs Ray: pip install 'dreamer-transfer[ray]'"
        ) from None


def on_ray(tasks: Sequence[Task], say: Say) -> Iterator[Ending]:
    """Does tasks on the Ray cluster of the address RAY_ADDRESS, on that of this machine, or on one
    of this machine alone that ends with this process.

    The first Ctrl-C cancels all tasks, which save and end as stopped; a second quits without.

    Args:
      tasks: each after those it needs.
      say: where messages go.

    Yields:
      What became of each, in the order in which they end.
    """
    import ray

    if not tasks:
        return
    ours = not ray.is_initialized()
    if ours:
        os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")
        context = ray.init(logging_level="warning")
        if context.dashboard_url:
            say(f"Ray's dashboard: http://{context.dashboard_url}")
    try:
        yield from _submitted(tasks, say)
    finally:
        if ours:
            ray.shutdown()


def _submitted(tasks: Sequence[Task], say: Say) -> Iterator[Ending]:
    import ray

    # A process per run: what JAX has in a device's memory ends with it.
    remote = ray.remote(max_calls=1, max_retries=RETRIES)(_perform)
    card = 1.0 if ray.cluster_resources().get("GPU", 0) else 0.0
    references: dict[str, Any] = {}
    for task in tasks:
        needs = [references[name] for name in task.needs]
        asked = _asked(task.resources, card)
        _tell_if_too_large(task, asked, say)
        references[task.name] = remote.options(name=task.name, **asked).remote(task.job, *needs)
        say(f"{task.described()}; it is with Ray")
    left = {references[task.name]: task for task in tasks}
    lost: set[str] = set()
    cancelled = False
    while left:
        try:
            done, _ = ray.wait(list(left), num_returns=1)
        except KeyboardInterrupt:
            if cancelled:
                raise
            cancelled = True
            say("stopping: runs save first (once more to quit without)")
            for reference in left:
                ray.cancel(reference, force=False)
            continue
        for reference in done:
            task = left.pop(reference)
            ending = _ending(task.name, reference, cancelled)
            if ending.kind == "failed":
                if lacking := [name for name in task.needs if name in lost]:
                    ending = Ending(task.name, "skipped", f"it needs {', '.join(lacking)}")
                lost.add(task.name)
            say(f"{ending.name}: {_told(ending)}")
            yield ending


def _ending(name: str, reference: Any, cancelled: bool) -> Ending:
    import ray

    try:
        return ray.get(reference)
    except ray.exceptions.TaskCancelledError:
        return Ending(name, "stopped")
    except ray.exceptions.RayError as error:
        if cancelled:
            return Ending(name, "stopped")
        told = str(error).strip().splitlines()[-1]
        return failed_but_kept(name, told)


def _told(ending: Ending) -> str:
    words = {"there": "was finished by another process"}.get(ending.kind, ending.kind)
    return f"{words}: {ending.message}" if ending.message else words


def _asked(resources: Resources, card: float) -> dict[str, Any]:
    """Options of a Ray task.

    Args:
      resources: what the run gets.
      card: accelerators where none are asked for.
    """
    gpus = card if resources.gpus is None else resources.gpus
    asked: dict[str, Any] = {"num_cpus": resources.cpus, "num_gpus": gpus}
    if resources.memory is not None:
        asked["memory"] = int(resources.memory * 2**30)
    return asked


def _tell_if_too_large(task: Task, asked: dict[str, Any], say: Say) -> None:
    """Says if no machine of the cluster, as it is now, has what a run asks for."""
    import ray

    wanted = {"CPU": asked["num_cpus"], "GPU": asked["num_gpus"], "memory": asked.get("memory", 0)}
    nodes = [node["Resources"] for node in ray.nodes() if node["Alive"]]
    if not any(all(node.get(kind, 0) >= count for kind, count in wanted.items()) for node in nodes):
        say(f"{task.name} asks for {wanted}, which no machine of the cluster has: it waits for one")


def _perform(job: Job, *needed: Ending) -> Ending:
    """What a Ray task does; what it needs has ended before, well or not, which the folder tells."""
    _share_of_a_card()
    return perform_elsewhere(job)


def _share_of_a_card() -> None:
    """Lets JAX take no more of an accelerator's memory than this task's part of it."""
    import ray

    gpus = ray.get_runtime_context().get_assigned_resources().get("GPU", 0)
    if 0 < gpus < 1:
        os.environ.setdefault("XLA_PYTHON_CLIENT_MEM_FRACTION", f"{0.9 * gpus:.2f}")
