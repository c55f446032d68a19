"""Commands on one run: train, evaluate, classify. Their options, and what they do.

What takes long to import is imported where it is used, so that bad input is told at once.
"""

import dataclasses
import functools
import inspect
import typing
from dataclasses import dataclass
from dataclasses import fields as _fields
from pathlib import Path
from typing import Annotated, Any, Literal

import tyro

from dreamer_jax.config import Config
from dreamer_jax.locks import FolderLock
from dreamer_jax.ranges import setting
from experiments import methods
from experiments.cli.exits import FAILURE, STOPPED, usage_errors
from experiments.cli.options import (
    DEFAULT_PRESET,
    Base,
    ConfigFile,
    Devices,
    Preset,
    Simulators,
    make_method,
    method_defaults,
    method_groups,
    method_summary,
    sequence,
)


@dataclass(frozen=True)
class Run:
    """What to train, and where."""

    task: tuple[str, ...]
    """Names of the tasks, such as bullet/hopper (an unknown name lists them all), or gymnasium/ID
    for any gymnasium environment with images, such as gymnasium/CartPole-v1."""
    out: Path
    """The results folder."""
    seeds: tuple[int, ...] = setting((0,), 0, 2**31 - 1)
    """One agent per seed; all train as one population."""
    preset: Preset = DEFAULT_PRESET
    """Settings to start from; each can be overridden by its name below."""
    file: ConfigFile = None
    """A YAML or JSON file of settings, written as a run's own are (run.json), or a part of them:
    over the preset's, under those given by name."""
    resume: bool = False
    """Continue the run that the results folder holds."""
    from_checkpoint: int | Literal["list"] | None = None
    """Continue it from an older checkpoint, named by its step; later ones are given up. `list`
    lists what there is."""
    accept_failed: bool = False
    """Transfer from agents whose losses were not finite any more, as they were before."""
    devices: Devices = setting("all", 1, 10_000)
    """Devices to spread members over, each member on one of them. How many is no part of what a run
    is: it goes on with more or fewer."""
    simulators: tyro.conf.OmitArgPrefixes[Simulators] = Simulators()
    trust: bool = False
    """Import the modules that the tasks of a folder made by others name, and so run their code."""


@dataclass(frozen=True)
class Train:
    """Train a population of agents, from scratch or from a source, or resume one.

    Several tasks make one multi-task agent. With --source and --omega the population holds one
    target per fraction and seed; other methods transfer in other ways.
    """

    run: Run
    method: str | None
    transfer: tuple[Any, ...]
    config: Config


@functools.cache
def train_options() -> type:
    """The options of `train`: a group for the run, one for the method, those of the settings of
    methods, and those of the agent's settings."""
    choices: Any = Literal[tuple(methods.known())]
    named = Annotated[choices | None, tyro.conf.arg(help=method_summary())]
    chooses = dataclasses.make_dataclass(
        "transfer", [("method", named, dataclasses.field(default=None))], frozen=True
    )
    chooses.__doc__ = "How knowledge is transferred from a trained agent, if at all."
    groups: dict[str, Any] = {"run": Run, "transfer": chooses, **method_groups(), "config": Config}
    without_prefix: Any = tyro.conf.OmitArgPrefixes
    fields = [(name, without_prefix[kind]) for name, kind in groups.items()]
    found = dataclasses.make_dataclass("TrainOptions", fields, frozen=True)
    found.__doc__ = inspect.getdoc(Train)
    return found


def train_defaults(base: Base) -> Any:
    """Defaults of `train_options`, from a preset and perhaps a file of settings.

    Raises:
      ValueError: the file names a setting that no method has.
    """
    options, values = train_options(), base.values
    kinds = {field.name: typing.get_type_hints(options)[field.name] for field in _fields(options)}
    name, groups = method_defaults(values)
    run = Run(
        task=sequence(values, "tasks", tyro.MISSING),
        out=tyro.MISSING,
        seeds=sequence(values, "seeds", (0,)),
        preset=base.preset,
        file=base.file,
    )
    return options(run=run, transfer=kinds["transfer"](name), **groups, config=base.config)


def train_command(options: Any) -> Train:
    """The command that options of `train_options` make."""
    groups = tuple(getattr(options, name) for name in method_groups())
    return Train(options.run, options.transfer.method, groups, options.config)


@dataclass(frozen=True)
class Evaluate:
    """Play episodes with every agent of a results folder (the mode, without noise)."""

    directory: tyro.conf.Positional[Path]
    """The results folder."""
    episodes: int = setting(5, 1, 10**6)
    """Episodes per agent and task."""
    video: bool = False
    """Write videos of an episode and of an open-loop prediction into the folder."""
    devices: Devices = setting("all", 1, 10_000)
    """Devices to spread the agents over, each agent on one of them."""
    simulators: tyro.conf.OmitArgPrefixes[Simulators] = Simulators()
    trust: bool = False
    """Import the modules that the tasks of a folder made by others name, and so run their code."""


@dataclass(frozen=True)
class Classify:
    """Tell the tasks of latent states, known ones from novel ones, as in Tables 13 to 15.

    Plays episodes of each task, fits a classifier on an agent's latent states of the known tasks,
    tests it on others, and draws them.
    """

    source: Path
    """Results folder of the agent whose latent states are classified."""
    task: tuple[str, ...]
    """Names of all tasks."""
    known: tuple[str, ...]
    """Those of the tasks that the classifier is fitted on; the others are novel."""
    out: Path | None = None
    """Folder for the table and the picture; by default classification/ in the source's."""
    source_member: int = setting(0, 0, 10**6)
    """Which member of the source's population."""
    samples: int = setting(100, 1, 10**6)
    """Latent states of each task to fit on, and as many, of other episodes, to test."""
    thresholds: tuple[float, ...] = setting((), 0, 1e9, above=True)
    """Distances beyond which a state is novel; by default 50, 70 and 90 for 230 features, scaled
    to the agent's. One suggested by the fitted samples is always added."""
    quantile: float = setting(0.95, 0, 1)
    """Share of known samples that the suggested threshold should hold."""
    neighbours: int = setting(5, 1, 10**6)
    """Nearest samples that vote for the task."""
    policy: Literal["random", "trained"] = "random"
    """Who plays: random actions, or a trained agent (the mode, without noise)."""
    actors: tuple[Path, ...] = ()
    """With --policy trained: results folders of the agents that play, one for each task; by
    default the source's agent plays all."""
    features: Literal["sample", "mean", "first"] = "sample"
    """The latent state: a sample of the posterior along an episode (what agents act on), its mean,
    or each image as if it were the first of an episode."""
    seed: int = setting(0, 0, 2**31 - 1)
    """Of episodes, actions and samples."""
    accept_failed: bool = False
    """Take agents whose losses were not finite any more, as they were before."""
    simulators: tyro.conf.OmitArgPrefixes[Simulators] = Simulators()
    trust: bool = False
    """Import the modules that the tasks of a folder made by others name, and so run their code."""


@dataclass(frozen=True)
class Verify:
    """Compare results folders with the checksums in them, and name what is damaged."""

    directories: tyro.conf.Positional[tuple[Path, ...]]
    """Results folders, or folders of several."""


def train(command: Train) -> int:
    """Trains a population."""
    import envs
    from experiments.cli.reports import Report, report
    from experiments.runs.spec import RunSpec

    run = command.run
    if run.from_checkpoint == "list":
        from experiments.runs.verify import checkpoint_table

        with usage_errors():
            print(checkpoint_table(run.out))
        return 0
    with usage_errors():
        method = make_method(command.method, command.transfer)
        spec = RunSpec(run.task, run.seeds, command.config, method)
        envs.specs(spec.tasks)
    from experiments.runs.trust import check_trust, is_of_another

    with usage_errors():
        check_trust([*method.sources, *method.stored], run.trust)
        if is_of_another(run.out):
            check_trust([run.out], run.trust)
    from dreamer_jax.host_memory import keep_freed_memory
    from experiments.runs.memory import in_memory
    from experiments.runs.run import carry_out, make_run

    keep_freed_memory()
    with usage_errors():
        begun = make_run(
            in_memory(spec, run.devices),
            run.out,
            resume=run.resume or run.from_checkpoint is not None,
            workers=run.simulators.workers,
            devices=run.devices,
            accept_failed=run.accept_failed,
            timeout=run.simulators.simulator_timeout,
            from_checkpoint=run.from_checkpoint,
        )
    if spec.method.needs:
        print((run.out / "transfer.txt").read_text())
    if carry_out(begun) == "stopped":
        print(f"stopped and saved in {run.out}: the same command with --resume continues")
        return STOPPED
    return report(Report((run.out,)))


def verify(command: Verify) -> int:
    """Compares results folders with their checksums."""
    from experiments.runs.verify import report_of

    with usage_errors():
        text, sound = report_of(command.directories)
    print(text)
    return 0 if sound else FAILURE


def evaluate(command: Evaluate) -> int:
    """Plays episodes and prints their returns."""
    with usage_errors():
        from dreamer_jax.devices import check_devices
        from experiments.runs.trust import check_trust

        check_devices(command.devices)
        check_trust([command.directory], command.trust)
        lock = FolderLock(command.directory, ".evaluation.lock")
    with lock:
        return _evaluate(command)


def _evaluate(command: Evaluate) -> int:
    import numpy as np

    from dreamer_jax.files import write_json_atomically
    from dreamer_jax.progress import reported
    from experiments.runs.evaluate import evaluate, load_agents
    from experiments.runs.text import aligned

    with usage_errors():
        agents = load_agents(command.directory)
    with reported("evaluating") as report:
        rows = evaluate(
            agents,
            command.episodes,
            video=command.video,
            workers=command.simulators.workers,
            timeout=command.simulators.simulator_timeout,
            devices=command.devices,
            report=report,
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


def classify(command: Classify) -> int:
    """Tells the tasks of latent states."""
    from dreamer_jax.progress import reported
    from experiments.runs import classify
    from experiments.runs.agents import load_source
    from experiments.runs.trust import check_trust

    request: dict[str, Any] = {
        "samples": command.samples,
        "neighbours": command.neighbours,
        "quantile": command.quantile,
        "policy": command.policy,
    }
    with usage_errors():
        classify.check_request(command.task, command.known, actors=command.actors, **request)
        check_trust([command.source, *command.actors], command.trust)
        load = functools.partial(load_source, accept_failed=command.accept_failed)
        source = load(command.source, command.source_member)
        actors = [load(directory) for directory in command.actors]
        with reported("gathering samples") as report:
            outcome = classify.classify(
                source,
                command.task,
                command.known,
                thresholds=command.thresholds,
                features=command.features,
                actors=actors,
                seed=command.seed,
                workers=command.simulators.workers,
                timeout=command.simulators.simulator_timeout,
                report=report,
                **request,
            )
    folder = command.source / "classification" if command.out is None else command.out
    with usage_errors():
        lock = FolderLock(folder, ".classification.lock")
    with lock:
        _write_classification(command, outcome, folder, request)
    return 0


def _write_classification(command: Classify, outcome, folder: Path, request: dict) -> None:
    from dreamer_jax.files import write_json_atomically
    from experiments.runs import classify

    print("Novel tasks: share taken for novel. Known: taken for not novel / for the right task.\n")
    print(classify.table(outcome) + "\n\n" + classify.distance_table(outcome) + "\n")
    settings = {"source": str(command.source), "features": command.features, **request}
    write_json_atomically(
        folder / "classification.json", {"settings": settings, **classify.to_dict(outcome)}
    )
    for path in (folder / "classification.json", *classify.plot(outcome, folder / "latents")):
        print(f"wrote {path}")
