"""The memory of a device: what an update takes of it, and how many members it has room for at once.

Axis letters: P population member, K task.
"""

import dataclasses
import functools
import math

import jax
import jax.numpy as jnp
import numpy as np

import envs
from dreamer_jax.agent import Agent
from dreamer_jax.device_round import on_device, replay_bytes
from dreamer_jax.devices import Choice, place
from dreamer_jax.population import batch_shapes, update_member
from dreamer_jax.training import Run
from experiments.runs.agents import make_agent
from experiments.runs.spec import Mapped, RunSpec
from experiments.runs.ways_out import WaysOut

MEMORY_SHARE = 0.8
"""Share of a device's memory that is counted on."""


class OutOfMemoryError(RuntimeError):
    """A device has no room for what a run asks of it; names the way out."""


@functools.cache
def traced_update(agent: Agent):
    """One member's update, traced for its shapes, and the shapes of its state and its batch."""
    # The one that runs compile, which so shares the trace as it maps it over members.
    agent = agent.on_any_schedule()
    learning = agent.config.learning
    batch = batch_shapes(agent, learning.batch_size, learning.sequence_length)
    state = jax.eval_shape(agent.init, jax.ShapeDtypeStruct((), jnp.int32))
    return update_member.trace(agent, state, batch), state, batch


@functools.cache
def compiled_update(agent: Agent):
    """One member's update, compiled."""
    return traced_update(agent)[0].lower().compile()


@functools.cache
def member_bytes(agent: Agent) -> int:
    """Parameters and both moments of Adam of one member."""
    state = jax.eval_shape(agent.init, jax.ShapeDtypeStruct((), jnp.int32))
    return sum(
        int(np.prod(leaf.shape)) * np.dtype(leaf.dtype).itemsize for leaf in jax.tree.leaves(state)
    )


def record_bytes(agent: Agent) -> int:
    """Image, action, reward and two flags."""
    size = agent.config.network.image_size
    return 3 * size * size + 4 * agent.action_size + 4 + 2


def bytes_of(agent: Agent, tasks: int, members: int, at_once: int, update_bytes: int) -> int:
    """Bytes of some members: states (twice, where those from before a round are kept beside it),
    two batches, one phase of records twice, and their updates.

    Args:
      agent: theirs.
      tasks: K.
      members: how many lie on the device.
      at_once: how many of them an update maps at once.
      update_bytes: what one member's update takes beside its state and batch.
    """
    learning, schedule = agent.config.learning, agent.config.schedule
    records = learning.batch_size * learning.sequence_length
    records += (schedule.phase_ticks + 1) * tasks
    states = 2 if schedule.collect == "beside" else 1
    each = states * member_bytes(agent) + 2 * records * record_bytes(agent)
    return members * each + at_once * update_bytes


def at_once(agent: Agent, members: int) -> int:
    """How many of the members of one device an update maps at once."""
    schedule = agent.config.schedule
    one_by_one = schedule.mapping == "auto" and jax.default_backend() == "cpu"
    if schedule.mapping == "chunks" or one_by_one:
        return min(schedule.mapping_chunk, members)
    return members


def even_chunk(members: int, fits: int) -> int:
    """Members in a chunk: as many turns as with so many that fit, and chunks as even as can be.

    Chunks of one size are one program; a smaller last one is a second, which is compiled too.

    Args:
      members: how many lie on the device.
      fits: how many of them it has memory for at once, at least 1.
    """
    turns = math.ceil(members / fits)
    return math.ceil(members / turns)


def room_for(agent: Agent, tasks: int, members: int, has_host: bool) -> int | None:
    """How many members' updates a device has memory for at once, by what the compiler says of one.

    Args:
      agent: theirs.
      tasks: K.
      members: how many lie on the device, their replay too if it is kept there.
      has_host: whether the environment has simulators on the host.

    Returns:
      At least 1; None where the device does not tell its memory.
    """
    limit = (jax.local_devices()[0].memory_stats() or {}).get("bytes_limit")
    if limit is None:
        return None
    update_bytes = max(1, compiled_update(agent).memory_analysis().temp_size_in_bytes)
    taken = bytes_of(agent, tasks, members, 0, update_bytes)
    if on_device(agent, has_host, tasks, members).device:
        taken += replay_bytes(agent, tasks, members)
    return max(1, int(MEMORY_SHARE * limit - taken) // update_bytes)


def in_memory(spec: RunSpec, devices: Choice = "all") -> RunSpec:
    """The spec with its updates in chunks, where a device's memory is short for all of its members
    at once (and for their replay, if that lies there too).

    A spec that says how members are mapped is left as it is.
    """
    if spec.config.schedule.mapping != "auto":
        return spec
    agent, each = make_agent(spec), place(len(spec.members), devices).each
    if (members := at_once(agent, each)) == 1:
        return spec
    has_host = any(task.has_host for task in envs.specs(spec.tasks))
    fits = room_for(agent, len(spec.tasks), each, has_host)
    if fits is None or fits >= members:
        return spec
    return mapped(spec, "chunks", even_chunk(members, fits))


def mapped(spec: RunSpec, mapping: Mapped, chunk: int) -> RunSpec:
    """The spec with its members mapped as that says, see `dreamer_jax.population.map_members`."""
    schedule = dataclasses.replace(spec.config.schedule, mapping=mapping, mapping_chunk=chunk)
    return dataclasses.replace(spec, config=dataclasses.replace(spec.config, schedule=schedule))


def is_exhausted(error: BaseException | None) -> bool:
    """Whether an error, or what caused it, is that a device has no memory left."""
    if error is None:
        return False
    ours = isinstance(error, jax.errors.JaxRuntimeError) and "RESOURCE_EXHAUSTED" in str(error)
    return ours or is_exhausted(error.__cause__)


def out_of_memory(run: Run, ways: WaysOut) -> OutOfMemoryError:
    """What to say of a run whose device had no memory left: what it mapped, and what may fit.

    Args:
      run: the run.
      ways: what to do about it, in the words of what was called.
    """
    agent, each, tasks = run.agent, run.placement.each, len(run.tasks)
    before = at_once(agent, each)
    told = (
        f"a device has no memory left: an update mapped {before} "
        f"member{'s' if before > 1 else ''} at once, of {each} on each device"
    )
    if before == 1:
        return OutOfMemoryError(f"{told}: what is left is {ways.otherwise}")
    room, half = room_for(agent, tasks, each, run.env.has_host), before // 2
    if room is not None and room < before:
        chunk, why = even_chunk(each, room), "by the compiler's count that fits"
    else:
        chunk, why = half, "half as many; fewer if that does not fit either"
    goes_on = ways.with_chunks.format(chunk=chunk)
    return OutOfMemoryError(f"{told}; {goes_on} ({why}). Else: {ways.otherwise}")
