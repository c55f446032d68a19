"""Statistics of few runs: interquartile means, bootstrap intervals, probability of improvement.

After "Deep Reinforcement Learning at the Edge of the Statistical Precipice" (Agarwal et al.,
2021): a run gives one score, and intervals come from drawing runs anew within each task. Pure
functions over NumPy arrays; those that draw take a generator. Differences to a baseline and what
they say of a transfer are in `verdicts`.

Axis letters: N runs (seeds) of one task, D draws of the bootstrap, E evaluations.
"""

import math
from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike
from scipy import optimize, stats

from experiments.reports.verdicts import CONFIDENCE

DRAWS = 2000
FINAL_SHARE = 0.1
"""Share of a run's environment steps, at its end, whose evaluations are the final ones."""
FIRST_SHARE = 0.05
"""Share of a run's evaluations, at its start, that a jumpstart compares."""
REACHED_SHARE = 0.9
"""How far from a baseline's first to its final return the threshold lies whose time is taken."""


class Estimate(NamedTuple):
    """A value and its interval; no ends where a group has one run, or a value is not finite."""

    value: float
    low: float | None
    high: float | None


def mean_and_deviation(returns: ArrayLike) -> tuple[float, float]:
    """Mean and standard deviation of returns, all evaluations of all seeds together.

    This is the thesis's ±. For InvertedPendulum it prints overall deviations, such as 723 ± 364
    from scratch, that three seeds cannot have among themselves: where no number exceeds M, the
    deviation of three is at most √2 (M - mean), or √3 with n - 1 in place of n; and agents that
    end at 883 ± 17 have M near 900. What they do have is a learning curve, low at first.
    """
    returns = np.asarray(returns, float)
    return float(returns.mean()), float(returns.std())


def interquartile_mean(scores: np.ndarray, axis: int = -1) -> np.ndarray:
    """Mean of the middle half of scores along an axis (of all, where there are fewer than 4)."""
    return stats.trim_mean(scores, 0.25, axis=axis)


def bootstrap(
    strata: Sequence[np.ndarray],
    statistic: Callable[..., np.ndarray],
    generator: np.random.Generator,
    confidence: float = CONFIDENCE,
    draws: int = DRAWS,
) -> Estimate:
    """A statistic with its percentile interval; runs are drawn anew within each stratum.

    Args:
      strata: scores [N] of each group of runs, such as those of a task.
      statistic: from the strata as arguments, arrays [..., N], to [...]; it takes `axis`.
      generator: of the draws.
      confidence: share of such intervals that would hold the truth, if there were many runs.
      draws: D.
    """
    strata = [np.asarray(scores, float) for scores in strata]
    value = float(statistic(*strata, axis=-1))
    if not math.isfinite(value) or any(len(scores) < 2 for scores in strata):
        return Estimate(value, None, None)
    interval = stats.bootstrap(
        strata,
        statistic,
        n_resamples=draws,
        vectorized=True,
        axis=-1,
        confidence_level=confidence,
        method="percentile",
        rng=generator,
    ).confidence_interval
    return Estimate(value, float(interval.low), float(interval.high))


def aggregate(strata: Sequence[np.ndarray], generator: np.random.Generator) -> Estimate:
    """Interquartile mean over the runs of all strata, with its interval."""

    def statistic(*scores, axis):
        return interquartile_mean(np.concatenate(scores, axis=axis), axis=axis)

    return bootstrap(strata, statistic, generator)


def improvement(ours: np.ndarray, baseline: np.ndarray, confidence: float = CONFIDENCE) -> Estimate:
    """Probability that a run beats one of the baseline, equal ones counted half.

    The statistic of Mann and Whitney over the number of pairs of runs. Its interval is the fifth
    of Newcombe (2006), which has a width where all runs of one side are better, too: of five and
    five runs it held the truth in 93 to 97 % of cases (normal with spreads alike and four times,
    exponential, and agents some of which learn).

    Args:
      ours, baseline: scores [N].
      confidence: of the interval.
    """
    ours, baseline = np.asarray(ours, float), np.asarray(baseline, float)
    value = float(_wins(ours, baseline))
    if len(ours) < 2 or len(baseline) < 2:
        return Estimate(value, None, None)
    pairs, more = len(ours) * len(baseline), (len(ours) + len(baseline)) / 2 - 1
    reach = float(stats.norm.ppf((1 + confidence) / 2))

    def beyond(truth: float) -> float:
        factor = 1 + more * ((1 - truth) / (2 - truth) + truth / (1 + truth))
        return abs(value - truth) - reach * math.sqrt(truth * (1 - truth) * factor / pairs)

    low = 0.0 if value == 0 else optimize.brentq(beyond, 0.0, value - 1e-9)
    high = 1.0 if value == 1 else optimize.brentq(beyond, value + 1e-9, 1.0)
    return Estimate(value, float(low), float(high))


def mean_improvement(
    pairs: Sequence[tuple[np.ndarray, np.ndarray]], generator: np.random.Generator
) -> Estimate:
    """Probability of improvement averaged over tasks, with its bootstrap interval.

    Args:
      pairs: for each task, scores [N] of the runs and of the baseline's.
      generator: of the draws.
    """

    def statistic(*scores, axis):
        tasks = zip(scores[::2], scores[1::2], strict=True)
        return np.mean([_wins(ours, base) for ours, base in tasks], axis=0)

    return bootstrap([scores for pair in pairs for scores in pair], statistic, generator)


def _wins(ours: np.ndarray, baseline: np.ndarray) -> np.ndarray:
    """Share of pairs of runs [..., N] that the first of both wins."""
    ours, baseline = ours[..., :, None], baseline[..., None, :]
    return ((ours > baseline) + 0.5 * (ours == baseline)).mean(axis=(-2, -1))


def normalised(groups: Sequence[np.ndarray]) -> list[np.ndarray]:
    """Scores of one task on a scale where its lowest run, of all groups, is 0 and the highest 1.

    Equal scores are all 0.5.
    """
    scores = np.concatenate([np.asarray(group, float) for group in groups])
    lowest, highest = scores.min(), scores.max()
    if lowest == highest:
        return [np.full(len(group), 0.5) for group in groups]
    return [(np.asarray(group, float) - lowest) / (highest - lowest) for group in groups]


def final(env_steps: ArrayLike, returns: ArrayLike, total: int, planned: int) -> np.ndarray:
    """The returns of a run's final evaluations: those in its last tenth, and the last one planned.

    A run that was cut before them has none.

    Args:
      env_steps: environment steps [E] at each evaluation.
      returns: of each evaluation [E].
      total: environment steps of the whole run.
      planned: evaluations of the whole run.
    """
    late = np.asarray(env_steps) > (1 - FINAL_SHARE) * total
    late[planned - 1 : planned] = True
    return np.asarray(returns, float)[late]


def first_evaluations(planned: int) -> int:
    """How many evaluations a jumpstart compares: 5 of a run of 100."""
    return max(1, math.ceil(FIRST_SHARE * planned))


def jumpstart(curves: ArrayLike, baseline: ArrayLike, count: int) -> float:
    """Mean return of the first `count` evaluations, less the baseline's; curves [N, E]."""
    ours, base = (np.asarray(group, float)[:, :count].mean() for group in (curves, baseline))
    return float(ours - base)


def threshold(first: float, final: float, share: float = REACHED_SHARE) -> float:
    """The return that lies this share of the way from a baseline's first returns to its final."""
    return first + share * (final - first)


def time_to_threshold(env_steps: ArrayLike, returns: ArrayLike, threshold: float) -> int | None:
    """Environment steps at the first of E evaluations to reach a return; None if none does."""
    reached = np.flatnonzero(np.asarray(returns, float) >= threshold)
    return int(np.asarray(env_steps)[reached[0]]) if len(reached) else None
