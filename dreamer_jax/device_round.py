"""A round as one program: collecting, storing, sampling and updating without the host.

For environments that are part of the jitted program. The replay lies in the device's memory; the
host draws where each batch's sequences begin, by the law of the files (`dreamer_jax.sampling`),
before the round begins, and writes what was collected to the files after it, from which the
device's copy is made anew when a run is resumed. Collecting is that of the path with files to the
bit, updates are to the rounding of float32; a run that is resumed is, to the bit, the one that was
not, as long as it stays with one of both.

Axis letters: P population member, K task, T ticks in a phase, U updates of a round, B batch,
L sequence length, C capacity in records.
"""

from __future__ import annotations

import functools
from collections.abc import Sequence
from typing import Any

import jax
import numpy as np

from dreamer_jax import device_replay
from dreamer_jax.agent import MODES, Agent, Mode
from dreamer_jax.devices import Placement, on_one_device
from dreamer_jax.learning import AgentState
from dreamer_jax.population import update_members
from dreamer_jax.records import Records
from dreamer_jax.replay import Replay
from dreamer_jax.rollout import collect
from dreamer_jax.sampling import sample_indices
from dreamer_jax.schedule import Schedule
from dreamer_jax.waiting import to_host

AUTOMATIC_SHARE = 0.5
"""Share of an accelerator's memory that a replay may take without being asked for."""


def on_device(agent: Agent, has_host: bool, tasks: int, members: int) -> tuple[bool, str]:
    """Whether the rounds of a run are one program each, with the replay on the device, and why.

    By the setting `replay` of the schedule: "files", "device", or "auto", which is the device on an
    accelerator if the environment is without a host and the replay takes at most half of the
    device's memory, and files otherwise.

    Args:
      agent: its functions and settings.
      has_host: whether anything of the environment runs on the host.
      tasks: K.
      members: P, of those on one device.

    Returns:
      Whether, and what to tell the user of it ("" where files are a matter of course).

    Raises:
      ValueError: "device" was asked for, and the environment has a host or the replay does not fit.
    """
    schedule = Schedule(agent.config.schedule, tasks)
    choice = agent.config.schedule.replay
    if choice == "files" or (choice == "auto" and has_host):
        return False, ""
    if has_host:
        raise ValueError(
            "replay=device needs an environment that is part of the jitted program, and this one "
            "has simulators or renderers on the host: choose replay=files, or tasks such as "
            "brax/hopper"
        )
    memory, needed = _memory(), replay_bytes(agent, tasks, members)
    takes = f"{_size(needed)} ({_contents(agent, tasks, members)})"
    if choice == "auto":
        if jax.default_backend() == "cpu" or memory is None:
            return False, ""
        if needed > AUTOMATIC_SHARE * memory:
            return False, (
                f"replay in files: on the device it would take {takes}, more than half of its "
                f"{_size(memory)}; replay_keep makes it smaller"
            )
    elif memory is not None and needed > memory:
        fits = memory * device_replay.capacity(schedule) // needed
        raise ValueError(
            f"replay=device would take {takes}, and the device has {_size(memory)}: keep fewer "
            f"records of each task (replay_keep, less than {fits}), or choose replay=files"
        )
    return True, f"replay on the device: {takes}"


def replay_bytes(agent: Agent, tasks: int, members: int) -> int:
    """Bytes of the replay on the device."""
    size = agent.config.network.image_size
    records = device_replay.capacity(Schedule(agent.config.schedule, tasks))
    return members * tasks * records * device_replay.record_bytes(size, agent.action_size)


def _contents(agent: Agent, tasks: int, members: int) -> str:
    """What a replay on the device holds, in words."""
    size = agent.config.network.image_size
    records = device_replay.capacity(Schedule(agent.config.schedule, tasks))
    return f"members {members}, tasks {tasks}, records {records} of {size} x {size} pixels"


def _memory() -> int | None:
    """Bytes of memory of the default device; None if that is not known."""
    stats = jax.local_devices()[0].memory_stats() or {}
    if "bytes_limit" in stats:
        return int(stats["bytes_limit"])
    if jax.default_backend() == "cpu":
        try:
            with open("/proc/meminfo") as file:
                lines = dict(line.split(":") for line in file)
            return 1024 * int(lines["MemAvailable"].split()[0])
        except (OSError, KeyError):
            pass  # not Linux
    return None


def _size(count: int) -> str:
    return f"{count / 2**30:.1f} GiB" if count >= 2**30 else f"{count / 2**20:.1f} MiB"


@functools.partial(
    jax.jit,
    static_argnames=("agent", "env", "ticks", "length", "mapping", "chunk"),
    donate_argnames=("state", "sums", "held"),
)
def whole_round(
    agent: Agent,
    env,
    state: AgentState,
    sums: dict[str, jax.Array],
    held: Records,
    seeds: jax.Array,
    phase: jax.Array,
    mode: jax.Array,
    updates: jax.Array,
    drawn: tuple[jax.Array, jax.Array],
    numbers: jax.Array | None = None,
    *,
    ticks: int,
    length: int,
    mapping: str,
    chunk: int,
) -> tuple[AgentState, dict[str, jax.Array], Records, Records]:
    """One phase of every task by every member, stored, and the updates that are due after it.

    Args:
      agent: the agent's functions.
      env: an environment without a host, see `dreamer_jax.rollout.collect`.
      state: leaves [P, ...]; its memory is reused.
      sums: running sums of the metrics, [P] each; its memory is reused.
      held: the replay, leaves [P, K, C, ...]; its memory is reused.
      seeds: int32 [P].
      phase: int32 [], how many phases were collected before.
      mode: int32 [], index in `MODES`.
      updates: int32 [], how many of the U updates are made.
      drawn: int32 [U, P, B] each, the streams and the places in [0, C) of the updates' sequences.
      numbers: int32 [P], see `dreamer_jax.rollout.collect`.
      ticks: T.
      length: L.
      mapping, chunk: see `dreamer_jax.population.map_members`.

    Returns:
      The new state, sums and replay, and the records that were collected, [P, K, T + 1, ...].
    """
    tasks = held.reward.shape[1]
    records = collect(
        agent,
        env,
        state.params,
        seeds,
        state.updates,
        phase,
        tasks=tasks,
        ticks=ticks,
        mode=mode,
        numbers=numbers,
    )
    held = device_replay.write(held, records, phase)

    def update(index, carry):
        batch = device_replay.read(held, drawn[0][index], drawn[1][index], length)
        # Kept apart, so that an update does nearly the same arithmetic as by itself: what differs
        # is the order in which the compiler sums up parts of the actor's and the value's gradients.
        carry, batch = jax.lax.optimization_barrier((carry, batch))
        state, sums, _ = update_members(agent, *carry, batch, mapping=mapping, chunk=chunk)
        return state, sums

    state, sums = jax.lax.fori_loop(0, updates, update, (state, sums))
    return state, sums, held, records


class DeviceRounds:
    """The rounds of one run, each one program, and the replay on the device between them.

    Args:
      agent: the agent's functions.
      env: an environment without a host.
      files: the committed records.
      seeds: of the P members.
      placement: where members lie, and so their replay; by default all on one device.
    """

    def __init__(
        self,
        agent: Agent,
        env,
        files: Replay,
        seeds: Sequence[int],
        placement: Placement | None = None,
    ):
        self._agent, self._env, self._files = agent, env, files
        self._seeds = np.asarray(seeds, np.int32)
        self._placement = placement or on_one_device(files.members)
        # The axes of members: of state, sums, replay, seeds, ..., the places of sequences, numbers.
        axes = (0, 0, 0, 0, None, None, None, 1, 0)
        self._whole_round = self._placement.over_devices(self._one_round, axes, donate=(0, 1, 2))
        self._spread_seeds = self._placement.spread(self._seeds)
        self._numbers = self._placement.numbers()
        self._schedule = Schedule(agent.config.schedule, files.tasks)
        self._capacity = device_replay.capacity(self._schedule)
        self._held: Records | None = None

    def _one_round(self, *arguments):
        learning, schedule = self._agent.config.learning, self._agent.config.schedule
        return whole_round(
            self._agent,
            self._env,
            *arguments,
            ticks=schedule.phase_ticks,
            length=learning.sequence_length,
            mapping=schedule.mapping,
            chunk=schedule.mapping_chunk,
        )

    def forget(self) -> None:
        """Frees the device's copy; the next round makes it anew from the files."""
        self._held = None

    def run(
        self, state: AgentState, sums: Any, rounds: int, updates: range, mode: Mode
    ) -> tuple[AgentState, Any, Records]:
        """One round: a phase, and the updates with these numbers after it.

        Args:
          state: leaves [P, ...]; used up.
          sums: of the metrics; used up.
          rounds: how many rounds the files hold.
          updates: the numbers of the round's updates.
          mode: "random" or "explore".

        Returns:
          The new state and sums, and the records, NumPy [P, K, T + 1, ...], which are not yet in
          the files.

        Raises:
          MemoryError: the device has no room for the round beside the replay; names the way out.
        """
        phase_records, placement = self._schedule.config.phase_ticks + 1, self._placement
        held, self._held = self._held, None
        try:
            if held is None:
                held = device_replay.filled(self._files, self._capacity, phase_records, placement)
            state, sums, held, records = self._whole_round(
                state,
                sums,
                held,
                self._spread_seeds,
                np.int32(rounds),
                np.int32(MODES.index(mode)),
                np.int32(len(updates)),
                placement.spread(self._drawn(updates, phase_records), axis=1),
                self._numbers,
            )
            records = placement.own(to_host(records))
        except jax.errors.JaxRuntimeError as error:
            if "RESOURCE_EXHAUSTED" not in str(error):
                raise
            size = _size(replay_bytes(self._agent, self._files.tasks, placement.each))
            raise MemoryError(
                f"a round does not fit into the device's memory beside the replay's {size}: keep "
                "fewer records (replay_keep), update fewer members at once (mapping=chunks), or "
                "choose replay=files"
            ) from error
        self._held = held
        return state, sums, records

    def _drawn(self, updates: range, records: int) -> tuple[np.ndarray, np.ndarray]:
        """Streams and places of the sequences of a round's updates: int32 [U, P, B] each."""
        learning, files = self._agent.config.learning, self._files
        # As many for rounds without updates, so that all have one program.
        most = max(1, self._schedule.tasks * self._schedule.config.updates_per_phase)
        shape = (most, files.members, learning.batch_size)
        tasks, places = np.zeros(shape, np.int32), np.zeros(shape, np.int32)
        lengths, deleted = files.lengths + records, files.deleted
        for row, update in enumerate(updates):
            for member, seed in enumerate(self._seeds):
                try:
                    tasks[row, member], starts = sample_indices(
                        int(seed),
                        update,
                        lengths[member],
                        learning.batch_size,
                        learning.sequence_length,
                        files.keep,
                        deleted[member],
                    )
                except ValueError as error:
                    raise ValueError(f"member {member} of {files.directory}: {error}") from None
                places[row, member] = starts % self._capacity
        return tasks, places
