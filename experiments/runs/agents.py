"""The agents and simulators of a run, as its spec says, and trained agents read back.

Axis letters: P population member, A action.
"""

import dataclasses
import functools
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jax

import envs
import transfer
from dreamer_jax.agent import Agent
from dreamer_jax.checkpoint import load_tree
from dreamer_jax.config import HOW_COMPUTED
from experiments.runs import exported
from experiments.runs.folder import failed_members
from experiments.runs.spec import RunSpec, action_size, read_spec


@functools.cache
def make_agent(spec: RunSpec) -> Agent:
    """The functions of a run's agents. What its method freezes is frozen in them."""
    discrete = envs.specs(spec.tasks)[0].discrete
    agent = Agent(spec.config, action_size(spec.tasks), discrete)
    if modules := spec.method.modules(agent):
        agent = dataclasses.replace(agent, modules=modules)
    if (chosen := spec.method.plan()) is None:
        return agent
    fresh = agent.parameter_shapes()
    kept = [path for path, rule in transfer.claims(chosen, fresh).items() if rule.frozen]
    learning = spec.config.learning
    learning = dataclasses.replace(learning, frozen=(*learning.frozen, *kept))
    return dataclasses.replace(agent, config=dataclasses.replace(spec.config, learning=learning))


def make_env(
    spec: RunSpec,
    workers: int | None = None,
    timeout: float = envs.SIMULATOR_TIMEOUT,
    shards: int = 1,
) -> envs.Env:
    """The simulators of a run: one for every member and task; `shards` devices play them."""
    return envs.make(
        spec.tasks,
        members=len(spec.members),
        image_size=spec.config.network.image_size,
        action_repeat=spec.config.schedule.action_repeat,
        workers=workers,
        supersample=spec.config.schedule.supersample,
        timeout=timeout,
        shards=shards,
    )


@dataclass(frozen=True)
class Source:
    """A trained agent that knowledge is taken from.

    Attributes:
      directory: its results folder, or its file of weights.
      spec: what its run is.
      params: the parameters of one member.
    """

    directory: Path
    spec: RunSpec
    params: dict[str, Any]


def load_source(
    name: str | Path, member: int = 0, base: str | Path = "", *, accept_failed: bool = False
) -> Source:
    """A trained agent: one member of a run, from its newest checkpoint, or an exported one.

    Args:
      name: a results folder, a .safetensors file with its card, or "zoo:NAME".
      member: which of the run's population.
      base: the folder that relative paths start from; by default the working directory.
      accept_failed: take a member that met losses that are not finite, as it was before.

    Raises:
      ValueError: there is no run, no checkpoint, no such member, or no sound file; or the member
        failed.
    """
    if exported.is_exported(name):
        if member:
            raise ValueError(f"{name} holds one agent, member {member} was asked for")
        params = exported.read_params(name, base)
        return Source(
            exported.weights_path(name, base), exported.read_card(name, base).spec, params
        )
    directory = Path(base) / name
    spec = read_spec(directory)
    count = len(spec.members)
    if not 0 <= member < count:
        raise ValueError(f"{directory} has members 0 to {count - 1}, member {member} was asked for")
    if not accept_failed:
        check_sound(directory, member)
    params = load_params(directory)
    return Source(directory, spec, jax.tree.map(lambda x: x[member], params))


def check_sound(directory: str | Path, member: int) -> None:
    """Checks that a member of a run has not failed.

    Raises:
      ValueError: it has.
    """
    if member in failed_members(directory):
        sound = sorted(set(range(len(read_spec(directory).members))) - failed_members(directory))
        others = f"take member {', '.join(map(str, sound))}" if sound else "train it anew"
        raise ValueError(
            f"member {member} of {directory} failed: its losses were not finite any more, and it "
            f"stayed as it was before. {others[0].upper()}{others[1:]}, or insist with "
            "--accept-failed"
        )


def load_params(directory: str | Path) -> dict[str, Any]:
    """The parameters of a run's population from its newest checkpoint, NumPy leaves [P, ...].

    Raises:
      ValueError: there is no checkpoint.
    """
    try:
        return load_tree(Path(directory) / "checkpoints", subtree="agent/params")
    except FileNotFoundError:
        raise ValueError(
            f"{directory} has no checkpoint: train it (or resume it) until it has one"
        ) from None


def check_source(source: Source, spec: RunSpec) -> None:
    """Checks that a source's networks are of the target's sizes.

    Raises:
      ValueError: naming every setting that differs, on both sides.
    """
    one, two = source.spec.config, spec.config
    keys = [f.name for f in dataclasses.fields(one.network) if f.name not in HOW_COMPUTED]
    different = [
        f"{key}: {getattr(one.network, key)} in the source, {getattr(two.network, key)} here"
        for key in keys
        if getattr(one.network, key) != getattr(two.network, key)
    ]
    if different:
        raise ValueError(
            f"the source {source.directory} has other networks ({'; '.join(different)}): "
            "choose the preset and sizes that it was trained with"
        )
