"""What the tables of returns compare: each entry's runs, the published number, the baseline.

Returns are those of the evaluations (section 4.2.3): "overall" takes all evaluations of a run,
"final" those in the last tenth of its environment steps. A run's score is their mean. Numbers are
given for entries all of whose runs are complete, and for no others.

Axis letters: N runs (seeds), E evaluations.
"""

import dataclasses
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from experiments.reports import statistics
from experiments.reports.outcomes import Outcome
from experiments.reports.statistics import Estimate
from experiments.thesis import grid, published
from experiments.thesis.grid import Cell, Metric, Table
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
    """

    difference: Estimate
    improvement: Estimate
    jumpstart: float

    @property
    def verdict(self) -> statistics.Verdict | None:
        """Positive, neutral or negative transfer; None where there is no interval to judge by."""
        return statistics.verdict(self.difference)


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
      omega: the fraction of equation 19, if any.
      outcomes: of each seed.
      planned: evaluations that the seeds make together; 0 if none of the table has begun.
      published: the thesis's entry, if it has one.
      scores: [N], of complete entries.
      ours: mean and deviation of returns, of complete entries.
      average: interquartile mean of the scores, of complete entries.
      transfer: against the baseline, where both are complete.
      threshold: likewise, and of the baseline itself.
    """

    target: str
    sources: int | None
    omega: float | None
    outcomes: tuple[Outcome, ...]
    planned: int
    published: Published | None
    scores: tuple[float, ...] = ()
    ours: tuple[float, float] | None = None
    average: Estimate | None = None
    transfer: Transfer | None = None
    threshold: Threshold | None = None

    @property
    def done(self) -> int:
        """Evaluations made by all seeds."""
        return sum(len(outcome.env_steps) for outcome in self.outcomes)

    @property
    def complete(self) -> bool:
        """Whether all seeds have made all their evaluations."""
        return all(outcome.state == "complete" for outcome in self.outcomes)

    @property
    def name(self) -> str:
        """Which entry of its table it is."""
        words = ["baseline"] if self.sources is None else [f"{self.sources} tasks"]
        return ", ".join(words + ([] if self.omega is None else [f"ω = {self.omega:g}"]))


def curves(outcomes: Sequence[Outcome], task: str) -> tuple[np.ndarray, np.ndarray]:
    """Returns on a task over environment steps, as far as all runs that have begun have come.

    Returns:
      environment steps [E] and returns [N, E]; N is 0 if no run has begun.
    """
    begun = [outcome for outcome in outcomes if outcome.env_steps]
    if not begun:
        return np.zeros(0, int), np.zeros((0, 0))
    length = min(len(outcome.returns.get(task, ())) for outcome in begun)
    steps = np.array(begun[0].env_steps[:length])
    return steps, np.array([outcome.returns[task][:length] for outcome in begun], float)


def _chosen(outcome: Outcome, task: str, metric: Metric) -> np.ndarray:
    returns = np.asarray(outcome.returns[task], float)
    if metric == "overall":
        return returns
    return statistics.final(outcome.env_steps, returns, outcome.total_env_steps)


def keys(table: Table) -> list[tuple[str, int | None, float | None]]:
    """Target, sources and fraction of each entry, a target's baseline first."""
    omegas = table.omegas if table.kind == "ftl" else (None,)
    found = []
    for target in table.targets:
        found.append((target, None, None))
        found += [(target, count, omega) for omega in omegas for count in table.counts]
    return found


def cells(table: Table, key: tuple, seeds: Sequence[int]) -> tuple[Cell, ...]:
    """The cells of an entry, one per seed; see `keys`."""
    target, count, omega = key
    backend, source = table.backend, seeds[0]
    if count is None:
        return tuple(grid.baseline(backend, target, seed) for seed in seeds)
    if table.kind == "meta":
        return tuple(grid.meta(backend, target, count, seed, source) for seed in seeds)
    return tuple(grid.fractional(backend, target, count, omega, seed, source) for seed in seeds)


def compare(
    table: Table, outcomes: Mapping[Cell, Outcome], seeds: Sequence[int]
) -> dict[tuple, Entry]:
    """The entries of a table of returns by their keys.

    Args:
      table: of kind "ftl" or "meta".
      outcomes: of all cells that the table shows.
      seeds: of targets and baselines; the first one is the sources'.
    """
    groups = {
        key: tuple(outcomes[cell] for cell in cells(table, key, seeds)) for key in keys(table)
    }
    planned = max(outcome.planned for group in groups.values() for outcome in group)
    entries: dict[tuple, Entry] = {}
    for key, group in groups.items():
        base = entries.get((key[0], None, None))
        entries[key] = _entry(table, key, group, planned * len(seeds), base)
    return entries


def _entry(table, key, outcomes, planned: int, base: Entry | None) -> Entry:
    target = key[0]
    empty = Entry(*key, outcomes, planned, published.returns(published.number(table), *key))
    if not empty.complete:
        return empty
    chosen = [_chosen(outcome, target, table.metric) for outcome in outcomes]
    scores = np.array([returns.mean() for returns in chosen])
    entry = dataclasses.replace(
        empty,
        scores=tuple(scores.tolist()),
        ours=statistics.mean_and_deviation(np.concatenate(chosen)),
        average=statistics.aggregate([scores], np.random.default_rng(DRAWS_SEED)),
    )
    if base is None:
        return dataclasses.replace(entry, threshold=_threshold(outcomes, outcomes, target))
    if not base.complete:
        return entry
    reference = np.array(base.scores)
    count = statistics.first_evaluations(outcomes[0].planned)
    transfer = Transfer(
        statistics.difference(scores, reference, np.random.default_rng(DRAWS_SEED)),
        statistics.improvement([(scores, reference)], np.random.default_rng(DRAWS_SEED)),
        statistics.jumpstart(curves(outcomes, target)[1], curves(base.outcomes, target)[1], count),
    )
    threshold = _threshold(outcomes, base.outcomes, target)
    return dataclasses.replace(entry, transfer=transfer, threshold=threshold)


def _threshold(outcomes, baselines, target: str) -> Threshold:
    count = statistics.first_evaluations(baselines[0].planned)
    _, base = curves(baselines, target)
    late = [_chosen(outcome, target, "final").mean() for outcome in baselines]
    value = statistics.threshold(float(base[:, :count].mean()), float(np.mean(late)))
    steps, returns = curves(outcomes, target)
    return Threshold(value, statistics.time_to_threshold(steps, returns.mean(0), value))


@dataclass(frozen=True)
class Aggregate:
    """One setting of a method over all targets that are complete.

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
    tables: Sequence[dict[tuple, Entry]],
) -> tuple[list[str], list[Aggregate]]:
    """Joins entries of several targets, each target a stratum of the bootstrap.

    Args:
      tables: entries of tables of one method and metric, from `compare`.

    Returns:
      The targets all of whose entries are complete, and one aggregate for each setting of the
      method, the baseline first; none without a target.
    """
    by_target: dict[str, dict[tuple, Entry]] = {}
    for entries in tables:
        for (target, *setting), entry in entries.items():
            by_target.setdefault(target, {})[tuple(setting)] = entry
    by_target = {
        target: group
        for target, group in by_target.items()
        if all(entry.complete for entry in group.values())
    }
    if not by_target:
        return [], []
    scaled = {
        target: dict(
            zip(group, statistics.normalised([e.scores for e in group.values()]), strict=True)
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
                statistics.improvement(pairs, np.random.default_rng(DRAWS_SEED))
                if entry.sources is not None
                else None,
            )
        )
    return list(by_target), aggregates
