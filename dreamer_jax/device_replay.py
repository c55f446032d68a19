"""Replay in the device's memory: the newest records of every stream, within a capacity.

A copy of what the files hold (`dreamer_jax.replay`), for programs that store and sample without the
host. A phase of T ticks has T + 1 records, and the capacity is a whole number of phases, so that a
new phase takes the place of the oldest as one block.

Axis letters: P population member, K task, T ticks in a phase, C capacity in records, B batch,
L sequence length, A action.
"""

from __future__ import annotations

import math

import jax
import jax.numpy as jnp
import numpy as np

from dreamer_jax.devices import Placement, on_one_device
from dreamer_jax.records import Records
from dreamer_jax.replay import Replay, record_dtype
from dreamer_jax.schedule import Schedule


def capacity(schedule: Schedule) -> int:
    """C: records of one stream that have to be held at once, whole phases of them.

    Those of the whole run or, of `replay_keep`, the newest that many.
    """
    records = schedule.config.phase_ticks + 1
    keep, phases = schedule.config.replay_keep, schedule.rounds
    if keep is not None:
        phases = min(phases, math.ceil(keep / records))
    return phases * records


def record_bytes(image_size: int, action_size: int) -> int:
    """Bytes of one record: image, action, reward and two flags."""
    return record_dtype(image_size, action_size).itemsize


def empty(
    members: int,
    tasks: int,
    capacity: int,
    image_size: int,
    action_size: int,
    sharding: jax.sharding.Sharding | None = None,
) -> Records:
    """A replay of zeros, by default on the default device, leaves [P, K, C, ...]."""
    dtype = record_dtype(image_size, action_size)
    layouts = (dtype[name] for name in Records._fields)
    shape = (members, tasks, capacity)
    return Records(
        *(jnp.zeros((*shape, *layout.shape), layout.base, device=sharding) for layout in layouts)
    )


def write(held: Records, records: Records, phase: jax.Array) -> Records:
    """The replay with one more phase, in place of the oldest if it is full.

    Args:
      held: leaves [P, K, C, ...].
      records: leaves [P, K, T + 1, ...]; C is a multiple of T + 1.
      phase: int32 [], how many phases were written before.
    """
    size = records.reward.shape[2]
    start = phase % (held.reward.shape[2] // size) * size
    return jax.tree.map(
        lambda old, new: jax.lax.dynamic_update_slice_in_dim(old, new, start, axis=2), held, records
    )


def read(held: Records, tasks: jax.Array, starts: jax.Array, length: int) -> Records:
    """Sequences of records for every member.

    Args:
      held: leaves [P, K, C, ...].
      tasks: int32 [P, B], the stream of each sequence.
      starts: int32 [P, B], the place in [0, C) of its first record.
      length: L; a sequence that reaches the end of the memory goes on at its beginning.

    Returns:
      Leaves [P, B, L, ...].
    """
    places = (starts[..., None] + jnp.arange(length)) % held.reward.shape[2]
    one = jax.vmap(lambda leaf, task, place: leaf[task[:, None], place])
    return held.map(lambda leaf: one(leaf, tasks, places))


def filled(
    files: Replay, capacity: int, records: int, placement: Placement | None = None
) -> Records:
    """The newest records that the files hold, phase by phase.

    Args:
      files: the streams, all of one length.
      capacity: C.
      records: of one phase, T + 1.
      placement: where members lie; by default all on one device.

    Returns:
      Leaves [P, K, C, ...], with the placement's padding.

    Raises:
      ValueError: the streams do not hold whole phases.
    """
    held_records, phases = int(files.lengths[0, 0]), int(files.lengths[0, 0]) // records
    if (files.lengths != phases * records).any():
        raise ValueError(
            f"the streams in {files.directory} hold {files.lengths.tolist()} records, no whole "
            f"number of phases of {records}: resume with the phase's length with which they were "
            "collected, or with replay=files"
        )
    size, actions = files.dtype["image"].shape[0], files.dtype["action"].shape[0]
    placement = placement or on_one_device(files.members)
    sharding = placement.sharding()
    held = empty(placement.padded, files.tasks, capacity, size, actions, sharding)
    store = placement.over_devices(jax.jit(write, donate_argnums=0), axes=(0, 0, None), donate=(0,))
    oldest = max(0, held_records - (capacity if files.keep is None else files.keep))
    for phase in range(oldest // records, phases):
        rows = phase_of(files, phase, records)
        held = store(held, placement.spread(rows), jnp.int32(phase))
    return held


def phase_of(files: Replay, phase: int, records: int) -> Records:
    """One phase as the files hold it, with zeros for what is deleted (which is never sampled).

    Args:
      files: the streams.
      phase: its number.
      records: T + 1.

    Returns:
      NumPy leaves [P, K, T + 1, ...].
    """
    start = max(phase * records, int(files.deleted.max()))
    missing = start - phase * records
    streams = [
        _padded(files.read(p, k, start, (phase + 1) * records), missing)
        for p, k in np.ndindex(files.members, files.tasks)
    ]
    rows = jax.tree.map(lambda *x: np.stack(x), *streams)
    return rows.map(lambda x: x.reshape(files.members, files.tasks, *x.shape[1:]))


def _padded(records: Records, missing: int) -> Records:
    """Records with zeros in front."""
    return records.map(lambda x: np.pad(x, [(missing, 0)] + [(0, 0)] * (x.ndim - 1)))
