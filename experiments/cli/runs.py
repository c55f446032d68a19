"""Commands on one run: train, evaluate, classify. Their options, and what they do.

What takes long to import is imported where it is used, so that bad input is told at once.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import tyro

from dreamer_jax.config import Config
from experiments.cli.exits import STOPPED, UsageError, usage_errors


@dataclass(frozen=True)
class Train:
    """Train a population of agents, from scratch or from a source, or resume one.

    Several tasks make one multi-task agent. With --source and --omega the population holds one
    target per fraction and seed; with --method uae or meta, one on the source's frozen encoder.
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
    source: tuple[Path, ...] = ()
    """The agent to transfer from: a results folder, a .safetensors file that `export` wrote, or
    zoo:NAME (`zoo` lists them). Fractional transfer takes several: each has targets of its own in
    the population."""
    source_member: int = 0
    """Which member of each source's population."""
    omega: tuple[float, ...] = ()
    """Fractions of the source's last reward and value layers to add (0 to 1)."""
    baseline: bool = False
    """Add agents from scratch, one per seed, to the transfer targets."""
    method: Literal["fractional", "uae", "meta"] = "fractional"
    """How the source is used: fractional transfer; as a universal autoencoder with a frozen
    encoder; or as that and with meta-models over the models of further agents."""
    fractions: tuple[str, ...] = ("reward", "value", "termination")
    """fractional: the components whose last layer a fraction is transferred of (any of reward,
    value, termination, dynamics, actor); the last layers of the other heads are drawn anew."""
    dynamics: Literal["fresh", "copied", "frozen"] = "fresh"
    """uae and meta: the latent dynamics, drawn anew, or copied from the source to train on, or
    copied and frozen but for the kernel of the action."""
    reward_sources: tuple[Path, ...] = ()
    """meta: results folders of agents made by --method uae from the same source, whose models the
    meta-model reads."""
    reward_counts: tuple[int, ...] = ()
    """meta: how many of these a target reads, the first ones; one target per number and seed."""
    meta: tuple[str, ...] = ("reward",)
    """meta: the components that are meta-models (any of reward, value, dynamics)."""
    meta_layers: int = 1
    """meta: hidden layers of a meta-model of reward or value."""
    switching: bool = False
    """meta: recognise the task of each latent state, and use the stored reward model of a task
    that is known and the meta-model for a novel one (needs --dynamics frozen)."""
    threshold: float | None = None
    """meta, switching: the distance beyond which a task is novel; by default suggested by the
    samples of the known tasks."""
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
    source_member: int = 0
    """Which member of the source's population."""
    samples: int = 100
    """Latent states of each task to fit on, and as many, of other episodes, to test."""
    thresholds: tuple[float, ...] = ()
    """Distances beyond which a state is novel; by default 50, 70 and 90 for 230 features, scaled
    to the agent's. One suggested by the fitted samples is always added."""
    quantile: float = 0.95
    """Share of known samples that the suggested threshold should hold."""
    neighbours: int = 5
    """Nearest samples that vote for the task."""
    policy: Literal["random", "trained"] = "random"
    """Who plays: random actions, or a trained agent (the mode, without noise)."""
    actors: tuple[Path, ...] = ()
    """With --policy trained: results folders of the agents that play, one for each task; by
    default the source's agent plays all."""
    features: Literal["sample", "mean", "first"] = "sample"
    """The latent state: a sample of the posterior along an episode (what agents act on), its mean,
    or each image as if it were the first of an episode."""
    seed: int = 0
    """Of episodes, actions and samples."""
    workers: int | None = None
    """Simulator processes; by default one per core."""


def train(command: Train) -> int:
    """Trains a population."""
    from experiments.cli.reports import Report, report
    from experiments.runs.run import carry_out, make_run
    from experiments.runs.spec import RunSpec

    with usage_errors():
        spec = RunSpec(
            tasks=command.task,
            seeds=command.seeds,
            config=command.config,
            sources=tuple(map(str, command.source)),
            source_member=command.source_member,
            omegas=command.omega,
            baseline=command.baseline,
            method=command.method,
            fractions=command.fractions,
            dynamics=command.dynamics,
            reward_sources=tuple(map(str, command.reward_sources)),
            reward_counts=command.reward_counts,
            meta=command.meta,
            meta_layers=command.meta_layers,
            switching=command.switching,
            threshold=command.threshold,
        )
        run = make_run(spec, command.out, resume=command.resume, workers=command.workers)
    if spec.sources:
        print((command.out / "transfer.txt").read_text())
    if carry_out(run) == "stopped":
        print(f"stopped and saved in {command.out}: the same command with --resume continues")
        return STOPPED
    return report(Report((command.out,)))


def evaluate(command: Evaluate) -> int:
    """Plays episodes and prints their returns."""
    import numpy as np
    from rich.progress import Progress

    from dreamer_jax.files import write_json_atomically
    from experiments.runs.evaluate import evaluate, load_agents
    from experiments.runs.text import aligned

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


def classify(command: Classify) -> int:
    """Tells the tasks of latent states."""
    from rich.progress import Progress

    from dreamer_jax.files import write_json_atomically
    from experiments.runs import classify
    from experiments.runs.agents import load_source

    request = {
        "samples": command.samples,
        "neighbours": command.neighbours,
        "quantile": command.quantile,
        "policy": command.policy,
    }
    with usage_errors():
        classify.check_request(command.task, command.known, actors=command.actors, **request)
        source = load_source(command.source, command.source_member)
        actors = [load_source(directory) for directory in command.actors]
        with Progress() as bar:
            total = classify.rounds(source, command.samples) * max(1, len(actors))
            job = bar.add_task("gathering samples", total=total)
            outcome = classify.classify(
                source,
                command.task,
                command.known,
                thresholds=command.thresholds,
                features=command.features,
                actors=actors,
                seed=command.seed,
                workers=command.workers,
                report=lambda: bar.advance(job),
                **request,
            )
    folder = command.source / "classification" if command.out is None else command.out
    folder.mkdir(parents=True, exist_ok=True)
    print("Novel tasks: share taken for novel. Known: taken for not novel / for the right task.\n")
    print(classify.table(outcome) + "\n\n" + classify.distance_table(outcome) + "\n")
    settings = {"source": str(command.source), "features": command.features, **request}
    write_json_atomically(
        folder / "classification.json", {"settings": settings, **classify.to_dict(outcome)}
    )
    for path in (folder / "classification.json", *classify.plot(outcome, folder / "latents")):
        print(f"wrote {path}")
    return 0
