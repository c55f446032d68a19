"""All evaluations of results folders as one tidy table: a row for each evaluation of an agent.

Made for `pandas.read_csv` and the like: plain columns, numbers as they were written, and nothing
where nothing is known.
"""

import csv
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any

from experiments.methods import BASELINE
from experiments.methods.scratch import Scratch
from experiments.reports.outcomes import Run
from experiments.runs.folder import CELLS, read_cells

FIRST = (
    "folder",
    "cell",
    "member",
    "seed",
    "label",
    "method",
    "omega",
    "from",
    "task",
    "state",
    "env_steps",
    "updates",
    "return",
)
"""The columns that all tables have; what else evaluations say follows in columns of its own."""


def rows(runs: Iterable[Run]) -> Iterator[dict[str, Any]]:
    """A mapping for each evaluation: what was evaluated, and what came of it.

    `folder` is the name of the results folder, `cell` that of the agent in the thesis's grid (if it
    has one), `from` the folders transferred from, joined by spaces, and `state` that of the agent:
    failed ones are to be left out of statistics.
    """
    for run in runs:
        cells = read_cells(run.folder) if (run.folder / CELLS).exists() else ()
        for row in run.evaluations:
            number = row["member"]
            member, outcome = run.spec.members[number], run.outcomes[number]
            scratch = member.label == BASELINE
            source = member.tags.get("source", " ".join(run.spec.method.sources))
            known = {
                "folder": run.folder.resolve().name,
                "cell": cells[number] if number < len(cells) else None,
                "seed": member.seed,
                "label": member.label,
                "method": Scratch.NAME if scratch else run.spec.method.NAME,
                "from": None if scratch else source,
                "state": outcome.state,
            }
            told = {name: value for name, value in row.items() if name != "kind"}
            yield {**member.tags, **told, **known}


def write_evaluations(runs: Iterable[Run], path: str | Path) -> Path:
    """Writes all evaluations of runs as one .csv.

    Args:
      runs: results folders.
      path: where to; its folder is made if absent.

    Returns:
      The path.
    """
    found: list[Mapping[str, Any]] = list(rows(runs))
    columns = dict.fromkeys([*FIRST, *(name for row in found for name in row)])
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    with open(path, "w", encoding="utf-8", newline="") as file:
        writer = csv.DictWriter(file, list(columns), lineterminator="\n")
        writer.writeheader()
        writer.writerows(found)
    return path
