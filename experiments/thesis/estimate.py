"""What runs will take: time, memory and disk, from a short measurement (`measurement`).

An estimate: it takes one member's update and one simulator's tick, and multiplies. Members that
are mapped at once on an accelerator take less time than that, and a busy machine more. Accelerators
work beside one another, each for its own members; several devices of one processor do not.

Axis letters: P population member, K task.
"""

import itertools
from dataclasses import dataclass

import jax

import envs
from dreamer_jax.device_round import on_device, replay_bytes
from dreamer_jax.devices import Choice, place
from dreamer_jax.schedule import Schedule
from experiments.runs.agents import make_agent
from experiments.runs.memory import at_once, bytes_of, member_bytes, record_bytes
from experiments.runs.text import aligned
from experiments.thesis.graph import Graph, PlannedRun, due
from experiments.thesis.measurement import Speed

CHECKPOINTS = 2
SLACK = 1.5
"""How much longer a run may take than what is counted of it."""
NAME_COLUMNS = 30


@dataclass(frozen=True)
class Estimate:
    """What one run still takes.

    Attributes:
      seconds: to its end.
      memory: bytes, at most, of each device.
      disk: bytes, in the end.
    """

    seconds: float
    memory: int
    disk: int


def estimate(run: PlannedRun, speed: Speed, devices: Choice = "all") -> Estimate:
    """What a run that is missing or was cut still takes, its members spread over devices."""
    spec, each = run.spec, place(len(run.spec.members), devices).each
    agent = make_agent(spec)
    members, tasks, schedule = len(spec.members), len(spec.tasks), spec.config.schedule
    whole = Schedule(schedule, tasks)
    ticks = (whole.rounds + whole.evaluations) * schedule.phase_ticks
    slots = members * tasks
    simulated = sum(speed.tick_seconds[task] for task in spec.tasks) * members
    # How many members wait for one another.
    in_turn = members if jax.default_backend() == "cpu" else each
    tick = in_turn * tasks * speed.policy_seconds + simulated / min(speed.workers, slots)
    left = 1 - run.progress
    seconds = left * (whole.updates * in_turn * speed.update_seconds + ticks * tick)
    records = whole.rounds * (schedule.phase_ticks + 1)
    if schedule.replay_keep is not None:
        records = min(records, schedule.replay_keep)
    disk = slots * records * record_bytes(agent)
    disk += CHECKPOINTS * members * member_bytes(agent)
    memory = bytes_of(agent, tasks, each, at_once(agent, each), speed.update_bytes)
    has_host = any(task.has_host for task in envs.specs(spec.tasks))
    if on_device(agent, has_host, tasks, each).device:
        memory += replay_bytes(agent, tasks, each)
    seconds += speed.compile_seconds + sum(speed.tick_compile_seconds[task] for task in spec.tasks)
    return Estimate(seconds, memory, disk)


def together(runs: Graph, speed: Speed, devices: Choice = "all") -> Estimate:
    """What all runs still take: time and disk add up, of memory the largest counts.

    Args:
      runs: from `graph.plan_runs`; they come one after another.
      speed: from `measure`.
      devices: over how many the members of each are spread.
    """
    each = [estimate(run, speed, devices) for run in due(runs)]
    return Estimate(
        sum(one.seconds for one in each),
        max((one.memory for one in each), default=0),
        sum(one.disk for one in each),
    )


def plan_table(runs: Graph, speed: Speed | None, devices: Choice = "all") -> str:
    """The graph as a table: a row for each run, which names those it needs by number, and totals.

    At most 100 columns wide: names that are longer go on in further lines.

    Args:
      runs: from `graph.plan_runs`.
      speed: from `measure`; without it nothing is said of time, memory and disk.
      devices: over how many the members of each are spread.
    """
    rows = []
    numbers = {run.name: str(number) for number, run in enumerate(runs, start=1)}
    words = (
        {}
        if speed is None
        else {run.name: _in_words(estimate(run, speed, devices), speed) for run in due(runs)}
    )
    for run in runs:
        state = f"cut at {run.progress:.0%}" if run.state == "cut" else run.state
        needs = ",".join(numbers.get(name, "?") for name in run.needs) or "-"
        first, *more = _lines(run.name)
        row = [f"{numbers[run.name]:>2}  {first}", str(len(run.cells)), needs, state]
        rows.append(row + words.get(run.name, ["-"] * 3))
        failed = len(run.failed) if isinstance(run, PlannedRun) else 0
        told = [f"{failed} failed"] if failed else []
        for line, word in itertools.zip_longest(more, told, fillvalue=""):
            rows.append([f"      {line}", "", "", word, "", "", ""])
    agents = str(sum(len(run.cells) for run in runs))
    total = ["-"] * 3 if speed is None else _in_words(together(runs, speed, devices), speed)
    rows.append(["    together", agents, "", "", *total])
    return aligned(["run", "agents", "needs", "state", "time", "memory", "disk"], rows)


def _lines(name: str) -> list[str]:
    """A name in lines of at most so many letters as fit, broken after - and + where it can be."""
    lines, rest = [], name
    while len(rest) > NAME_COLUMNS:
        place = max(rest.rfind(sign, 0, NAME_COLUMNS) for sign in "-+") + 1 or NAME_COLUMNS
        lines.append(rest[:place])
        rest = rest[place:]
    return [*lines, rest]


def _in_words(one: Estimate, speed: Speed) -> list[str]:
    """Time as a range, memory and disk."""
    return [span(one.seconds, speed), _size(one.memory), _size(one.disk)]


def span(seconds: float, speed: Speed) -> str:
    """A time as a range, such as "2.1 to 4.5 h".

    From what it takes if all updates are as fast as the fastest tenth of those measured, to what it
    takes if all are as slow as the slowest tenth and as much again as SLACK goes to what is not
    counted: evaluations' videos, checkpoints, and whatever else the machine does.
    """
    fast, slow = (each / speed.update_seconds for each in speed.update_range)
    low, high = seconds * fast, seconds * slow * SLACK
    for unit, length in (("days", 86400), ("h", 3600), ("min", 60)):
        if high >= 2 * length:
            return f"{low / length:,.1f} to {high / length:,.1f} {unit}"
    return f"{low:.0f} to {high:.0f} s"


def _size(count: int) -> str:
    return f"{count / 2**30:,.1f} GiB" if count >= 2**30 else f"{count / 2**20:,.1f} MiB"
