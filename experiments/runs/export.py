"""A member of a run -> an exported agent: weights and a card, see `experiments.runs.exported`."""

from pathlib import Path
from typing import Any

import numpy as np

import envs
import transfer
from dreamer_jax.checkpoint import Checkpointer
from dreamer_jax.files import write_json_atomically
from dreamer_jax.integrity import read_sealed_json
from dreamer_jax.logs import read_metrics
from dreamer_jax.progress import Report, unreported
from dreamer_jax.schedule import Schedule
from experiments.runs.agents import load_source
from experiments.runs.evaluate import evaluate, load_agents
from experiments.runs.exported import FORMAT, SUFFIX, Card, file_sha256


def export(
    directory: str | Path,
    path: str | Path,
    *,
    member: int = 0,
    episodes: int = 10,
    note: str = "",
    accept_failed: bool = False,
    workers: int | None = None,
    timeout: float = envs.SIMULATOR_TIMEOUT,
    report: Report = unreported,
) -> Card:
    """Writes one member of a run as weights and a card, after playing episodes with it.

    Args:
      directory: the results folder; its newest checkpoint is exported.
      path: the file of weights to write, ending in .safetensors.
      member: which of the population.
      episodes: to play of each task, for the card.
      note: a sentence for the card.
      accept_failed: export a member that met losses that are not finite, as it was before.
      workers: simulator processes; by default one per core.
      timeout: seconds after which a simulator that does not answer is given up.
      report: called after each episode, with its mean return; it counts episodes.

    Raises:
      ValueError: the path ends otherwise; the folder holds no run, no checkpoint, no such member,
        one that failed (unless that is accepted), or parameters that are not finite.
      FileExistsError: there is such a file already.
    """
    directory, path = Path(directory), Path(path)
    if path.suffix != SUFFIX:
        raise ValueError(f"weights are written as {SUFFIX}, and {path} ends otherwise")
    for there in (path, path.with_suffix(".json")):
        if there.exists():
            raise FileExistsError(f"{there} is there already: choose another name, or remove it")
    if episodes < 1:
        raise ValueError(f"a card needs episodes: {episodes} were asked for, must be at least 1")
    source = load_source(directory, member, accept_failed=accept_failed)
    spec, params, chosen = source.spec, source.params, source.spec.members[member]
    for name, leaf in transfer.flatten(params).items():
        if not np.all(np.isfinite(leaf)):
            raise ValueError(f"{name} of member {member} of {directory} is not finite")
    returns = _play(directory, member, episodes, workers=workers, timeout=timeout, report=report)
    counters = Checkpointer(directory / "checkpoints").metadata()["counters"]
    schedule = Schedule(spec.config.schedule, len(spec.tasks))
    steps = schedule.environment_steps(counters["rounds"])
    header = read_sealed_json(directory / "run.json")
    path.parent.mkdir(parents=True, exist_ok=True)
    transfer.save(path, params)
    card = Card(
        spec=spec,
        seed=chosen.seed,
        label=chosen.label,
        environment_steps=steps,
        updates=counters["updates"],
        curves=_curves(directory, member, steps),
        returns=returns,
        revision=header.get("revision", "unknown"),
        versions=header.get("versions", {}),
        sha256=file_sha256(path),
        note=note,
    )
    values = {**vars(card), "spec": spec.to_dict(), "format": FORMAT}
    write_json_atomically(path.with_suffix(".json"), values)
    return card


def _play(directory: Path, member: int, episodes: int, **options: Any) -> dict[str, tuple]:
    """Returns of episodes of one member, by name of the task; options are those of `evaluate`."""
    rows = evaluate(load_agents(directory), episodes, **options)
    returns: dict[str, tuple[float, ...]] = {}
    for row in rows:
        if row["member"] == member:
            returns[row["task"]] = (*returns.get(row["task"], ()), round(row["return"], 2))
    return returns


def _curves(directory: Path, member: int, steps: int) -> dict[str, tuple]:
    """Evaluation returns of one member up to a number of environment steps, by name of the task."""
    curves: dict[str, tuple[tuple[int, float], ...]] = {}
    for row in read_metrics(directory / "metrics.jsonl"):
        if (row["kind"], row["member"]) == ("evaluation", member) and row["env_steps"] <= steps:
            point = (row["env_steps"], round(row["return"], 2))
            curves[row["task"]] = (*curves.get(row["task"], ()), point)
    return curves
