"""What runs will take: time, memory and disk, from a short measurement (`measurement`).

An estimate: it takes one member's update and one simulator's tick, and multiplies. Members that
are mapped at once on an accelerator take less time than that, and a busy machine more. Accelerators
work beside one another, each for its own members; several devices of one processor do not.

Axis letters: P population member, K task.
"""

import dataclasses
import functools
import itertools
from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np

import envs
from dreamer_jax.agent import Agent
from dreamer_jax.device_round import on_device, replay_bytes
from dreamer_jax.devices import Choice, place
from dreamer_jax.schedule import Schedule
from experiments.runs.agents import make_agent
from experiments.runs.spec import RunSpec, action_size
from experiments.runs.text import aligned
from experiments.thesis.graph import Graph, PlannedRun, due
from experiments.thesis.measurement import Speed, compiled_update

MEMORY_SHARE, CHECKPOINTS = 0.8, 2
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


def _bytes(tree) -> int:
    return sum(
        int(np.prod(leaf.shape)) * np.dtype(leaf.dtype).itemsize for leaf in jax.tree.leaves(tree)
    )


@functools.cache
def _member_bytes(agent: Agent) -> int:
    """Parameters and both moments of Adam of one member."""
    return _bytes(jax.eval_shape(agent.init, jax.ShapeDtypeStruct((), jnp.int32)))


def _record_bytes(spec: RunSpec) -> int:
    """Image, action, reward and two flags."""
    size = spec.config.network.image_size
    return 3 * size * size + 4 * action_size(spec.tasks) + 4 + 2


def _memory(spec: RunSpec, update_bytes: int, members: int, chunk: int) -> int:
    """Bytes of some members: states, two batches, one phase of records twice, and the updates of
    one chunk."""
    learning, schedule = spec.config.learning, spec.config.schedule
    records = learning.batch_size * learning.sequence_length
    records += (schedule.phase_ticks + 1) * len(spec.tasks)
    each = _member_bytes(make_agent(spec)) + 2 * records * _record_bytes(spec)
    return members * each + chunk * update_bytes


def _chunk(spec: RunSpec, members: int) -> int:
    """How many of the members of one device an update maps at once."""
    schedule = spec.config.schedule
    one_by_one = schedule.mapping == "auto" and jax.default_backend() == "cpu"
    if schedule.mapping == "chunks" or one_by_one:
        return min(schedule.mapping_chunk, members)
    return members


def estimate(run: PlannedRun, speed: Speed, devices: Choice = "all") -> Estimate:
    """What a run that is missing or was cut still takes, its members spread over devices."""
    spec, each = run.spec, place(len(run.spec.members), devices).each
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
    disk = slots * records * _record_bytes(spec)
    disk += CHECKPOINTS * members * _member_bytes(make_agent(spec))
    memory = _memory(spec, speed.update_bytes, each, _chunk(spec, each))
    seconds += speed.compile_seconds + sum(speed.tick_compile_seconds[task] for task in spec.tasks)
    return Estimate(seconds, memory, disk)


def in_memory(spec: RunSpec, devices: Choice = "all") -> RunSpec:
    """The spec with its updates in chunks, where a device's memory is short for all of its members
    at once (and for their replay, if that lies there too)."""
    device = jax.local_devices()[0]
    limit = (device.memory_stats() or {}).get("bytes_limit")
    each = place(len(spec.members), devices).each
    if limit is None or _chunk(spec, each) == 1:
        return spec
    alone = dataclasses.replace(spec, seeds=spec.seeds[:1])
    update = compiled_update(make_agent(alone))
    update_bytes = max(1, update.memory_analysis().temp_size_in_bytes)
    taken = _memory(spec, update_bytes, each, 0)
    sizes = len(spec.tasks), each
    if on_device(make_agent(spec), any(x.has_host for x in envs.specs(spec.tasks)), *sizes)[0]:
        taken += replay_bytes(make_agent(spec), *sizes)
    fits = int(MEMORY_SHARE * limit - taken) // update_bytes
    if fits >= _chunk(spec, each):
        return spec
    schedule = dataclasses.replace(
        spec.config.schedule, mapping="chunks", mapping_chunk=max(1, fits)
    )
    return dataclasses.replace(spec, config=dataclasses.replace(spec.config, schedule=schedule))


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
