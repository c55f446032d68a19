"""The folder of a run: checkpoints, replay and metrics, committed together and taken back together.

A checkpoint names how much of the replay and of the metrics belongs to it, and their checksums.
Both are on the disk before it is. Going on from it cuts them back to that, after comparing them.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import jax
import numpy as np

from dreamer_jax.checkpoint import Checkpointer, CorruptCheckpointError
from dreamer_jax.integrity import DamagedError
from dreamer_jax.locks import FolderLock
from dreamer_jax.logs import MetricsWriter
from dreamer_jax.replay import Replay
from dreamer_jax.schema import METADATA, check_shape


class RunFolder:
    """What a run keeps, locked for this process until `close`.

    Args:
      directory: the folder; made if absent.
      lock: its lock, if the caller holds it already.
      resume: whether the folder may hold a run.
      layout: keywords of `Replay`.

    Raises:
      FolderInUseError: another process has the folder.
      FileExistsError: it holds a run, and `resume` is False.
      ValueError: it holds a replay of another layout, or damaged files.
    """

    def __init__(
        self,
        directory: Path,
        *,
        lock: FolderLock | None,
        resume: bool,
        layout: Mapping[str, Any],
    ):
        self.directory = directory
        self._lock = lock or FolderLock(directory)
        try:
            if not resume and (directory / "replay").exists():
                raise FileExistsError(
                    f"{directory} already holds a run: resume it, or choose another folder"
                )
            self.checkpoints = Checkpointer(directory / "checkpoints")
            self.replay = Replay(directory / "replay", **layout)
            self.writer = MetricsWriter(directory)
        except BaseException:
            self._lock.release()
            raise

    def restore(
        self,
        template: Any,
        step: int | None = None,
        put: Callable[[np.ndarray], jax.Array] | None = None,
    ) -> tuple[Any, dict[str, int]] | None:
        """Goes back to a checkpoint: cuts replay and metrics back to what it committed.

        Args:
          template: see `Checkpointer.restore`.
          step: of the checkpoint; by default the newest that can be read. Later ones are removed.
          put: see `Checkpointer.restore`.

        Returns:
          The state and the counters; None where nothing has been kept yet.

        Raises:
          DamagedError, CorruptCheckpointError: files are not what was written, or checkpoints are
            missing; nothing is cut then.
          FileNotFoundError: there is no checkpoint of that step.
        """
        if step is None and self.checkpoints.latest() is None:
            if self.replay.lengths.any() or self.writer.offset():
                raise DamagedError(
                    f"{self.directory} holds records and metrics of a run, but no checkpoint to go "
                    "on from: restore its folder checkpoints/, or choose another folder (or move "
                    "this one away) to start again"
                )
            return None
        tree, metadata, found = self.checkpoints.restore(template, step, put)
        check_shape(metadata, METADATA, self.checkpoints.path(found) / "metadata.json")
        checksums = metadata.get("checksums", {})
        lengths = np.asarray(metadata["replay"])
        try:
            self.replay.check(lengths, checksums.get("replay"))
            self.writer.check(metadata["metrics"], checksums.get("metrics"))
        except DamagedError as error:
            raise DamagedError(f"{error}. {self._choices(found)}") from error
        # First, so that a process killed here does not find a checkpoint of what is cut.
        self.checkpoints.remove_later(found)
        self.replay.truncate(lengths)
        self.writer.truncate(metadata["metrics"])
        return tree, metadata["counters"]

    def _choices(self, step: int) -> str:
        older = [other for other in self.checkpoints.steps() if other < step]
        if not older:
            return f"There is no checkpoint before that of step {step}"
        return f"Older checkpoints: --from-checkpoint {' or '.join(map(str, older[::-1]))}"

    def save(self, step: int, tree: Any, counters: Mapping[str, int]) -> None:
        """Writes a checkpoint of everything that a resumed run needs."""
        self.replay.sync()
        self.writer.sync()
        metadata = {
            "counters": dict(counters),
            "replay": self.replay.lengths,
            "metrics": self.writer.offset(),
            "checksums": {
                "replay": self.replay.checksums(),
                "metrics": self.writer.checksum(),
            },
        }
        self.checkpoints.save(step, tree, metadata)
        self._delete_records()

    def _delete_records(self) -> None:
        """Deletes the records that are too old for every checkpoint."""
        checkpoints = self.checkpoints
        try:
            lengths = [checkpoints.metadata(step)["replay"] for step in checkpoints.steps()]
        except CorruptCheckpointError:
            return  # until it has been replaced
        self.replay.delete(np.min(lengths, axis=0))

    def close(self) -> None:
        """Closes the files, and gives the lock back."""
        self.writer.close()
        self.replay.close()
        self._lock.release()
