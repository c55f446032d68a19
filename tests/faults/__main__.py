"""python -m tests.faults: kills, damage, hostile environments, full disks, two writers.

Prints for each how many there were, and how many ended as they must. Exit code 1 if one did not.
"""

import argparse
import sys
import tempfile
from pathlib import Path

from tests.faults import commits, damages, hostile, kills, others

PARTS = ("commits", "kills", "disks", "writers", "damages", "hostile")
# Damages and hostile environments come last: they use JAX in this process, which then has threads.


def main() -> int:
    """Runs the parts asked for."""
    parser = argparse.ArgumentParser(prog="python -m tests.faults", description=__doc__)
    parser.add_argument("parts", nargs="*", choices=[[], *PARTS], help="by default all")
    parser.add_argument("--kills", type=int, default=100, help="of each kind of run")
    parser.add_argument("--kinds", nargs="*", choices=list(kills.KINDS), default=list(kills.KINDS))
    parser.add_argument("--minutes", type=float, default=float("inf"), help="for kills, at most")
    parser.add_argument("--damages", type=int, default=300)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--folder", type=Path, help="kept; by default a temporary one")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as temporary:
        folder = options.folder or Path(temporary)
        lines, bad = [], 0
        for part in options.parts or PARTS:
            for line, failures in _PARTS[part](options, folder):
                lines.append(line)
                bad += len(failures)
                for failure in failures:
                    print(f"FAILED: {failure}", flush=True)
    print("\n".join(["", *lines]))
    return 1 if bad else 0


def _commits(options, folder):
    outcome = commits.kill_commits(options.kills, folder / "commits", options.seed)
    identical = outcome.chains - len(outcome.different)
    yield (
        f"commits: {outcome.kills} kills in {outcome.chains} folders, {identical} of them resumed "
        "to the same end, byte for byte",
        outcome.different,
    )


def _kills(options, folder):
    found = kills.kill_runs(
        options.kinds, options.kills, folder / "kills", options.seed, 60 * options.minutes, _say
    )
    for kind, outcome in found.items():
        identical = outcome.chains - len(outcome.different)
        yield (
            f"{kind}: {outcome.kills} kills in {outcome.chains} runs, {identical} of them resumed "
            "to the same end, byte for byte",
            outcome.different,
        )


def _damages(options, folder):
    outcome = damages.damage_folders(options.damages, folder / "damages", options.seed)
    yield (
        f"damages: {options.damages} tried, {outcome.told} told clearly, {outcome.harmless} "
        f"without any effect, {len(outcome.silent)} silent; verify names {outcome.verified}",
        outcome.silent,
    )


def _hostile(options, folder):
    silent = []
    for name in hostile.HOSTILE:
        said = hostile.play(name, timeout=5.0 if name in hostile.SLOW else 300.0)
        if not hostile.is_clear(name, said):
            silent.append(f"{name}: {said}")
    count = len(hostile.HOSTILE)
    yield f"hostile environments: {count} tried, {count - len(silent)} told clearly", silent


def _disks(options, folder):
    base, cache = _whole(folder)
    rooms = (40, 300, 900, 1500)
    told = [others.fill_disk("one task", base, cache, room) for room in rooms]
    if "" in told:
        yield "full disks: none tried, as no small file system may be mounted here", []
        return
    silent = [f"{room} KiB of room" for room, said in zip(rooms, told, strict=True) if said is None]
    yield f"full disks: {len(rooms)} tried, {len(rooms) - len(silent)} told and resumed", silent


def _writers(options, folder):
    base, cache = _whole(folder)
    said = others.two_writers("one task", folder / "two", base, cache)
    yield "two writers: 1 tried", [] if said else ["the second one was not told"]


def _whole(folder: Path) -> tuple[Path, Path]:
    base, cache = folder / "kills" / "whole", folder / "kills" / "cache"
    base.mkdir(parents=True, exist_ok=True)
    kills.train("one task", base / "one task", base, cache)
    return base, cache


def _say(text: str) -> None:
    print(text, flush=True)


_PARTS = dict(zip(PARTS, (_commits, _kills, _disks, _writers, _damages, _hostile), strict=True))

if __name__ == "__main__":
    sys.exit(main())
