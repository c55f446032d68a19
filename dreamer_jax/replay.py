"""Replay on the host: append-only files of records, sampled as sequences for a population.

Each population member has one stream per task, a file `member_000/task_0.records` of fixed-size
records. Record t holds image t and the action and reward that led to it; `first` marks a reset
(zero action and reward) and `terminal` an episode that ended by falling. Records are never
changed once written, so a run is resumed by cutting every stream back to the length its
checkpoint names. The oldest may be deleted: their disk space is given back, while files keep
their lengths and later records their places. Files are read through memory maps: the page cache
holds what was read last and gives it back under pressure, so the process does not grow with the
replay. Every append has a checksum (see `dreamer_jax.stream_checksums`); what this process has not
written itself is compared with it when it is first read.

Axis letters: P population member, K task, T steps in a phase, B batch, L sequence length,
A action. Images are uint8 [height, width, 3] with height = width = `image_size`.
"""

from __future__ import annotations

import contextlib
import errno
import os
import warnings
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path

import numpy as np

from dreamer_jax import schema
from dreamer_jax.files import explained
from dreamer_jax.holes import free_beginning
from dreamer_jax.integrity import (
    DamagedError,
    read_sealed_json,
    sync_all,
    sync_files,
    write_sealed_json,
)
from dreamer_jax.prefetch import Prefetcher
from dreamer_jax.records import Records
from dreamer_jax.sampling import sample_indices
from dreamer_jax.schema import check_shape
from dreamer_jax.stream_checksums import StreamChecksums
from dreamer_jax.stream_reader import Place, StreamReader

_HEADER = "replay.json"
_DELETED = "deleted.json"
_FORMAT = 1


def record_dtype(image_size: int, action_size: int) -> np.dtype:
    """The layout of one record on disk: packed, little-endian, in the order of `Records`."""
    return np.dtype(
        [
            ("image", "u1", (image_size, image_size, 3)),
            ("action", "<f4", (action_size,)),
            ("reward", "<f4"),
            ("first", "?"),
            ("terminal", "?"),
        ]
    )


class Replay:
    """The streams of P members and K tasks in one folder, created or opened.

    `lengths` counts the committed records of every stream. A folder opened again starts with all
    whole records that its files hold; what a killed process left half-written beyond them is
    overwritten by the next `append`.

    Args:
      directory: the folder; made if absent.
      members: P.
      tasks: K.
      image_size: height and width of the images.
      action_size: A.
      keep: sample only from the newest `keep` records of each stream; None for all. The others
        stay on the disk until `delete` is called.
      threads: how many put a batch together; by default 4, or as many as there are cores if these
        are fewer.

    Raises:
      ValueError: the folder holds a replay of another layout, or `keep` is less than 1.
    """

    def __init__(
        self,
        directory: str | os.PathLike,
        members: int,
        tasks: int,
        image_size: int,
        action_size: int,
        keep: int | None = None,
        threads: int | None = None,
    ):
        layout = {
            "members": int(members),
            "tasks": int(tasks),
            "image_size": int(image_size),
            "action_size": int(action_size),
        }
        if min(layout.values()) < 1:
            raise ValueError(f"sizes of a replay must be at least 1, got {layout}")
        if keep is not None and keep < 1:
            raise ValueError(f"keep must be at least 1 record, or None for all; got {keep}")
        self.directory = Path(directory)
        self.members = layout["members"]
        self.tasks = layout["tasks"]
        self.keep = keep
        self.dtype = record_dtype(image_size, action_size)
        self._open(layout)
        self._lengths = self._stored_lengths()
        self._checksums = {
            stream: StreamChecksums(self.path(*stream), self.dtype.itemsize)
            for stream in self._streams()
        }
        self._unsynced: set[tuple[int, int]] = set()
        self._folder_synced = False
        self._deleted = self._stored_deleted()
        self._paths = {stream: self.path(*stream) for stream in self._streams()}
        self._reader = StreamReader(self.dtype, threads)

    def close(self) -> None:
        """Closes files and ends threads, until they are needed again."""
        self._reader.close()

    def _open(self, layout: Mapping[str, int]) -> None:
        header = self.directory / _HEADER
        expected = {"format": _FORMAT, **layout}
        if header.exists():
            stored = check_shape(read_sealed_json(header), {"*": object}, header)
            differences = [
                f"{name} {stored.get(name)} (expected {value})"
                for name, value in expected.items()
                if stored.get(name) != value
            ]
            if differences:
                raise ValueError(
                    f"{self.directory} holds a replay with {', '.join(differences)}; "
                    "use the settings it was made with, or another folder"
                )
            return
        try:
            self.directory.mkdir(parents=True, exist_ok=True)
            for member in range(self.members):
                self.path(member, 0).parent.mkdir(exist_ok=True)
                for task in range(self.tasks):
                    self.path(member, task).touch()
            # Written last: a folder with a header is complete.
            write_sealed_json(header, expected)
        except OSError as error:
            raise explained(
                error, f"could not make the replay folder {self.directory}", self.directory
            ) from error

    def path(self, member: int, task: int) -> Path:
        """The file of one stream."""
        return self.directory / f"member_{member:03d}" / f"task_{task}.records"

    @property
    def lengths(self) -> np.ndarray:
        """Committed records of every stream: int64 [P, K], a copy."""
        return self._lengths.copy()

    @property
    def deleted(self) -> np.ndarray:
        """How many of the oldest records of every stream are deleted: int64 [P, K], a copy."""
        return self._deleted.copy()

    def _streams(self) -> Iterator[tuple[int, int]]:
        return np.ndindex(self.members, self.tasks)

    def _stored_lengths(self) -> np.ndarray:
        lengths = np.zeros((self.members, self.tasks), np.int64)
        for stream in self._streams():
            path = self.path(*stream)
            try:
                lengths[stream] = path.stat().st_size // self.dtype.itemsize
            except FileNotFoundError:
                raise ValueError(
                    f"{path} is missing from the replay in {self.directory}; restore it, "
                    "or start again in another folder"
                ) from None
        return lengths

    def _stored_deleted(self) -> np.ndarray:
        path = self.directory / _DELETED
        if not path.exists():
            return np.zeros_like(self._lengths)
        stored = check_shape(read_sealed_json(path), schema.DELETED, path)["deleted"]
        if np.shape(stored) != self._lengths.shape:
            raise DamagedError(
                f"{path} names {np.shape(stored)} streams, not {self._lengths.shape}"
            )
        return np.array(stored, np.int64)

    def _set_deleted(self, deleted: np.ndarray) -> None:
        if (deleted != self._deleted).any():
            path = self.directory / _DELETED
            try:
                write_sealed_json(path, {"deleted": deleted.tolist()})
            except OSError as error:
                raise explained(error, f"could not write {path}", path) from error
            self._deleted = deleted

    def append(self, records: Records) -> None:
        """Add a phase to every stream.

        Either all streams grow by T records or, if this raises, none does.

        Args:
          records: leaves [P, K, T, ...].

        Raises:
          ValueError: a shape or dtype is not that of the layout.
          OSError: the disk is full or not writable; names the file and the free space.
        """
        records = self._checked(records)
        steps = records.reward.shape[2]
        path = self.directory
        try:
            for stream in self._streams():
                path = self.path(*stream)
                rows = np.empty(steps, self.dtype)
                for name, values in records._asdict().items():
                    rows[name] = values[stream]
                with open(path, "r+b") as file:
                    file.seek(int(self._lengths[stream]) * self.dtype.itemsize)
                    _write(file, rows)
                checksums = self._checksums[stream]
                if checksums.end != self._lengths[stream]:
                    checksums.truncate(int(self._lengths[stream]))
                checksums.append(rows.data, steps)
                self._unsynced.add(stream)
        except OSError as error:
            self._roll_back()
            raise explained(
                error,
                f"could not append {steps} records to {path}",
                path,
                "every stream still holds what was committed before",
            ) from error
        except BaseException:
            self._roll_back()
            raise
        self._lengths += steps

    def _checked(self, records: Records) -> Records:
        arrays = records.map(np.asarray)
        steps = arrays.reward.shape[2] if arrays.reward.ndim == 3 else "T"
        for name, array in arrays._asdict().items():
            field = self.dtype[name]
            expected = (self.members, self.tasks, steps, *field.shape)
            if array.shape != expected or array.dtype != field.base:
                raise ValueError(
                    f"the records' {name} is {array.dtype} {list(array.shape)}, expected "
                    f"{field.base} {list(expected)} (members, tasks, steps, ...)"
                )
        return arrays

    def _roll_back(self) -> None:
        # Where cutting fails too, what is beyond the committed lengths is overwritten later.
        with contextlib.suppress(OSError):
            self._cut()

    def _cut(self) -> None:
        """Drop from the files whatever lies beyond the committed lengths."""
        self._reader.drop()
        for stream in self._streams():
            size = int(self._lengths[stream]) * self.dtype.itemsize
            path = self.path(*stream)
            if path.stat().st_size > size:
                os.truncate(path, size)
            self._checksums[stream].truncate(int(self._lengths[stream]))

    def checksums(self) -> list[list[int]]:
        """CRC-32 of every stream up to its committed length, [P, K], for a checkpoint to commit."""
        return [
            [self._checksums[member, task].checksum for task in range(self.tasks)]
            for member in range(self.members)
        ]

    def sync(self) -> None:
        """Wait until all committed records are on the disk, so that no loss of power takes them."""
        if not self._folder_synced:
            sync_all(self.directory)
            self._folder_synced = True
        else:
            for stream in self._unsynced:
                sync_files([self.path(*stream), self._checksums[stream].path])
        self._unsynced.clear()

    def check(self, lengths: np.ndarray, checksums: Sequence[Sequence[int]] | None = None) -> None:
        """Whether the streams can be cut back to what a checkpoint committed.

        Args:
          lengths: integers [P, K].
          checksums: of the streams at these lengths; None of a checkpoint that has none.

        Raises:
          ValueError: see `truncate`; a `DamagedError` if the streams' checksums are others.
        """
        lengths = np.asarray(lengths, np.int64)
        if lengths.shape != self._lengths.shape:
            raise ValueError(
                f"lengths have shape {list(lengths.shape)}, expected [members, tasks] = "
                f"{list(self._lengths.shape)}"
            )
        stored = self._stored_lengths()
        for stream in self._streams():
            if not 0 <= lengths[stream] <= stored[stream]:
                raise DamagedError(
                    f"{self.path(*stream)} holds {stored[stream]} records, "
                    f"{lengths[stream]} were to be kept: the file does not belong to this "
                    "checkpoint or has lost data; resume from an older checkpoint"
                )
            needed = self._oldest_sampled(lengths)[stream]
            if lengths[stream] > 0 and self._deleted[stream] > needed:
                raise ValueError(
                    f"the oldest {self._deleted[stream]} records of {self.path(*stream)} are "
                    f"deleted, those from {needed} on were to be kept: resume from a newer "
                    "checkpoint, or with as many records kept as before"
                )
            if checksums is not None:
                member, task = stream
                checksum = checksums[member][task]
                self._checksums[stream].check_end(int(lengths[stream]), checksum)

    def truncate(self, lengths: np.ndarray) -> None:
        """Cut every stream back to the lengths that a checkpoint committed.

        Args:
          lengths: integers [P, K].

        Raises:
          ValueError: the shape is wrong, or a stream holds fewer records than asked for, or some
            that would be sampled at these lengths are deleted; nothing is cut then.
        """
        self.check(lengths)
        lengths = np.asarray(lengths, np.int64)
        self._lengths = lengths.copy()
        self._cut()
        self._set_deleted(np.minimum(self._deleted, lengths))

    def verify(self, member: int, task: int, length: int) -> tuple[str | None, int]:
        """Compares the first `length` records of a stream, but for deleted ones, with checksums.

        Returns:
          What is wrong, if anything; and how many of the records have no checksum.
        """
        checksums, deleted = self._checksums[member, task], int(self._deleted[member, task])
        try:
            for number in checksums.overlapping(deleted, length):
                checksums.check(number)
        except (DamagedError, OSError) as error:
            return str(error), 0
        return None, checksums.unchecked(deleted, length)

    def _oldest_sampled(self, lengths: np.ndarray) -> np.ndarray:
        """Which records are the first that are sampled at these lengths: int64 [P, K]."""
        if self.keep is None:
            return np.zeros_like(lengths)
        return np.maximum(lengths - self.keep, 0)

    def delete(self, lengths: np.ndarray) -> None:
        """Give back the disk space of records that are not sampled from these lengths on.

        These are the ones older than the newest `keep`; without `keep` there are none. What a
        `truncate` to `lengths` or more needs stays. Where the file system cannot free a part of
        a file nothing is deleted, and a warning says so.

        Args:
          lengths: integers [P, K], such as those of the oldest checkpoint to which a run may
            have to go back.
        """
        lengths = np.minimum(np.asarray(lengths, np.int64), self._lengths)
        deleted = np.maximum(self._deleted, self._oldest_sampled(lengths))
        streams = [stream for stream in self._streams() if deleted[stream] > self._deleted[stream]]
        # Written first: what it names is never read again, whether or not it is still there.
        self._set_deleted(deleted)
        for stream in streams:
            path = self.path(*stream)
            self._checksums[stream].split(int(deleted[stream]))
            try:
                free_beginning(path, int(deleted[stream]) * self.dtype.itemsize)
            except OSError as error:
                if error.errno not in (errno.ENOTSUP, errno.EOPNOTSUPP, errno.ENOSYS):
                    raise explained(
                        error, f"could not delete the oldest records of {path}", path
                    ) from error
                warnings.warn(
                    f"the file system of {self.directory} cannot free a part of a file: records "
                    "that are no longer sampled stay on the disk",
                    stacklevel=2,
                )
                return

    def read(self, member: int, task: int, start: int, stop: int) -> Records:
        """A copy of the records [start, stop) of one stream, leaves [stop - start, ...].

        Raises:
          ValueError: the range is not within the committed records that are not deleted.
        """
        oldest, held = int(self._deleted[member, task]), int(self._lengths[member, task])
        if not oldest <= start <= stop <= held:
            raise ValueError(
                f"records [{start}, {stop}) of {self.path(member, task)} were asked for, "
                f"it holds [{oldest}, {held})"
            )
        self._checksums[member, task].check_records(start, stop)
        places = [self._place(member, task, start)] if stop > start else []
        return self._reader.sequences(places, stop - start)

    def sample(
        self,
        seeds: Sequence[int],
        update: int,
        batch: int,
        length: int,
        members: Sequence[int] | None = None,
        lengths: np.ndarray | None = None,
    ) -> Records:
        """A batch of sequences for every member.

        A member's rows depend only on its own seed, the update and the lengths of its own streams
        (see `sample_indices`). Sequences stay within a stream and may cross an episode's end.

        Args:
          seeds: [P], one for each of `members`.
          update: number of the update.
          batch: B.
          length: L.
          members: which members, in the order of the result; all by default.
          lengths: [P, K] sample as when the streams had these lengths (at most the committed
            ones, which are the default).

        Returns:
          Leaves [P, B, L, ...]. The arrays are new and never written again: on the CPU, JAX
          may use their memory without a copy.

        Raises:
          ValueError: no stream of a member holds L records, or arguments do not fit together.
        """
        members = range(self.members) if members is None else list(members)
        if len(seeds) != len(members):
            raise ValueError(f"{len(seeds)} seeds for {len(members)} members: one each is needed")
        lengths = self._lengths if lengths is None else np.asarray(lengths, np.int64)
        if lengths.shape != self._lengths.shape or (lengths > self._lengths).any():
            raise ValueError(
                f"lengths {lengths.tolist()} are not at most the committed {self._lengths.tolist()}"
            )
        places = []
        for member, seed in zip(members, seeds, strict=True):
            try:
                tasks, starts = sample_indices(
                    int(seed),
                    update,
                    lengths[member],
                    batch,
                    length,
                    self.keep,
                    self._deleted[member],
                )
            except ValueError as error:
                raise ValueError(f"member {member} of {self.directory}: {error}") from None
            for task, start in zip(tasks.tolist(), starts.tolist(), strict=True):
                self._checksums[member, task].check_records(start, start + length)
                places.append(self._place(member, task, start))
        return self._reader.sequences(places, length, len(members), batch)

    def batches(
        self, seeds: Sequence[int], updates: Iterable[int], batch: int, length: int, depth: int = 2
    ) -> Prefetcher[Records]:
        """The batches of `updates` in turn, prepared in the background (see `Prefetcher`).

        All are drawn from the records committed now, even if more are appended meanwhile.
        """
        lengths = self.lengths

        def prepare(update: int) -> Records:
            return self.sample(seeds, update, batch, length, lengths=lengths)

        return Prefetcher(prepare, updates, depth)

    def _place(self, member: int, task: int, start: int) -> Place:
        return Place(self._paths[member, task], int(self._lengths[member, task]), start)


def _write(file, rows: np.ndarray) -> None:
    file.write(rows.data)
    file.flush()
