"""Latent task classification (sections 3.3.3 and 4.3): which known task a state is of, or none.

Samples of known tasks fit a classifier; other samples of them and of novel tasks test it.

Axis letters: K task, S samples, M latent feature size.
"""

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

import envs
from dreamer_jax.progress import Report, unreported
from experiments.runs.agents import Source
from experiments.runs.latents import Features, Latents, Policy, gather, phases_for
from experiments.runs.text import aligned, titles
from transfer import ltc
from transfer.recipes import latent_task_thresholds


@dataclass(frozen=True)
class Outcome:
    """How well the tasks of samples were told.

    Attributes:
      tasks: the K tasks.
      known: those that the classifier was fitted on; its labels are places among them.
      fitted: latent states of the known tasks, by task.
      tested: other latent states of all tasks, by task.
      thresholds: ξ, the suggested one last.
      accuracies: for each threshold and task.
      distances: for each task the distances [S] to the nearest fitted sample.
      votes: for each task how many samples the neighbours took for each known one.
    """

    tasks: tuple[str, ...]
    known: tuple[str, ...]
    fitted: dict[str, Latents]
    tested: dict[str, Latents]
    thresholds: tuple[float, ...]
    accuracies: tuple[dict[str, ltc.Accuracy], ...]
    distances: dict[str, np.ndarray]
    votes: dict[str, Counter]

    @property
    def novel(self) -> tuple[str, ...]:
        """The tasks that the classifier has not seen."""
        return tuple(task for task in self.tasks if task not in self.known)


def check_request(
    tasks: Sequence[str],
    known: Sequence[str],
    *,
    samples: int,
    neighbours: int,
    quantile: float,
    actors: Sequence[Any],
    policy: Policy,
) -> None:
    """Checks what is asked for before anything is read or played.

    Raises:
      ValueError: naming what is wrong and the way out.
    """
    for name in (*tasks, *known):
        envs.spec(name)
    if len(set(tasks)) != len(tasks) or len(set(known)) != len(known):
        raise ValueError(f"a task is named twice: {tuple(tasks)}, known {tuple(known)}")
    if not known:
        raise ValueError("a classifier needs known tasks: add --known and some of the tasks")
    if strange := [name for name in known if name not in tasks]:
        raise ValueError(
            f"{', '.join(strange)} is known but not among the tasks: add it to --task too"
        )
    if samples < 1:
        raise ValueError(f"--samples is {samples}, must be at least 1")
    if not 1 <= neighbours <= samples * len(known):
        raise ValueError(
            f"--neighbours is {neighbours}, must lie in [1, {samples * len(known)}], the number of "
            "samples of all known tasks"
        )
    if not 0 < quantile < 1:
        raise ValueError(f"--quantile is {quantile}, must lie between 0 and 1")
    if actors and (policy != "trained" or len(actors) != len(tasks)):
        raise ValueError(
            f"--actors names {len(actors)} agents for {len(tasks)} tasks: give one for each, and "
            "--policy trained"
        )


def rounds(source: Source, samples: int) -> int:
    """Phases of each task that `classify` plays, half of them to fit and half to test."""
    return 2 * phases_for(source, samples)


def classify(
    source: Source,
    tasks: Sequence[str],
    known: Sequence[str],
    *,
    samples: int = 100,
    thresholds: Sequence[float] = (),
    neighbours: int = ltc.NEIGHBOURS,
    quantile: float = 0.95,
    features: Features = "sample",
    policy: Policy = "random",
    actors: Sequence[Source] = (),
    seed: int = 0,
    workers: int | None = None,
    timeout: float = envs.SIMULATOR_TIMEOUT,
    report: Report = unreported,
) -> Outcome:
    """Fits a classifier on samples of known tasks, and tests it on others of all tasks.

    Args:
      source: the agent whose latent states are classified.
      tasks: K names.
      known: those to fit on.
      samples: S of each task to fit on, and as many to test, from other episodes.
      thresholds: ξ; by default the thesis's, scaled to the agent's M.
      neighbours: votes.
      quantile: share of known samples that the suggested threshold should hold.
      features, policy, workers, timeout: see `latents.gather`.
      actors: with the policy "trained", one agent for each task; by default the source.
      seed: of episodes, draws and posterior samples.
      report: called after each phase; it counts those of all players.

    Raises:
      ValueError: see `check_request` and `latents.gather`.
    """
    tasks, known = tuple(tasks), tuple(known)
    check_request(
        tasks,
        known,
        samples=samples,
        neighbours=neighbours,
        quantile=quantile,
        actors=actors,
        policy=policy,
    )
    players: list[tuple[Source, tuple[str, ...]]] = [
        (actor, (task,)) for actor, task in zip(actors, tasks, strict=False)
    ] or [(source, tasks)]
    gathered: dict[str, Latents] = {}
    for number, (actor, played) in enumerate(players):

        def of_all(done: int, phases: int, text: str, number: int = number) -> None:
            report(number * phases + done, len(players) * phases, text)

        found = gather(
            source,
            played,
            rounds(source, samples),
            seed=seed,
            policy=policy,
            actor=actor,
            features=features,
            workers=workers,
            timeout=timeout,
            report=of_all,
        )
        gathered |= dict(zip(played, found, strict=True))
    drawn = {task: draw(latents, samples, seed) for task, latents in gathered.items()}
    return judge(
        tasks, known, drawn, thresholds=thresholds, neighbours=neighbours, quantile=quantile
    )


def draw(latents: Latents, samples: int, seed: int) -> tuple[Latents, Latents]:
    """S latent states of a task to fit on, and S to test: of the two halves of its phases.

    No episode goes from one phase on to the next, so none is in both.
    """
    fitted, tested = (half.draw(samples, seed) for half in latents.halves())
    return fitted, tested


def judge(
    tasks: Sequence[str],
    known: Sequence[str],
    drawn: Mapping[str, tuple[Latents, Latents]],
    *,
    thresholds: Sequence[float] = (),
    neighbours: int = ltc.NEIGHBOURS,
    quantile: float = 0.95,
) -> Outcome:
    """Fits a classifier on samples of the known tasks, and tests it on others of all tasks.

    Args:
      drawn: of each task, what `draw` gives.
      tasks, known, thresholds, neighbours, quantile: see `classify`.
    """
    tasks, known = tuple(tasks), tuple(known)
    fitted = {task: drawn[task][0] for task in known}
    tested = {task: drawn[task][1] for task in tasks}
    labels = np.concatenate([[i] * len(fitted[task].episodes) for i, task in enumerate(known)])
    model = ltc.fit(
        np.concatenate([fitted[task].features for task in known]), labels, neighbours=neighbours
    )
    # Numbers of episodes are those of a task: no two tasks share an episode.
    episodes = np.concatenate([fitted[task].episodes for task in known])
    groups = labels * (episodes.max() + 1) + episodes
    suggested = float(ltc.suggest_threshold(model, quantile=quantile, groups=groups))
    size = model.latents.shape[1]
    thresholds = (*(thresholds or latent_task_thresholds(size)), suggested)
    accuracies: list[dict[str, ltc.Accuracy]] = []
    for threshold in thresholds:
        results = {task: ltc.classify(model, tested[task].features, threshold) for task in tasks}
        accuracies.append(
            {
                task: ltc.accuracy(result, known.index(task) if task in known else ltc.NOVEL)
                for task, result in results.items()
            }
        )
    return Outcome(
        tasks=tasks,
        known=known,
        fitted=fitted,
        tested=tested,
        thresholds=thresholds,
        accuracies=tuple(accuracies),
        distances={task: np.asarray(result.distances) for task, result in results.items()},
        votes={
            # A latent that is not finite has no neighbours that could vote.
            task: Counter(
                known[vote] for vote in np.asarray(result.votes).tolist() if vote != ltc.NOVEL
            )
            for task, result in results.items()
        },
    )


def table(outcome: Outcome) -> str:
    """Accuracies in the form of Tables 13 to 15.

    A row for each threshold; for a novel task the share taken for novel, for a known one the share
    taken for not novel / the share whose neighbours vote for the right task.
    """
    called = titles(outcome.tasks)
    header = ["threshold"]
    header += [f"{called[task]}, novel" for task in outcome.novel]
    header += [called[task] for task in outcome.known]
    rows: list[list[str]] = []
    for threshold, accuracies in zip(outcome.thresholds, outcome.accuracies, strict=True):
        suggested = len(rows) == len(outcome.thresholds) - 1
        row = [f"{threshold:.4g}" + (" (suggested)" if suggested else "")]
        row += [f"{accuracies[task].correct:.2f}" for task in outcome.novel]
        row += [
            f"{accuracies[task].not_novel:.2f}/{accuracies[task].right_task:.2f}"
            for task in outcome.known
        ]
        rows.append(row)
    return aligned(header, rows)


def distance_table(outcome: Outcome) -> str:
    """Distances to the nearest fitted sample, and what the neighbours took each task for."""
    rows: list[list[str]] = []
    called = titles(outcome.tasks)
    for task in outcome.tasks:
        distances = outcome.distances[task]
        votes = ", ".join(f"{called[name]} {n}" for name, n in outcome.votes[task].most_common())
        if lost := round(float(outcome.accuracies[-1][task].not_finite) * len(distances)):
            votes = ", ".join(filter(None, [votes, f"not finite {lost}"]))
        name = called[task] + ("" if task in outcome.known else ", novel")
        rows.append(
            [name, f"{np.median(distances):.4g}", f"{distances.min():.4g}"]
            + [f"{distances.max():.4g}", votes]
        )
    return aligned(["distance to the nearest", "median", "lowest", "highest", "votes"], rows)


def to_dict(outcome: Outcome) -> dict[str, Any]:
    """The outcome without its latent states, as JSON can hold it."""
    return {
        "tasks": list(outcome.tasks),
        "known": list(outcome.known),
        "suggested_threshold": outcome.thresholds[-1],
        "accuracies": [
            {"threshold": threshold, "task": task, "known": task in outcome.known}
            | {name: float(share) for name, share in accuracies[task]._asdict().items()}
            for threshold, accuracies in zip(outcome.thresholds, outcome.accuracies, strict=True)
            for task in outcome.tasks
        ],
        "distances": {task: values.tolist() for task, values in outcome.distances.items()},
        "votes": {task: dict(votes) for task, votes in outcome.votes.items()},
    }


def principal_components(latents: np.ndarray, count: int = 2):
    """Mean [M], directions [count, M] and their shares of the variance [count]."""
    mean = latents.mean(0)
    _, sizes, directions = np.linalg.svd(latents - mean, full_matrices=False)
    total = max(float((sizes**2).sum()), np.finfo(np.float32).tiny)
    return mean, directions[:count], sizes[:count] ** 2 / total


def plot(outcome: Outcome, stem: str | Path) -> list[Path]:
    """Draws the latent states on their principal components, and the distances that ξ judges.

    Args:
      outcome: from `classify`.
      stem: where to, without suffix.

    Returns:
      The files written, PNG and SVG.
    """
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    figure, (left, right) = pyplot.subplots(1, 2, figsize=(12.8, 4.8), layout="constrained")
    parts = [*outcome.fitted.values(), *outcome.tested.values()]
    mean, directions, shares = principal_components(np.concatenate([x.features for x in parts]))
    palette, called = pyplot.get_cmap("tab10"), titles(outcome.tasks)
    random = np.random.default_rng(0)
    for number, task in enumerate(outcome.tasks):
        known, color = task in outcome.known, palette(number % 10)
        x, y = ((outcome.tested[task].features - mean) @ directions.T).T
        label = called[task] + ("" if known else " (novel)")
        left.scatter(
            x, y, label=label, color=color, s=18 if known else 30, marker="o" if known else "x"
        )
        if known:
            x, y = ((outcome.fitted[task].features - mean) @ directions.T).T
            left.scatter(x, y, color=color, s=4, alpha=0.4)
        distances = outcome.distances[task]
        height = number + random.uniform(-0.25, 0.25, len(distances))
        right.scatter(distances, height, color=color, s=8, marker="o" if known else "x")
    left.set_xlabel(f"first principal component ({shares[0]:.0%} of the variance)")
    left.set_ylabel(f"second ({shares[1]:.0%})")
    left.set_title("latent states: fitted (small) and tested (large)")
    figure.legend(*left.get_legend_handles_labels(), loc="outside lower center", ncols=6)
    for threshold in outcome.thresholds[:-1]:
        right.axvline(threshold, color="black", linewidth=0.8, linestyle=":")
    right.axvline(outcome.thresholds[-1], color="black", linewidth=0.8)
    right.set_yticks(
        range(len(outcome.tasks)),
        [called[task] + ("" if task in outcome.known else " (novel)") for task in outcome.tasks],
    )
    right.set_xlim(left=0)
    right.invert_yaxis()
    right.set_xlabel("Manhattan distance to the nearest fitted state")
    right.set_title("tested states; lines: thresholds ξ, solid the suggested one")
    paths = [Path(stem).with_suffix(suffix) for suffix in (".png", ".svg")]
    for path in paths:
        figure.savefig(path, dpi=150)
    pyplot.close(figure)
    return paths
