"""A stream to print on that never raises: a run does not end because nobody listens."""

from __future__ import annotations

import contextlib
import os
import sys
from typing import Any, TextIO, cast


class SafeStream:
    """A text stream in whose place it stands; what cannot be written is lost.

    Letters that the stream's encoding lacks become question marks. When the other end is closed (as
    by `| head -1`), or the disk of a log is full, everything from then on is lost.

    Args:
      stream: where to write.
    """

    def __init__(self, stream: TextIO):
        self._stream = stream
        self._closed = False

    def __getattr__(self, name: str) -> Any:
        return getattr(self._stream, name)

    def write(self, text: str) -> int:
        """Write what can be written."""
        if not self._closed:
            try:
                try:
                    self._stream.write(text)
                except UnicodeEncodeError:
                    encoding = getattr(self._stream, "encoding", None) or "ascii"
                    self._stream.write(text.encode(encoding, "replace").decode(encoding))
            except (OSError, ValueError):  # ValueError of a stream that was closed here
                self._give_up()
        return len(text)

    def flush(self) -> None:
        """Flush, if there is anybody left."""
        if not self._closed:
            try:
                self._stream.flush()
            except (OSError, ValueError):
                self._give_up()

    def _give_up(self) -> None:
        self._closed = True
        if self._stream in (sys.__stdout__, sys.__stderr__):
            # What Python still holds would be written as the program ends, and raise then.
            with contextlib.suppress(OSError, ValueError):
                nowhere = os.open(os.devnull, os.O_WRONLY)
                os.dup2(nowhere, self._stream.fileno())
                os.close(nowhere)


@contextlib.contextmanager
def safe_output():
    """Has everything that is printed meanwhile go through safe streams."""
    streams = [cast(TextIO, SafeStream(stream)) for stream in (sys.stdout, sys.stderr)]
    with contextlib.redirect_stdout(streams[0]), contextlib.redirect_stderr(streams[1]):
        try:
            yield
        finally:
            for stream in streams:
                stream.flush()
