"""Verdicts on transfers: laws, an independent library, and tables without any effect."""

import numpy as np
import pytest
from scipy import stats

from experiments.reports import verdicts
from experiments.reports.verdicts import differences, holm, verdict

CELLS = 18
TABLES = 2000


def draws(seed=0):
    return np.random.default_rng(seed)


# --- one comparison -------------------------------------------------------------------------------


def test_the_interval_of_one_group_is_welchs_or_students_whichever_is_wider():
    random = draws()
    for one, other in (
        (random.normal(size=5), random.normal(size=5)),
        (random.normal(size=5), 9 * random.normal(size=8)),
    ):
        found = differences([one], other)
        tests = [stats.ttest_ind(one, other, equal_var=equal) for equal in (True, False)]
        intervals = [test.confidence_interval(0.95) for test in tests]
        assert found.value == pytest.approx(one.mean() - other.mean())
        assert found.low == pytest.approx(min(interval.low for interval in intervals))
        assert found.high == pytest.approx(max(interval.high for interval in intervals))
        assert found.chance == pytest.approx(max(test.pvalue for test in tests))


def test_a_group_that_lies_close_by_chance_is_not_certain_beside_wider_ones():
    close = np.array([1.00, 1.01, 0.99, 1.00, 1.01])
    baseline = np.array([0.00, 0.01, -0.01, 0.00, 0.01])
    wide = [draws(seed).normal(0.5, 1.0, 5) for seed in range(6)]
    alone, among = differences([close], baseline), differences([close, *wide], baseline)
    assert alone.chance[0] < 1e-6 and among.chance[0] > 0.05
    assert alone.low[0] > 0 > among.low[0]


def test_groups_may_have_different_numbers_of_seeds():
    groups = [np.arange(5.0), np.arange(7.0), np.array([3.0])]
    found = differences(groups, np.arange(6.0))
    assert np.isfinite(found.low).tolist() == [True, True, False]
    assert np.isnan(found.chance).tolist() == [False, False, True]
    assert found.value.tolist() == [-0.5, 0.5, 0.5]


def test_a_baseline_of_one_run_gives_values_and_no_interval():
    found = differences([np.arange(5.0)], np.array([1.0]))
    assert found.value == 1.0 and np.isnan([found.low, found.high, found.chance]).all()


def test_equal_scores_all_over_are_no_difference_and_apart_a_certain_one():
    same, apart = np.full(5, 2.0), np.full(5, 3.0)
    found = differences([same, apart], same)
    assert found.chance.tolist() == [1.0, 0.0] and found.low.tolist() == [0.0, 1.0]


def test_a_scale_and_a_shift_change_no_probability():
    random = draws()
    groups, baseline = [random.normal(size=5) for _ in range(3)], random.normal(size=5)
    one = differences(groups, baseline)
    other = differences([7 - 3 * group for group in groups], 7 - 3 * baseline)
    np.testing.assert_allclose(one.chance, other.chance)
    np.testing.assert_allclose(other.low, -3 * one.high)


# --- a table --------------------------------------------------------------------------------------


def test_holms_correction_is_that_of_his_example():
    # Sorted 0.01, 0.02, 0.03, 0.2: times 4, 3, 2, 1, never falling.
    np.testing.assert_allclose(holm([0.02, 0.2, 0.01, 0.03]), [0.06, 0.2, 0.04, 0.06])
    np.testing.assert_allclose(holm([0.6, 0.7]), [1.0, 1.0])


def test_a_verdict_has_the_sign_of_the_difference_and_needs_the_level():
    assert verdict(3.0, 0.05) == "positive" and verdict(-3.0, 0.01) == "negative"
    assert verdict(3.0, 0.051) == "undecided" and verdict(3.0, float("nan")) == "undecided"


def learners(random, share, size):
    """Scores of agents some of which have learned: near -840 or near 880, as the pendulum's."""
    learned = random.random(size) < share
    return np.where(learned, 880.0, -840.0) + 40 * random.normal(size=size)


def spread(scores, factors):
    """Groups [..., G, N] with deviations of their own about the same mean."""
    return scores * np.resize(factors, scores.shape[-2])[:, None]


NULLS = {
    "normal": lambda random, size: random.normal(size=size),
    "normal, transfers spread four times as far": lambda random, size: spread(
        random.normal(size=size), [4.0] * CELLS + [1.0]
    ),
    "normal, the baseline spread four times as far": lambda random, size: spread(
        random.normal(size=size), [1.0] * CELLS + [4.0]
    ),
    "normal, each spread otherwise": lambda random, size: spread(
        random.normal(size=size), [1.0, 2.0, 4.0, 0.5]
    ),
    "skewed": lambda random, size: random.lognormal(size=size),
    "skewed, transfers spread three times as far": lambda random, size: spread(
        random.exponential(size=size) - 1, [3.0] * CELLS + [1.0]
    ),
    "half learn": lambda random, size: learners(random, 0.5, size),
    "a third learns": lambda random, size: learners(random, 1 / 3, size),
    "half learn, transfers spread twice as far": lambda random, size: spread(
        learners(random, 0.5, size) - 20, [2.0] * CELLS + [1.0]
    ),
}


@pytest.mark.parametrize("seeds", [5, 7, 12])
@pytest.mark.parametrize("noise", NULLS)
def test_at_most_one_in_twenty_tables_of_noise_has_any_verdict(noise, seeds):
    scores = NULLS[noise](draws(seeds), (TABLES, CELLS + 1, seeds))
    groups = [scores[:, cell] for cell in range(CELLS)]
    corrected = holm(differences(groups, scores[:, -1]).chance)
    assert (corrected <= verdicts.LEVEL).any(-1).mean() <= 0.05


@pytest.mark.parametrize("seeds, least", [(5, 0.5), (10, 0.95)])
def test_an_effect_of_three_deviations_is_found(seeds, least):
    scores = draws(seeds).normal(size=(TABLES, CELLS + 1, seeds))
    groups = [scores[:, cell] + 3.0 * (cell == 0) for cell in range(CELLS)]
    corrected = holm(differences(groups, scores[:, -1]).chance)
    assert (corrected[:, 0] <= verdicts.LEVEL).mean() >= least


@pytest.mark.parametrize("ratio", [1.0, 4.0])
def test_intervals_of_one_difference_hold_the_truth_as_often_as_they_say(ratio):
    scores = draws(3).normal(size=(4 * TABLES, 2, 5)) * np.array([1.0, ratio])[:, None]
    found = differences([scores[:, 0] + 2.0], scores[:, 1])
    held = (found.low <= 2.0) & (2.0 <= found.high)
    assert 0.935 <= held.mean() <= 0.975
