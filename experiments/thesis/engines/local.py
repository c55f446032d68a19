"""Runs one after another in this process, beside other processes that do the same."""

import time
from collections.abc import Callable, Iterator, Sequence

from experiments.thesis.engines import Task
from experiments.thesis.graph import PlannedRun
from experiments.thesis.jobs import POLL_SECONDS, Ending, Say, Train, perform


def one_by_one(
    tasks: Sequence[Task], say: Say, *, train: Train | None = None, poll: float = POLL_SECONDS
) -> Iterator[Ending]:
    """Does tasks in the order given, those first that no other process does.

    Args:
      tasks: each after those it needs.
      say: where messages go.
      train: what trains a run; by default `jobs.train`.
      poll: seconds between looks at what others do.

    Yields:
      What became of each, until one is stopped.
    """
    yield from in_turn(lambda: tasks, say, train=train, poll=poll)


def in_turn(
    due: Callable[[], Sequence[Task]],
    say: Say,
    *,
    train: Train | None = None,
    poll: float = POLL_SECONDS,
) -> Iterator[Ending]:
    """Does what is due, one after another, until nothing is left; see `one_by_one`.

    Args:
      due: what there is to do, asked again after each; what has ended here is not done again.
    """
    ended: set[str] = set()
    told: set[str] = set()
    while tasks := [task for task in due() if task.name not in ended]:
        names = {task.name for task in tasks}
        busy: dict[str, str] = {}
        for task in tasks:
            if not names.isdisjoint(task.needs):
                continue
            ending = perform(task.job, train=train, begins=_telling(task, say))
            if ending.kind == "busy":
                busy[task.name] = ending.message
                continue
            ended.add(ending.name)
            yield ending
            if ending.kind == "stopped":
                return
            break
        else:
            if not told.issuperset(busy.values()):
                say("waiting: " + "; ".join(dict.fromkeys(busy.values())))
            told = set(busy.values())
            try:
                time.sleep(poll)
            except KeyboardInterrupt:
                yield Ending(next(iter(busy)), "stopped")
                return


def _telling(task: Task, say: Say) -> Callable[[PlannedRun], None]:
    def begins(run: PlannedRun) -> None:
        verb = f"goes on at {run.progress:.0%}" if run.state == "cut" else "begins"
        say(f"{task.described()}; it {verb}")

    return begins
