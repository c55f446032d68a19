"""Full disks, and two writers of one folder, with real processes."""

import os
import subprocess
import tempfile
import time
from contextlib import contextmanager
from pathlib import Path

from tests.faults.kills import ROOT, command, environment


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
        words = command(kind, out, base, "--resume")
        process = subprocess.run(
            words, cwd=ROOT, env=environment(cache), capture_output=True, text=True
        )
        if process.returncode == 0:
            return None
        filler.unlink()
        again = subprocess.run(
            words, cwd=ROOT, env=environment(cache), capture_output=True, text=True
        )
        if again.returncode:
            return None
        error = process.stderr.strip().splitlines()[-1]
        same = (out / "metrics.jsonl").read_bytes() == (base / kind / "metrics.jsonl").read_bytes()
        clear = "Traceback" not in process.stderr and "No space left" in error
        return error if same and clear else None


def two_writers(kind: str, out: Path, base: Path, cache: Path) -> str | None:
    """Starts a second process on the folder of one that trains.

    Returns:
      What the second one says, if the first one's result is as if it had been alone.
    """
    words, settings = command(kind, out, base, "--resume"), environment(cache)
    first = subprocess.Popen(
        words, cwd=ROOT, env=settings, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
    )
    while first.poll() is None and not (out / ".lock").exists():
        time.sleep(0.01)
    second = subprocess.run(words, cwd=ROOT, env=settings, capture_output=True, text=True)
    first.wait()
    same = (out / "metrics.jsonl").read_bytes() == (base / kind / "metrics.jsonl").read_bytes()
    told = second.returncode == 2 and f"process {first.pid} on" in second.stderr
    return second.stderr.strip() if same and told and first.returncode == 0 else None
