"""What a run tells of what it did: rows of metrics, timings, warnings and videos.

Axis letters: P population member, K task, T ticks in a phase.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, Literal

import numpy as np

from dreamer_jax.config import LearningConfig
from dreamer_jax.diagnosis import warnings
from dreamer_jax.logs import MetricsWriter
from dreamer_jax.population import Member
from dreamer_jax.records import Records
from dreamer_jax.rollout import Episode, episodes
from dreamer_jax.schedule import Counters, Schedule
from dreamer_jax.video import tile, write_video

MAXIMUM_VIDEO_MEMBERS = 9


class RunRows:
    """Writes the rows of one run.

    Every method is told how far the run has come and which members are healthy, bool [P]: what a
    frozen member played is told as unknown.

    Args:
      writer: of the run's folder.
      schedule: of the run.
      tasks: names of the K tasks.
      members: the P members.
      videos: how many of the evaluations are also written as videos, spread over the run.
    """

    def __init__(
        self,
        writer: MetricsWriter,
        schedule: Schedule,
        tasks: Sequence[str],
        members: Sequence[Member],
        videos: int,
    ):
        self._writer, self._schedule = writer, schedule
        self._tasks, self._members, self._videos = tasks, members, videos
        self._warned: set[tuple[int, str]] = set()

    def named(self, member: int) -> str:
        """A member with its seed, for messages."""
        chosen = self._members[member]
        return f"member {member} ({chosen.label}, seed {chosen.seed})"

    def _columns(self, member: int, counters: Counters, healthy: np.ndarray) -> dict[str, Any]:
        chosen = self._members[member]
        return {
            "member": member,
            "seed": chosen.seed,
            "label": chosen.label,
            **chosen.tags,
            "env_steps": self._schedule.environment_steps(counters.rounds),
            "updates": counters.updates,
            "healthy": bool(healthy[member]),
        }

    def collected(
        self,
        records: Records,
        policy: Literal["random", "explore"],
        counters: Counters,
        healthy: np.ndarray,
    ) -> float:
        """A row for each task of each member: the episodes of a phase.

        Args:
          records: NumPy leaves [P, K, T + 1, ...].
          policy: with which they were collected.
          counters: with this phase.
          healthy: bool [P].

        Returns:
          The mean return of what is known.
        """
        scores = []
        for member, task in np.ndindex(len(self._members), len(self._tasks)):
            found: list[Episode] = episodes(records.at(member, task)) if healthy[member] else []
            scores.append(_mean([episode.score for episode in found]))
            self._writer.write(
                {
                    "kind": "collect",
                    **self._columns(member, counters, healthy),
                    "task": self._tasks[task],
                    "policy": policy,
                    "episodes": len(found),
                    "return": scores[-1],
                    "length": _mean([episode.length for episode in found]),
                }
            )
        return _known_mean(scores)

    def updated(
        self,
        averages: Mapping[str, np.ndarray],
        counters: Counters,
        healthy: np.ndarray,
        learning: LearningConfig,
        say: Callable[[str], None],
    ) -> None:
        """A row for each member: means over updates.

        Says once for each member what keeps it from learning.

        Args:
          averages: by name, [P].
          counters: with these updates.
          healthy: bool [P].
          learning: the settings of the updates.
          say: is told the warnings.
        """
        for member in range(len(self._members)):
            own = {name: float(values[member]) for name, values in averages.items()}
            columns = self._columns(member, counters, healthy)
            self._writer.write({"kind": "update", **columns, **own})
            for name, message in warnings(own, learning, counters.updates).items():
                if (member, name) not in self._warned:
                    self._warned.add((member, name))
                    say(f"{self.named(member)}, update {counters.updates}: {message}")

    def evaluated(
        self,
        records: Records,
        diagnosis: Mapping[str, np.ndarray],
        counters: Counters,
        healthy: np.ndarray,
    ) -> float:
        """A row for each task of each member, of its first episode, and perhaps a video.

        Args:
          records: NumPy leaves [P, K, T + 1, ...].
          diagnosis: what models know of them, by name, [P, K].
          counters: before this evaluation.
          healthy: bool [P].

        Returns:
          The mean return of what is known.
        """
        scores = []
        for member, task in np.ndindex(len(self._members), len(self._tasks)):
            well, episode = bool(healthy[member]), episodes(records.at(member, task))[0]
            knowledge = {name: float(x[member, task]) for name, x in diagnosis.items()}
            scores.append(episode.score if well else math.nan)
            self._writer.write(
                {
                    "kind": "evaluation",
                    **self._columns(member, counters, healthy),
                    "task": self._tasks[task],
                    "return": scores[-1],
                    "length": episode.length if well else 0,
                    "fell": well and episode.fell,
                    **(knowledge if well else dict.fromkeys(knowledge, math.nan)),
                }
            )
        index, evaluations = counters.evaluations + 1, self._schedule.evaluations
        stride = max(1, evaluations // max(1, self._videos))
        if self._videos and (index % stride == 0 or index == evaluations):
            steps = self._schedule.environment_steps(counters.rounds)
            folder: Path = self._writer.directory / "videos"
            frames = records.image[:MAXIMUM_VIDEO_MEMBERS]
            frames = frames.reshape(-1, *frames.shape[2:])
            write_video(folder / f"evaluation_{steps:09d}.mp4", tile(frames), fps=30)
        return _known_mean(scores)

    def timed(self, what: str, seconds: float, counters: Counters, **columns: int) -> None:
        """How long something took."""
        steps = self._schedule.environment_steps(counters.rounds)
        row = {"kind": what, "seconds": seconds, "env_steps": steps, **columns}
        self._writer.write_timing(row)


def _mean(values: Sequence[float]) -> float:
    """The mean, NaN of nothing."""
    return float(np.mean(values)) if len(values) else math.nan


def _known_mean(scores: Sequence[float]) -> float:
    """The mean of the scores that are numbers."""
    return _mean([score for score in scores if not math.isnan(score)])
