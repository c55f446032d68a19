"""The sequential choice of the number of seeds: laws, and what it decides of noise."""

import numpy as np
import pytest

from experiments.reports import sequential
from experiments.reports.sequential import Decision, decide


def noise(seed, count, seeds, shift=0.0):
    random = np.random.default_rng(seed)
    baseline = random.normal(size=seeds)
    return [(random.normal(size=seeds) + shift, baseline) for _ in range(count)]


def test_looks_are_whole_groups():
    assert sequential.looks(5, 20) == (5, 10, 15, 20) and sequential.looks(4, 10) == (4, 8)
    for group, most in ((1, 20), (6, 5)):
        with pytest.raises(ValueError, match=f"--group is {group} and --most {most}"):
            sequential.looks(group, most)


def test_without_a_whole_group_the_first_is_needed():
    (pair,) = noise(0, 1, 5)
    for ours, base in ((0, 0), (4, 5), (5, 3)):
        found = decide([(pair[0][:ours], pair[1][:base])], draws=100)
        assert found == [Decision("open", None, 5)]


def test_groups_far_apart_are_decided_early_and_noise_not_to_the_end():
    apart = noise(1, 1, 20, shift=50.0)
    assert decide(apart)[0] == Decision("decided", "positive", 5)
    assert decide([(base, ours) for ours, base in apart])[0].verdict == "negative"
    assert decide(noise(2, 1, 20))[0] == Decision("exhausted", None, 20)
    assert decide(noise(2, 1, 12))[0] == Decision("open", None, 15)


def test_many_comparisons_need_more_seeds_than_one():
    # Of five and five there are 252 exchanges: one in a hundred is no small enough share of 18.
    found = decide(noise(3, 18, 10, shift=50.0), draws=4000)
    assert {one.state for one in found} == {"decided"} and {one.seeds for one in found} == {10}
    assert {one.seeds for one in decide(noise(3, 18, 5, shift=50.0), draws=4000)} == {10}


def test_what_is_decided_stays_so_when_seeds_are_added():
    pairs = [*noise(4, 2, 20, shift=2.5), *noise(5, 2, 20)]
    before = [None] * len(pairs)
    for seeds in (5, 10, 15, 20):
        found = decide([(ours[:seeds], base[:seeds]) for ours, base in pairs], draws=3000)
        for old, new in zip(before, found, strict=True):
            if old is not None and old.state == "decided":
                assert (new.state, new.verdict) == (old.state, old.verdict)
                assert new.seeds <= old.seeds
        before = found
    assert [one.verdict for one in before] == ["positive", "positive", None, None]


def test_beside_a_sure_comparison_another_is_decided_as_if_it_were_alone():
    weak = noise(7, 1, 10, shift=1.6)
    sure = noise(8, 1, 10, shift=50.0)
    (alone,) = decide(weak, most=10, draws=4000)
    assert alone.state == "decided"
    assert decide([*weak, *sure], most=10, draws=4000)[0] == alone
    # Beside noise, which keeps its part of the level, it has but half.
    assert decide([*weak, *noise(9, 20, 10)], most=10, draws=4000)[0].state == "exhausted"


def test_equal_scores_decide_nothing():
    scores = np.full(20, 3.0)
    assert decide([(scores, scores)], draws=200)[0].state == "exhausted"


@pytest.mark.parametrize("kind", ["normal", "half learn"])
def test_noise_is_decided_in_at_most_one_table_of_twenty(kind):
    """Tables of three comparisons over three looks, whatever look decides."""
    random, tables, false = np.random.default_rng(11), 300, 0
    for _ in range(tables):
        scores = random.normal(size=(4, 15))
        if kind == "half learn":
            scores = np.where(scores > 0, 880.0, -840.0) + 40 * random.normal(size=scores.shape)
        found = decide([(ours, scores[3]) for ours in scores[:3]], most=15, draws=300)
        false += any(one.state == "decided" for one in found)
    # 5 % and what 300 tables let it deviate by.
    assert false / tables <= 0.05 + 2 * np.sqrt(0.05 * 0.95 / tables)
