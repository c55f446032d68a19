"""The process that measures one part: lines of JSON on its output, as things happen.

    python -m benchmarks.accelerator.measures PART '{"sizes": "debug", "cases": ["P=1"], ...}'

A line is {"machine": ...}, then for each case {"begins": case}, perhaps {"told": words}, and at
last {"case": case, "figures": {...}} or {"case": case, "failure": words}. A process of its own, for
peaks of memory are a process's, and what ends it takes nothing else along.

Axis letters: P population member, T agent steps of a phase.
"""

import dataclasses
import gc
import json
import math
import os
import platform
import shlex
import signal
import statistics
import sys
import tempfile
import threading
import time
import traceback
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import jax
import numpy as np

import envs
from benchmarks.accelerator.plan import LEARNING_TASK, ONE_PROGRAM, SIZES, Sizes, members_of
from benchmarks.beside import line_of
from benchmarks.brax import Rollout
from benchmarks.update import Updates, peak_bytes
from dreamer_jax.agent import Agent
from dreamer_jax.config import Config, preset
from dreamer_jax.host_memory import keep_freed_memory
from dreamer_jax.logs import read_metrics
from envs.pool import available_cores
from experiments.runs.memory import MEMORY_SHARE, bytes_of, even_chunk, in_memory, is_exhausted
from experiments.runs.run import carry_out, make_run, revision
from experiments.runs.spec import RunSpec
from experiments.thesis.measurement import operations

REFERENCE = Path(__file__).parents[2] / "tests" / "golden" / "pytorch_reference.py"
MOST = 50
"""What is timed is repeated no more often than this."""

SAVING_SECONDS = 10.0
"""How long before the end of its time a run that learns is asked to save."""

Say = Callable[[dict[str, Any]], None]


class NoRoomError(MemoryError):
    """A program needs more memory than the device has, by the compiler's count."""


class StoppedError(RuntimeError):
    """Whoever waits asked for an end, and what there was is saved."""


def own_output() -> Say:
    """What tells the process that waits; all else that is printed goes to the standard error."""
    stream = os.fdopen(os.dup(1), "w")
    os.dup2(2, 1)

    def say(event: dict[str, Any]) -> None:
        stream.write(json.dumps(event) + "\n")
        stream.flush()

    return say


def machine() -> dict[str, Any]:
    """What figures are figures of."""
    device = jax.devices()[0]
    return {
        "card": device.device_kind,
        "platform": device.platform,
        "devices": len(jax.devices()),
        "memory_bytes": memory_limit(),
        "cores": available_cores(),
        "python": platform.python_version(),
        "jax": jax.__version__,
        "revision": revision(),
        "xla_flags": os.environ.get("XLA_FLAGS", ""),
        "matmul_precision": jax.config.jax_default_matmul_precision or "default",
        "compilation_cache": jax.config.jax_compilation_cache_dir is not None,
    }


def memory_limit() -> int:
    """Bytes that the device allows; on a CPU those that are free."""
    limit = (jax.devices()[0].memory_stats() or {}).get("bytes_limit")
    return limit or os.sysconf("SC_AVPHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")


def repeated(function: Callable[[], float], seconds: float) -> float:
    """The median of what a function returns, which is seconds.

    Args:
      function: what is timed.
      seconds: how long it is repeated; three times at least.
    """
    taken: list[float] = []
    while len(taken) < 3 or (sum(taken) < seconds and len(taken) < MOST):
        taken.append(function())
    return statistics.median(taken)


def timed(function: Callable[[], Any]) -> float:
    """Seconds of a call."""
    started = time.perf_counter()
    function()
    return time.perf_counter() - started


def action_size(sizes: Sizes) -> int:
    """A of what the agents play."""
    return envs.spec(sizes.task).action_size


class UpdatePart:
    """Updates of populations: all members at once, or in chunks where memory does not allow it."""

    def __init__(self, sizes: Sizes, request: dict[str, Any], precision: str):
        config = preset(sizes.preset)
        network = dataclasses.replace(config.network, precision=precision)
        self.agent = Agent(dataclasses.replace(config, network=network), action_size(sizes))
        self._sizes = sizes
        self._working_bytes: int | None = None

    def __call__(self, case: str, say: Say) -> dict[str, Any]:
        members = members_of(case)
        tried: list[str] = []
        for chunk in self._chunks(members):
            way = "vmap" if chunk == members else f"chunks of {chunk}"
            try:
                figures = self._measured(members, chunk)
            except Exception as error:
                if not (isinstance(error, NoRoomError) or is_exhausted(error)):
                    raise
                tried.append(way)
                say({"told": f"{way}: no memory for it"})
            else:
                return {"P": members, "mapped": way, **figures, "without_memory": tried}
            # What failed is let go of only here, where its trace is.
            gc.collect()
        raise NoRoomError(f"no memory for any of {', '.join(tried)}")

    def _chunks(self, members: int) -> Iterator[int]:
        """Numbers of members at once to try, until there is memory for one of them."""
        # Far too many are not even compiled.
        if members == 1 or self._fitting(members, 1.3) >= members:
            yield members
        fits = min(self._fitting(members, 1.0), members - 1)
        while fits:
            yield even_chunk(members, fits)  # as runs choose them
            fits //= 2

    def _fitting(self, members: int, times: float) -> int:
        """How many members' updates fit into so many times the memory, by that of one's."""
        if self._working_bytes is None:
            return members
        beside = bytes_of(self.agent, 1, members, 0, 0)
        room = times * MEMORY_SHARE * memory_limit() - beside
        return max(1, min(members, int(room // self._working_bytes)))

    def _measured(self, members: int, chunk: int) -> dict[str, Any]:
        mapping = "vmap" if chunk == members else "chunks"
        updates = Updates(self.agent.config, self.agent.action_size, members, mapping, chunk)
        self._working_bytes = max(1, updates.working_bytes // chunk)
        if updates.program_bytes > memory_limit():
            raise NoRoomError(f"{updates.program_bytes} bytes are more than there are")
        updates()  # the first one allocates
        seconds = repeated(updates, self._sizes.seconds)
        return {
            "chunk": chunk,
            "seconds_per_update": seconds,
            "member_updates_per_second": members / seconds,
            "operations": operations(self.agent),
            "compile_seconds": updates.compile_seconds,
            "peak_bytes": peak_bytes(),
            "program_bytes": updates.program_bytes,
        }


class PeerPart:
    """The update of one member in float32 beside the project's own in PyTorch, in turns."""

    def __init__(self, sizes: Sizes, request: dict[str, Any]):
        self._config, self._actions = preset(sizes.preset), action_size(sizes)
        self._sizes, self._python = sizes, request["peer"]

    def __call__(self, case: str, say: Say) -> dict[str, Any]:
        device = {"cpu": "cpu", "gpu": "cuda"}.get(jax.default_backend())
        if device is None:
            raise ValueError(f"the peer in PyTorch does not run on {jax.default_backend()}")
        words = reference_words(self._config, self._actions)
        reference = shlex.quote(str(REFERENCE))
        command = f"{self._python} {reference} time {words} n=3 device={device}"
        first = self._line(command)  # whether it runs at all, before anything is compiled
        updates = Updates(self._config, self._actions, members_of(case))
        updates()
        ours, peers = [], []
        for turn in range(self._sizes.turns):
            ours.append(repeated(updates, self._sizes.seconds))
            peers.append(self._line(command)["s_per_update"])
            say({"told": f"turn {turn + 1}: {ours[-1]:.3g} s, PyTorch {peers[-1]:.3g} s"})
        return {
            "P": 1,
            "seconds_per_update": statistics.median(ours),
            "peer_seconds_per_update": statistics.median(peers),
            "ratio": statistics.median(a / b for a, b in zip(ours, peers, strict=True)),
            "torch": first["torch"],
            "peer_on": first["on"],
        }

    def _line(self, command: str) -> dict[str, Any]:
        try:
            return line_of(command)
        except (RuntimeError, OSError) as error:
            # Of a trace the last line says what it was.
            raise RuntimeError(f"{self._python}: {str(error).strip().splitlines()[-1]}") from error


def reference_words(config: Config, actions: int) -> str:
    """Sizes of an update as the reference in PyTorch is told them."""
    network, learning = config.network, config.learning
    values = {
        "depth": network.encoder_depth,
        "deter": network.deterministic_size,
        "stoch": network.stochastic_size,
        "units": network.head_units,
        "B": learning.batch_size,
        "L": learning.sequence_length,
        "H": learning.horizon,
        "A": actions,
        "image": network.image_size,
    }
    return " ".join(f"{name}={value}" for name, value in values.items())


class RolloutPart:
    """Phases of a Brax task in the graph: physics, pictures, policy and records."""

    def __init__(self, sizes: Sizes, request: dict[str, Any]):
        self._sizes = sizes

    def __call__(self, case: str, say: Say) -> dict[str, Any]:
        members, sizes = members_of(case), self._sizes
        rollout = Rollout(sizes.task, preset(sizes.preset), members, sizes.ticks)
        try:
            rollout.play()
            seconds = repeated(lambda: timed(rollout.play), sizes.seconds)
        finally:
            rollout.close()
        return {
            "P": members,
            "task": sizes.task,
            "agent_steps_per_second": members * sizes.ticks / seconds,
            "compile_seconds": rollout.compile_seconds,
            "peak_bytes": peak_bytes(),
        }


class RoundPart:
    """Rounds of one member's run, as one program each and with a dispatch for each update."""

    def __init__(self, sizes: Sizes, request: dict[str, Any]):
        self._sizes = sizes

    def __call__(self, case: str, say: Say) -> dict[str, Any]:
        sizes, config = self._sizes, preset(self._sizes.preset)
        schedule = dataclasses.replace(
            config.schedule,
            environment_steps=(1 + sizes.rounds) * config.schedule.phase_environment_steps,
            prefill_phases=1,
            evaluate_every=10**12,
            checkpoint_every=10**12,
            replay="device" if case == ONE_PROGRAM else "files",
        )
        spec = RunSpec((sizes.task,), (0,), dataclasses.replace(config, schedule=schedule))
        with tempfile.TemporaryDirectory() as folder:
            run = make_run(spec, Path(folder) / "run", devices=1)
            started = time.time()
            carry_out(run)
            rows = read_metrics(Path(folder) / "run" / "timings.jsonl")
        # When the updates of each round were done; the first round compiled.
        ends = {row["env_steps"]: row["time"] for row in rows if row.get("updates")}
        moments = list(ends.values())
        seconds = statistics.median(np.diff(moments).tolist())
        updates, ticks = schedule.updates_per_phase, schedule.phase_ticks
        return {
            "P": 1,
            "task": sizes.task,
            "agent_steps": ticks,
            "updates": updates,
            "seconds_per_round": seconds,
            "first_round_seconds": moments[0] - started,
            "updates_per_second": updates / seconds,
            "peak_bytes": peak_bytes(),
        }


class LearningPart:
    """A run that learns, through the code that trains every run, for as long as it may."""

    def __init__(self, sizes: Sizes, request: dict[str, Any]):
        self._sizes, self._folder = sizes, Path(request["folder"])
        self._seconds, self._until = request["seconds"], request["until"]

    def __call__(self, case: str, say: Say) -> dict[str, Any]:
        spec = RunSpec((LEARNING_TASK,), self._sizes.seeds, preset(self._sizes.learning))
        run = make_run(in_memory(spec, 1), self._folder, resume=True, devices=1)
        write = run.writer.write

        def telling(row):
            write(row)
            if row["kind"] == "evaluation":
                say({"told": f"{row['env_steps']:,} steps, {row['label']}, seed {row['seed']}: "
                             f"return {row['return']:.0f}"})  # fmt: skip

        run.writer.write = telling
        out_of_time = threading.Event()

        def stop():
            # The first Ctrl-C saves.
            out_of_time.set()
            os.kill(os.getpid(), signal.SIGINT)

        left = min(self._seconds - spent(self._folder), self._until - SAVING_SECONDS - time.time())
        timer = threading.Timer(max(1.0, left), stop)
        timer.daemon = True
        timer.start()
        outcome = carry_out(run)
        timer.cancel()
        if outcome == "stopped" and not out_of_time.is_set():
            raise StoppedError("stopped, and saved: the same command goes on")
        return {
            "task": LEARNING_TASK,
            "preset": self._sizes.learning,
            "seeds": self._sizes.seeds,
            "ended": "at its end" if outcome == "finished" else "by the clock",
            "seconds": spent(self._folder),
            "env_steps": run.schedule.environment_steps(run.counters.rounds),
            "updates": run.counters.updates,
            "evaluations": evaluations(self._folder),
            "peak_bytes": peak_bytes(),
        }


def spent(folder: Path) -> float:
    """Seconds that a run has trained."""
    path = folder / "timings.jsonl"
    return sum(row["seconds"] for row in read_metrics(path)) if path.exists() else 0.0


def evaluations(folder: Path) -> list[dict[str, Any]]:
    """What a run reached, and when: seconds of training up to each evaluation, and returns."""
    rows = [row for row in read_metrics(folder) if row["kind"] == "evaluation"]
    found: dict[int, dict[str, Any]] = {}
    for row in rows:
        steps = row["env_steps"]
        one = found.setdefault(
            steps, {"env_steps": steps, "updates": row["updates"], "returns": []}
        )
        # That of an agent that failed is no number.
        one["returns"].append(row["return"] if math.isfinite(row["return"]) else None)
    trained = 0.0
    for row in read_metrics(folder / "timings.jsonl"):
        trained += row["seconds"]
        if row["kind"] == "evaluate" and row["env_steps"] in found:
            found[row["env_steps"]]["seconds"] = trained
    return list(found.values())


def make_part(name: str, sizes: Sizes, request: dict[str, Any]):
    """What measures the cases of a part."""
    kind, _, precision = name.partition(" ")
    if kind == "update":
        return UpdatePart(sizes, request, precision)
    kinds = {"peer": PeerPart, "rollout": RolloutPart, "round": RoundPart}
    return {**kinds, "learning": LearningPart}[kind](sizes, request)


def in_words(error: BaseException) -> str:
    """An error in one line."""
    first, *_ = str(error).strip().splitlines() or [""]
    return f"{type(error).__name__}: {first}"[:300]


def main(name: str, request: dict[str, Any]) -> None:
    """Measures a part's cases."""
    say = own_output()
    # As the command line does.
    keep_freed_memory()
    say({"machine": machine()})
    part = make_part(name, SIZES[request["sizes"]], request)
    for case in request["cases"]:
        say({"begins": case})
        try:
            figures = part(case, say)
        except Exception as error:
            traceback.print_exc()
            say({"case": case, "failure": in_words(error)})
        else:
            say({"case": case, "figures": figures})
        gc.collect()


if __name__ == "__main__":
    main(sys.argv[1], json.loads(sys.argv[2]))
