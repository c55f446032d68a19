"""Full disks, and two writers of one folder, with real processes."""

import os
import subprocess
import tempfile
import time
from contextlib import contextmanager
from pathlib import Path

from tests.faults.kills import arguments, same
from tests.faults.processes import start


@contextmanager
def small_disk(megabytes: int):
    """A file system of its own with little room; None where this process may not mount one."""
    with tempfile.TemporaryDirectory() as folder:
        words = ["mount", "-t", "tmpfs", "-o", f"size={megabytes}m", "tmpfs", folder]
        if subprocess.run(words, capture_output=True).returncode:
            yield None
            return
        try:
            yield Path(folder)
        finally:
            subprocess.run(["umount", "-l", folder], check=False)


def fill_disk(kind: str, base: Path, cache: Path, room: int) -> str | None:
    """Trains on a disk of `room` kilobytes more than a start needs; then with room, to the end.

    Returns:
      What is told; None if nothing is; "" where there is no small disk to be had.
    """
    with small_disk(64) as disk:
        if disk is None:
            return ""
        filler = disk / "filler"
        free = os.statvfs(disk).f_bavail * os.statvfs(disk).f_frsize
        filler.write_bytes(bytes(max(0, free - room * 1024)))
        out = disk / "run"
        words, log = arguments(kind, out, base), base / f"disk of {room} KiB.log"
        process = start(words, cache, log)
        process.join()
        said = log.read_text()
        if process.exitcode == 0:
            return None
        filler.unlink()
        again = start(words, cache)
        again.join()
        if again.exitcode:
            return None
        error = said.strip().splitlines()[-1]
        clear = "Traceback" not in said and "No space left" in error
        return error if clear and same(base / kind, out) is None else None


def two_writers(kind: str, out: Path, base: Path, cache: Path) -> str | None:
    """Starts a second process on the folder of one that trains.

    Returns:
      What the second one says, if the first one's result is as if it had been alone.
    """
    words, log = arguments(kind, out, base), base / "second writer.log"
    first = start(words, cache)
    while first.is_alive() and not (out / ".lock").exists():
        time.sleep(0.01)
    second = start(words, cache, log)
    second.join()
    first.join()
    said = log.read_text().strip()
    told = second.exitcode == 2 and f"process {first.pid} on" in said
    alike = first.exitcode == 0 and same(base / kind, out) is None
    return said if told and alike else None
