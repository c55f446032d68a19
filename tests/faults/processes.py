"""Commands of the program as processes that are forks of this one.

This process imports all and starts nothing: no device of JAX, no thread. A fork of it is what a
fresh process is after its imports, which are a third of what a short run takes; its simulators are
processes of their own, as always.
"""

import multiprocessing
import os
import sys
import threading
from collections.abc import Sequence
from multiprocessing.process import BaseProcess
from pathlib import Path

import jax

# What a training imports, so that its forks need not.
import dreamer_jax.training  # noqa: F401
import envs.pool  # noqa: F401
import experiments.cli.runs  # noqa: F401
import experiments.runs.run  # noqa: F401
import experiments.runs.start  # noqa: F401
from experiments.__main__ import main

ROOT = Path(__file__).parents[2]


def start(arguments: Sequence[str], cache: Path, output: Path | None = None) -> BaseProcess:
    """Starts `python -m experiments ARGUMENTS` as a fork of this process.

    Args:
      arguments: of the command.
      cache: the folder of compiled functions, shared by all processes.
      output: the file that stdout and stderr go to; by default nowhere.

    Returns:
      The process: `pid`, `is_alive()`, `join()`, `exitcode`.

    Raises:
      RuntimeError: this process has threads, which a fork would not have.
    """
    if threading.active_count() > 1:
        names = [thread.name for thread in threading.enumerate()]
        raise RuntimeError(f"a process with threads ({', '.join(names)}) cannot be forked safely")
    process = multiprocessing.get_context("fork").Process(
        target=_run, args=(list(arguments), cache, output or Path(os.devnull))
    )
    process.start()
    return process


def _run(arguments: list[str], cache: Path, output: Path) -> None:
    os.chdir(ROOT)
    # Simulators are started as python -m envs.worker.
    os.environ["PYTHONPATH"] = str(ROOT)
    os.environ.setdefault("XLA_FLAGS", "--xla_backend_optimization_level=0")
    jax.config.update("jax_compilation_cache_dir", str(cache))
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.1)
    nothing = os.open(os.devnull, os.O_RDONLY)
    file = os.open(output, os.O_WRONLY | os.O_CREAT | os.O_TRUNC)
    for source, target in ((nothing, 0), (file, 1), (file, 2)):
        os.dup2(source, target)
    sys.exit(main(arguments))
