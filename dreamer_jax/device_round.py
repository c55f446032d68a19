"""Updates with the replay on the device: storing, sampling and updating without the host.

The replay lies in the device's memory; the host draws where each batch's sequences begin, by the
law of the files (`dreamer_jax.sampling`), and keeps the files, from which the device's copy is made
anew when a run is resumed. An environment that is part of the jitted program is played in the same
program as the updates after it, so that a round is one (`whole_round`). With simulators on the host
a phase comes first, is checked and written to the files, and the program after it takes it up
(`store_and_update`). Collecting is that of the path with files to the bit, updates are to the
rounding of float32; a run that is resumed is, to the bit, the one that was not, as long as it stays
with one of both.

Axis letters: P population member, K task, T ticks in a phase, U updates of a round, B batch,
L sequence length, C capacity in records.
"""

from __future__ import annotations

import contextlib
import functools
from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

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
from dreamer_jax.waiting import to_host, wait_for

AUTOMATIC_SHARE = 0.5
"""Share of an accelerator's memory that a replay may take without being asked for."""


class ReplayPlace(NamedTuple):
    """Where the updates of a run take records from.

    Attributes:
      device: whether from the device's memory; from files otherwise.
      one_program: whether a round, its phase too, is one program.
      note: what to tell the user of it; "" where files are a matter of course.
    """

    device: bool
    one_program: bool
    note: str


def on_device(agent: Agent, has_host: bool, tasks: int, members: int) -> ReplayPlace:
    """Where the updates of a run take records from, and why.

    By the setting `replay` of the schedule: "files", "device", or "auto", which is the device on an
    accelerator if the replay takes at most half of its memory, and files otherwise.

    Args:
      agent: its functions and settings.
      has_host: whether anything of the environment runs on the host; then phases are programs of
        their own, as they are where they are collected beside updates.
      tasks: K.
      members: P, of those on one device.

    Raises:
      ValueError: "device" was asked for, and the replay does not fit.
    """
    schedule = Schedule(agent.config.schedule, tasks)
    choice = agent.config.schedule.replay
    if choice == "files":
        return ReplayPlace(False, False, "")
    memory, needed = _memory(), replay_bytes(agent, tasks, members)
    takes = f"{_size(needed)} ({_contents(agent, tasks, members)})"
    if choice == "auto":
        if jax.default_backend() == "cpu" or memory is None:
            return ReplayPlace(False, False, "")
        if needed > AUTOMATIC_SHARE * memory:
            told = (
                f"replay in files: on the device it would take {takes}, more than half of its "
                f"{_size(memory)}; replay_keep makes it smaller"
            )
            return ReplayPlace(False, False, told)
    elif memory is not None and needed > memory:
        fits = memory * device_replay.capacity(schedule) // needed
        raise ValueError(
            f"replay=device would take {takes}, and the device has {_size(memory)}: keep fewer "
            f"records of each task (replay_keep, less than {fits}), or choose replay=files"
        )
    one_program = not has_host and agent.config.schedule.collect == "before"
    return ReplayPlace(True, one_program, f"replay on the device: {takes}")


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
    static_argnames=("agent", "length", "mapping", "chunk"),
    donate_argnames=("state", "sums", "held"),
)
def store_and_update(
    agent: Agent,
    state: AgentState,
    sums: dict[str, jax.Array],
    held: Records,
    records: Records,
    phase: jax.Array,
    updates: jax.Array,
    drawn: tuple[jax.Array, jax.Array],
    *,
    length: int,
    mapping: str,
    chunk: int,
) -> tuple[AgentState, dict[str, jax.Array], Records]:
    """A phase stored, and the updates that are due after it.

    Args:
      agent: the agent's functions.
      state: leaves [P, ...]; its memory is reused.
      sums: running sums of the metrics, [P] each; its memory is reused.
      held: the replay, leaves [P, K, C, ...]; its memory is reused.
      records: of the phase, leaves [P, K, T + 1, ...].
      phase: int32 [], its number.
      updates: int32 [], how many of the U updates are made.
      drawn: int32 [U, P, B] each, the streams and the places in [0, C) of the updates' sequences.
      length: L.
      mapping, chunk: see `dreamer_jax.population.map_members`.

    Returns:
      The new state, sums and replay.
    """
    held = device_replay.write(held, records, phase)

    def update(index, carry):
        batch = device_replay.read(held, drawn[0][index], drawn[1][index], length)
        # Kept apart, so that an update does nearly the same arithmetic as by itself: what differs
        # is the order in which the compiler sums up parts of the actor's and the value's gradients.
        carry, batch = jax.lax.optimization_barrier((carry, batch))
        state, sums, _ = update_members(agent, *carry, batch, mapping=mapping, chunk=chunk)
        return state, sums

    state, sums = jax.lax.fori_loop(0, updates, update, (state, sums))
    return state, sums, held


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
    """One phase of every task by every member, and what `store_and_update` does with it.

    Args:
      env: an environment without a host, see `dreamer_jax.rollout.collect`.
      seeds: int32 [P].
      phase: int32 [], how many phases were collected before.
      mode: int32 [], index in `MODES`.
      numbers: int32 [P], see `dreamer_jax.rollout.collect`.
      ticks: T.
      agent, state, sums, held, updates, drawn, length, mapping, chunk: see `store_and_update`.

    Returns:
      The new state, sums and replay, and the records that were collected, [P, K, T + 1, ...].
    """
    records = collect(
        agent,
        env,
        state.params,
        seeds,
        state.updates,
        phase,
        tasks=held.reward.shape[1],
        ticks=ticks,
        mode=mode,
        numbers=numbers,
    )
    options: dict[str, Any] = {"length": length, "mapping": mapping, "chunk": chunk}
    done = store_and_update(agent, state, sums, held, records, phase, updates, drawn, **options)
    return *done, records


class DeviceRounds:
    """The rounds of one run with the replay on the device, and the replay between them.

    Args:
      agent: the agent's functions.
      env: the environment; one without a host for `run`.
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
        self._compiled = agent.on_any_schedule()
        self._seeds = np.asarray(seeds, np.int32)
        self._placement = placement or on_one_device(files.members)
        over = self._placement.over_devices
        # The axes of members: of state, sums, replay, seeds, ..., the places of sequences, numbers;
        # and of state, sums, replay, records, ..., the places.
        of_round, of_updates = (0, 0, 0, 0, None, None, None, 1, 0), (0, 0, 0, 0, None, None, 1)
        self._whole_round = over(self._one_round, of_round, donate=(0, 1, 2))
        self._store_and_update = over(self._updates_of_round, of_updates, donate=(0, 1, 2))
        self._spread_seeds = self._placement.spread(self._seeds)
        self._numbers = self._placement.numbers()
        self._schedule = Schedule(agent.config.schedule, files.tasks)
        self._capacity = device_replay.capacity(self._schedule)
        self._records = agent.config.schedule.phase_ticks + 1
        self._held: Records | None = None

    def _settings(self) -> dict[str, Any]:
        schedule = self._agent.config.schedule
        return {
            "length": self._agent.config.learning.sequence_length,
            "mapping": schedule.mapping,
            "chunk": schedule.mapping_chunk,
        }

    def _one_round(self, *arguments):
        ticks = self._agent.config.schedule.phase_ticks
        return whole_round(self._compiled, self._env, *arguments, ticks=ticks, **self._settings())

    def _updates_of_round(self, *arguments):
        return store_and_update(self._compiled, *arguments, **self._settings())

    def forget(self) -> None:
        """Frees the device's copy; the next round makes it anew from the files."""
        self._held = None

    def run(
        self, state: AgentState, sums: Any, rounds: int, updates: range, mode: Mode
    ) -> tuple[AgentState, Any, Records]:
        """One round as one program: a phase, and the updates with these numbers after it.

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
        with self._replay() as held:
            state, sums, held, records = self._whole_round(
                state,
                sums,
                held,
                self._spread_seeds,
                np.int32(rounds),
                np.int32(MODES.index(mode)),
                np.int32(len(updates)),
                self._drawn(updates, self._files.lengths + self._records),
                self._numbers,
            )
            records = self._placement.own(to_host(records))
        self._held = held
        return state, sums, records

    def update(self, state: AgentState, sums: Any, updates: range) -> tuple[AgentState, Any]:
        """Takes up the newest phase of the files, and makes the updates with these numbers.

        Args:
          state: leaves [P, ...]; used up.
          sums: of the metrics; used up.
          updates: the numbers of the updates.

        Returns:
          The new state and sums.

        Raises:
          MemoryError: as of `run`.
        """
        with self._replay() as held:
            newest = int(self._files.lengths.min()) // self._records - 1
            records = device_replay.phase_of(self._files, newest, self._records)
            state, sums, held = self._store_and_update(
                state,
                sums,
                held,
                self._placement.spread(records),
                np.int32(newest),
                np.int32(len(updates)),
                self._drawn(updates, self._files.lengths),
            )
            wait_for(sums)
        self._held = held
        return state, sums

    @contextlib.contextmanager
    def _replay(self) -> Iterator[Records]:
        """The replay for a program that uses it up, made from the files if there is none."""
        held, self._held = self._held, None
        try:
            if held is None:
                held = device_replay.filled(
                    self._files, self._capacity, self._records, self._placement
                )
            yield held
        except jax.errors.JaxRuntimeError as error:
            if "RESOURCE_EXHAUSTED" not in str(error):
                raise
            size = _size(replay_bytes(self._agent, self._files.tasks, self._placement.each))
            raise MemoryError(
                f"a round does not fit into the device's memory beside the replay's {size}: keep "
                "fewer records (replay_keep), update fewer members at once (mapping=chunks), or "
                "choose replay=files"
            ) from error

    def _drawn(self, updates: range, lengths: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Streams and places of the sequences of a round's updates: int32 [U, P, B] each.

        Args:
          updates: their numbers.
          lengths: int64 [P, K], records of each stream.
        """
        learning, files = self._agent.config.learning, self._files
        # As many for rounds without updates, so that all have one program.
        most = max(1, self._schedule.tasks * self._schedule.config.updates_per_phase)
        shape = (most, files.members, learning.batch_size)
        tasks, places = np.zeros(shape, np.int32), np.zeros(shape, np.int32)
        deleted = files.deleted
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
        return self._placement.spread((tasks, places), axis=1)
