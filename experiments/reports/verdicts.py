"""What few runs say of a transfer: intervals that keep their level, and verdicts over a table.

A run gives one score. A group of runs (a transfer) is compared with the runs from scratch on the
same task. The interval of the difference is the wider one of two: Welch's, of the spreads of the
two groups alone, and Student's, of a spread pooled over all groups of the target. Welch's alone
takes groups for certain that lie close together by chance, which agents do that have or have not
begun to learn; the pooled one alone takes all spreads for alike. A verdict takes five seeds on both
sides, and Holm's correction over all comparisons of a table.

How often tables of 18 comparisons have any verdict at all where there is no effect, by simulation
(5000 tables each):

    seeds                                            5      10      20
    normal, spreads alike                          0.7 %   1.7 %   2.3 %
    normal, spread of the transfers 4 times        0.1 %   0.0 %   0.1 %
    normal, spread of the baseline 4 times         1.2 %   0.9 %   0.9 %
    exponential, spreads alike                     0.2 %   0.2 %   0.6 %
    half of the agents learn                       2.5 %   3.5 %   3.2 %
    four of ten learn, spreads of 1/2 to 4 times   6.4 %   2.8 %   2.4 %
    one of two learns, spreads of transfers twice  0.0 %   0.1 %   0.2 %

With Welch's interval alone the second row has 8.2, 6.0 and 5.1 %, the last one 12.4, 11.2 and
7.0 %. What the pooled spread costs: of a shift by three deviations in one of 18 groups of five
seeds, 59 % are found either way. How often 95 % intervals of a single difference of five and five
normal scores hold the truth, with spreads alike and 4 times: Welch's 95.0 and 94.4 %, the
percentile bootstrap's 86.1 and 84.5 %, the studentised bootstrap's 95.5 and 92.8 %, its symmetric
kind's 96.5 and 96.0 % with 1.1 and 1.3 times the width (1500 pairs each). So the bootstrap, which
needs draws too, was not taken.

Axis letters: N runs (seeds) of one group, G groups.
"""

from collections.abc import Sequence
from typing import Literal, NamedTuple

import numpy as np
from scipy import stats

CONFIDENCE = 0.95
LEVEL = 1 - CONFIDENCE
"""How often a table without any effect may have a verdict."""
LEAST_SEEDS = 5
"""Seeds on either side without which there is no verdict."""

Verdict = Literal["positive", "negative", "undecided"]


class Differences(NamedTuple):
    """Groups less their baseline, arrays [..., G].

    Attributes:
      value: difference of the means.
      low, high: ends of its interval; NaN where a group, or the baseline, has fewer than two runs.
      chance: probability of a difference as large without an effect (two-sided), likewise.
    """

    value: np.ndarray
    low: np.ndarray
    high: np.ndarray
    chance: np.ndarray


def differences(
    groups: Sequence[np.ndarray], baseline: np.ndarray, confidence: float = CONFIDENCE
) -> Differences:
    """Compares groups of runs with the runs from scratch on the same task.

    Args:
      groups: scores [..., N] of each of G groups, whose N may differ.
      baseline: scores [..., N].
      confidence: of each interval, by itself.
    """
    everyone = [np.asarray(scores, float) for scores in (*groups, baseline)]
    counts = np.array([scores.shape[-1] for scores in everyone])
    means = np.stack([scores.mean(-1) for scores in everyone], -1)
    squares = np.stack([scores.var(-1) * scores.shape[-1] for scores in everyone], -1)
    freedom = counts - 1
    # Groups of one run have no spread of their own: NaN here, and so in what follows.
    single = freedom == 0
    variances = np.where(single, np.nan, squares / np.where(single, 1, freedom))
    pooled_freedom = freedom.sum()
    pooled = squares.sum(-1, keepdims=True) / max(1, pooled_freedom)

    ours, base = variances[..., :-1] / counts[:-1], variances[..., -1:] / counts[-1]
    own_error = np.sqrt(ours + base)
    with np.errstate(divide="ignore", invalid="ignore"):
        own_freedom = (ours + base) ** 2 / (ours**2 / freedom[:-1] + base**2 / freedom[-1])
        # Equal scores all over have no spread, hence any freedom.
        own_freedom = np.where(own_error == 0, 1, own_freedom)
    pooled_error = np.sqrt(pooled * (1 / counts[:-1] + 1 / counts[-1]))
    value = means[..., :-1] - means[..., -1:]

    quantile = (1 + confidence) / 2
    reach = np.fmax(
        stats.t.ppf(quantile, own_freedom) * own_error,
        stats.t.ppf(quantile, max(1, pooled_freedom)) * pooled_error,
    )
    chance = np.fmax(
        _chance(value, own_error, own_freedom),
        _chance(value, pooled_error, max(1, pooled_freedom)),
    )
    known = np.isfinite(own_error)
    reach, chance = np.where(known, reach, np.nan), np.where(known, chance, np.nan)
    return Differences(value, value - reach, value + reach, chance)


def _chance(value, error, freedom):
    """Two-sided probability of Student's t; of equal means 1, also without any spread."""
    with np.errstate(divide="ignore", invalid="ignore"):
        distance = np.where(value == 0, 0.0, np.abs(value) / error)
    return 2 * stats.t.sf(distance, freedom)


def holm(chances: np.ndarray) -> np.ndarray:
    """Probabilities [..., G] corrected for their number, after Holm (1979).

    A difference whose corrected probability is at most α counts; then the probability that any
    counts of those without an effect is at most α.
    """
    chances = np.asarray(chances, float)
    count = chances.shape[-1]
    order = np.argsort(chances, -1)
    ascending = np.take_along_axis(chances, order, -1) * np.arange(count, 0, -1)
    corrected = np.minimum(np.maximum.accumulate(ascending, -1), 1.0)
    found = np.empty_like(corrected)
    np.put_along_axis(found, order, corrected, -1)
    return found


def verdict(value: float, corrected: float) -> Verdict:
    """What a difference and its corrected probability say of a transfer (section 2.4.1).

    The thesis's third kind, neutral transfer, cannot be shown by a test that finds nothing:
    "undecided".
    """
    if not corrected <= LEVEL:
        return "undecided"
    return "positive" if value > 0 else "negative"
