"""Where runs are trained: an engine gets jobs with their needs and resources, and tells their ends.

`local` does them one after another in this process, `on_ray` on a Ray cluster and `on_slurm` in a
Slurm queue, each in its own order, but none before what it needs.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

from experiments.thesis.graph import PlannedRun
from experiments.thesis.jobs import Ending, Job, Say


@dataclass(frozen=True)
class Resources:
    """What a run gets.

    Attributes:
      gpus: accelerators; a part of one shares it. By default one if the cluster has any.
      cpus: cores.
      memory: GiB of the machine's memory; by default no bound is asked for.
      hours: how long it may take at once, where a queue wants to know; longer ones go on.
    """

    gpus: float | None = None
    cpus: int = 1
    memory: float | None = None
    hours: float | None = None


@dataclass(frozen=True)
class Task:
    """A job for an engine.

    Attributes:
      job: what is to be done.
      run: as it was planned.
      needs: names of the tasks that must end before.
      resources: what it gets.
      title: what it is called in messages.
    """

    job: Job
    run: PlannedRun
    needs: tuple[str, ...] = ()
    resources: Resources = Resources()
    title: str = ""

    @property
    def name(self) -> str:
        """The run's name."""
        return self.job.name

    def described(self) -> str:
        """What it is, in words."""
        agents = f"{len(self.run.cells)} agents" if len(self.run.cells) > 1 else "1 agent"
        return f"{self.title or self.name}: {agents} on {' + '.join(self.run.spec.tasks)}"


Engine = Callable[[Sequence[Task], Say], Iterator[Ending]]
"""Gets tasks, each after those it needs, and where messages go; gives the ending of each."""
