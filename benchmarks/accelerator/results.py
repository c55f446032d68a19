"""The file of results: rows of figures, or of words on why there are none. Written after each."""

import datetime
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from benchmarks.accelerator.peaks import known_peaks
from benchmarks.accelerator.plan import Part
from benchmarks.accelerator.table import table
from dreamer_jax.files import read_json, write_json_atomically

_SAME = ("card", "jax", "xla_flags", "matmul_precision")
"""What must be the same of a machine for figures to stand beside one another."""


class MismatchError(ValueError):
    """What is there already cannot stand beside what was asked for; names the way out."""


class Results:
    """What was measured so far, and the two files that hold it.

    Args:
      path: of the JSON; the table is beside it.
      sizes: what was asked for.
      peaks: TFLOP/s in float32 and bfloat16, if they were given.

    Raises:
      MismatchError: the file holds something else.
    """

    def __init__(self, path: Path, sizes: str, peaks: Sequence[float] | None = None):
        self.path, self.table_path = path, path.with_suffix(".md")
        self._given, self._revision = peaks, ""
        self.values: dict[str, Any] = {
            "benchmark": "accelerator",
            "sizes": sizes,
            "date": str(datetime.date.today()),
            "machine": None,
            "peak_tflops": None,
            "rows": [],
        }
        if path.exists():
            found = read_json(path)
            if not isinstance(found, dict) or set(found) != set(self.values):
                raise MismatchError(f"{path} is no file of this benchmark: name another with --out")
            if found["sizes"] != sizes:
                raise MismatchError(
                    f"{path} holds sizes {found['sizes']}, {sizes} were asked for: name another "
                    "file with --out"
                )
            self.values = found

    def on(self, machine: dict[str, Any]) -> None:
        """Notes what is measured on.

        Raises:
          MismatchError: what is there already was measured on something else.
        """
        # The program may be mended meanwhile, and each row says what it was measured with.
        self._revision = machine.pop("revision")
        before = self.values["machine"]
        if before is not None:
            for name in _SAME:
                if before[name] != machine[name]:
                    raise MismatchError(
                        f"{self.path} was measured with {name} {before[name]!r}, here it is "
                        f"{machine[name]!r}: name another file with --out"
                    )
            return
        self.values["machine"] = machine

    def missing(self, part: Part) -> tuple[str, ...]:
        """The cases of a part that have no figures."""
        measured = {(row["part"], row["case"]) for row in self.values["rows"] if "figures" in row}
        return tuple(case for case in part.cases if (part.name, case) not in measured)

    def add(self, part: str, case: str, kind: str, what: Any) -> None:
        """Notes what came of a case, in place of what was there, and writes both files.

        Args:
          part, case: their names.
          kind: "figures", "failure" or "skipped"; the last two in words.
          what: it.
        """
        rows = self.values["rows"]
        place = [index for index, x in enumerate(rows) if (x["part"], x["case"]) == (part, case)]
        row = {"part": part, "case": case, "revision": self._revision, kind: what}
        if place:
            rows[place[0]] = row
        else:
            rows.append(row)
        self.write()

    def write(self) -> None:
        """Writes both files."""
        if (machine := self.values["machine"]) is not None:
            by_default = machine["matmul_precision"] == "default"
            known = known_peaks(machine["card"]) if by_default else None
            peaks = self._given or self.values["peak_tflops"] or known
            self.values["peak_tflops"] = None if peaks is None else list(peaks)
        for row in self.values["rows"]:
            if row["part"].startswith("update") and "figures" in row:
                row["figures"]["share_of_peak"] = self._share(row["part"], row["figures"])
        self.path.parent.mkdir(parents=True, exist_ok=True)
        write_json_atomically(self.path, self.values)
        self.table_path.write_text(table(self.values), encoding="utf-8")

    def _share(self, part: str, figures: dict[str, Any]) -> float | None:
        """Of the card's arithmetic in the part's precision, what is the agents'."""
        peaks = self.values["peak_tflops"]
        if peaks is None:
            return None
        peak = peaks[part.endswith("bfloat16")]
        return figures["member_updates_per_second"] * figures["operations"] / (1e12 * peak)
