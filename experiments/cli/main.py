"""The command line: parses, runs one command, and gives its exit code.

What takes long to import is imported by the command that needs it, so that bad input and --help are
answered at once.
"""

import importlib.util
import inspect
import os
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import tyro

from dreamer_jax.output import safe_output
from dreamer_jax.ranges import check_ranges
from experiments.cli import demo, engines, plan, reports, runs, sharing, thesis
from experiments.cli.exits import FAILURE, STOPPED, USAGE, UsageError, usage_errors
from experiments.cli.options import CONSTRUCTORS, Base, read_base

PROGRAM = "python -m experiments"


class Command(NamedTuple):
    """A command of the command line.

    Attributes:
      options: what it is asked with; its docstring is its help.
      carry_out: from options to an exit code.
      defaults: of the options, where they are a preset's or of a file of settings.
    """

    options: Callable[[], type]
    carry_out: Callable[[Any], int]
    defaults: Callable[[Base], Any] | None = None


def _plain(options: type, carry_out: Callable[[Any], int], defaults=None) -> Command:
    return Command(lambda: options, carry_out, defaults)


COMMANDS = {
    "train": Command(
        runs.train_options,
        lambda options: runs.train(runs.train_command(options)),
        runs.train_defaults,
    ),
    "evaluate": _plain(runs.Evaluate, runs.evaluate),
    "classify": _plain(runs.Classify, runs.classify),
    "report": _plain(reports.Report, reports.report),
    "verify": _plain(runs.Verify, runs.verify),
    "export": _plain(sharing.Export, sharing.export),
    "zoo": _plain(sharing.Zoo, sharing.zoo),
    "table": _plain(thesis.Tables, thesis.tables, thesis.table_defaults),
    "figure": _plain(thesis.Figures, thesis.figures, thesis.figure_defaults),
    "sweep": _plain(thesis.Sweeps, thesis.sweep, thesis.sweep_defaults),
    "work": _plain(engines.Work, engines.work),
    "plan": _plain(plan.Plan, plan.plan, plan.plan_defaults),
    "seeds": _plain(reports.Seeds, reports.seeds),
    "demo": _plain(demo.Demo, demo.demo),
}
"""All commands by name."""


def main(arguments: Sequence[str] | None = None, program: str = PROGRAM) -> int:
    """Runs one command.

    Args:
      arguments: by default those of this process.
      program: what it is called in messages.

    Returns:
      The exit code: 0, 1 (failed while running), 2 (bad input) or 130 (stopped by Ctrl-C).
    """
    arguments = list(sys.argv[1:] if arguments is None else arguments)
    _keep_compiled_functions()
    repeat_on_cards()
    with safe_output():
        return _main(arguments, program)


def _main(arguments: list[str], program: str) -> int:
    try:
        with usage_errors():
            command, options = _parse(arguments, program)
            check_ranges(options)
        return command.carry_out(options)
    except UsageError as error:
        print(f"error: {error}", file=sys.stderr)
        return USAGE
    except KeyboardInterrupt:
        print("stopped without saving; what was saved before can be resumed", file=sys.stderr)
        return STOPPED
    except Exception as error:
        if not _is_told(error):
            raise
        print(f"error: {error}", file=sys.stderr)
        return FAILURE


def console() -> int:
    """The command `dreamer-transfer`."""
    return main(program="dreamer-transfer")


def _is_told(error: Exception) -> bool:
    """Whether an error's message says all that a user needs."""
    if isinstance(error, OSError | ModuleNotFoundError):
        return True
    from dreamer_jax.checkpoint import CorruptCheckpointError
    from dreamer_jax.integrity import DamagedError
    from dreamer_jax.record_checks import RecordsError
    from dreamer_jax.training import NonFiniteError
    from envs import SimulatorError
    from experiments.runs.memory import OutOfMemoryError

    known = (SimulatorError, NonFiniteError, CorruptCheckpointError, DamagedError, RecordsError)
    return isinstance(error, (*known, OutOfMemoryError))


def _keep_compiled_functions() -> None:
    """Keeps compiled functions on disk, so that the second start of a run takes seconds.

    JAX reads this as it is imported; its own setting takes precedence.
    """
    try:
        cache = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
    except RuntimeError:  # neither HOME nor an entry in the list of users
        return
    os.environ.setdefault("JAX_COMPILATION_CACHE_DIR", str(cache / "dreamer-transfer" / "jax"))


DETERMINISTIC = "--xla_gpu_deterministic_ops"
"""The flag of XLA's with which a program gives the same numbers each time that it runs on a GPU."""


def repeat_on_cards() -> None:
    """Has NVIDIA cards give the same numbers each time, so that resumed runs are the same.

    XLA reads this when it makes its first program. Whoever sets the flag, to false too, has it so.
    Nothing is set where JAX has no plugin for such a card, or is told not to use it.
    """
    flags = os.environ.get("XLA_FLAGS", "")
    platforms = os.environ.get("JAX_PLATFORMS", "")
    elsewhere = platforms and not {"cuda", "gpu"} & set(platforms.split(","))
    plugins = ("jax_cuda12_plugin", "jax_cuda13_plugin")
    if DETERMINISTIC in flags or elsewhere or not any(map(importlib.util.find_spec, plugins)):
        return
    os.environ["XLA_FLAGS"] = f"{flags} {DETERMINISTIC}=true".strip()


def _parse(arguments: list[str], program: str) -> tuple[Command, Any]:
    """The command that arguments name, and its options.

    Presets and files of settings are read before the other options, whose defaults they are.
    """
    name = arguments[0] if arguments else "--help"
    if name in ("-h", "--help"):
        print(_overview(program))
        sys.exit(0)
    if name not in COMMANDS:
        raise UsageError(f"there is no command {name!r}{_near(name)}\n\n{_overview(program)}")
    command = COMMANDS[name]
    options = command.options()
    default = None if command.defaults is None else command.defaults(read_base(arguments[1:]))
    return command, tyro.cli(
        options,
        default=default,
        args=arguments[1:],
        prog=f"{program} {name}",
        description=inspect.getdoc(options),
        registry=CONSTRUCTORS,
    )


def _near(name: str) -> str:
    import difflib

    near = difflib.get_close_matches(name, COMMANDS, n=1)
    return f" (did you mean {near[0]!r}?)" if near else ""


def _overview(program: str) -> str:
    """What commands there are."""
    lines = [f"usage: {program} COMMAND [OPTIONS]", ""]
    for name, command in COMMANDS.items():
        first, *_ = (inspect.getdoc(command.options()) or "").splitlines()
        lines.append(f"  {name:<10}{first}")
    return "\n".join([*lines, "", f"more of one: {program} COMMAND --help"])
