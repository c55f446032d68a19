"""Copies sequences of records out of files, through memory maps, by several threads.

Axis letters: L sequence length.
"""

from __future__ import annotations

import os
import threading
from collections import OrderedDict
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import NamedTuple

import numpy as np

from dreamer_jax.records import Records

MOST_MAPS = 256
"""Maps that are kept; each holds a file open, of which a process may often have 1024."""

MOST_THREADS = 4
"""Threads by default, where there are as many cores."""


class Place(NamedTuple):
    """Where a sequence begins.

    Attributes:
      path: the file.
      held: how many records it holds at least.
      start: number of the sequence's first one.
    """

    path: Path
    held: int
    start: int


class StreamReader:
    """Reads files of records that grow.

    Maps are kept from one reading to the next: pages that were read before are found without asking
    the system again. They have to be dropped before a file is cut.

    Args:
      dtype: of a record, with the fields of `Records`.
      threads: how many copy; by default 4, or as many as there are cores if these are fewer.
      most_maps: how many maps are kept; of more files, those that were read last.
    """

    def __init__(self, dtype: np.dtype, threads: int | None = None, most_maps: int = MOST_MAPS):
        self._dtype, self._most_maps = dtype, most_maps
        self.threads = threads or min(MOST_THREADS, available_cores())
        self._maps: OrderedDict[Path, np.ndarray] = OrderedDict()
        self._lock = threading.Lock()
        self._pool: ThreadPoolExecutor | None = None

    def sequences(self, places: Sequence[Place], length: int, *lead: int) -> Records:
        """Sequences of L records, in arrays of their own.

        Args:
          places: where they begin.
          length: L.
          lead: the leading axes, which hold as many sequences.

        Returns:
          Leaves [lead, L, ...].
        """
        layouts = (self._dtype[name] for name in Records._fields)
        result = Records(*(np.empty((*lead, length, *x.shape), x.base) for x in layouts))
        rows = result.map(lambda x: x.reshape(len(places), *x.shape[len(lead) :]))

        def copy(part: range) -> None:
            for number in part:
                path, held, start = places[number]
                sequence = self._map(path, held)[start : start + length]
                for name, values in rows._asdict().items():
                    values[number] = sequence[name]

        parts = list(_parts(len(places), self.threads))
        if len(parts) == 1:
            copy(parts[0])
        else:
            # NumPy lets other threads go on while it copies.
            list(self._workers().map(copy, parts))
        return result

    def drop(self) -> None:
        """Closes the maps, as soon as nobody reads them any more."""
        with self._lock:
            self._maps.clear()

    def close(self) -> None:
        """Closes the maps and ends the threads, until they are needed again."""
        self.drop()
        if self._pool is not None:
            self._pool.shutdown()
            self._pool = None

    def _workers(self) -> ThreadPoolExecutor:
        if self._pool is None:
            self._pool = ThreadPoolExecutor(self.threads, thread_name_prefix="replay")
        return self._pool

    def _map(self, path: Path, held: int) -> np.ndarray:
        """The first records of a file, at least so many."""
        with self._lock:
            found = self._maps.pop(path, None)
            if found is None or len(found) < held:
                found = np.memmap(path, self._dtype, "r", shape=(held,))
            self._maps[path] = found
            if len(self._maps) > self._most_maps:
                self._maps.popitem(last=False)
            return found


def _parts(count: int, threads: int) -> Iterator[range]:
    """The numbers below `count` in as many parts as there are threads, none of them empty."""
    threads = max(1, min(threads, count))
    for part in range(threads):
        yield range(part * count // threads, (part + 1) * count // threads)


def available_cores() -> int:
    """The number of cores that this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1
