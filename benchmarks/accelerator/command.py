"""The command: parts one after another, each in a process of its own, until the time is up.

python -m benchmarks accelerator [--peer /path/to/python] [--peak-tflops 494 989]
"""

import contextlib
import importlib.util
import json
import os
import queue
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import tyro

from benchmarks.accelerator.plan import MINUTES, SIZES, Part, parts
from benchmarks.accelerator.results import MismatchError, Results
from benchmarks.accelerator.table import number
from dreamer_jax.ranges import check_ranges, setting
from experiments.cli.main import repeat_on_cards

GRACE_SECONDS, SAVING_SECONDS = 10.0, 60.0
"""What a process has to end, once it was asked to, and what one has that saves."""

MEASURES = [sys.executable, "-m", "benchmarks.accelerator.measures"]
"""The program that measures a part."""

NO_PEER = "no Python with PyTorch was found: name one with --peer /path/to/python"
LATE = "not begun: the time was up; the same command goes on with it"


@dataclass(frozen=True)
class Options:
    """Measure a card: updates of populations, the peer in PyTorch beside them, rollouts, rounds as
    one program, and a run that learns.

    Results are written after every case, as JSON and as a table in Markdown beside it. Cases that
    fail are told in words, and the rest goes on. The same command again measures what has no
    figures yet.
    """

    out: Path = Path("runs/accelerator.json")
    """The file of results. The table is beside it, and so is the folder of the run that learns."""
    sizes: Literal["thesis", "debug"] = "thesis"
    """debug: everything as small as can be, to see that it works."""
    minutes: float = setting(MINUTES, 0, 10_000, above=True)
    """All of it takes no longer; more than a third of it is for the run that learns."""
    peer: str | None = None
    """A Python with PyTorch and NumPy, in which the peer runs; by default this one, if it has
    them."""
    peak_tflops: tuple[float, float] | None = None
    """How many operations the card does at most, in 10^12 a second: in float32, as JAX multiplies
    it there (TensorFloat-32 on NVIDIA cards), and in bfloat16. By default from a list of cards."""


class Failed(Exception):
    """A process ended, or was ended, before it had told of all of its cases; says why."""


def main(arguments: Sequence[str]) -> int:
    """Measures, and returns the exit code."""
    options = tyro.cli(Options, args=arguments, prog="python -m benchmarks accelerator")
    repeat_on_cards()  # as the command line trains
    try:
        check_ranges(options)
        results = Results(options.out, options.sizes, options.peak_tflops)
    except ValueError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    try:
        Command(options, results).measure()
    except MismatchError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print(f"stopped: {options.out} holds what was measured; the same command goes on")
        return 130
    print(f"\n{results.table_path.read_text(encoding='utf-8')}")
    print(f"wrote {results.path} and {results.table_path}")
    rows = results.values["rows"]
    if failed := [f"{row['part']}, {row['case']}" for row in rows if "failure" in row]:
        print(f"without figures: {'; '.join(failed)}: the same command tries again")
    return 1 if failed else 0


class Command:
    """One start of the command.

    Args:
      options: what was asked for.
      results: where rows go, and which there are.
    """

    def __init__(self, options: Options, results: Results):
        self._options, self._results = options, results
        self._sizes = SIZES[options.sizes]
        self._began = time.monotonic()

    def measure(self) -> None:
        """Measures what is missing.

        Raises:
          MismatchError: what is there was measured on something else.
          KeyboardInterrupt: stopped by Ctrl-C.
        """
        minutes = self._options.minutes
        self._say(f"sizes {self._options.sizes}, at most {minutes:g} minutes")
        until = 0.0
        for part in parts(self._sizes):
            # What a part leaves of its time the next ones have.
            until += part.share * 60 * minutes
            if cases := self._results.missing(part):
                self._measure_part(part, cases, until)
        self._results.write()

    def _say(self, words: str) -> None:
        passed = int(time.monotonic() - self._began)
        print(f"{passed // 60:2d}:{passed % 60:02d}  {words}", flush=True)

    def _measure_part(self, part: Part, cases: Sequence[str], until: float) -> None:
        """Measures cases of a part; each ends with a row."""
        if part.name == "peer" and self._peer() is None:
            self._say(f"peer: skipped, {NO_PEER}")
            for case in cases:
                self._results.add(part.name, case, "skipped", NO_PEER)
            return
        left = list(cases)
        while left and (seconds := self._began + until - time.monotonic()) > 1:
            self._say(f"{part.name}: {', '.join(left)}; at most {number(seconds)} s")
            begun: str | None = None
            try:
                for event in self._events(part, left, seconds):
                    if "machine" in event:
                        self._results.on(event["machine"])
                    elif "told" in event:
                        self._say(f"  {event['told']}")
                    elif "begins" in event:
                        begun = event["begins"]
                        self._say(f"  {begun} …")
                    else:
                        left.remove(event["case"])
                        begun = None
                        kind = "figures" if "figures" in event else "failure"
                        self._results.add(part.name, event["case"], kind, event[kind])
                        self._say(f"  {event['case']}: {_in_short(event)}")
            except Failed as error:
                # Of a process that began nothing there is no more to hope for.
                for case in [begun] if begun is not None else list(left):
                    left.remove(case)
                    self._results.add(part.name, case, "failure", str(error))
                    self._say(f"  {case}: {error}")
        for case in left:
            self._results.add(part.name, case, "failure", LATE)
            self._say(f"  {part.name}, {case}: {LATE}")

    def _peer(self) -> str | None:
        """The Python of the peer."""
        if self._options.peer is not None:
            return self._options.peer
        return sys.executable if importlib.util.find_spec("torch") else None

    def _events(self, part: Part, cases: Sequence[str], seconds: float) -> Iterator[dict[str, Any]]:
        """What a process tells that measures cases of a part.

        Raises:
          Failed: it ended before it had told of all, or the time was up.
        """
        out = self._options.out
        request = {
            "sizes": self._options.sizes,
            "cases": list(cases),
            "peer": self._peer(),
            # The run that learns does not have what other parts leave.
            "seconds": part.share * 60 * self._options.minutes,
            "until": time.time() + seconds,
            "folder": str(out.with_name(f"{out.stem}-learning").absolute()),
        }
        # The run that learns ends by itself before its time is up.
        limit, grace = seconds, GRACE_SECONDS
        if part.name == "learning":
            limit, grace = seconds + SAVING_SECONDS, SAVING_SECONDS
        with tempfile.TemporaryFile("w+") as errors:
            process = subprocess.Popen(
                [*MEASURES, part.name, json.dumps(request)],
                stdout=subprocess.PIPE,
                stderr=errors,
                text=True,
                env=self._environment(part),
                # Ctrl-C is for this process, which passes it on once.
                start_new_session=True,
            )
            with _ended(process, grace):
                told = 0
                for line in _lines(process, limit):
                    event = json.loads(line)
                    told += "case" in event
                    yield event
            if told < len(cases):
                raise Failed(_ending(process.returncode, errors))

    def _environment(self, part: Part) -> dict[str, str]:
        """Of the process that measures a part."""
        if part.name != "peer":
            return dict(os.environ)
        # Both of them are on the card at once.
        return {**os.environ, "XLA_PYTHON_CLIENT_PREALLOCATE": "false"}


def _lines(process: subprocess.Popen, seconds: float) -> Iterator[str]:
    """The lines that a process writes.

    Raises:
      Failed: it has not ended after so many seconds.
    """
    found: queue.Queue[str | None] = queue.Queue()

    def read():
        with process.stdout:
            for line in process.stdout:
                found.put(line)
        found.put(None)

    threading.Thread(target=read, daemon=True).start()
    until = time.monotonic() + seconds
    while True:
        try:
            line = found.get(timeout=max(0.0, until - time.monotonic()))
        except queue.Empty:
            raise Failed(
                "not done when the time was up; the same command tries again (--minutes gives it "
                "more)"
            ) from None
        if line is None:
            return
        yield line


@contextlib.contextmanager
def _ended(process: subprocess.Popen, grace: float) -> Iterator[None]:
    """A process that has ended afterwards: asked to if something is wrong, and killed at last.

    Args:
      process: the process.
      grace: seconds that it has to end.
    """
    try:
        yield
    except BaseException:
        process.send_signal(signal.SIGINT)
        raise
    finally:
        try:
            process.wait(grace)
        except (subprocess.TimeoutExpired, KeyboardInterrupt):
            process.kill()
            process.wait()


def _ending(code: int, errors) -> str:
    """How a process ended, in words."""
    if code < 0:
        name = signal.Signals(-code).name
        why = ", perhaps for want of memory" if name == "SIGKILL" else ""
        return f"its process was ended by {name}{why}"
    errors.seek(0)
    lines = [line.strip() for line in errors if line.strip()]
    return f"its process ended with code {code}: {lines[-1] if lines else 'nothing was said'}"[:300]


def _in_short(event: dict[str, Any]) -> str:
    """What came of a case, for a line of progress."""
    if "failure" in event:
        return event["failure"]
    figures = event["figures"]
    for name, unit in (
        ("member_updates_per_second", "member updates a second"),
        ("ratio", "of PyTorch's time"),
        ("agent_steps_per_second", "agent steps a second"),
        ("seconds_per_round", "s for a round"),
    ):
        if name in figures:
            at_once = f", {figures['mapped']}" if "mapped" in figures else ""
            return f"{number(figures[name])} {unit}{at_once}"
    return f"{figures['env_steps']:,} environment steps, ended {figures['ended']}"
