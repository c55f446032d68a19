"""One population: tasks, settings, seeds and perhaps a source -> a results folder.

A results folder holds run.json (what the run is), metrics.jsonl, timings.jsonl, tensorboard/,
checkpoints/, replay/, videos/ and, where knowledge was transferred, transfer.txt and
transfer.json. Axis letters: P population member, K task, A action.
"""

import dataclasses
import importlib.metadata
import json
import platform
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import jax
import jax.numpy as jnp
import numpy as np

import envs
import transfer
from dreamer_jax import config as configs
from dreamer_jax.agent import Agent, AgentState
from dreamer_jax.checkpoint import Checkpointer, load_tree
from dreamer_jax.config import Config
from dreamer_jax.files import read_json, write_json_atomically
from dreamer_jax.population import init_members
from dreamer_jax.training import Member, Run
from transfer.recipes import fractional_transfer

BASELINE = "baseline"


@dataclass(frozen=True)
class RunSpec:
    """What a results folder is a run of.

    Attributes:
      tasks: names of the K tasks; several make a multi-task agent.
      seeds: one member (or one for each omega) per seed.
      config: the settings.
      source: folder of the run whose agent is transferred; none for training from scratch.
      source_member: which member of the source's population.
      omegas: fractions of equation 19, one target per fraction and seed.
      baseline: whether agents from scratch, one per seed, join the transfer targets.
    """

    tasks: tuple[str, ...]
    seeds: tuple[int, ...]
    config: Config
    source: str | None = None
    source_member: int = 0
    omegas: tuple[float, ...] = ()
    baseline: bool = False

    def __post_init__(self):
        choices = ", ".join([*envs.task_names(), "gymnasium/ID"])
        _require(self.tasks, f"no task given: choose from {choices}")
        envs.specs(self.tasks)
        _require(len(set(self.tasks)) == len(self.tasks), f"a task is named twice: {self.tasks}")
        _require(self.seeds, "no seed given")
        _require(len(set(self.seeds)) == len(self.seeds), f"a seed is named twice: {self.seeds}")
        _require(
            all(0 <= seed < 2**31 for seed in self.seeds),
            f"seeds {self.seeds} must lie in [0, 2^31)",
        )
        if self.source is None:
            _require(not self.omegas, "--omega needs a source agent: add --source DIR")
        else:
            _require(self.omegas, "--source needs the fractions to transfer: add --omega 0 0.2")
            _require(
                all(0 <= omega <= 1 for omega in self.omegas),
                f"omega {self.omegas} must lie in [0, 1] (equation 19)",
            )

    @property
    def members(self) -> tuple[Member, ...]:
        """The population: seeds within fractions, then the baseline."""
        targets = tuple(
            Member(seed, f"omega={omega:g}", {"omega": omega})
            for omega in self.omegas
            for seed in self.seeds
        )
        scratch = tuple(Member(seed, BASELINE) for seed in self.seeds)
        return targets + (scratch if self.baseline or not targets else ())

    def to_dict(self) -> dict[str, Any]:
        """As JSON can hold it."""
        return dataclasses.asdict(self)

    @classmethod
    def from_dict(cls, values: Mapping[str, Any]) -> "RunSpec":
        """From `to_dict`'s result, by way of JSON too."""
        values = {k: tuple(v) if isinstance(v, list) else v for k, v in values.items()}
        return cls(**{**values, "config": configs.from_dict(values["config"])})

    def differences(self, other: "RunSpec") -> list[str]:
        """What differs between two, as "name: this / other"."""
        names = [field.name for field in dataclasses.fields(self) if field.name != "config"]
        pairs = [(name, getattr(self, name), getattr(other, name)) for name in names]
        return [f"{name}: {one} / {two}" for name, one, two in pairs if one != two] + (
            configs.differences(self.config, other.config)
        )


def _require(condition, message: str) -> None:
    if not condition:
        raise ValueError(message)


def read_spec(directory: str | Path) -> RunSpec:
    """The spec of a results folder.

    Raises:
      ValueError: the folder holds no run.
    """
    path = Path(directory) / "run.json"
    if not path.exists():
        raise ValueError(
            f"{directory} holds no run (there is no {path.name} in it); "
            "make one with: python -m experiments train --task ... --out " + str(directory)
        )
    return RunSpec.from_dict(read_json(path)["spec"])


def _versions() -> dict[str, str]:
    names = ("jax", "jaxlib", "flax", "optax", "numpy", "gymnasium", "pybullet", "pygame", "pillow")
    versions = {"python": platform.python_version(), "backend": jax.default_backend()}
    for name in names:
        try:
            versions[name] = importlib.metadata.version(name)
        except importlib.metadata.PackageNotFoundError:
            versions[name] = "not installed"
    return versions


def action_size(tasks: tuple[str, ...]) -> int:
    """A of an agent for several tasks: the largest of theirs (equation 18)."""
    return max(task.action_size for task in envs.specs(tasks))


@dataclass(frozen=True)
class Source:
    """A trained agent that knowledge is taken from.

    Attributes:
      directory: its results folder.
      spec: what that run is.
      params: the parameters of one member.
    """

    directory: Path
    spec: RunSpec
    params: dict[str, Any]


def load_source(directory: str | Path, member: int = 0) -> Source:
    """The agent of one member, from its run's newest checkpoint.

    Raises:
      ValueError: the folder holds no run, no checkpoint, or no such member.
    """
    directory = Path(directory)
    spec = read_spec(directory)
    count = len(spec.members)
    _require(
        0 <= member < count,
        f"{directory} has members 0 to {count - 1}, member {member} was asked for",
    )
    params = load_params(directory)
    return Source(directory, spec, jax.tree.map(lambda x: x[member], params))


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
    keys = [f.name for f in dataclasses.fields(one.network) if f.name != "precision"]
    different = [
        f"{key}: {getattr(one.network, key)} in the source, {getattr(two.network, key)} here"
        for key in keys
        if getattr(one.network, key) != getattr(two.network, key)
    ]
    _require(
        not different,
        f"the source {source.directory} has other networks ({'; '.join(different)}): "
        "choose the preset and sizes that it was trained with",
    )


def transferred_members(
    agent: Agent, spec: RunSpec, source: Source
) -> tuple[AgentState, transfer.Report]:
    """Fresh agents for all members, those with an omega after fractional transfer.

    Returns:
      The state, leaves [P, ...], and the report of what happened to each leaf.
    """
    members = spec.members
    seeds = jnp.array([member.seed for member in members], jnp.int32)
    fresh = init_members(agent, seeds).params
    count = len(spec.omegas) * len(spec.seeds)
    omegas = jnp.array([member.tags["omega"] for member in members[:count]], jnp.float32)
    targets, report = transfer.apply(
        fractional_transfer(),
        jax.tree.map(lambda x: x[:count], fresh),
        source.params,
        omega=omegas,
        population=True,
    )
    params = jax.tree.map(lambda new, old: jnp.concatenate([new, old[count:]]), targets, fresh)
    return jax.vmap(agent.start)(params, seeds), report


def make_run(
    spec: RunSpec, directory: str | Path, *, resume: bool = False, workers: int | None = None
) -> Run:
    """Prepares a run: simulators, agents, and the results folder.

    Args:
      spec: what to run.
      directory: the results folder.
      resume: continue what the folder holds.
      workers: simulator processes; by default one per core.

    Raises:
      ValueError: the folder holds another run, or the source does not fit.
      FileExistsError: the folder holds a run, and `resume` is False.
    """
    directory = Path(directory)
    header = directory / "run.json"
    if header.exists():
        different = read_spec(directory).differences(spec)
        _require(
            not different,
            f"{directory} holds another run (there / here: {'; '.join(different)}): "
            "give the same settings, or choose another folder",
        )
        if not resume:
            raise FileExistsError(
                f"{directory} already holds this run: add --resume, or choose another folder"
            )
    source = None
    if spec.source is not None and Checkpointer(directory / "checkpoints").latest() is None:
        source = load_source(spec.source, spec.source_member)
        check_source(source, spec)
    agent = make_agent(spec)
    env = make_env(spec, workers=workers)
    try:
        directory.mkdir(parents=True, exist_ok=True)
        state = None
        if source is not None:
            state, report = transferred_members(agent, spec, source)
            write_report(report, directory)
        # Written last: what has a header can be resumed.
        if not header.exists():
            write_json_atomically(header, {"spec": spec.to_dict(), "versions": _versions()})
        return Run(agent, env, spec.tasks, spec.members, directory, state=state, resume=True)
    except BaseException:
        env.close()
        raise


def make_agent(spec: RunSpec) -> Agent:
    """The functions of a run's agents."""
    discrete = envs.specs(spec.tasks)[0].discrete
    return Agent(spec.config, action_size(spec.tasks), discrete)


def make_env(spec: RunSpec, workers: int | None = None) -> envs.Env:
    """The simulators of a run: one for every member and task."""
    return envs.make(
        spec.tasks,
        members=len(spec.members),
        image_size=spec.config.network.image_size,
        action_repeat=spec.config.schedule.action_repeat,
        workers=workers,
    )


def write_report(report: transfer.Report, directory: Path) -> None:
    """Writes what was transferred as transfer.txt (for people) and transfer.json."""
    (directory / "transfer.txt").write_text(f"{report}\n")
    records = json.dumps(report.records(), indent=1, default=_plain)
    (directory / "transfer.json").write_text(records + "\n")


def _plain(value):
    return np.asarray(value).tolist()


def carry_out(run: Run) -> Literal["finished", "stopped"]:
    """Trains to the end or to Ctrl-C, and closes the run and its simulators."""
    try:
        return run.train()
    finally:
        run.close()
        run.env.close()
