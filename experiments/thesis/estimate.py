"""What runs will take: time, memory and disk, from a short measurement on this machine.

An estimate: it takes one member's update and one simulator's tick, and multiplies. Members that
are mapped at once on an accelerator take less time than that, and a busy machine more. Accelerators
work beside one another, each for its own members; several devices of one processor do not.

Axis letters: P population member, K task, T ticks in a phase, A action.
"""

import dataclasses
import functools
import itertools
import time
from collections.abc import Iterable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np

import envs
from dreamer_jax.agent import Agent
from dreamer_jax.config import Config
from dreamer_jax.device_round import on_device, replay_bytes
from dreamer_jax.devices import Choice, place
from dreamer_jax.progress import Report, unreported
from dreamer_jax.records import Records
from dreamer_jax.schedule import Schedule
from envs.pool import available_cores
from experiments.runs.agents import make_agent
from experiments.runs.spec import RunSpec, action_size
from experiments.runs.text import aligned
from experiments.thesis import flops
from experiments.thesis.graph import PlannedRun

SAMPLE_OPERATIONS = 1e11
"""An update that does no more than this is measured as it is."""

SCALING_ERROR = 0.3
"""By how much the time of a large update may differ from that scaled from smaller batches: an
allowance, for small products of matrices use a machine less well than large ones. One agent's
update of the thesis was 8% off in processor time, up to 21% in single turns of wall time."""

UPDATE_SECONDS, TICKS, MEMORY_SHARE, CHECKPOINTS = 2.0, 50, 0.8, 2
SLACK = 1.5
"""How much longer a run may take than what is counted of it."""
NAME_COLUMNS = 30
DUE = ("missing", "cut")
"""States of the runs that still take time."""


@dataclass(frozen=True)
class Speed:
    """What was measured.

    Attributes:
      update_seconds: one update of one member, half of those measured taking less.
      update_range: seconds that a tenth of the measured updates took less than, and a tenth more.
      update_bytes: memory that it takes beside the member's state and batch.
      policy_seconds: choosing one action for one member.
      tick_seconds: one tick of one simulator, by name of task.
      compile_seconds: until an update and a policy are compiled.
      tick_compile_seconds: until a tick of a simulator is, by name of task; physics that is part
        of the program takes long.
      workers: simulator processes that work at once.
      scaled: by how much the time of an update on smaller batches was multiplied; 1 if the update
        itself was measured.
    """

    update_seconds: float
    update_range: tuple[float, float]
    update_bytes: int
    policy_seconds: float
    tick_seconds: Mapping[str, float]
    compile_seconds: float
    tick_compile_seconds: Mapping[str, float]
    workers: int
    scaled: float = 1.0


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


@functools.cache
def _traced_update(agent: Agent):
    """One member's update, traced for its shapes."""
    learning, size = agent.config.learning, agent.config.network.image_size
    shape = (learning.batch_size, learning.sequence_length)
    batch = Records(
        image=jax.ShapeDtypeStruct((*shape, size, size, 3), jnp.uint8),
        action=jax.ShapeDtypeStruct((*shape, agent.action_size), jnp.float32),
        reward=jax.ShapeDtypeStruct(shape, jnp.float32),
        first=jax.ShapeDtypeStruct(shape, jnp.bool_),
        terminal=jax.ShapeDtypeStruct(shape, jnp.bool_),
    )
    state = jax.eval_shape(agent.init, jax.ShapeDtypeStruct((), jnp.int32))
    return jax.jit(agent.update).trace(state, batch), state, batch


@functools.cache
def _compiled_update(agent: Agent):
    """One member's update, compiled."""
    return _traced_update(agent)[0].lower().compile()


def _made_up(agent: Agent):
    """A state and a batch of made-up numbers for one member's update."""
    _, state, batch = _traced_update(agent)
    random = np.random.default_rng(0)

    def make(leaf):
        if jnp.issubdtype(leaf.dtype, jnp.floating):
            return jnp.asarray(random.normal(0, 0.03, leaf.shape), leaf.dtype)
        return jnp.ones(leaf.shape, leaf.dtype)

    state = jax.tree.map(make, state)
    optimisers = jax.tree.map(jnp.zeros_like, state.optimisers)
    state = dataclasses.replace(state, optimisers=optimisers)
    image = random.integers(0, 256, batch.image.shape, dtype=np.uint8)
    return state, batch.map(lambda x: np.zeros(x.shape, x.dtype))._replace(image=image)


def sample_of(agent: Agent) -> tuple[Agent, float]:
    """An agent with smaller batches, whose update can be measured in seconds and little memory.

    Returns:
      The agent, the same networks with a part of the sequences and of their length; and how many
      times the arithmetic of its update the given agent's is. The agent itself and 1, where its
      update is small.
    """
    whole = _operations(agent)
    if whole <= SAMPLE_OPERATIONS:
        return agent, 1.0
    learning = agent.config.learning
    batch, length = (max(1, n // 4) for n in (learning.batch_size, learning.sequence_length))
    starts = learning.imagination_starts
    if starts is not None:
        starts = max(1, starts * batch * length // (learning.batch_size * learning.sequence_length))
    learning = dataclasses.replace(
        learning, batch_size=batch, sequence_length=length, imagination_starts=starts
    )
    config = dataclasses.replace(agent.config, learning=learning)
    part = dataclasses.replace(agent, config=config)
    return part, whole / _operations(part)


def _operations(agent: Agent) -> float:
    """Of one member's update."""
    return flops.of_jaxpr(_traced_update(agent)[0].jaxpr.jaxpr)


def _scaled_bytes(agent: Agent, part: Agent, temporary: int) -> int:
    """Memory of an update from that of one on smaller batches: nearly all of it grows with them."""
    records = [
        x.config.learning.batch_size * x.config.learning.sequence_length for x in (agent, part)
    ]
    return int(temporary * records[0] / records[1])


def measure(specs: Iterable[RunSpec], report: Report = unreported) -> Speed:
    """Measures the updates and the simulators of runs of one preset.

    A plain agent of the largest action size stands for all of them. An update that is large is
    measured on smaller batches, and multiplied by how much more arithmetic it does (see
    `sample_of`). Nearly all of the time goes to compilation, which a thread does while simulators
    are measured, if there is more than one core.

    Args:
      specs: the runs.
      report: called before each measurement with what it is of; it counts those begun.
    """
    specs = tuple(specs)
    tasks = tuple(dict.fromkeys(task for spec in specs for task in spec.tasks))
    things = len(tasks) + 1
    widest = max(tasks, key=lambda task: envs.spec(task).action_size)
    agent = make_agent(RunSpec((widest,), (0,), specs[0].config))
    part, times = sample_of(agent)
    lowered = _traced_update(part)[0].lower()

    def compiled():
        started = time.perf_counter()
        # The operations that take long are those of a library: they are no faster for more passes.
        quick = times > 1 and jax.default_backend() == "cpu"
        options = {"xla_backend_optimization_level": 1} if quick else None
        return lowered.compile(compiler_options=options), time.perf_counter() - started

    ticks = {}
    with ThreadPoolExecutor(1) as executor:
        compiling = executor.submit(compiled)
        if available_cores() == 1:
            compiling.result()
        for number, task in enumerate(tasks, start=1):
            report(number, things, task)
            ticks[task] = _tick_seconds(task, agent.config)
        report(things, things, "an update and a policy")
        update, update_compile_seconds = compiling.result()
    state, batch = _made_up(part)
    started = time.perf_counter()
    policy_seconds = _policy_seconds(part, state.params)
    compile_seconds = update_compile_seconds + time.perf_counter() - started
    update_bytes = _scaled_bytes(agent, part, update.memory_analysis().temp_size_in_bytes)
    state, metrics = update(state, batch)
    metrics["model_loss"].block_until_ready()
    took: list[float] = []
    while sum(took) < times * UPDATE_SECONDS:
        started = time.perf_counter()
        state, metrics = update(state, batch)
        metrics["model_loss"].block_until_ready()
        took.append(times * (time.perf_counter() - started))
    fast, middle, slow = np.quantile(took, [0.1, 0.5, 0.9]).tolist()
    return Speed(
        update_seconds=middle,
        update_range=(fast, slow),
        update_bytes=update_bytes,
        policy_seconds=policy_seconds,
        tick_seconds={task: each for task, (each, _) in ticks.items()},
        compile_seconds=compile_seconds,
        tick_compile_seconds={task: first for task, (_, first) in ticks.items()},
        workers=available_cores(),
        scaled=times,
    )


def _policy_seconds(agent: Agent, params) -> float:
    """Seconds for the choice of one action."""
    size = agent.config.network.image_size
    image = jnp.zeros((size, size, 3), jnp.uint8)

    @jax.jit
    def act(params):
        def tick(carry, key):
            action, carry = agent.policy(params, carry, image, jnp.bool_(False), key, "explore")
            return carry, action

        keys = jax.random.split(jax.random.key(0), TICKS)
        return jax.lax.scan(tick, agent.initial_carry(), keys)[1]

    act(params).block_until_ready()
    started = time.perf_counter()
    act(params).block_until_ready()
    return (time.perf_counter() - started) / TICKS


def _tick_seconds(task: str, config: Config) -> tuple[float, float]:
    """Seconds for a tick of one simulator, what carries it to jitted code included, and seconds
    until the first."""
    env = envs.make(
        [task],
        image_size=config.network.image_size,
        action_repeat=config.schedule.action_repeat,
        workers=1,
        supersample=config.schedule.supersample,
    )
    try:
        made = time.perf_counter()
        state, _ = jax.jit(jax.vmap(env.reset))(
            jnp.arange(1), jax.random.split(jax.random.key(0), 1)
        )

        @jax.jit
        def play(state, key):
            actions = jax.random.uniform(key, (TICKS, 1, env.action_size), minval=-1.0)
            return jax.lax.scan(jax.vmap(env.step), state, actions)

        state, _ = jax.block_until_ready(play(state, jax.random.key(1)))
        first_seconds = time.perf_counter() - made
        started = time.perf_counter()
        jax.block_until_ready(play(state, jax.random.key(2)))
        seconds = time.perf_counter() - started
        env.check()
        return seconds / TICKS, first_seconds
    finally:
        env.close()


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
    update = _compiled_update(make_agent(alone))
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


def together(runs: Sequence[PlannedRun], speed: Speed | None, devices: Choice = "all") -> Estimate:
    """What all runs still take: time and disk add up, of memory the largest counts.

    Args:
      runs: from `graph.plan_runs`; they come one after another.
      speed: from `measure`; not needed if nothing is missing.
      devices: over how many the members of each are spread.
    """
    each = [estimate(run, speed, devices) for run in runs if run.state in DUE]
    return Estimate(
        sum(one.seconds for one in each),
        max((one.memory for one in each), default=0),
        sum(one.disk for one in each),
    )


def plan_table(runs: Sequence[PlannedRun], speed: Speed | None, devices: Choice = "all") -> str:
    """The graph as a table: a row for each run, which names those it needs by number, and totals.

    At most 100 columns wide: names that are longer go on in further lines.

    Args:
      runs: from `graph.plan_runs`.
      speed: from `measure`; not needed if nothing is missing.
      devices: over how many the members of each are spread.
    """
    rows = []
    numbers = {run.name: str(number) for number, run in enumerate(runs, start=1)}
    for run in runs:
        state = f"cut at {run.progress:.0%}" if run.state == "cut" else run.state
        needs = ",".join(numbers.get(name, "?") for name in run.needs) or "-"
        first, *more = _lines(run.name)
        row = [f"{numbers[run.name]:>2}  {first}", str(len(run.cells)), needs, state]
        if run.state in DUE:
            row += _in_words(estimate(run, speed, devices), speed)
        rows.append(row + ["-"] * (7 - len(row)))
        told = [f"{len(run.failed)} failed"] if run.failed else []
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
