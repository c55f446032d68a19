"""How far work has come: what tells it, and the bars that show it.

A function that takes long takes `report`, a `Report`, and calls it. `reported` makes one that draws
a bar; `Progress` is the richer one of a run, live on a terminal, a plain line now and then
elsewhere.
"""

from __future__ import annotations

import contextlib
import math
import sys
import time
from collections import deque
from collections.abc import Callable, Iterator
from typing import Any, TextIO, cast

import rich.progress
from rich.console import Console, Group, RenderableType
from rich.live import Live
from rich.progress_bar import ProgressBar
from rich.table import Table
from rich.text import Text

from dreamer_jax.output import SafeStream

Report = Callable[[int, int, str], Any]
"""Called as `report(done, total, text)` whenever something is done: how much is, of how much, and a
few words on the newest, or none."""


def unreported(done: int, total: int, text: str) -> None:
    """A `Report` that tells nobody."""


@contextlib.contextmanager
def reported(description: str) -> Iterator[Report]:
    """A `Report` that draws a bar on standard output, from its first call on."""
    with rich.progress.Progress() as bar:
        job = bar.add_task(description, total=None, visible=False)

        def report(done: int, total: int, text: str) -> None:
            title = f"{description}, {text}" if text else description
            bar.update(job, completed=done, total=total, description=title, visible=True)

        yield report


_WINDOW = 1000  # calls of `update` that the estimated time goes by


class Progress:
    """How far a run has come, what it is doing, its rates and newest return.

    A context manager. The bar is the mean of the shares of environment steps and of updates done.
    Rates count only the time spent on the thing itself: from the `phase` it began with, or the last
    time the count moved, to the next move. The time left follows from how the bar moved of late,
    so that what was slow once (compilation) is forgotten. It never raises: a run goes on where
    nobody reads what it says.

    Args:
      total_env_steps: environment steps of the whole run.
      total_updates: updates of the whole run; 0 if it makes none.
      env_steps: environment steps made before (by the part of the run that is now resumed).
      updates: updates made before.
      description: shown in front.
      stream: where to write; standard output by default.
      interval: seconds between plain lines, where the stream is not a terminal.
    """

    def __init__(
        self,
        total_env_steps: int,
        total_updates: int = 0,
        env_steps: int = 0,
        updates: int = 0,
        description: str = "training",
        stream: TextIO | None = None,
        interval: float = 30.0,
    ):
        self._env_steps = _Count(total_env_steps, env_steps)
        self._updates = _Count(total_updates, updates)
        self._description = description
        self._phase = ""
        self._last_return: float | None = None
        self._interval = interval
        self._console = Console(file=cast(TextIO, SafeStream(stream or sys.stdout)))
        self._live: Live | None = None
        self._printed = -math.inf
        self._history = deque([(time.monotonic(), self._share())], maxlen=_WINDOW)

    def update(
        self,
        env_steps: int | None = None,
        updates: int | None = None,
        phase: str | None = None,
        last_return: float | None = None,
    ) -> None:
        """Say what is new; what is left out stays as it was.

        Args:
          env_steps: environment steps made so far, in all.
          updates: updates made so far, in all.
          phase: what begins now, e.g. "collecting".
          last_return: return of the newest episodes (of a population, their mean).
        """
        if phase is not None:
            self._phase = phase
            self._env_steps.restart()
            self._updates.restart()
        if env_steps is not None:
            self._env_steps.move_to(env_steps)
        if updates is not None:
            self._updates.move_to(updates)
        if last_return is not None:
            self._last_return = float(last_return)
        self._history.append((time.monotonic(), self._share()))
        if not self._console.is_terminal and time.monotonic() - self._printed >= self._interval:
            self._print_line()

    def message(self, text: str) -> None:
        """Print a line that stays, above a live bar."""
        self._console.print(text, markup=False, highlight=False, soft_wrap=True)

    def seconds_left(self) -> float | None:
        """Estimated seconds until the end; None before there is anything to go by."""
        (start, before), (end, done) = self._history[0], self._history[-1]
        if done >= 1.0:
            return 0.0
        if done <= before:
            return None
        return (end - start) / (done - before) * (1.0 - done)

    def _share(self) -> float:
        counts = [count for count in (self._env_steps, self._updates) if count.total]
        return sum(min(count.done / count.total, 1.0) for count in counts) / max(len(counts), 1)

    def _title(self) -> str:
        return f"{self._description} · {self._phase}" if self._phase else self._description

    def _details(self) -> str:
        parts = [f"{self._env_steps.done:,}/{self._env_steps.total:,} steps"]
        if self._last_return is not None:
            parts.append(f"return {self._last_return:.1f}")
        for count, unit in ((self._env_steps, "steps/s"), (self._updates, "updates/s")):
            if (rate := count.per_second()) is not None:
                parts.append(f"{rate:,.0f} {unit}" if rate >= 100 else f"{rate:.3g} {unit}")
        return " · ".join(parts)

    def _time_left(self) -> str:
        seconds = self.seconds_left()
        if seconds is None:
            return ""
        # A live bar counts down between calls.
        seconds = max(int(seconds - (time.monotonic() - self._history[-1][0])), 0)
        minutes, hours = seconds // 60, seconds // 3600
        clock = f"{hours}:{minutes % 60:02d}" if hours else f"{minutes}"
        return f"{clock}:{seconds % 60:02d} left"

    def _render(self) -> RenderableType:
        bar = Table.grid(expand=True, padding=(0, 1))
        bar.add_column(no_wrap=True)
        bar.add_column(ratio=1)
        bar.add_column(justify="right", no_wrap=True)
        percent = f"{self._share():.0%} {self._time_left()}"
        bar.add_row(Text(self._title()), ProgressBar(1.0, self._share()), Text(percent))
        details = Text(self._details(), style="dim", no_wrap=True, overflow="ellipsis")
        return Group(bar, details)

    def _print_line(self) -> None:
        self._printed = time.monotonic()
        parts = [f"{self._title()} {self._share():.0%}", self._details(), self._time_left()]
        self.message(" · ".join(filter(None, parts)))

    def __enter__(self) -> Progress:
        self._history = deque([(time.monotonic(), self._share())], maxlen=_WINDOW)
        if self._console.is_terminal:
            self._live = Live(get_renderable=self._render, console=self._console)
            self._live.start()
        return self

    def __exit__(self, *_) -> None:
        if self._live:
            self._live.stop()
            self._live = None
        else:
            self._print_line()


class _Count:
    """How much of one kind of work is done, and how fast it went of late."""

    def __init__(self, total: int, done: int):
        self.total = total
        self.done = done
        self._recent: deque[tuple[int, float]] = deque(maxlen=50)
        self.restart()

    def restart(self) -> None:
        """What comes next begins now."""
        self._since = time.monotonic()

    def move_to(self, done: int) -> None:
        now = time.monotonic()
        if done > self.done:
            self._recent.append((done - self.done, now - self._since))
        self._since = now
        self.done = done

    def per_second(self) -> float | None:
        seconds = sum(seconds for _, seconds in self._recent)
        return sum(amount for amount, _ in self._recent) / seconds if seconds else None
