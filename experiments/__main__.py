"""The command line: python -m experiments {train, evaluate, report, demo}."""

import contextlib
import os
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import jax
import tyro

from dreamer_jax import config as configs
from dreamer_jax.checkpoint import CorruptCheckpointError
from dreamer_jax.config import Config
from dreamer_jax.host_memory import keep_freed_memory
from dreamer_jax.training import NonFiniteError
from envs import SimulatorError

FAILURE, USAGE, STOPPED = 1, 2, 130


@dataclass(frozen=True)
class Train:
    """Train a population of agents, from scratch or from a source, or resume one.

    Several tasks make one multi-task agent. With --source and --omega the population holds one
    target per fraction and seed.
    """

    task: tuple[str, ...]
    """Names of the tasks, such as bullet/hopper (an unknown name lists them all), or gymnasium/ID
    for any gymnasium environment with images, such as gymnasium/CartPole-v1."""
    out: Path
    """The results folder."""
    seeds: tuple[int, ...] = (0,)
    """One agent per seed; all train as one population."""
    preset: Literal["thesis", "cpu", "demo", "debug"] = "cpu"
    """Settings to start from; each can be overridden by its name below."""
    source: Path | None = None
    """Results folder of the agent to transfer from."""
    source_member: int = 0
    """Which member of the source's population."""
    omega: tuple[float, ...] = ()
    """Fractions of the source's last reward and value layers to add (0 to 1)."""
    baseline: bool = False
    """Add agents from scratch, one per seed, to the transfer targets."""
    resume: bool = False
    """Continue the run that the results folder holds."""
    workers: int | None = None
    """Simulator processes; by default one per core."""
    config: tyro.conf.OmitArgPrefixes[Config] = Config()


@dataclass(frozen=True)
class Evaluate:
    """Play episodes with every agent of a results folder (the mode, without noise)."""

    directory: tyro.conf.Positional[Path]
    """The results folder."""
    episodes: int = 5
    """Episodes per agent and task."""
    video: bool = False
    """Write videos of an episode and of an open-loop prediction into the folder."""
    workers: int | None = None
    """Simulator processes; by default one per core."""


@dataclass(frozen=True)
class Report:
    """Print the table of a results folder and draw its learning curves."""

    directory: tyro.conf.Positional[Path]
    """The results folder."""


@dataclass(frozen=True)
class Demo:
    """The main job in minutes: a multi-task source, then fractional transfer beside a baseline."""

    out: Path = Path("runs/demo")
    """Folder for the demo's two results folders."""
    preset: Literal["demo", "debug"] = "demo"
    """debug runs the same in seconds."""
    workers: int | None = None
    """Simulator processes; by default one per core."""


Command = (
    Annotated[Train, tyro.conf.subcommand("train")]
    | Annotated[Evaluate, tyro.conf.subcommand("evaluate")]
    | Annotated[Report, tyro.conf.subcommand("report")]
    | Annotated[Demo, tyro.conf.subcommand("demo")]
)


class UsageError(Exception):
    """Bad input, with a message that names the way out."""


@contextlib.contextmanager
def usage_errors():
    """What is raised while input is read and checked is the user's to mend."""
    try:
        yield
    except (ValueError, FileExistsError, ModuleNotFoundError) as error:
        raise UsageError(str(error)) from error


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
        run = {Train: _train, Evaluate: _evaluate, Report: _report, Demo: _demo}[type(command)]
        return run(command)
    except UsageError as error:
        print(f"error: {error}", file=sys.stderr)
        return USAGE
    except (OSError, SimulatorError, NonFiniteError, CorruptCheckpointError) as error:
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
    if arguments[:1] != ["train"]:
        return tyro.cli(Command, args=arguments, prog="python -m experiments")
    name = Train.preset
    for i, argument in enumerate(arguments):
        if argument == "--preset" and i + 1 < len(arguments):
            name = arguments[i + 1]
        elif argument.startswith("--preset="):
            name = argument.partition("=")[2]
    default = Train(task=tyro.MISSING, out=tyro.MISSING, preset=name, config=configs.preset(name))
    return tyro.cli(
        Train,
        default=default,
        args=arguments[1:],
        prog="python -m experiments train",
        description=Train.__doc__,
    )


def _train(command: Train) -> int:
    from experiments.run import RunSpec, carry_out, make_run

    with usage_errors():
        spec = RunSpec(
            tasks=command.task,
            seeds=command.seeds,
            config=command.config,
            source=None if command.source is None else str(command.source),
            source_member=command.source_member,
            omegas=command.omega,
            baseline=command.baseline,
        )
        run = make_run(spec, command.out, resume=command.resume, workers=command.workers)
    if spec.source is not None:
        print((command.out / "transfer.txt").read_text())
    if carry_out(run) == "stopped":
        print(f"stopped and saved in {command.out}: the same command with --resume continues")
        return STOPPED
    return _report(Report(command.out))


def _report(command: Report) -> int:
    from experiments import report

    with usage_errors():
        summaries = report.summarise(command.directory)
    print(report.table(summaries))
    if report.evaluations(command.directory):
        picture, _ = report.plot_curves(command.directory)
        print(f"learning curves: {picture}")
    return 0


def _evaluate(command: Evaluate) -> int:
    import numpy as np
    from rich.progress import Progress

    from dreamer_jax.files import write_json_atomically
    from experiments.evaluate import evaluate, load_agents
    from experiments.report import aligned

    if command.episodes < 1:
        raise UsageError(f"--episodes is {command.episodes}, must be at least 1")
    with usage_errors():
        agents = load_agents(command.directory)
    with Progress() as bar:
        job = bar.add_task("evaluating", total=command.episodes)
        rows = evaluate(
            agents,
            command.episodes,
            video=command.video,
            workers=command.workers,
            report=lambda done, score: bar.update(
                job, completed=done, description=f"evaluating, return {score:.0f}"
            ),
        )
    groups: dict[tuple, list] = {}
    for row in rows:
        groups.setdefault((row["label"], row["seed"], row["task"]), []).append(row)
    lines = []
    for (label, seed, task), chosen in groups.items():
        returns = [row["return"] for row in chosen]
        length = np.mean([row["length"] for row in chosen])
        lines.append(
            [
                f"{label}, seed {seed}, {task}",
                f"{np.mean(returns):.1f} ± {np.std(returns):.1f}",
                f"{min(returns):.1f}",
                f"{max(returns):.1f}",
                f"{length:.0f}",
            ]
        )
    print(aligned(["agent", "return", "lowest", "highest", "length"], lines))
    write_json_atomically(command.directory / "evaluation.json", {"episodes": rows})
    print(f"episodes: {command.directory / 'evaluation.json'}")
    if command.video:
        videos = command.directory / "videos"
        for path in sorted([*videos.glob("evaluate_*.mp4"), *videos.glob("prediction_*.mp4")]):
            print(f"video: {path}")
    return 0


def _demo(command: Demo) -> int:
    from experiments import demo, evaluate, report
    from experiments.run import carry_out, make_run

    config = configs.preset(command.preset)
    for name, spec in demo.specs(command.out, config).items():
        with usage_errors():
            run = make_run(spec, command.out / name, resume=True, workers=command.workers)
        if carry_out(run) == "stopped":
            print(f"stopped and saved in {command.out}: the same command continues")
            return STOPPED
    targets = command.out / "targets"
    evaluate.evaluate(evaluate.load_agents(targets), 1, video=True, workers=command.workers)
    pictures = report.plot_curves(targets)
    print("\nWhat was transferred, leaf by leaf (norms are means over the targets)\n")
    print((targets / "transfer.txt").read_text())
    print("Return of evaluation episodes on InvertedPendulum, mean ± standard deviation\n")
    print(report.table(report.summarise(targets)))
    print("\n" + demo.scale(config))
    for path in (*pictures, *sorted((targets / "videos").glob("*.mp4"))):
        print(f"wrote {path}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
