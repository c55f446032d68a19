"""Which seeds the comparisons of a table still need (see `sequential`)."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from experiments.reports import comparison, sequential
from experiments.reports.comparison import Entry
from experiments.reports.outcomes import Outcome
from experiments.reports.sequential import Decision
from experiments.runs.text import aligned
from experiments.thesis.grid import Cell, ReturnsTable


@dataclass(frozen=True)
class Need:
    """One comparison with agents from scratch, and what it takes to decide it.

    Attributes:
      entry: the transfer.
      baseline: the agents from scratch.
      decision: what is known.
      ours, base: seeds to be made before the next look, of the transfer and from scratch; none of
        a comparison that is not open.
    """

    entry: Entry
    baseline: Entry
    decision: Decision
    ours: tuple[int, ...]
    base: tuple[int, ...]


def needed(
    table: ReturnsTable,
    outcomes: Mapping[Cell, Outcome],
    seeds: Sequence[int],
    group: int = sequential.GROUP,
    most: int = sequential.MOST,
) -> list[Need]:
    """What each comparison of a table of returns needs.

    The level is held over all comparisons of the table as it is given: leave out fractions and
    numbers of sources that nobody means to run.

    Args:
      table: which one.
      outcomes: of all cells that it shows.
      seeds: that there are; the first one is the sources'.
      group, most: see `sequential.decide`.

    Raises:
      ValueError: see `sequential.looks`.
    """
    entries = comparison.compare(table, outcomes, seeds)
    transfers = [entry for entry in entries.values() if entry.sources is not None]
    baselines = [entries[entry.target, None, None] for entry in transfers]
    pairs = [
        (np.array(entry.scores), np.array(base.scores))
        for entry, base in zip(transfers, baselines, strict=True)
    ]
    found = []
    decisions = sequential.decide(pairs, group, most)
    for entry, base, decision in zip(transfers, baselines, decisions, strict=True):
        more = [_more(one, decision.seeds) for one in (entry, base)]
        ours, scratch = more if decision.state == "open" else ((), ())
        found.append(Need(entry, base, decision, ours, scratch))
    return found


def _more(entry: Entry, count: int) -> tuple[int, ...]:
    """The seeds that bring an entry to a number of them: the lowest that are not done or failed."""
    pairs = zip(entry.seeds, entry.outcomes, strict=True)
    spent = {seed for seed, outcome in pairs if outcome.state in ("done", "failed")}
    missing = max(0, count - len(entry.scores))
    free = (seed for seed in range(count + len(spent)) if seed not in spent)
    return tuple(seed for seed, _ in zip(free, range(missing), strict=False))


def spans(seeds: Sequence[int]) -> str:
    """Ascending seeds in words: "seed 3", "seeds 5 to 9", "seeds 1, 3 to 5"."""
    parts: list[list[int]] = []
    for seed in seeds:
        if parts and parts[-1][-1] == seed - 1:
            parts[-1].append(seed)
        else:
            parts.append([seed])
    words = [f"{part[0]} to {part[-1]}" if len(part) > 1 else str(part[0]) for part in parts]
    return f"seed{'s' if len(seeds) > 1 else ''} {', '.join(words)}"


def in_words(need: Need) -> str:
    """What is to be said of a comparison."""
    decision = need.decision
    if decision.state == "decided":
        return f"decided, {decision.verdict}, by {decision.seeds} seeds"
    if decision.state == "exhausted":
        return f"not decided, with at most {decision.seeds} seeds"
    if need.ours == need.base:
        return f"needs {spans(need.ours)}"
    words = [spans(need.ours)] if need.ours else []
    words += [f"from scratch {spans(need.base)}"] if need.base else []
    return f"needs {', '.join(words)}"


def as_text(needs: Sequence[Need]) -> str:
    """A row for each comparison."""
    rows = []
    for need in needs:
        transfer = need.entry.transfer
        counts = f"{len(need.entry.scores)} / {len(need.baseline.scores)}"
        difference = "-" if transfer is None else f"{transfer.difference.value:+z.0f}"
        rows.append([need.entry.full_name, counts, difference, in_words(need)])
    return aligned(["", "seeds", "difference", "state"], rows)
