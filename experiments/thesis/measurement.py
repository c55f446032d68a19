"""How fast this machine is: one member's update, one simulator's tick.

Axis letters: T ticks.
"""

import dataclasses
import time
from collections.abc import Iterable, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np

import envs
from dreamer_jax.agent import Agent
from dreamer_jax.config import Config
from dreamer_jax.learning import AgentState
from dreamer_jax.progress import Report, unreported
from dreamer_jax.records import Records
from envs.pool import available_cores
from experiments.runs.agents import make_agent
from experiments.runs.memory import traced_update
from experiments.runs.spec import RunSpec
from experiments.thesis import flops

SAMPLE_OPERATIONS = 1e11
"""An update that does no more than this is measured as it is."""

SCALING_ERROR = 0.3
"""By how much the time of a large update may differ from that scaled from smaller batches: an
allowance, for small products of matrices use a machine less well than large ones. One agent's
update of the thesis was 8% off in processor time, up to 21% in single turns of wall time."""

UPDATE_SECONDS, TICKS = 2.0, 50


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


def made_up(agent: Agent) -> tuple[AgentState, Records]:
    """A state and a batch of made-up numbers for one member's update; nothing is compiled."""
    _, state, batch = traced_update(agent)
    random = np.random.default_rng(0)

    def make(leaf):
        if jnp.issubdtype(leaf.dtype, jnp.floating):
            return random.normal(0, 0.03, leaf.shape).astype(leaf.dtype)
        return np.ones(leaf.shape, leaf.dtype)

    state = jax.tree.map(make, state)
    optimisers = jax.tree.map(np.zeros_like, state.optimisers)
    state = jax.device_put(dataclasses.replace(state, optimisers=optimisers))
    image = random.integers(0, 256, batch.image.shape, dtype=np.uint8)
    return state, batch.map(lambda x: np.zeros(x.shape, x.dtype))._replace(image=image)


def sample_of(agent: Agent) -> tuple[Agent, float]:
    """An agent with smaller batches, whose update can be measured in seconds and little memory.

    Returns:
      The agent, the same networks with a part of the sequences and of their length; and how many
      times the arithmetic of its update the given agent's is. The agent itself and 1, where its
      update is small.
    """
    whole = operations(agent)
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
    return part, whole / operations(part)


def operations(agent: Agent) -> float:
    """Arithmetic operations of one member's update."""
    return flops.of_jaxpr(traced_update(agent)[0].jaxpr.jaxpr)


def _scaled_bytes(agent: Agent, part: Agent, temporary: int) -> int:
    """Memory of an update from that of one on smaller batches: nearly all of it grows with them."""
    records = [
        x.config.learning.batch_size * x.config.learning.sequence_length for x in (agent, part)
    ]
    return int(temporary * records[0] / records[1])


def measure(
    specs: Iterable[RunSpec],
    report: Report = unreported,
    *,
    timeout: float = envs.SIMULATOR_TIMEOUT,
) -> Speed:
    """Measures the updates and the simulators of runs of one preset.

    A plain agent of the largest action size stands for all of them. An update that is large is
    measured on smaller batches, and multiplied by how much more arithmetic it does (see
    `sample_of`). Nearly all of the time goes to compilation, which a thread does while simulators
    are measured, if there is more than one core.

    Args:
      specs: the runs.
      report: called before each measurement with what it is of; it counts those begun.
      timeout: seconds after which a simulator that does not answer is given up.
    """
    specs = tuple(specs)
    tasks = tuple(dict.fromkeys(task for spec in specs for task in spec.tasks))
    things = len(tasks) + 1
    widest = max(tasks, key=lambda task: envs.spec(task).action_size)
    agent = make_agent(RunSpec((widest,), (0,), specs[0].config))
    part, times = sample_of(agent)
    lowered = traced_update(part)[0].lower()

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
            ticks[task] = _tick_seconds(task, agent.config, timeout)
        report(things, things, "an update and a policy")
        update, update_compile_seconds = compiling.result()
    state, batch = made_up(part)
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


def _tick_seconds(task: str, config: Config, timeout: float) -> tuple[float, float]:
    """Seconds for a tick of one simulator, what carries it to jitted code included, and seconds
    until the first."""
    env = envs.make(
        [task],
        image_size=config.network.image_size,
        action_repeat=config.schedule.action_repeat,
        workers=1,
        supersample=config.schedule.supersample,
        timeout=timeout,
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
