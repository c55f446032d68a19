"""Train, transfer, evaluate and act from Python, without the command line.

    from experiments import evaluate, load, train, transfer

    source = train("bullet/inverted_pendulum", preset="demo")
    target = transfer(source, "bullet/inverted_double_pendulum", omegas=(0.0, 0.2), baseline=True)
    rows = evaluate(target, episodes=3)

    agent = load(target)
    env, memory = agent.environment(), agent.start()
    image, _ = env.reset(seed=0)
    action, memory = agent.act(image, memory)
    image, reward, fell, cut, _ = env.step(action)

Each run is kept in a folder, by default in runs/ of the working folder under a name of its own: the
same call again goes on where it was stopped, and gives what is there once it is done.

Axis letters: P population member, A action.
"""

import dataclasses
import difflib
import functools
import hashlib
import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import gymnasium
import jax
import jax.numpy as jnp
import numpy as np

import envs
from dreamer_jax import config as configs
from dreamer_jax.agent import Agent, Carry
from dreamer_jax.config import Config
from dreamer_jax.devices import Choice
from dreamer_jax.randomness import acting_key
from envs.pixel_env import PixelEnv
from experiments import methods
from experiments.runs import evaluate as evaluation
from experiments.runs.agents import load_source, make_agent
from experiments.runs.memory import in_memory, mapped
from experiments.runs.run import carry_out, make_run
from experiments.runs.spec import RunSpec
from experiments.runs.ways_out import CALL

RUNS = Path("runs")
"""Where runs are kept that are given no folder."""


@dataclasses.dataclass(frozen=True)
class Trained:
    """A run that is done.

    Attributes:
      directory: its results folder.
      spec: what it is a run of.
    """

    directory: Path
    spec: RunSpec

    @property
    def members(self) -> tuple[str, ...]:
        """What each agent of the population is called, in order."""
        return tuple(f"{member.label}, seed {member.seed}" for member in self.spec.members)


class Memory(NamedTuple):
    """What an agent remembers of an episode.

    Attributes:
      carry: of its policy.
      step: int32 [], agent steps of the episode so far.
    """

    carry: Carry
    step: jax.Array


@dataclasses.dataclass(frozen=True, eq=False)
class Player:
    """A trained agent that acts: the mode of its policy, without noise.

    Attributes:
      spec: of its run.
      agent: its functions.
      params: its parameters.
    """

    spec: RunSpec
    agent: Agent
    params: Any

    def start(self) -> Memory:
        """The memory before an episode."""
        return Memory(self.agent.initial_carry(), jnp.int32(0))

    def act(self, image: np.ndarray, memory: Memory) -> tuple[np.ndarray, Memory]:
        """Chooses an action.

        Args:
          image: uint8 [size, size, 3].
          memory: from `start`, or from the step before.

        Returns:
          The action, float32 [A], and the new memory.

        Raises:
          ValueError: the image is not of the agent's size.
        """
        size = self.spec.config.network.image_size
        if np.shape(image) != (size, size, 3):
            raise ValueError(
                f"the image has the shape {np.shape(image)}, the agent reads {(size, size, 3)}: "
                "its `environment` draws such"
            )
        action, memory = _act(self.agent, self.params, memory, jnp.asarray(image, jnp.uint8))
        return np.asarray(action), memory

    def environment(self, task: str | None = None) -> gymnasium.Env:
        """A task as the agent was trained on it: one simulator with gymnasium's interface.

        Args:
          task: its name; by default the first that the agent was trained on.

        Raises:
          ValueError: there is no such task, or its actions are more than the agent's.
        """
        schedule = self.spec.config.schedule
        task = self.spec.tasks[0] if task is None else task
        spec = dataclasses.replace(envs.spec(task), supersample=schedule.supersample)
        if spec.action_size > self.agent.action_size:
            raise ValueError(
                f"{task} takes actions of size {spec.action_size}, the agent gives "
                f"{self.agent.action_size}: choose a task that it was trained on"
            )
        env = PixelEnv(spec, self.spec.config.network.image_size, schedule.action_repeat)
        space = gymnasium.spaces.Box(-1.0, 1.0, (self.agent.action_size,), np.float32)
        return gymnasium.wrappers.TransformAction(
            env, lambda action: action[: spec.action_size], space
        )


@functools.partial(jax.jit, static_argnames="agent")
def _act(agent: Agent, params, memory: Memory, image: jax.Array) -> tuple[jax.Array, Memory]:
    key, first = acting_key(memory.step), memory.step == 0
    action, carry = agent.policy(params, memory.carry, image, first, key, "evaluate")
    return action, Memory(carry, memory.step + 1)


def train(
    task: str | Sequence[str],
    *,
    seeds: int | Sequence[int] = 0,
    preset: str = "cpu",
    out: str | Path | None = None,
    workers: int | None = None,
    devices: Choice = "all",
    **settings: Any,
) -> Trained:
    """Trains agents from scratch, one per seed, as one population.

    Args:
      task: its name, such as "bullet/hopper"; several make one agent for all of them.
      seeds: of the agents.
      preset: settings to start from, see `dreamer_jax.config`.
      out: the results folder; by default one of its own in runs/.
      workers: simulator processes; by default one per core.
      devices: how many to spread the agents over, each agent on one of them.
      settings: others than the preset's, by name, such as environment_steps=20_000.

    Raises:
      ValueError: bad settings, or the folder holds another run.
      KeyboardInterrupt: stopped by Ctrl-C, and saved: the same call goes on.
    """
    config = _with(configs.preset(preset), settings)
    return _run(RunSpec(_several(task, str), _several(seeds, int), config), out, workers, devices)


def transfer(
    source: "Trained | str | Path | Sequence[Trained | str | Path]",
    task: str | Sequence[str],
    *,
    method: str = "fractional",
    seeds: int | Sequence[int] = 0,
    out: str | Path | None = None,
    workers: int | None = None,
    devices: Choice = "all",
    **settings: Any,
) -> Trained:
    """Trains targets that begin with what a source knows.

    Args:
      source: a run, its folder, an exported agent (.safetensors) or "zoo:NAME"; or several of them,
        where the method takes several.
      task: as for `train`.
      method: one of `experiments.methods.known()`, such as "fine-tuning".
      seeds: of the targets, one for each seed and each variant of the method.
      out, workers, devices: as for `train`.
      settings: of the method, such as omegas=(0.0, 0.2), and of the agents where they are to differ
        from the source's.

    Raises:
      ValueError: bad settings, a source that does not fit or failed, or the folder holds another
        run.
      KeyboardInterrupt: stopped by Ctrl-C, and saved: the same call goes on.
    """
    sources = [source] if isinstance(source, Trained | str | Path) else list(source)
    names = tuple(_folder(one) for one in sources)
    own = {name: settings.pop(name) for name in list(settings) if name in methods.options()}
    # As options of the command line, settings may be lists.
    own = {name: tuple(x) if isinstance(x, list) else x for name, x in own.items()}
    if "reward_sources" in own:
        own["reward_sources"] = tuple(map(_folder, own["reward_sources"]))
    made = methods.make(method, {"sources": names, **own})
    # But for how members are mapped: that was right for the source's population.
    source_spec = mapped(load_source(names[0], made.source_member).spec, "auto", 1)
    config = _with(source_spec.config, settings)
    spec = RunSpec(_several(task, str), _several(seeds, int), config, made)
    return _run(spec, out, workers, devices)


def evaluate(
    trained: Trained | str | Path,
    episodes: int = 5,
    *,
    workers: int | None = None,
    devices: Choice = "all",
) -> list[dict[str, Any]]:
    """Plays whole episodes with every agent of a run: the mode, without noise.

    Args:
      trained: a run, or its folder.
      episodes: of each agent on each task.
      workers, devices: as for `train`.

    Returns:
      One row per agent, task and episode: member, seed, label, task, episode, return, length,
      fell.

    Raises:
      ValueError: the folder holds no run or no checkpoint, or there are not so many devices.
    """
    agents = evaluation.load_agents(_folder(trained))
    return evaluation.evaluate(agents, episodes, workers=workers, devices=devices)


def load(trained: Trained | str | Path, member: int = 0) -> Player:
    """One agent, to act with.

    Args:
      trained: a run, its folder, an exported agent (.safetensors) or "zoo:NAME".
      member: which of the population.

    Raises:
      ValueError: there is no such agent, or it failed.
    """
    source = load_source(_folder(trained), member)
    return Player(source.spec, make_agent(source.spec), jax.device_put(source.params))


def _folder(trained: Trained | str | Path) -> str:
    return str(trained.directory if isinstance(trained, Trained) else trained)


def _several(values: Any, kind: type) -> tuple[Any, ...]:
    """One value or several, as several."""
    return (values,) if isinstance(values, kind) else tuple(values)


def _with(config: Config, settings: Mapping[str, Any]) -> Config:
    """Settings with some replaced by name.

    Raises:
      ValueError: there is no setting of that name.
    """
    whole = configs.to_dict(config)
    groups = {name: group for group, names in whole.items() for name in names}
    for name, value in settings.items():
        if name not in groups:
            near = difflib.get_close_matches(name, [*groups, *methods.options()], n=1)
            hint = f": did you mean {near[0]!r}?" if near else ""
            raise ValueError(f"there is no setting {name!r}{hint}")
        whole[groups[name]][name] = value
    return configs.from_dict(whole)


def _run(spec: RunSpec, out: str | Path | None, workers: int | None, devices: Choice) -> Trained:
    """Carries out a run, or what is left of it."""
    directory = RUNS / _name(spec) if out is None else Path(out)
    spec = in_memory(spec, devices)
    run = make_run(spec, directory, resume=True, workers=workers, devices=devices)
    if carry_out(run, CALL) == "stopped":
        raise KeyboardInterrupt(f"stopped and saved in {directory}: the same call goes on")
    return Trained(directory, spec)


def _name(spec: RunSpec) -> str:
    """A name that no other run has: tasks, method, and a digest of all settings but those of the
    machine."""
    spec = mapped(spec, "auto", 1)
    digest = hashlib.sha256(json.dumps(spec.to_dict(), sort_keys=True).encode()).hexdigest()
    titles = "+".join(task.replace("/", "-") for task in spec.tasks)
    return f"{titles}-{spec.method.NAME}-{digest[:8]}"
