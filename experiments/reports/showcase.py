"""One run of transfer targets and agents from scratch: what it shows, as a sentence and a video.

Axis letters: P population member, K task, T records of a phase.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import jax
import numpy as np

import envs
from dreamer_jax.video import captioned, write_video
from experiments.methods import BASELINE
from experiments.reports import verdicts
from experiments.reports.outcomes import Run
from experiments.runs.agents import Source
from experiments.runs.evaluate import Agents, play
from experiments.runs.spec import RunSpec

FRAMES_A_SECOND = 30


class Effect(NamedTuple):
    """What one group of targets scores more than the agents from scratch.

    A score is the mean return of all evaluations of an agent, "overall" in the thesis's tables.

    Attributes:
      label: of the targets.
      difference, low, high: of the mean scores, with its interval of 95 %.
      verdict: after Holm's correction over all groups; None below five seeds.
      reached: environment steps at the first evaluation in which the targets' mean is at least what
        agents from scratch have in their last; None if there is none.
    """

    label: str
    difference: float
    low: float
    high: float
    verdict: verdicts.Verdict | None
    reached: int | None


def effects(run: Run, task: str) -> list[Effect]:
    """The effect of each group of targets of a run that is done.

    Raises:
      ValueError: there are no agents from scratch, or an agent is not done.
    """
    curves = _curves(run, task)
    if BASELINE not in curves or len(curves) < 2:
        raise ValueError(f"{run.folder} has no transfer targets beside agents from scratch")
    baseline = curves.pop(BASELINE)
    last = baseline[:, -1].mean()
    steps = run.outcomes[0].env_steps
    groups = [curve.mean(axis=1) for curve in curves.values()]
    found = verdicts.differences(groups, baseline.mean(axis=1))
    corrected = verdicts.holm(found.chance)
    told = []
    for i, (label, curve) in enumerate(curves.items()):
        enough = min(len(curve), len(baseline)) >= verdicts.LEAST_SEEDS
        reached = np.flatnonzero(curve.mean(axis=0) >= last)
        told.append(
            Effect(
                label=label,
                difference=float(found.value[i]),
                low=float(found.low[i]),
                high=float(found.high[i]),
                verdict=verdicts.verdict(found.value[i], corrected[i]) if enough else None,
                reached=int(steps[reached[0]]) if len(reached) else None,
            )
        )
    return told


def _curves(run: Run, task: str) -> dict[str, np.ndarray]:
    """Returns of evaluations [N, E] by label, in the order of the members."""
    found: dict[str, list[Sequence[float]]] = {}
    for member, outcome in zip(run.spec.members, run.outcomes, strict=True):
        if outcome.state != "done":
            raise ValueError(
                f"{member.label}, seed {member.seed} of {run.folder} is {outcome.state}: go on "
                "with the run, or leave it out"
            )
        found.setdefault(member.label, []).append(outcome.returns[task])
    return {label: np.array(curves) for label, curves in found.items()}


def sentence(run: Run, task: str, source: str) -> str:
    """What a run shows, in words: of the group whose effect is the largest, either way.

    Args:
      run: with agents from scratch in it, done.
      task: the name of the target.
      source: what the source is called.
    """
    title = envs.described(task).title
    best = max(effects(run, task), key=lambda effect: abs(effect.difference))
    baseline = _curves(run, task)[BASELINE]
    seeds, steps = len(baseline), run.outcomes[0].env_steps
    told = (
        f"{best.difference:+.0f}, 95 % interval {best.low:+.0f} to {best.high:+.0f}, {seeds} "
        f"seed{'s' if seeds > 1 else ''} on either side, mean return over {steps[-1]:,} "
        "environment steps"
    )
    if best.verdict is None:
        return (
            f"{title}: {seeds} seeds are too few to say what the transfer from {source} does "
            f"({best.label} less scratch: {told}); {verdicts.LEAST_SEEDS} can."
        )
    if best.verdict == "undecided":
        return (
            f"{title}: no difference is seen between agents from {source} and from scratch "
            f"({best.label}: {told})."
        )
    word = "better" if best.verdict == "positive" else "worse"
    text = f"{title}: agents from {source} ({best.label}) do {word} than from scratch ({told})"
    if best.verdict == "positive" and best.reached is not None:
        text += (
            f"; what agents from scratch have after {steps[-1]:,} steps, a mean of "
            f"{baseline[:, -1].mean():.0f}, they have after {best.reached:,}"
        )
    return text + "."


class Panel(NamedTuple):
    """One video of several side by side.

    Attributes:
      caption: what it shows.
      frames: uint8 [T, height, width, 3].
    """

    caption: str
    frames: np.ndarray


def source_panel(
    source: Source,
    task: str,
    *,
    workers: int | None = None,
    timeout: float = envs.SIMULATOR_TIMEOUT,
) -> Panel:
    """An episode of a source agent on the one of its tasks that is most like a target's.

    Args:
      source: of plain networks.
      task: the target's name.
      workers: simulator processes; by default one per core.
      timeout: seconds after which a simulator that does not answer is given up.

    Raises:
      ModuleNotFoundError: the task's simulator is not installed.
    """
    alike = [
        one for one in source.spec.tasks if envs.described(one).title == envs.described(task).title
    ]
    own = (alike or list(source.spec.tasks))[0]
    spec = RunSpec((own,), (0,), source.spec.config)
    params = jax.device_put(jax.tree.map(lambda x: x[None], source.params))
    records = play(Agents(source.directory, spec, params), workers=workers, timeout=timeout)
    score = records.reward[0, 0].sum()
    return Panel(f"source on {own}\nreturn {score:.0f}", records.image[0, 0])


def member_panels(
    agents: Agents,
    run: Run,
    *,
    workers: int | None = None,
    timeout: float = envs.SIMULATOR_TIMEOUT,
) -> list[Panel]:
    """An episode of the middle one of each group of a run's agents, by their scores.

    Args:
      agents: the run's population, on one task.
      run: their evaluations.
      workers: simulator processes; by default one per core.
      timeout: seconds after which a simulator that does not answer is given up.
    """
    records = play(agents, workers=workers, timeout=timeout)
    groups: dict[str, list[int]] = {}
    for place, member in enumerate(run.spec.members):
        groups.setdefault(member.label, []).append(place)
    panels = []
    for label, places in groups.items():
        scores = [np.mean(run.outcomes[place].returns[run.spec.tasks[0]]) for place in places]
        middle = places[int(np.argsort(scores)[len(scores) // 2])]
        name = "from scratch" if label == BASELINE else label
        score = records.reward[middle, 0].sum()
        caption = f"{name}, seed {run.spec.members[middle].seed}\nreturn {score:.0f}"
        panels.append(Panel(caption, records.image[middle, 0]))
    return panels


def write_film(panels: Sequence[Panel], path: str | Path) -> Path:
    """Writes videos side by side under their captions, as long as the shortest of them."""
    length = min(len(panel.frames) for panel in panels)
    videos = np.stack([panel.frames[:length] for panel in panels])
    captions = [panel.caption for panel in panels]
    return write_video(path, captioned(videos, captions), fps=FRAMES_A_SECOND)
