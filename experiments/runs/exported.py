"""Trained agents as files to share, and the zoo of those that come with this package.

An exported agent is two files of one name: its weights (.safetensors) and its card (.json), which
says what the agent was trained on and how well it does. The zoo is a folder of them; "zoo:NAME" is
the agent of that name there. `experiments.runs.export` makes them.
"""

import hashlib
import os
import statistics
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import scipy.stats

import envs
import transfer
from dreamer_jax.files import read_json
from experiments.runs.spec import RunSpec

ZOO = Path(__file__).parent.parent / "zoo"
"""The folder of the agents that come with this package."""
PREFIX = "zoo:"
SUFFIX = ".safetensors"
FORMAT = 1


@dataclass(frozen=True)
class Card:
    """What is known of an exported agent.

    Attributes:
      spec: the run that it is a member of.
      seed, label: which member.
      environment_steps, updates: how long it had been trained.
      curves: evaluation returns along its training, by name of the task: (environment steps,
        return).
      returns: of whole episodes of the exported agent (the mode, without noise), by name of the
        task.
      revision, versions: of this package, and of others, when the run was begun.
      sha256: of the file of weights, in hexadecimal.
      note: what else its maker says.
    """

    spec: RunSpec
    seed: int
    label: str
    environment_steps: int
    updates: int
    curves: Mapping[str, tuple[tuple[int, float], ...]]
    returns: Mapping[str, tuple[float, ...]]
    revision: str
    versions: Mapping[str, str]
    sha256: str
    note: str = ""

    def verdict(self, task: str) -> str:
        """How well the agent does a task, beside the returns of those who have learned nothing.

        Learned is what lies above the returns of random and of constant actions with 95 %
        confidence (Student's t over its episodes).
        """
        returns = self.returns[task]
        mean, spread = statistics.fmean(returns), np.std(returns)
        words = f"{mean:.0f} ± {spread:.0f} in {len(returns)} episodes"
        known = envs.described(task)
        idle = {name: value for name, value in known.levels if name != "balanced"}
        if not idle:
            return f"{words}; no level is known to compare it with"
        best = max(idle, key=idle.__getitem__)
        beside = f"{best} {idle[best]:.0f}"
        if _lower_bound(returns) <= idle[best]:
            return f"{words}; has not learned it ({beside})"
        solved = dict(known.levels).get("balanced")
        if solved is None:
            return f"{words}; above {beside}"
        share = (mean - idle[best]) / (solved - idle[best])
        return f"{words}; {100 * share:.0f} % of the way from {beside} to balanced {solved:.0f}"


def _lower_bound(values: tuple[float, ...]) -> float:
    """Of the mean, with 95 % confidence."""
    if len(values) < 2:
        return -np.inf
    error = statistics.stdev(values) / len(values) ** 0.5
    return statistics.fmean(values) - scipy.stats.t.ppf(0.95, len(values) - 1) * error


def is_exported(name: str | os.PathLike) -> bool:
    """Whether a source's name is that of an exported agent, and not of a results folder."""
    return str(name).startswith(PREFIX) or str(name).endswith(SUFFIX)


def weights_path(name: str | os.PathLike, base: str | os.PathLike = "") -> Path:
    """The file of weights of an exported agent.

    Args:
      name: "zoo:NAME", or the path of a .safetensors file.
      base: the folder that relative paths start from.

    Raises:
      ValueError: the zoo has no such agent; names those it has.
    """
    name = str(name)
    if not name.startswith(PREFIX):
        return Path(base) / name
    title = name.removeprefix(PREFIX)
    if title not in (there := zoo()):
        raise ValueError(
            f"the zoo has no agent {title!r}: choose from {', '.join(there) or 'none'} "
            "(python -m experiments zoo says more of each)"
        )
    return ZOO / f"{title}{SUFFIX}"


def zoo() -> tuple[str, ...]:
    """Names of the agents that come with this package, without "zoo:"."""
    return tuple(sorted(path.stem for path in ZOO.glob(f"*{SUFFIX}")))


def read_card(name: str | os.PathLike, base: str | os.PathLike = "") -> Card:
    """The card of an exported agent.

    Args:
      name, base: as for `weights_path`.

    Raises:
      ValueError: there is none, or it is no card.
    """
    path = weights_path(name, base).with_suffix(".json")
    if not path.exists():
        raise ValueError(
            f"there is no {path}, the card beside the weights: python -m experiments export makes "
            "both, and they are moved together"
        )
    values = read_json(path)
    try:
        if values["format"] != FORMAT:
            raise ValueError(f"its format is {values['format']!r}, read are those of {FORMAT}")
        return Card(
            spec=RunSpec.from_dict(values["spec"]),
            seed=int(values["seed"]),
            label=str(values["label"]),
            environment_steps=int(values["environment_steps"]),
            updates=int(values["updates"]),
            curves={
                task: tuple((int(steps), float(score)) for steps, score in curve)
                for task, curve in values["curves"].items()
            },
            returns={task: tuple(map(float, found)) for task, found in values["returns"].items()},
            revision=str(values["revision"]),
            versions=dict(values["versions"]),
            sha256=str(values["sha256"]),
            note=str(values["note"]),
        )
    except (KeyError, TypeError, AttributeError, ValueError) as error:
        raise ValueError(f"{path} is not the card of an exported agent: {error!r}") from error


def read_params(name: str | os.PathLike, base: str | os.PathLike = "") -> dict[str, Any]:
    """The parameters of an exported agent: nested, NumPy leaves without an axis of members.

    Args:
      name, base: as for `weights_path`.

    Raises:
      ValueError: there is no such file, it is damaged, or it is not the one of its card.
    """
    path = weights_path(name, base)
    card = read_card(name, base)
    if not path.exists():
        raise ValueError(f"there is no {path}, the weights beside their card")
    if (found := file_sha256(path)) != card.sha256:
        raise ValueError(
            f"{path} is not the file that its card was written for (SHA-256 {found[:12]}…, the "
            f"card says {card.sha256[:12]}…): one of both is damaged or was replaced; fetch or "
            "export both again"
        )
    nested: dict[str, Any] = {}
    for leaf, value in transfer.load(path).items():
        *above, last = leaf.split("/")
        place = nested
        for part in above:
            place = place.setdefault(part, {})
        place[last] = value
    return nested


def file_sha256(path: Path) -> str:
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()
