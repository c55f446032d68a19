"""Evaluation of trained populations: returns, videos of episodes, and open-loop predictions.

Axis letters: P population member, K task, T records of a phase, L frames of a prediction.
"""

import re
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

import envs
from dreamer_jax.agent import Agent
from dreamer_jax.devices import Choice, Placement, on_one_device, place
from dreamer_jax.learning import AgentState
from dreamer_jax.population import Population
from dreamer_jax.progress import Report, unreported
from dreamer_jax.randomness import EVALUATION_PHASES, prediction_key
from dreamer_jax.records import Records
from dreamer_jax.rollout import Episode, episodes
from dreamer_jax.video import tile, write_video
from dreamer_jax.waiting import to_host
from experiments.runs.agents import load_params, make_agent, make_env
from experiments.runs.spec import RunSpec, read_spec

CONTEXT = 5
PREDICTED_FRAMES = 60
SHOWN_MEMBERS = 8


class Agents(NamedTuple):
    """The trained population of a results folder.

    Attributes:
      directory: the results folder.
      spec: what it is a run of.
      params: leaves [P, ...], from its newest checkpoint.
    """

    directory: Path
    spec: RunSpec
    params: Any


def load_agents(directory: str | Path) -> Agents:
    """Reads a trained population.

    Raises:
      ValueError: the folder holds no run or no checkpoint.
    """
    spec = read_spec(directory)
    return Agents(Path(directory), spec, jax.device_put(load_params(directory)))


def evaluate(
    agents: Agents,
    count: int,
    *,
    video: bool = False,
    workers: int | None = None,
    timeout: float = envs.SIMULATOR_TIMEOUT,
    devices: Choice = "all",
    report: Report = unreported,
) -> list[dict[str, Any]]:
    """Plays episodes with every member of a run: the mode, without noise, up to the first fall.

    Args:
      agents: the population.
      count: episodes per member and task.
      video: whether to write videos/evaluate_TASK.mp4 and videos/prediction_TASK.mp4.
      workers: simulator processes; by default one per core.
      timeout: seconds after which a simulator that does not answer is given up.
      devices: how many to spread the members over, each member on one of them.
      report: called after each episode, with its mean return; it counts episodes.

    Returns:
      One row per member, task and episode: member, seed, label, task, episode, return, length,
      fell.

    Raises:
      ValueError: there are not so many devices.
    """
    directory, spec, params = agents
    placement = place(len(spec.members), devices)
    agent, env = make_agent(spec), make_env(spec, workers, timeout, shards=placement.count)
    rows = []
    try:
        player = _Player(agent, env, agents, placement)
        for number in range(count):
            records = player.play(number)
            new = _rows(spec, records, number)
            rows += new
            report(number + 1, count, f"return {np.mean([row['return'] for row in new]):.0f}")
            if video and number == 0:
                write_videos(directory, spec, agent, params, records)
    finally:
        env.close()
    return rows


def play(
    agents: Agents,
    number: int = 0,
    *,
    workers: int | None = None,
    timeout: float = envs.SIMULATOR_TIMEOUT,
) -> Records:
    """One phase of every member on every task: the mode, without noise.

    Args:
      agents: the population.
      number: of the phase; each has starts of its own, those of `evaluate`'s episodes.
      workers: simulator processes; by default one per core.
      timeout: seconds after which a simulator that does not answer is given up.

    Returns:
      NumPy leaves [P, K, T, ...].
    """
    env = make_env(agents.spec, workers, timeout)
    try:
        placement = on_one_device(len(agents.spec.members))
        return _Player(make_agent(agents.spec), env, agents, placement).play(number)
    finally:
        env.close()


class _Player:
    """Members on their devices, and what they play."""

    def __init__(self, agent: Agent, env, agents: Agents, placement: Placement):
        spec, self._env, self._placement = agents.spec, env, placement
        seeds = [member.seed for member in spec.members]
        self._population = Population(agent, env, len(spec.tasks), seeds, placement)
        # Of an agent that is done nothing but its parameters is played.
        count = len(seeds)
        state = AgentState(
            agents.params, {}, jnp.zeros(count, jnp.int32), jnp.array(seeds), jnp.ones(count, bool)
        )
        self._state = self._population.put(state)

    def play(self, number: int) -> Records:
        """One phase of every member on every task, NumPy leaves [P, K, T, ...]."""
        phase = int(EVALUATION_PHASES[number])
        records = to_host(self._population.collect(self._state, phase, "evaluate"))
        self._env.check()
        return self._placement.own(records)


def _rows(spec: RunSpec, records: Records, number: int) -> list[dict[str, Any]]:
    rows = []
    for (p, member), (k, task) in (
        (a, b) for a in enumerate(spec.members) for b in enumerate(spec.tasks)
    ):
        episode = episodes(records.at(p, k))[0]
        rows.append(
            {
                "member": p,
                "seed": member.seed,
                "label": member.label,
                "task": task,
                "episode": number,
                "return": episode.score,
                "length": episode.length,
                "fell": episode.fell,
            }
        )
    return rows


def write_videos(
    directory: str | Path, spec: RunSpec, agent: Agent, params, records: Records
) -> list[Path]:
    """Writes, for each task, one phase of every member side by side and an open-loop prediction.

    The prediction has three rows: the truth; the model, which sees the first 5 frames and
    predicts the others from the actions alone; and half their difference around grey.

    Args:
      directory: the results folder.
      spec: of the run.
      agent, params: its functions and parameters, leaves [P, ...].
      records: of an evaluation phase, NumPy leaves [P, K, T, ...].

    Returns:
      The files written.
    """
    folder, paths = Path(directory) / "videos", []
    members = range(min(SHOWN_MEMBERS, len(spec.members)))
    for k, task in enumerate(spec.tasks):
        name = re.sub(r"[^\w.-]", "_", task)
        frames = records.image[: len(members), k]
        paths.append(write_video(folder / f"evaluate_{name}.mp4", tile(frames), fps=30))
        longest = [_longest_episode(records.at(p, k)) for p in members]
        length = min(PREDICTED_FRAMES, min(episode.length + 1 for episode in longest))
        if length <= CONTEXT:
            continue
        windows = [
            records.at(p, k, slice(episode.start, episode.start + length))
            for p, episode in zip(members, longest, strict=True)
        ]
        batch = jax.tree.map(lambda *x: np.stack(x)[:, None], *windows)
        shown = jax.tree.map(lambda x: x[: len(members)], params)
        paths.append(
            write_video(
                folder / f"prediction_{name}.mp4", prediction_frames(agent, shown, batch), fps=10
            )
        )
    return paths


def _longest_episode(records: Records) -> Episode:
    return max(episodes(records), key=lambda episode: episode.length)


def prediction_frames(agent: Agent, params, batch: Records) -> np.ndarray:
    """Truth, model and error of open-loop predictions, as frames of a video.

    Args:
      agent, params: functions and parameters, leaves [P, ...].
      batch: one sequence per member, leaves [P, 1, L, ...].

    Returns:
      uint8 [L, 3 * size, about P * size, 3].
    """
    keys = jax.vmap(prediction_key)(jnp.arange(batch.reward.shape[0]))
    predict = jax.jit(
        jax.vmap(lambda params, batch, key: agent.predict(params, batch, CONTEXT, key))
    )
    truth, model = (np.asarray(x)[:, 0] for x in predict(params, batch, keys))
    error = (model - truth + 1) / 2
    rows = [tile((255 * x + 0.5).astype(np.uint8)) for x in (truth, model, error)]
    return np.concatenate(rows, axis=1)
