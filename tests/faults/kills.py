"""Real runs whose processes are killed at random moments, again and again, and resumed.

A run that was killed and resumed must end with the same metrics and the same last checkpoint, to
the byte, as one that was not.
"""

import os
import random
import signal
import time
from dataclasses import dataclass, field
from pathlib import Path

from dreamer_jax.checkpoint import Checkpointer
from tests.faults.processes import start

LONG = ("--preset", "debug", "--environment-steps", "600", "--evaluate-every", "120")
KINDS = {
    "one task": ("--task", "bullet/inverted_pendulum"),
    "two tasks": ("--task", "bullet/inverted_pendulum", "bullet/hopper"),
    "population": ("--task", "bullet/inverted_pendulum", "--seeds", "0", "1", "2"),
    "old records deleted": ("--task", "bullet/inverted_pendulum", "--replay-keep", "50"),
    "device": ("--task", "bullet/inverted_pendulum", "--replay", "device"),
    "beside": ("--task", "bullet/inverted_pendulum", "--replay", "device", "--collect", "beside"),
    "uae": ("--task", "bullet/inverted_pendulum", "--method", "uae", "--source", "{source}"),
    "meta": ("--task", "bullet/inverted_pendulum", "--method", "meta", "--source", "{source}")
    + ("--reward-sources", "{uae}"),
    "gymnasium": ("--task", "gymnasium/CartPole-v1", "--action-repeat", "1"),
    "brax": ("--task", "brax/inverted_pendulum"),
}
"""Arguments of a run of each kind."""

TARGETS = ("trainer", "worker", "both")


@dataclass
class Outcome:
    """What became of the kills of one kind of run."""

    kills: int = 0
    chains: int = 0
    different: list[str] = field(default_factory=list)


def arguments(kind: str, out: Path, base: Path) -> list[str]:
    """The arguments of the command that trains a run of a kind, or goes on with it."""
    places = {"source": base / "one task", "uae": base / "uae"}
    words = [word.format(**places) for word in KINDS[kind]]
    return ["train", *words, *LONG, "--out", str(out), "--resume"]


def train(kind: str, out: Path, base: Path, cache: Path) -> None:
    """Trains a whole run.

    Raises:
      RuntimeError: it failed; with its output.
    """
    log = base / f"{out.name}.log"
    process = start(arguments(kind, out, base), cache, log)
    process.join()
    if process.exitcode:
        raise RuntimeError(f"{kind}: exit code {process.exitcode}\n{log.read_text()}")


def workers(pid: int) -> list[int]:
    """The processes that a process has started."""
    children = Path(f"/proc/{pid}/task/{pid}/children")
    return [int(word) for word in children.read_text().split()] if children.exists() else []


def kill_once(
    kind: str, out: Path, base: Path, cache: Path, target: str, chance: random.Random
) -> bool:
    """Starts or resumes a run and kills it at a random moment.

    Returns:
      Whether it was killed; not if it came to its end before.
    """
    process = start(arguments(kind, out, base), cache)
    # Starting takes the larger part of the time, so most kills wait for a sign of life.
    if chance.random() < 0.8:
        before = _size(out)
        while process.is_alive() and _size(out) == before:
            time.sleep(0.005)
        delay = chance.expovariate(1 / 1.5)
    else:
        delay = chance.uniform(0, 10)
    deadline = time.monotonic() + delay
    while process.is_alive() and time.monotonic() < deadline:
        time.sleep(0.002)
    if not process.is_alive():
        return False
    victims = workers(process.pid) if target != "trainer" else []
    for victim in [*victims[:1], *([process.pid] if target != "worker" else [])]:
        try:
            os.kill(victim, signal.SIGKILL)
        except ProcessLookupError:
            pass
    if target == "worker" and not victims:  # none yet, or the physics is in the program
        process.kill()
    process.join()
    return True


def _size(out: Path) -> int:
    files = [out / "metrics.jsonl", *out.glob("replay/*/*.records")]
    return sum(path.stat().st_size for path in files if path.exists())


def same(one: Path, other: Path) -> str | None:
    """What differs between two finished runs, if anything."""
    if (one / "metrics.jsonl").read_bytes() != (other / "metrics.jsonl").read_bytes():
        return "metrics.jsonl"
    folders = [Checkpointer(run / "checkpoints") for run in (one, other)]
    if folders[0].latest() != folders[1].latest():
        return "the last checkpoint's step"
    leaves = [(x.path(x.latest()) / "leaves.json").read_bytes() for x in folders]
    metadata = [x.metadata() for x in folders]
    if leaves[0] != leaves[1]:  # every leaf's checksum is in it
        return "the last checkpoint's arrays"
    return None if metadata[0] == metadata[1] else "the last checkpoint's metadata"


def chain(
    kind: str, out: Path, base: Path, cache: Path, most: int, chance: random.Random
) -> tuple[int, str | None]:
    """Kills one run up to `most` times, lets it finish, and compares it with the whole one."""
    kills = 0
    while kills < most:
        target = chance.choice(TARGETS)
        if not kill_once(kind, out, base, cache, target, chance):
            break
        kills += 1
    train(kind, out, base, cache)
    return kills, same(base / kind, out)


def kill_runs(
    kinds, count: int, folder: Path, seed: int = 0, seconds: float = float("inf"), say=print
) -> dict[str, Outcome]:
    """Kills runs of some kinds `count` times each, or until the time is up."""
    base, cache = folder / "whole", folder / "cache"
    base.mkdir(parents=True, exist_ok=True)
    deadline, outcomes = time.monotonic() + seconds, {}
    needed = {"uae": ["one task"], "meta": ["one task", "uae"]}
    wholes = [name for kind in kinds for name in [*needed.get(kind, []), kind]]
    for name in dict.fromkeys(wholes):
        train(name, base / name, base, cache)
        say(f"{name}: the whole run is there")
    outcomes = {kind: Outcome() for kind in kinds}
    number = 0
    while any(one.kills < count for one in outcomes.values()) and time.monotonic() < deadline:
        for kind, outcome in outcomes.items():
            left = count - outcome.kills
            if left <= 0 or time.monotonic() > deadline:
                continue
            number += 1
            out = folder / f"killed-{seed}-{number}"
            chance = random.Random(f"{seed} {number}")
            kills, difference = chain(kind, out, base, cache, min(left, 8), chance)
            outcome.kills += kills
            outcome.chains += 1
            if difference:
                outcome.different.append(f"{out}: {difference}")
            say(f"{kind}: {outcome.kills} kills, {len(outcome.different)} different")
    return outcomes
