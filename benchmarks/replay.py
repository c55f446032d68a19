"""Memory and speed of the replay at full size: a million environment steps of each member.

    python -m benchmarks.replay [records=500000] [P=3] [image_size=64] [actions=8] [B=50] [L=50]
                                [batches=50] [threads=0] [keep=0] [directory=/tmp]

Writes random records into a new folder in `directory` (18 GB by default), samples batches from
them, and removes the folder. Prints one line of JSON: "anonymous_gib" is by how much the memory of
the process grew that no file stands behind, at its largest; "seconds_per_batch" are of one batch
for all members, put together by so many `threads` (0: as a run does by itself), "cold" right after
the page cache was told to drop the files, "warm" after as many batches of other places in them.
With keep=1 freed memory is kept, as a run does: batches then take no new pages, and the last one's
memory counts as grown.
"""

from __future__ import annotations

import json
import os
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

from dreamer_jax.host_memory import keep_freed_memory
from dreamer_jax.records import Records
from dreamer_jax.replay import Replay

DEFAULTS = {
    "records": 500_000,
    "P": 3,
    "image_size": 64,
    "actions": 8,
    "B": 50,
    "L": 50,
    "batches": 50,
    "threads": 0,
    "keep": 0,
    "directory": tempfile.gettempdir(),
}
PHASE = 1000


def anonymous_bytes() -> int:
    """Memory of this process that no file stands behind."""
    status = Path("/proc/self/status").read_text()
    line = next(line for line in status.splitlines() if line.startswith("RssAnon"))
    return int(line.split()[1]) * 1024


def fill(replay: Replay, records: int) -> int:
    """Appends random records to every stream; returns the most anonymous memory seen."""
    random = np.random.default_rng(0)
    image, action = replay.dtype["image"].shape, replay.dtype["action"].shape
    largest = 0
    for start in range(0, records, PHASE):
        shape = (replay.members, replay.tasks, min(PHASE, records - start))
        replay.append(
            Records(
                image=np.frombuffer(random.bytes(int(np.prod(shape + image))), np.uint8).reshape(
                    shape + image
                ),
                action=random.random((*shape, *action), np.float32),
                reward=random.random(shape, np.float32),
                first=np.zeros(shape, bool),
                terminal=np.zeros(shape, bool),
            )
        )
        largest = max(largest, anonymous_bytes())
    return largest


def drop_from_page_cache(replay: Replay) -> None:
    """Asks the system to read the files from the disk the next time."""
    for member in range(replay.members):
        with open(replay.path(member, 0), "rb") as file:
            os.fsync(file.fileno())
            os.posix_fadvise(file.fileno(), 0, 0, os.POSIX_FADV_DONTNEED)


def sample(replay: Replay, updates: range, batch: int, length: int) -> tuple[float, int]:
    """Median seconds of a batch, and the most anonymous memory seen."""
    seconds, largest = [], 0
    for update in updates:
        start = time.perf_counter()
        replay.sample(range(replay.members), update, batch, length)
        seconds.append(time.perf_counter() - start)
        largest = max(largest, anonymous_bytes())
    return float(np.median(seconds)), largest


def main(arguments: list[str]) -> None:
    """Measure and print; `arguments` are name=value pairs that replace the defaults."""
    given = dict(argument.split("=", 1) for argument in arguments)
    if unknown := given.keys() - DEFAULTS.keys():
        sys.exit(f"got {sorted(unknown)}, expected names among {list(DEFAULTS)}")
    settings = DEFAULTS | {name: type(DEFAULTS[name])(value) for name, value in given.items()}
    batch, length, batches = settings["B"], settings["L"], settings["batches"]
    if settings["keep"]:
        keep_freed_memory()
    with tempfile.TemporaryDirectory(dir=settings["directory"]) as directory:
        replay = Replay(
            directory,
            settings["P"],
            1,
            settings["image_size"],
            settings["actions"],
            threads=settings["threads"] or None,
        )
        before, start = anonymous_bytes(), time.perf_counter()
        most_filling = fill(replay, settings["records"])
        filled = time.perf_counter() - start
        drop_from_page_cache(replay)
        cold, most_cold = sample(replay, range(batches), batch, length)
        warm, most_warm = sample(replay, range(batches, 2 * batches), batch, length)
        stored = sum(replay.path(member, 0).stat().st_size for member in range(settings["P"]))
    most = max(most_filling, most_cold, most_warm)
    print(
        json.dumps(
            {
                "benchmark": "replay",
                **{name: settings[name] for name in DEFAULTS if name != "directory"},
                "stored_gib": round(stored / 2**30, 2),
                "anonymous_gib": round((most - before) / 2**30, 3),
                "append_mib_per_second": round(stored / 2**20 / filled, 1),
                "seconds_per_batch": {"cold": round(cold, 4), "warm": round(warm, 4)},
            }
        )
    )


if __name__ == "__main__":
    main(sys.argv[1:])
