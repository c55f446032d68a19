"""The command line: parses, runs one command, and gives its exit code."""

import functools
import inspect
import operator
import os
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any

import jax
import tyro

from dreamer_jax import config as configs
from dreamer_jax.checkpoint import CorruptCheckpointError
from dreamer_jax.host_memory import keep_freed_memory
from dreamer_jax.training import NonFiniteError
from envs import SimulatorError
from experiments.cli import reports, runs, sharing, thesis
from experiments.cli.exits import FAILURE, STOPPED, USAGE, UsageError, usage_errors

COMMANDS = {
    "train": (runs.Train, runs.train),
    "evaluate": (runs.Evaluate, runs.evaluate),
    "classify": (runs.Classify, runs.classify),
    "report": (reports.Report, reports.report),
    "export": (sharing.Export, sharing.export),
    "zoo": (sharing.Zoo, sharing.zoo),
    "table": (thesis.Tables, thesis.tables),
    "figure": (thesis.Figures, thesis.figures),
    "plan": (thesis.Plan, thesis.plan),
    "seeds": (reports.Seeds, reports.seeds),
    "demo": (thesis.Demo, thesis.demo),
}
"""Options of each command, and what carries it out."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Runs one command.

    Returns:
      The exit code: 0, 1 (failed while running), 2 (bad input) or 130 (stopped by Ctrl-C).
    """
    arguments = list(sys.argv[1:] if arguments is None else arguments)
    try:
        with usage_errors():
            command = _parse(arguments)
        _keep_compiled_functions()
        keep_freed_memory()
        return dict(COMMANDS.values())[type(command)](command)
    except UsageError as error:
        print(f"error: {error}", file=sys.stderr)
        return USAGE
    except (
        OSError,
        ModuleNotFoundError,
        SimulatorError,
        NonFiniteError,
        CorruptCheckpointError,
    ) as error:
        print(f"error: {error}", file=sys.stderr)
        return FAILURE
    except KeyboardInterrupt:
        print("stopped without saving; what was saved before can be resumed", file=sys.stderr)
        return STOPPED


def _keep_compiled_functions() -> None:
    """Keeps compiled functions on disk, so that the second start of a run takes seconds.

    JAX's own settings (JAX_COMPILATION_CACHE_DIR and the like) take precedence.
    """
    if not jax.config.jax_compilation_cache_dir:
        cache = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
        jax.config.update("jax_compilation_cache_dir", str(cache / "dreamer-transfer" / "jax"))


def _parse(arguments: list[str]):
    """Parses in two steps: the preset first, since it sets the defaults of all other settings."""
    defaults = _with_settings(_preset_in(arguments))
    if not arguments or arguments[0] not in defaults:
        choices = [
            Annotated[options, tyro.conf.subcommand(name)]
            for name, (options, _) in COMMANDS.items()
        ]
        return tyro.cli(
            functools.reduce(operator.or_, choices), args=arguments, prog="python -m experiments"
        )
    name, options = arguments[0], COMMANDS[arguments[0]][0]
    return tyro.cli(
        options,
        default=defaults[name],
        args=arguments[1:],
        prog=f"python -m experiments {name}",
        description=inspect.getdoc(options),
    )


def _preset_in(arguments: list[str]) -> str:
    """The preset that the arguments name, or the default one."""
    name = runs.Train.preset
    for i, argument in enumerate(arguments):
        if argument == "--preset" and i + 1 < len(arguments):
            name = arguments[i + 1]
        elif argument.startswith("--preset="):
            name = argument.partition("=")[2]
    return name


def _with_settings(preset: str) -> dict[str, Any]:
    """Defaults of the commands whose settings are a preset's, each to be overridden by name.

    Raises:
      ValueError: there is no such preset.
    """
    config, missing = configs.preset(preset), tyro.MISSING
    sweep = thesis.Sweep(preset=preset, config=config)
    return {
        "train": runs.Train(task=missing, out=missing, preset=preset, config=config),
        "table": thesis.Tables(names=missing, sweep=sweep),
        "figure": thesis.Figures(names=missing, sweep=sweep),
        "plan": thesis.Plan(sweep=sweep),
    }
