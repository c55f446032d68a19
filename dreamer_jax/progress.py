"""The progress bar of a run: live on a terminal, a plain line now and then elsewhere."""

from __future__ import annotations

import math
import sys
import time
from collections import deque
from typing import TextIO

from rich.console import Console, Group, RenderableType
from rich.live import Live
from rich.progress_bar import ProgressBar as Bar
from rich.table import Table
from rich.text import Text

_WINDOW = 1000  # calls of `advance_to` that the estimated time goes by


class ProgressBar:
    """How far a run has come, what it is doing, its rates and newest returns.

    A context manager. Rates count only the time spent on the thing itself: from `describe`, or the
    last time the count moved, to the next move. The time left follows from the units of the last
    calls of `advance_to`, so that what was slow once (compilation) is forgotten.

    Args:
        total: units of work of the whole run.
        done: units done before (by the part of the run that is now resumed).
        show: False for messages only.
        stream: where to write; standard output by default.
        interval: seconds between plain lines, where the stream is not a terminal.
    """

    def __init__(
        self,
        total: int,
        done: int = 0,
        show: bool = True,
        stream: TextIO | None = None,
        interval: float = 30.0,
    ):
        self._total = total
        self._console = Console(file=stream or sys.stdout)
        self._show = show
        self._interval = interval
        self._live: Live | None = None
        self._activity = ""
        self._returns: dict[str, float] = {}
        self._env_steps = _Rate()
        self._updates = _Rate()
        self._history = deque([(time.monotonic(), done)], maxlen=_WINDOW)
        self._printed = -math.inf

    def describe(self, activity: str) -> None:
        """Say what begins now, e.g. "collecting"."""
        self._activity = activity
        self._env_steps.restart()
        self._updates.restart()
        self._print_if_due()

    def advance_to(self, done: int) -> None:
        """Say how many units of the whole run are done."""
        self._history.append((time.monotonic(), done))
        self._print_if_due()

    def update(
        self,
        env_steps: int | None = None,
        updates: int | None = None,
        episode_return: float | None = None,
        evaluation_return: float | None = None,
    ) -> None:
        """Say what is new; what is left out stays as it was.

        Args:
            env_steps: environment steps so far.
            updates: updates so far.
            episode_return: return of the newest training episodes (of a population, their mean).
            evaluation_return: return of the newest evaluation, likewise.
        """
        if env_steps is not None:
            self._env_steps.move_to(env_steps)
        if updates is not None:
            self._updates.move_to(updates)
        for name, value in (("return", episode_return), ("evaluation", evaluation_return)):
            if value is not None:
                self._returns[name] = float(value)
        self._print_if_due()

    def message(self, text: str) -> None:
        """Print a line that stays, above a live bar."""
        self._console.print(text, markup=False, highlight=False, soft_wrap=True)

    def seconds_left(self) -> float | None:
        """Estimated seconds until the end; None before there is anything to go by."""
        (start, before), (end, done) = self._history[0], self._history[-1]
        if done >= self._total:
            return 0.0
        if done <= before:
            return None
        return (end - start) / (done - before) * (self._total - done)

    def _share(self) -> float:
        return min(self._history[-1][1] / self._total, 1.0) if self._total else 1.0

    def _details(self) -> str:
        parts = []
        if self._env_steps.count:
            parts.append(f"{self._env_steps.count:,} steps")
        parts += [f"{name} {value:.1f}" for name, value in self._returns.items()]
        for rate, unit in ((self._env_steps, "steps/s"), (self._updates, "updates/s")):
            if (value := rate.per_second()) is not None:
                parts.append(f"{value:,.0f} {unit}" if value >= 100 else f"{value:.3g} {unit}")
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
        summary = f"{self._share():.0%} {self._time_left()}"
        bar.add_row(Text(self._activity), Bar(1.0, self._share()), Text(summary))
        details = Text(self._details(), style="dim", no_wrap=True, overflow="ellipsis")
        return Group(bar, details)

    def _print_if_due(self) -> None:
        plain = self._show and not self._console.is_terminal
        if plain and time.monotonic() - self._printed >= self._interval:
            self._print_line()

    def _print_line(self) -> None:
        self._printed = time.monotonic()
        parts = [f"{self._share():.0%}", self._activity, self._details(), self._time_left()]
        self.message(" · ".join(part for part in parts if part))

    def __enter__(self) -> ProgressBar:
        self._history = deque([(time.monotonic(), self._history[-1][1])], maxlen=_WINDOW)
        if self._show and self._console.is_terminal:
            self._live = Live(get_renderable=self._render, console=self._console)
            self._live.start()
        return self

    def __exit__(self, *_) -> None:
        if self._live:
            self._live.stop()
            self._live = None
        elif self._show:
            self._print_line()


class _Rate:
    """A count, and how fast it grew of late."""

    def __init__(self):
        self.count = 0
        self._recent: deque[tuple[int, float]] = deque(maxlen=50)
        self.restart()

    def restart(self) -> None:
        """What comes next starts now."""
        self._since: float = time.monotonic()

    def move_to(self, count: int) -> None:
        now = time.monotonic()
        # The first count is where the run stood, not what was done since.
        if 0 < self.count < count:
            self._recent.append((count - self.count, now - self._since))
        self._since = now
        self.count = count

    def per_second(self) -> float | None:
        seconds = sum(seconds for _, seconds in self._recent)
        return sum(amount for amount, _ in self._recent) / seconds if seconds else None
