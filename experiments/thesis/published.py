"""The thesis's tables 1 to 17 as records, read from published.json.

Tables 1 to 12 are fractional transfer, 13 to 15 latent task classification, 16 and 17 reward
meta-models. All are of PyBullet and of the preset `thesis`.
"""

import functools
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from dreamer_jax.files import read_json
from experiments.thesis.grid import TABLES, Table

PATH = Path(__file__).with_name("published.json")
COPIES = (4, 6, 8, 12)
"""Tables whose deviations of 2 source tasks are those of the table before, digit by digit."""


@dataclass(frozen=True)
class Published:
    """One entry of a table; what does not apply is None.

    Attributes:
      table: the number of the table.
      target: title of the target task.
      method: "ftl" (fractional transfer), "meta" (reward meta-model), "baseline" (from scratch) or
        "ltc" (latent task classification).
      sources: number of source tasks.
      omega: the fraction of equation 19.
      metric: "overall" or "final" of returns; "novel" or "known" of tasks classified.
      threshold: ξ.
      task: title of the classified task.
      mean: of the returns; of a novel task the share of samples taken for novel, of a known one
        the share not taken for novel (the number to the left of the stroke).
      std: deviation of the returns.
      correct: of a known task, the share taken for the right task (to the right of the stroke).
    """

    table: int
    target: str | None
    method: Literal["ftl", "meta", "baseline", "ltc"]
    sources: int | None
    omega: float | None
    metric: Literal["overall", "final", "novel", "known"]
    threshold: float | None
    task: str | None
    mean: float
    std: float | None
    correct: float | None

    @property
    def copied(self) -> bool:
        """Whether the deviation is a copy of another table's, and so tells nothing."""
        return self.table in COPIES and self.sources == 2


@functools.cache
def records() -> tuple[Published, ...]:
    """All entries, in the order of the thesis."""
    return tuple(Published(**values) for values in read_json(PATH))


def number(table: Table) -> int:
    """The number of the thesis's table with the same name."""
    if table.name not in TABLES:
        raise ValueError(f"the thesis has no {table.name}, its tables are {', '.join(TABLES)}")
    return int(table.name.removeprefix("table-"))


@functools.cache
def _index() -> dict[tuple, Published]:
    return {
        (record.table, record.target, record.sources, record.omega): record
        for record in records()
        if record.method != "ltc"
    } | {
        (record.table, record.task, record.threshold): record
        for record in records()
        if record.method == "ltc"
    }


def returns(
    table: int, target: str, sources: int | None = None, variant: float | str | None = None
) -> Published | None:
    """The entry of tables 1 to 12, 16 or 17 with these keys; the baseline without `sources`.

    None if the table has no such entry, such as a fraction or a method that the thesis did not try.
    """
    return _index().get((table, target, sources, variant))


def classification(table: int, task: str, threshold: float) -> Published | None:
    """The entry of tables 13 to 15 with these keys, or None."""
    return _index().get((table, task, threshold))
