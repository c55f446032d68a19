"""Processes that write what a run writes, killed at random moments and resumed.

They are forks of this one, which has imported all and started nothing, so a kill costs a second or
two where that of a real run (tests/faults/kills.py) costs a start of one.
"""

import os
import random
import signal
import time
from dataclasses import dataclass, field
from pathlib import Path

from tests.faults.damages import go_on, make_folder, read_all

PHASES, EVERY = 12, 2


@dataclass
class Outcome:
    """What became of the kills."""

    kills: int = 0
    chains: int = 0
    different: list[str] = field(default_factory=list)


def _in_a_fork(function, *arguments) -> int:
    """Calls a function in a fork, silent but for its exit code; returns its process."""
    pid = os.fork()
    if pid == 0:
        nowhere = os.open(os.devnull, os.O_WRONLY)
        os.dup2(nowhere, 1)
        os.dup2(nowhere, 2)
        try:
            function(*arguments)
            os._exit(0)
        except BaseException:
            os._exit(1)
    return pid


def _read(directory: Path, path: Path) -> None:
    path.write_text(repr(read_all(directory)))


def kill_commits(count: int, folder: Path, seed: int = 0, most: int = 10) -> Outcome:
    """Kills such processes `count` times, up to `most` times in one folder, which is then finished
    and compared with one that was left alone."""
    folder.mkdir(parents=True, exist_ok=True)
    whole = folder / "whole"
    os.waitpid(_in_a_fork(_whole, whole), 0)
    os.waitpid(_in_a_fork(_read, whole, folder / "whole.txt"), 0)
    expected, outcome = (folder / "whole.txt").read_text(), Outcome()
    while outcome.kills < count:
        outcome.chains += 1
        chance = random.Random(f"{seed} {outcome.chains}")
        directory = folder / f"killed-{outcome.chains}"
        os.waitpid(_in_a_fork(make_folder, directory, 0), 0)
        for _ in range(min(most, count - outcome.kills)):
            pid = _in_a_fork(go_on, directory, PHASES, EVERY)
            time.sleep(chance.expovariate(1 / 0.7))
            os.kill(pid, signal.SIGKILL)
            if os.WIFEXITED(os.waitpid(pid, 0)[1]):
                break  # it was done before
            outcome.kills += 1
        _, status = os.waitpid(_in_a_fork(go_on, directory, PHASES, EVERY), 0)
        os.waitpid(_in_a_fork(_read, directory, folder / "killed.txt"), 0)
        if status or (folder / "killed.txt").read_text() != expected:
            outcome.different.append(str(directory))
        (folder / "killed.txt").unlink(missing_ok=True)
    return outcome


def _whole(directory: Path) -> None:
    make_folder(directory, 0)
    go_on(directory, PHASES, EVERY)
