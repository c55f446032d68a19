"""Tables 13 to 15: latent states of the six tasks, gathered once, and what is told of them.

The agent is the one whose autoencoder is the universal one. Its folder under the root of results
holds samples.npz (latent states of each task, to fit on and to test) and, for each table, its
accuracies and a picture.

Axis letters: S samples, M latent feature size.
"""

import os
import zipfile
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

import envs
from dreamer_jax.files import write_json_atomically
from dreamer_jax.progress import Report, unreported
from experiments.runs import classify
from experiments.runs.agents import Source, load_source
from experiments.runs.folder import folders, latents_folder
from experiments.runs.latents import Latents, gather
from experiments.thesis.grid import AUTOENCODER, TASKS, Backend, LatentTable, multitask
from experiments.thesis.populations import task_name

SAMPLES = 100
"""Of each task to fit on, and as many to test (section 4.3.2)."""

Drawn = Mapping[str, tuple[Latents, Latents]]


def make_table(
    root: str | Path,
    table: LatentTable,
    seed: int,
    *,
    workers: int | None = None,
    timeout: float = envs.SIMULATOR_TIMEOUT,
    accept_failed: bool = False,
    say: Callable[[str], Any] = print,
    report: Report = unreported,
) -> Path:
    """Tells the tasks of a table's latent states; gathers them first if nobody has.

    Args:
      root: the folder of all results.
      table: which one.
      seed: of the agent, and of episodes and samples.
      workers: simulator processes; by default one per core.
      timeout: seconds after which a simulator that does not answer is given up.
      accept_failed: take an agent whose losses were not finite any more, as it was before.
      say: where messages go.
      report: called after each round of gathering; it counts them.

    Returns:
      The file of accuracies, which `reports.outcomes.read_classification` reads.

    Raises:
      ValueError: the agent is not trained or failed, or its samples are damaged.
    """
    folder = latents_folder(root, table.backend, seed)
    path = folder / f"{table.name}.json"
    if path.exists():
        return path
    names = {title: task_name(table.backend, title) for title in TASKS}
    if not (folder / "samples.npz").exists():
        say(f"latent states of {len(names)} tasks: {folder}")
        source = _agent(root, table.backend, seed, accept_failed)
        found = gather(
            source,
            tuple(names.values()),
            classify.rounds(source, SAMPLES),
            seed=seed,
            workers=workers,
            timeout=timeout,
            report=report,
        )
        drawn = {
            task: classify.draw(latents, SAMPLES, seed)
            for task, latents in zip(names.values(), found, strict=True)
        }
        _write(folder / "samples.npz", drawn)
    drawn = _read(folder / "samples.npz", tuple(names.values()))
    tasks = tuple(names[title] for title in table.tasks)
    outcome = classify.judge(tasks, tuple(names[title] for title in table.known), drawn)
    classify.plot(outcome, folder / table.name)
    size = next(iter(drawn.values()))[0].features.shape[1]
    header = {"samples": SAMPLES, "feature_size": size}
    write_json_atomically(path, header | classify.to_dict(outcome))
    return path


def _agent(root: str | Path, backend: Backend, seed: int, accept_failed: bool) -> Source:
    """The agent whose latent states are classified."""
    cell = multitask(backend, AUTOENCODER, seed)
    places = folders(root)
    if cell.name not in places:
        raise ValueError(f"the agent {cell.name!r} is not trained yet: its table trains it first")
    return load_source(*places[cell.name], accept_failed=accept_failed)


def _write(path: Path, drawn: Drawn) -> None:
    """All samples in one file: features [S, M] and episodes [S] of each task and half."""
    path.parent.mkdir(parents=True, exist_ok=True)
    arrays = {
        f"{task}/{half}/{name}": array
        for task, halves in drawn.items()
        for half, latents in zip(("fitted", "tested"), halves, strict=True)
        for name, array in latents._asdict().items()
    }
    temporary = path.with_suffix(".tmp")
    with open(temporary, "wb") as file:
        np.savez(file, **arrays)
    os.replace(temporary, path)


def _read(path: Path, tasks: tuple[str, ...]) -> dict[str, tuple[Latents, Latents]]:
    try:
        with np.load(path) as arrays:

            def half(task: str, name: str) -> Latents:
                return Latents(*(arrays[f"{task}/{name}/{field}"] for field in Latents._fields))

            return {task: (half(task, "fitted"), half(task, "tested")) for task in tasks}
    except (OSError, ValueError, KeyError, zipfile.BadZipFile) as error:
        raise ValueError(
            f"{path} is damaged ({error}): delete it, and its samples are gathered again"
        ) from error
