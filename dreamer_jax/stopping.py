"""Ctrl-C as a request to stop."""

import signal
import threading
from collections.abc import Callable
from typing import Any


class StopRequest:
    """Turns the first Ctrl-C (or SIGTERM, or the terminal's end) into a request to stop, and lets a
    second one quit.

    A context manager; outside the main thread it does nothing, as Python allows no more.

    Args:
      say: is told of the request in words.
      hurry: called at the request, so that nothing that hangs is waited for.
    """

    def __init__(self, say: Callable[[str], None], hurry: Callable[[], None]):
        self.requested = False
        self._say, self._hurry = say, hurry
        self._previous: dict[int, Any] = {}

    def __enter__(self) -> "StopRequest":
        if threading.current_thread() is threading.main_thread():
            for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
                if signal.getsignal(number) != signal.SIG_IGN:  # as under nohup
                    self._previous[number] = signal.signal(number, self._handle)
        return self

    def __exit__(self, *_) -> None:
        for number, handler in self._previous.items():
            signal.signal(number, handler)

    def _handle(self, number, frame) -> None:
        if self.requested:
            raise KeyboardInterrupt
        self.requested = True
        self._hurry()
        self._say("stopping: saving first (once more to quit without)")
