"""Results prepared in the background, in order, while the caller works on earlier ones."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Generic, TypeVar

Prepared = TypeVar("Prepared")


class Prefetcher(Generic[Prepared]):
    """`prepare(item)` for each item in turn, computed ahead in one background thread.

    An iterator and a context manager; leaving it waits for the item in work and drops the rest.
    An exception in `prepare` is raised by the `next` that would have returned its result.

    Args:
      prepare: called in the background thread, one item at a time, in order.
      items: what to prepare, e.g. the numbers of the updates of a round.
      depth: how many results are prepared ahead at most.
    """

    def __init__(self, prepare: Callable[[int], Prepared], items: Iterable[int], depth: int = 2):
        if depth < 1:
            raise ValueError(f"depth must be at least 1, got {depth}")
        self._prepare = prepare
        self._items = iter(items)
        self._pool = ThreadPoolExecutor(max_workers=1, thread_name_prefix="prefetch")
        self._pending: deque[Future[Prepared]] = deque()
        for _ in range(depth):
            self._submit()

    def _submit(self) -> None:
        for item in self._items:
            self._pending.append(self._pool.submit(self._prepare, item))
            return

    def __iter__(self) -> Prefetcher[Prepared]:
        return self

    def __next__(self) -> Prepared:
        if not self._pending:
            self.close()
            raise StopIteration
        future = self._pending.popleft()
        self._submit()
        return future.result()

    def close(self) -> None:
        """Stop preparing and wait for the thread; may be called twice."""
        self._items = iter(())
        self._pending.clear()
        self._pool.shutdown(wait=True, cancel_futures=True)

    def __enter__(self) -> Prefetcher[Prepared]:
        return self

    def __exit__(self, *_) -> None:
        self.close()
