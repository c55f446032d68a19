"""A phase collected ahead: on a thread, beside the updates of the round before it.

Updates reuse the memory of the agents they begin from, and a phase that fails must not leave the
updates beside it behind, for a resumed run could not collect it again: so what a run was before
both is kept until both are done.
"""

from __future__ import annotations

import concurrent.futures
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import jax
import numpy as np

from dreamer_jax.learning import AgentState
from dreamer_jax.records import Records
from dreamer_jax.schedule import Counters


@dataclass(frozen=True)
class PhaseAhead:
    """A phase that is being collected, and the run from before it.

    Attributes:
      records: of the phase, checked, NumPy leaves [P, K, T + 1, ...]; or what its simulators met.
      state: the agents, leaves [P, ...].
      sums: of the metrics.
      counters: how far the run had come.
      healthy: bool [P].
      metrics: bytes of rows that were written.
    """

    records: concurrent.futures.Future[Records]
    state: AgentState
    sums: dict[str, jax.Array]
    counters: Counters
    healthy: np.ndarray
    metrics: int

    @property
    def failed(self) -> bool:
        """Whether it is known by now that there will be no records."""
        return self.records.done() and self.records.exception() is not None

    def wait(self) -> None:
        """Until the thread is done with the environment, however that ended."""
        concurrent.futures.wait([self.records])


def on_thread(function: Callable[..., Any], *arguments: Any) -> concurrent.futures.Future:
    """Calls a function on a thread of its own."""
    pool = concurrent.futures.ThreadPoolExecutor(max_workers=1, thread_name_prefix="collect")
    future = pool.submit(function, *arguments)
    pool.shutdown(wait=False)  # the thread ends when it is done
    return future
