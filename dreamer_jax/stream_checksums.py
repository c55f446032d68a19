"""Checksums of one stream of a replay: one entry for every append, in a file beside the records.

The checksum of an entry goes on from the one before, so that each piece of the stream can be
checked by itself, and the last entry, which a checkpoint commits, stands for all of it.
"""

from __future__ import annotations

import os
import zlib
from pathlib import Path

import numpy as np

from dreamer_jax.integrity import DamagedError

_PIECE = 1 << 20
_ENTRY = np.dtype([("end", "<u8"), ("checksum", "<u4"), ("checked", "<u4")])
"""Records up to the entry's end; CRC-32 of all of them; 0 if the records were there before their
checksum (of an earlier version, or of a process killed between the two)."""


class StreamChecksums:
    """The entries of one stream's file of records.

    Pieces that this object has found sound, or has written, are not read again.

    Args:
      records: the file of records; the entries are in a file of that name with `.checksums`.
      item_size: bytes of a record.
    """

    def __init__(self, records: Path, item_size: int):
        self.records, self.path = records, records.with_suffix(".checksums")
        self._item_size = item_size
        content = self.path.read_bytes() if self.path.exists() else b""
        whole = len(content) // _ENTRY.itemsize
        self._entries = np.frombuffer(content, _ENTRY, count=whole).copy()
        self._sound = np.zeros(len(self._entries), bool)

    @property
    def end(self) -> int:
        """How many records the entries cover."""
        return int(self._entries["end"][-1]) if len(self._entries) else 0

    @property
    def checksum(self) -> int:
        """CRC-32 of the records covered; of those without checksums it begins at 0."""
        return int(self._entries["checksum"][-1]) if len(self._entries) else 0

    def unchecked(self, start: int, stop: int) -> int:
        """How many of the records [start, stop) have no checksum of when they were written."""
        numbers = [n for n in self.overlapping(start, stop) if not self._entries["checked"][n]]
        inside = [
            min(stop, int(self._entries["end"][n])) - max(start, self.start(n)) for n in numbers
        ]
        return sum(inside) + max(0, stop - max(start, self.end))

    def append(self, content: memoryview, count: int) -> None:
        """Add an entry for `count` records, which have just been written."""
        self._add(self.end + count, zlib.crc32(content, self.checksum), True)

    def _add(self, end: int, checksum: int, checked: bool) -> None:
        entry = np.array([(end, checksum, checked)], _ENTRY)
        # Over what a killed process may have left half-written.
        with open(self.path, "r+b" if self.path.exists() else "w+b") as file:
            file.seek(self._entries.nbytes)
            file.write(entry.data)
            file.truncate()
        self._entries = np.append(self._entries, entry)
        self._sound = np.append(self._sound, checked)

    def truncate(self, length: int) -> None:
        """Make the entries those of the first `length` records of the file, which holds them.

        Raises:
          DamagedError: `length` is within a piece that is not what was written.
        """
        if length < self.end:
            self.split(length)
        kept = int(np.searchsorted(self._entries["end"], length, side="right"))
        if kept < len(self._entries):
            self._entries, self._sound = self._entries[:kept].copy(), self._sound[:kept]
            os.truncate(self.path, self._entries.nbytes)
        if length > self.end:
            self._add(length, self.checksum, False)

    def split(self, length: int) -> None:
        """Let a piece end at `length` and the next one begin, so that each can be checked alone.

        Raises:
          DamagedError: the piece is not what was written.
        """
        number = int(np.searchsorted(self._entries["end"], length))
        if not 0 < length < self.end or self._entries["end"][number] == length:
            return
        self.check(number)  # before records that its checksum is of can be gone
        entry = self._entries[number : number + 1].copy()
        before = int(self._entries["checksum"][number - 1]) if number else 0
        entry["end"] = length
        entry["checksum"] = before
        if entry["checked"]:
            entry["checksum"] = self._read(self.start(number), length, before)
        self._entries = np.insert(self._entries, number, entry)
        self._sound = np.insert(self._sound, number, True)
        temporary = self.path.with_name(self.path.name + ".tmp")
        temporary.write_bytes(self._entries.tobytes())
        os.replace(temporary, self.path)

    def overlapping(self, start: int, stop: int) -> range:
        """Numbers of the entries whose pieces hold some of the records [start, stop)."""
        ends = self._entries["end"]
        first = int(np.searchsorted(ends, start, side="right"))
        last = int(np.searchsorted(ends, stop, side="left"))
        return range(first, min(last + 1, len(ends)) if stop > start else first)

    def start(self, number: int) -> int:
        """The first record of a piece."""
        return int(self._entries["end"][number - 1]) if number else 0

    def check_records(self, start: int, stop: int) -> None:
        """Checks the pieces that hold some of the records [start, stop); see `check`."""
        if not self._sound.all():
            for number in self.overlapping(start, stop):
                self.check(number)

    def check_end(self, length: int, checksum: int) -> None:
        """Whether the entries up to `length` are those that a checkpoint committed.

        Raises:
          DamagedError: they are not.
        """
        held = self._entries["checksum"][self._entries["end"] == length]
        if length and (not len(held) or held[0] != checksum):
            raise DamagedError(
                f"{self.path} is missing, damaged, or does not belong to this checkpoint: restore "
                f"it together with {self.records.name}, or resume from an older checkpoint"
            )

    def check(self, number: int) -> None:
        """Reads a piece and compares it with its checksum, unless that was done before.

        Raises:
          DamagedError: it is not what was written; names the file and the records.
        """
        if self._sound[number]:
            return
        start, end = self.start(number), int(self._entries["end"][number])
        if self._entries["checked"][number]:
            before = int(self._entries["checksum"][number - 1]) if number else 0
            if self._read(start, end, before) != self._entries["checksum"][number]:
                raise DamagedError(
                    f"{self.records} is damaged: the records [{start}, {end}) are not what was "
                    "written (their checksum differs). Restore the file, or resume from an older "
                    "checkpoint, or start again in another folder"
                )
        self._sound[number] = True

    def _read(self, start: int, stop: int, checksum: int) -> int:
        """The checksum after the records [start, stop), read piece by piece."""
        left = (stop - start) * self._item_size
        with open(self.records, "rb", buffering=0) as file:
            file.seek(start * self._item_size)
            while left > 0 and (piece := file.read(min(_PIECE, left))):
                checksum = zlib.crc32(piece, checksum)
                left -= len(piece)
        if left:
            raise DamagedError(
                f"{self.records} ends before record {stop}: it has lost data. Restore the file, or "
                "resume from an older checkpoint"
            )
        return checksum
