"""Damage to the files of a results folder: told clearly, without effect, or silent.

All in one process, by the functions that the commands call: reading the header, going back to the
newest checkpoint, sampling all of the replay, and reading the metrics for a report.
"""

import contextlib
import random
import shutil
import warnings
from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path

import jax
import numpy as np

from dreamer_jax.checkpoint import CorruptCheckpointError
from dreamer_jax.config import preset
from dreamer_jax.integrity import DamagedError, write_sealed_json
from dreamer_jax.records import Records
from dreamer_jax.run_folder import RunFolder
from dreamer_jax.schema import COUNTERS
from experiments.reports.outcomes import read_run
from experiments.runs.folder import read_cells
from experiments.runs.spec import RunSpec, read_spec
from experiments.runs.verify import findings_of

LAYOUT = {"members": 2, "tasks": 1, "image_size": 8, "action_size": 2}
SPEC = RunSpec(("bullet/hopper",), (0, 1), preset("debug"))
IGNORED = ("timings.jsonl", "tensorboard", ".lock")
"""What no command reads back but to show it."""


@dataclass
class Outcome:
    """What became of damages: how many were told, how many had no effect, and which were silent."""

    told: int = 0
    harmless: int = 0
    silent: list[str] = field(default_factory=list)
    verified: int = 0
    kinds: Counter = field(default_factory=Counter)


def state(number: int) -> dict:
    """Something like an agent, which differs from checkpoint to checkpoint."""
    random = np.random.default_rng(number)
    return {"params": {"kernel": random.normal(size=(40, 30)).astype(np.float32)}, "step": number}


def make_folder(directory: Path, phases: int = 4) -> Path:
    """A results folder of two members, with all files that a run's has."""
    directory.mkdir(parents=True, exist_ok=True)
    content = {"spec": SPEC.to_dict(), "cells": ["one", "two"], "revision": "made up"}
    write_sealed_json(directory / "run.json", content)
    (directory / "cells.json").write_text('["one", "two"]\n')
    go_on(directory, phases)
    return directory


def go_on(directory: Path, phases: int, every: int = 1) -> None:
    """Begins or resumes what stands for a training: records, metrics, and a checkpoint now and
    then, all functions of the number of the phase."""
    folder = RunFolder(directory, lock=None, resume=True, layout=LAYOUT)
    found = folder.restore(state(0))
    if found is None:  # as a training does, so that nothing is ever without a checkpoint
        folder.save(0, state(0), dict.fromkeys(COUNTERS, 0))
    for number in range(found[1]["rounds"] if found else 0, phases):
        chance, shape = np.random.default_rng(number), (2, 1, 21)
        folder.replay.append(
            Records(
                image=chance.integers(0, 256, (*shape, 8, 8, 3), dtype=np.uint8),
                action=chance.normal(size=(*shape, 2)).astype(np.float32),
                reward=chance.normal(size=shape).astype(np.float32),
                first=np.arange(21) % 7 == np.zeros(shape, int),
                terminal=np.zeros(shape, bool),
            )
        )
        for member in range(2):
            row = {"kind": "evaluation", "member": member, "seed": member, "label": "baseline"}
            row |= {"env_steps": 40 * number, "task": SPEC.tasks[0], "return": chance.normal()}
            folder.writer.write(row)
        if number % every == every - 1 or number == phases - 1:
            counters = {"rounds": number + 1, "updates": 2 * number, "evaluations": number}
            folder.save(number + 1, state(number), {**counters, "averaged": 0})
    folder.close()


def read_all(directory: Path) -> tuple:
    """All that a resumed run and a report read, as values that can be compared."""
    spec, cells, rows = read_spec(directory), read_cells(directory), repr(read_run(directory))
    rows = rows.replace(str(directory), "")
    folder = RunFolder(directory, lock=None, resume=True, layout=LAYOUT)
    try:
        tree, counters = folder.restore(state(0))
        replay, lengths = folder.replay, folder.replay.lengths
        records = [
            value.tobytes()
            for stream in np.ndindex(*lengths.shape)
            for value in replay.read(*stream, 0, int(lengths[stream]))
        ]
        metrics = (directory / "metrics.jsonl").read_bytes()
    finally:
        folder.close()
    arrays = [np.asarray(leaf).tobytes() for leaf in jax.tree.leaves(tree)]
    return spec, cells, rows, tuple(counters.items()), records, metrics, arrays


def targets(directory: Path) -> list[Path]:
    """The files that are damaged."""
    files = [path for path in sorted(directory.rglob("*")) if path.is_file()]
    return [f for f in files if not set(f.relative_to(directory).parts) & set(IGNORED)]


def damage(path: Path, chance: random.Random) -> str:
    """Damages a file in one of several ways; says which."""
    data = bytearray(path.read_bytes())
    kinds = ["flip", "byte", "zeros", "cut", "grow", "digit", "gone", "empty"]
    kind, place = chance.choice(kinds), chance.randrange(max(1, len(data)))
    digits = [i for i, byte in enumerate(data) if 48 <= byte <= 57]
    if kind == "gone":
        path.unlink()
        return kind
    if kind == "flip" and data:
        data[place] ^= 1 << chance.randrange(8)
    elif kind == "byte" and data:
        data[place] = chance.randrange(256)
    elif kind == "zeros":
        data[place : place + 64] = bytes(len(data[place : place + 64]))
    elif kind == "cut":
        del data[place:]
    elif kind == "grow":
        data += bytes(chance.randrange(1, 200))
    elif kind == "digit" and digits:
        data[chance.choice(digits)] = 48 + chance.randrange(10)
    elif kind == "empty":
        data.clear()
    path.write_bytes(data)
    return kind


def damage_folders(count: int, folder: Path, seed: int = 0) -> Outcome:
    """Damages a file of a folder `count` times, each time anew, and looks what is told."""
    whole, outcome = make_folder(folder / "whole"), Outcome()
    expected = read_all(whole)
    for number in range(count):
        chance = random.Random(f"{seed} {number}")
        broken = folder / "broken"
        shutil.copytree(whole, broken)
        files = targets(broken)
        # Each kind of file as often as the others, however many there are of it.
        by_kind = {}
        for path in files:
            by_kind.setdefault(path.name if path.suffix == ".json" else path.suffix, []).append(
                path
            )
        path = chance.choice(by_kind[chance.choice(sorted(by_kind))])
        before = path.read_bytes()
        kind = damage(path, chance)
        name = f"{number}: {kind} in {path.relative_to(broken)}"
        same = path.exists() and path.read_bytes() == before
        outcome.kinds[kind] += 1
        outcome.verified += any(one.state == "damaged" for one in findings_of(broken))
        with warnings.catch_warnings(record=True) as warned:
            warnings.simplefilter("always")
            try:
                found = read_all(broken)
            except (DamagedError, CorruptCheckpointError, ValueError, OSError) as error:
                if len(str(error)) > 1500 or str(broken) not in str(error):
                    outcome.silent.append(f"{name}: unclear: {error}")
                else:
                    outcome.told += 1
            except Exception as error:
                outcome.silent.append(f"{name}: {type(error).__name__}: {error}")
            else:
                if same or found == expected:
                    outcome.harmless += 1
                elif any(str(broken) in str(one.message) for one in warned):
                    outcome.told += 1  # and gone on from the checkpoint before
                else:
                    outcome.silent.append(name)
        with contextlib.suppress(FileNotFoundError):
            shutil.rmtree(broken)
    return outcome
