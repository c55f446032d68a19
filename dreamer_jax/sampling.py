"""Which sequences of a replay make up a batch: a law without files.

Axis letters: K task, B batch, L sequence length.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from dreamer_jax.randomness import batch_generator


def sample_indices(
    seed: int,
    update: int,
    lengths: Sequence[int],
    batch: int,
    length: int,
    keep: int | None = None,
    deleted: Sequence[int] | None = None,
) -> tuple[np.ndarray, np.ndarray]:
    """Where the sequences of one member's batch begin: a pure function of the arguments.

    Every row draws a stream uniformly among those with at least `length` records, whatever their
    lengths, then a start uniformly among the starts that keep the sequence inside the stream.

    Args:
      seed: the member's seed, not negative.
      update: the number of the update, not negative.
      lengths: [K] records in each of the member's streams.
      batch: B.
      length: L.
      keep: only the newest `keep` records of each stream are sampled; None for all.
      deleted: [K] records at the beginning of each stream that are there no more; none given: 0.

    Returns:
      tasks int64 [B] and starts int64 [B], starts counted from the first record of the stream.

    Raises:
      ValueError: no stream holds L records (within `keep`, and not deleted).
    """
    if batch < 1 or length < 1:
        raise ValueError(f"batch and length must be at least 1, got {batch} and {length}")
    if seed < 0 or update < 0:
        raise ValueError(f"seed and update must not be negative, got {seed} and {update}")
    held = np.asarray(lengths, np.int64)
    oldest = np.zeros_like(held) if deleted is None else np.asarray(deleted, np.int64)
    if keep is not None:
        oldest = np.maximum(oldest, held - keep)
    starts = held - oldest - length + 1
    eligible = np.flatnonzero(starts > 0)
    if not eligible.size:
        within = "" if keep is None else f" (of which the newest {keep} are sampled)"
        raise ValueError(
            f"no stream is long enough for sequences of {length} records: "
            f"the streams hold {held.tolist()}{within}; collect more or shorten the sequences"
        )
    random = batch_generator(seed, update)
    tasks = eligible[random.integers(eligible.size, size=batch)]
    return tasks, oldest[tasks] + random.integers(starts[tasks])
