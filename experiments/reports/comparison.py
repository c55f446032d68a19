"""What the tables of returns compare: each entry's runs, the published number, the baseline.

Returns are those of the evaluations (section 4.2.3): "overall" takes all evaluations of a run,
"final" those in the last tenth of its environment steps. A run's score is their mean. Numbers are
those of the seeds that are done; a verdict takes five of them on either side, and is corrected for
the number of comparisons in its table (see `verdicts`).

Axis letters: N runs (seeds), E evaluations.
"""

import dataclasses
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from experiments.reports import statistics, verdicts
from experiments.reports.outcomes import Outcome, curves
from experiments.reports.statistics import Estimate
from experiments.reports.verdicts import Verdict
from experiments.thesis import grid, published
from experiments.thesis.grid import Cell, Key, ReturnsTable
from experiments.thesis.published import Published

# Intervals are the same whenever and in whatever order tables are written.
DRAWS_SEED = 0


@dataclass(frozen=True)
class Transfer:
    """What transfer did to a target, against its baseline.

    Attributes:
      difference: mean score less the baseline's.
      improvement: probability that a run beats one of the baseline.
      jumpstart: mean return of the first evaluations, less the baseline's.
      chance: probability of a difference as large without an effect, corrected for the number of
        comparisons in the table; None where either side has fewer than five seeds.
    """

    difference: Estimate
    improvement: Estimate
    jumpstart: float
    chance: float | None = None

    @property
    def verdict(self) -> Verdict | None:
        """Positive or negative transfer, or undecided; None where there are too few seeds."""
        if self.chance is None:
            return None
        return verdicts.verdict(self.difference.value, self.chance)


@dataclass(frozen=True)
class Threshold:
    """When a return was reached that lies 0.9 of the way from the baseline's first to its final.

    Attributes:
      value: the return.
      env_steps: environment steps at which the mean curve of the seeds reached it; None if never.
    """

    value: float
    env_steps: int | None


@dataclass(frozen=True)
class Entry:
    """One entry of a table of returns: the seeds of one target, source and fraction.

    Attributes:
      target: title of the task.
      sources: number of source tasks; None for the baseline.
      variant: the fraction of equation 19, if any; or the name of the method, where it is not the
        table's own.
      outcomes: of each seed.
      seeds: of the outcomes.
      published: the thesis's entry, if it has one.
      scores: [N], of the seeds that are done.
      ours: mean and deviation of their returns, if there are any.
      average: interquartile mean of the scores.
      transfer: against the baseline, where seeds of both are done.
      threshold: likewise, and of the baseline itself.
    """

    target: str
    sources: int | None
    variant: float | str | None
    outcomes: tuple[Outcome, ...]
    seeds: tuple[int, ...]
    published: Published | None
    scores: tuple[float, ...] = ()
    ours: tuple[float, float] | None = None
    average: Estimate | None = None
    transfer: Transfer | None = None
    threshold: Threshold | None = None

    @property
    def done(self) -> int:
        """Evaluations made by all seeds that have begun and not failed."""
        return sum(len(outcome.env_steps) for outcome in self._sound)

    @property
    def planned(self) -> int:
        """Evaluations that these seeds will have made."""
        return sum(outcome.planned for outcome in self._sound)

    @property
    def failed(self) -> tuple[int, ...]:
        """The seeds that failed."""
        return self._seeds("failed")

    @property
    def cut(self) -> tuple[int, ...]:
        """The seeds that have begun and are not done."""
        return self._seeds("cut")

    @property
    def begun(self) -> bool:
        """Whether anything of it has been evaluated."""
        return any(outcome.state != "missing" for outcome in self.outcomes)

    @property
    def name(self) -> str:
        """Which entry of its table it is."""
        words = ["baseline"] if self.sources is None else [f"{self.sources} tasks"]
        if self.method is not None:
            words.append(self.method)
        elif self.omega is not None:
            words.append(f"ω = {self.omega:g}")
        return ", ".join(words)

    @property
    def omega(self) -> float | None:
        """The fraction, if any."""
        return None if isinstance(self.variant, str) else self.variant

    @property
    def method(self) -> str | None:
        """The name of the method, where it is not the table's own."""
        return self.variant if isinstance(self.variant, str) else None

    @property
    def full_name(self) -> str:
        """Which entry it is of any table."""
        return f"{self.target}, {self.name}"

    @property
    def _sound(self) -> list[Outcome]:
        return [outcome for outcome in self.outcomes if outcome.state in ("cut", "done")]

    def _seeds(self, state: str) -> tuple[int, ...]:
        pairs = zip(self.seeds, self.outcomes, strict=True)
        return tuple(seed for seed, outcome in pairs if outcome.state == state)


def compare(
    table: ReturnsTable, outcomes: Mapping[Cell, Outcome], seeds: Sequence[int]
) -> dict[Key, Entry]:
    """The entries of a table of returns by their keys.

    Args:
      table: which one.
      outcomes: of all cells that the table shows.
      seeds: of targets and baselines; the first one is the sources'.
    """
    entries: dict[Key, Entry] = {}
    for key, cells in grid.entries(table, seeds).items():
        group = tuple(outcomes[cell] for cell in cells)
        base = entries.get((key[0], None, None))
        entries[key] = _entry(table, key, group, tuple(seeds), base)
    return _with_verdicts(entries)


def transferred(
    table: ReturnsTable, outcomes: Mapping[Cell, Outcome], seeds: Sequence[int]
) -> bool:
    """Whether anything of a table of returns but its agents from scratch has begun."""
    return any(
        outcomes[cell].state != "missing"
        for (_, count, _), cells in grid.entries(table, seeds).items()
        if count is not None
        for cell in cells
    )


def _entry(
    table: ReturnsTable,
    key: Key,
    outcomes: tuple[Outcome, ...],
    seeds: tuple[int, ...],
    base: Entry | None,
) -> Entry:
    target, sources, variant = key
    known = published.returns(published.number(table), target, sources, variant)
    empty = Entry(target, sources, variant, outcomes, seeds, known)
    done = [outcome for outcome in outcomes if outcome.state == "done"]
    if not done:
        return empty
    scores = np.array([outcome.score(target, table.metric) for outcome in done])
    returns = np.concatenate([outcome.chosen(target, table.metric) for outcome in done])
    entry = dataclasses.replace(
        empty,
        scores=tuple(scores.tolist()),
        ours=statistics.mean_and_deviation(returns),
        average=statistics.aggregate([scores], np.random.default_rng(DRAWS_SEED)),
    )
    if base is None:
        return dataclasses.replace(entry, threshold=_threshold(done, done, target))
    if not base.scores:
        return entry
    baselines = [outcome for outcome in base.outcomes if outcome.state == "done"]
    count = statistics.first_evaluations(done[0].planned)
    transfer = Transfer(
        Estimate(float(scores.mean() - np.mean(base.scores)), None, None),
        statistics.improvement(scores, np.array(base.scores)),
        statistics.jumpstart(curves(done, target)[1], curves(baselines, target)[1], count),
    )
    threshold = _threshold(done, baselines, target)
    return dataclasses.replace(entry, transfer=transfer, threshold=threshold)


def _with_verdicts(entries: dict[Key, Entry]) -> dict[Key, Entry]:
    """Intervals of the differences, of each target's groups together, and what they say."""
    transfers: dict[Key, Transfer] = {}
    chances: dict[Key, float] = {}
    for target in dict.fromkeys(entry.target for entry in entries.values()):
        chosen = {
            key: entry.transfer
            for key, entry in entries.items()
            if entry.target == target and entry.transfer is not None
        }
        if not chosen:
            continue
        base = entries[target, None, None].scores
        groups = [np.array(entries[key].scores) for key in chosen]
        differences = verdicts.differences(groups, np.array(base))
        for key, value, low, high, chance in zip(chosen, *differences, strict=True):
            ends = (float(low), float(high)) if np.isfinite(low) else (None, None)
            difference = Estimate(float(value), *ends)
            transfers[key] = dataclasses.replace(chosen[key], difference=difference)
            if min(len(base), len(entries[key].scores)) >= verdicts.LEAST_SEEDS:
                chances[key] = float(chance)
    corrected = verdicts.holm(np.array(list(chances.values())))
    for key, chance in zip(chances, corrected, strict=True):
        transfers[key] = dataclasses.replace(transfers[key], chance=float(chance))
    return entries | {
        key: dataclasses.replace(entries[key], transfer=transfer)
        for key, transfer in transfers.items()
    }


def _threshold(done: Sequence[Outcome], baselines: Sequence[Outcome], target: str) -> Threshold:
    count = statistics.first_evaluations(baselines[0].planned)
    _, base = curves(baselines, target)
    late = [outcome.score(target, "final") for outcome in baselines]
    value = statistics.threshold(float(base[:, :count].mean()), float(np.mean(late)))
    steps, returns = curves(done, target)
    return Threshold(value, statistics.time_to_threshold(steps, returns.mean(0), value))


@dataclass(frozen=True)
class Aggregate:
    """One setting of a method over all targets all of whose entries are there.

    Attributes:
      name: of the setting.
      average: interquartile mean of scores on each target's own scale from 0, its lowest run, to
        1, its highest.
      improvement: probability of improvement over the baseline, averaged over targets; None for
        the baseline itself.
    """

    name: str
    average: Estimate
    improvement: Estimate | None


def across_targets(
    tables: Sequence[Mapping[Key, Entry]],
) -> tuple[list[str], list[Aggregate]]:
    """Joins entries of several targets, each target a stratum of the bootstrap.

    Args:
      tables: entries of tables of one method and metric, from `compare`.

    Returns:
      The targets all of whose entries have seeds that are done, and one aggregate for each setting
      of the method, the baseline first; none without a target.
    """
    by_target: dict[str, dict[tuple[int | None, float | None], Entry]] = {}
    for entries in tables:
        for entry in entries.values():
            if entry.method is not None:
                continue  # not of the table's own method
            by_target.setdefault(entry.target, {})[entry.sources, entry.omega] = entry
    by_target = {
        target: group
        for target, group in by_target.items()
        if all(entry.scores for entry in group.values())
    }
    if not by_target:
        return [], []
    scaled = {
        target: dict(
            zip(
                group,
                statistics.normalised([np.array(e.scores) for e in group.values()]),
                strict=True,
            )
        )
        for target, group in by_target.items()
    }
    aggregates = []
    for setting, entry in next(iter(by_target.values())).items():
        strata = [scores[setting] for scores in scaled.values()]
        pairs = [(scores[setting], scores[None, None]) for scores in scaled.values()]
        aggregates.append(
            Aggregate(
                entry.name,
                statistics.aggregate(strata, np.random.default_rng(DRAWS_SEED)),
                statistics.mean_improvement(pairs, np.random.default_rng(DRAWS_SEED))
                if entry.sources is not None
                else None,
            )
        )
    return list(by_target), aggregates
