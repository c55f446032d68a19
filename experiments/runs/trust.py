"""Code that a results folder names: imported only if whoever uses the folder says so.

A task `gymnasium/MODULE:ID` is made by importing MODULE. Typed on the command line, that is wanted;
read from a folder that somebody else made, it may not be. Reports, tables, `verify` and the reading
of sources import nothing of the kind.
"""

import os
from collections.abc import Iterable
from pathlib import Path

import envs
from experiments.runs.exported import is_exported, read_card
from experiments.runs.spec import read_spec


def check_trust(names: Iterable[str | Path], trust: bool) -> None:
    """Refuses to go on with folders (or exported agents) whose tasks name modules.

    Args:
      names: what tasks are read from.
      trust: whether that is allowed.

    Raises:
      ValueError: a task names a module, and it is not; or a folder holds no run.
    """
    for name in names:
        spec = read_card(name).spec if is_exported(name) else read_spec(name)
        named = [task for task in spec.tasks if envs.names_module(task)]
        if named and not trust:
            module = named[0].partition("/")[2].rpartition(":")[0]
            raise ValueError(
                f"{name} has the task {named[0]}, for which the module {module} would be imported "
                "and its code run: add --trust if you trust whoever made it"
            )


def is_of_another(directory: Path) -> bool:
    """Whether a results folder's header belongs to another user of this machine."""
    header = directory / "run.json"
    return header.exists() and header.stat().st_uid != os.getuid()
