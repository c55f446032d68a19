"""Statistics of few runs: numbers worked out by hand, and laws."""

import math
from itertools import product

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.stats import mannwhitneyu, norm

from experiments.reports import statistics
from experiments.reports.statistics import Estimate

SCORES = st.lists(st.integers(-1000, 1000).map(float), min_size=2, max_size=5).map(np.array)


def draws(seed=0):
    return np.random.default_rng(seed)


# --- one number -----------------------------------------------------------------------------------


def test_mean_and_deviation_take_all_returns_together():
    assert statistics.mean_and_deviation([2.0, 4.0, 4.0, 4.0, 5.0, 5.0, 7.0, 9.0]) == (5.0, 2.0)


def test_the_interquartile_mean_leaves_out_the_lowest_and_highest_quarter():
    assert statistics.interquartile_mean(np.array([1000.0, 2.0, 4.0, -1000.0])) == 3.0
    eight = np.array([[9.0, 1, 8, 2, 7, 3, 6, 4]])
    np.testing.assert_allclose(statistics.interquartile_mean(eight), [(3 + 4 + 6 + 7) / 4])


def test_the_interquartile_mean_of_three_is_their_mean():
    assert statistics.interquartile_mean(np.array([0.0, 0.0, 9.0])) == 3.0


def test_final_returns_are_those_of_the_last_ten_of_a_hundred_evaluations():
    steps = [10_000 * (i + 1) for i in range(100)]
    found = statistics.final(steps, np.arange(100.0), 1_000_000, planned=100)
    assert found.tolist() == list(range(90, 100))


def test_final_returns_are_those_of_the_last_evaluation_if_none_lies_in_the_last_tenth():
    assert statistics.final([400, 800], [1.0, 2.0], 1000, planned=2).tolist() == [2.0]


def test_a_run_that_was_cut_before_its_last_tenth_has_no_final_returns():
    assert statistics.final([400], [1.0], 1000, planned=2).tolist() == []
    assert statistics.final([100, 950], [1.0, 2.0], 1000, planned=3).tolist() == [2.0]


def test_a_jumpstart_compares_the_first_evaluations_alone():
    ours, baseline = [[10.0, 20.0, 999.0], [30.0, 40.0, 999.0]], [[1.0, 3.0, 0.0]]
    assert statistics.jumpstart(ours, baseline, 2) == 25.0 - 2.0


@pytest.mark.parametrize("planned, count", [(1, 1), (20, 1), (21, 2), (100, 5)])
def test_a_jumpstart_takes_a_twentieth_of_the_evaluations(planned, count):
    assert statistics.first_evaluations(planned) == count


def test_the_threshold_lies_between_first_and_final_returns_whatever_their_signs():
    assert statistics.threshold(0.0, 100.0) == pytest.approx(90.0)
    assert statistics.threshold(-840.0, 160.0) == pytest.approx(60.0)
    assert statistics.threshold(-840.0, -340.0, 0.5) == -590.0


def test_the_time_to_a_threshold_is_that_of_the_first_evaluation_to_reach_it():
    steps, returns = [10, 20, 30, 40], [0.0, 5.0, 3.0, 9.0]
    assert statistics.time_to_threshold(steps, returns, 4.0) == 20
    assert statistics.time_to_threshold(steps, returns, 5.0) == 20
    assert statistics.time_to_threshold(steps, returns, 5.1) == 40
    assert statistics.time_to_threshold(steps, returns, 9.1) is None


def test_scores_are_scaled_to_the_lowest_and_highest_run_of_all_groups():
    one, other = statistics.normalised([[10.0, 30.0], [20.0, 50.0]])
    assert one.tolist() == [0.0, 0.5] and other.tolist() == [0.25, 1.0]
    assert [group.tolist() for group in statistics.normalised([[7.0], [7.0, 7.0]])] == [
        [0.5],
        [0.5, 0.5],
    ]


# --- intervals ------------------------------------------------------------------------------------


def test_the_interval_of_two_runs_spans_both():
    # Of the draws, a quarter each give the lower run and the higher one twice.
    estimate = statistics.bootstrap([np.array([0.0, 1.0])], np.mean, draws())
    assert estimate == Estimate(0.5, 0.0, 1.0)


def test_the_interval_is_that_of_all_draws_that_there_are():
    """Of three runs there are 27 draws, each as likely as the others."""
    scores = np.array([1.0, 4.0, 10.0])
    means = [np.mean(drawn) for drawn in product(scores, repeat=3)]
    estimate = statistics.bootstrap([scores], np.mean, draws(), draws=50_000)
    expected = np.quantile(means, [0.025, 0.975], method="inverted_cdf")
    np.testing.assert_allclose(estimate[1:], expected)


def test_runs_are_drawn_anew_within_their_stratum():
    """Two strata without spread of their own leave nothing to draw, far apart as they are."""
    strata = [np.array([0.0, 0.0]), np.array([100.0, 100.0])]
    assert statistics.aggregate(strata, draws()) == Estimate(50.0, 50.0, 50.0)


def test_a_single_run_has_no_interval():
    assert statistics.aggregate([np.array([5.0])], draws()) == Estimate(5.0, None, None)
    one = statistics.improvement(np.array([5.0]), np.array([1.0, 2.0]))
    assert one == Estimate(1.0, None, None)


def test_the_same_generator_gives_the_same_interval():
    scores = draws(1).normal(size=5)
    one, other, different = (
        statistics.bootstrap([scores], np.mean, draws(seed)) for seed in (0, 0, 1)
    )
    assert one == other != different


@given(SCORES, st.integers(-500, 500))
@settings(max_examples=15, deadline=None)
def test_a_shift_of_the_runs_moves_value_and_interval_with_it(scores, shift):
    one = statistics.aggregate([scores], draws())
    other = statistics.aggregate([scores + shift], draws())
    np.testing.assert_allclose(other, np.add(one, shift), atol=1e-6)


@given(SCORES, SCORES)
@settings(max_examples=15, deadline=None)
def test_the_interval_holds_the_value(ours, baseline):
    for estimate in (
        statistics.aggregate([ours, baseline], draws()),
        statistics.improvement(ours, baseline),
        statistics.mean_improvement([(ours, baseline)], draws()),
    ):
        assert estimate.low <= estimate.value <= estimate.high


def test_intervals_hold_the_truth_about_as_often_as_they_say_for_many_runs_and_not_for_three():
    def coverage(runs, trials=200):
        random = draws(7)
        held = 0
        for _ in range(trials):
            sample = random.normal(3.0, 2.0, size=runs)
            estimate = statistics.bootstrap([sample], np.mean, random, draws=200)
            held += estimate.low <= 3.0 <= estimate.high
        return held / trials

    assert 0.90 <= coverage(20) <= 0.97
    assert 0.65 <= coverage(3) <= 0.85


# --- probability of improvement -------------------------------------------------------------------


def test_the_probability_of_improvement_counts_pairs_and_halves_of_equal_ones():
    # 3 > 1, 3 > 2, 3 = 3, 2 > 1, 2 = 2, 2 < 3
    ours, baseline = np.array([3.0, 2.0]), np.array([1.0, 2.0, 3.0])
    estimate = statistics.improvement(ours, baseline)
    assert estimate.value == pytest.approx((1 + 1 + 0.5 + 1 + 0.5 + 0) / 6)


@given(SCORES, SCORES)
@settings(max_examples=15, deadline=None)
def test_the_probability_of_improvement_is_mann_and_whitneys_statistic(ours, baseline):
    expected = mannwhitneyu(ours, baseline).statistic / (len(ours) * len(baseline))
    found = statistics.improvement(ours, baseline).value
    assert found == pytest.approx(expected)
    assert statistics.improvement(baseline, ours).value == pytest.approx(1 - found)


def test_the_probability_of_improvement_is_averaged_over_tasks():
    low, high = np.array([0.0, 1.0]), np.array([5.0, 6.0])
    pairs = [(high, low), (low, high), (high, low), (high, low)]
    assert statistics.mean_improvement(pairs, draws()) == Estimate(0.75, 0.75, 0.75)


@given(SCORES, SCORES)
@settings(max_examples=15, deadline=None)
def test_the_interval_of_the_probability_of_improvement_is_a_mirror_image(ours, baseline):
    one, other = statistics.improvement(ours, baseline), statistics.improvement(baseline, ours)
    np.testing.assert_allclose([1 - one.high, 1 - one.low], [other.low, other.high], atol=1e-6)


def test_the_interval_of_five_better_runs_of_five_has_a_width():
    low, high = np.arange(5.0), np.arange(5.0) + 10
    value, low, high = statistics.improvement(high, low)
    # 1 - t = 1.96 √(t (1 - t) (1 + 4 ((1 - t) / (2 - t) + t / (1 + t))) / 25), solved by hand.
    factor = 1 + 4 * ((1 - low) / (2 - low) + low / (1 + low))
    assert (value, high) == (1.0, 1.0) and 0.6 < low < 0.7
    assert 1 - low == pytest.approx(1.959964 * math.sqrt(low * (1 - low) * factor / 25), rel=1e-4)


@pytest.mark.parametrize("shift, spread", [(0.0, 1.0), (1.0, 1.0), (0.0, 3.0)])
def test_intervals_of_the_probability_of_improvement_hold_the_truth_of_five_and_five(shift, spread):
    random, held, trials = draws(5), 0, 600
    truth = norm.cdf(shift / math.hypot(1.0, spread))
    for _ in range(trials):
        ours, base = shift + random.normal(size=5), spread * random.normal(size=5)
        estimate = statistics.improvement(ours, base)
        held += estimate.low <= truth <= estimate.high
    assert 0.91 <= held / trials <= 0.99
