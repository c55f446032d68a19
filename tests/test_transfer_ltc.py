"""Latent task classification, against scikit-learn and by hand."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from sklearn.neighbors import KNeighborsClassifier

from traces import equations
from transfer.ltc import NOVEL, accuracy, classify, fit, nearest, suggest_threshold, vote
from transfer.recipes import latent_task_thresholds

random = np.random.default_rng(0)


def gaussian(samples, features, scale=1.0, offset=0.0):
    return (offset + scale * random.standard_normal((samples, features))).astype(np.float32)


def grid(samples, features, size):
    return random.integers(0, size, (samples, features)).astype(np.float32)


def reference(latents, labels, queries, neighbours=5):
    """Votes and distances in float64; of samples equally far the first stored come first."""
    distances = np.abs(queries[:, None].astype(float) - latents[None].astype(float)).sum(-1)
    order = np.argsort(distances, axis=1, kind="stable")[:, :neighbours]
    votes = [np.bincount(row).argmax() for row in labels[order]]
    return np.array(votes), np.take_along_axis(distances, order, 1), order


def test_points_in_general_position_are_classified_as_by_scikit_learn():
    latents, labels = gaussian(400, 230), random.integers(0, 4, 400)
    queries = gaussian(4000, 230)
    judge = KNeighborsClassifier(n_neighbors=5, metric="manhattan").fit(latents, labels)
    model = fit(latents, labels)
    result = classify(model, queries, np.inf)
    np.testing.assert_array_equal(result.labels, judge.predict(queries))
    distances, indices = judge.kneighbors(queries)
    found = nearest(model, queries)
    np.testing.assert_array_equal(found.indices, indices)
    np.testing.assert_allclose(found.distances, distances, rtol=1e-5)


@pytest.mark.parametrize(("features", "size"), [(2, 6), (3, 4), (6, 3)])
def test_points_on_a_grid_are_classified_as_by_scikit_learn_ties_included(features, size):
    latents, labels = grid(300, features, size), random.integers(0, 4, 300)
    queries = grid(2000, features, size)
    model = fit(latents, labels)
    result = jax.tree.map(np.asarray, classify(model, queries, np.inf))
    votes, distances, order = reference(latents, labels, queries)
    found = nearest(model, queries)
    np.testing.assert_array_equal(found.indices, order)
    np.testing.assert_array_equal(found.distances, distances)
    np.testing.assert_array_equal(result.votes, votes)

    judge = KNeighborsClassifier(n_neighbors=5, metric="manhattan", algorithm="brute")
    judge.fit(latents, labels)
    np.testing.assert_array_equal(found.distances, judge.kneighbors(queries)[0])
    # Which of the samples that are equally far is the fifth neighbour, scikit-learn leaves open:
    # where that decides the vote, its choice of neighbours is given to our vote.
    theirs = labels[judge.kneighbors(queries, return_distance=False)]
    np.testing.assert_array_equal(vote(jnp.asarray(theirs)), judge.predict(queries))
    farther = KNeighborsClassifier(n_neighbors=6, metric="manhattan").fit(latents, labels)
    fifth, sixth = farther.kneighbors(queries)[0][:, 4:6].T
    decided = fifth < sixth
    assert decided.sum() > 50 and (~decided).sum() > 50
    np.testing.assert_array_equal(result.labels[decided], judge.predict(queries)[decided])


def test_equal_votes_go_to_the_smallest_label():
    model = fit([[0.0], [1.0], [2.0], [3.0]], [7, 3, 3, 7], neighbours=4)
    assert classify(model, jnp.array([[1.5]]), 10.0).labels[0] == 3


def test_novel_is_what_is_farther_than_the_threshold_and_not_what_is_as_far():
    model = fit([[0.0, 0.0], [0.0, 1.0]], [0, 1], neighbours=1)
    # Manhattan distances 3 and 3.5 to the nearest sample.
    queries = jnp.array([[2.0, -1.0], [2.5, 2.0]])
    result = classify(model, queries, 3.0)
    np.testing.assert_array_equal(result.distances, [3, 3.5])
    np.testing.assert_array_equal(result.labels, [0, NOVEL])
    np.testing.assert_array_equal(result.votes, [0, 1])


def test_classification_is_the_same_in_chunks_of_any_size(monkeypatch):
    from transfer import ltc

    model = fit(gaussian(20, 7), random.integers(0, 3, 20))
    queries = gaussian(11, 7)
    whole = nearest(model, queries)
    for chunk in (1, 3 * model.latents.size):
        monkeypatch.setattr(ltc, "_CHUNK", chunk)
        chunked = jax.jit(lambda *arguments: nearest.__wrapped__(*arguments))(model, queries)
        for a, b in zip(chunked, whole, strict=True):
            np.testing.assert_array_equal(a, b)


def test_no_array_of_all_queries_times_all_samples_times_all_features_is_made():
    samples, queries, features = 400, 8000, 230
    model = fit(np.zeros((samples, features)), np.zeros(samples, int))
    traced = jax.make_jaxpr(nearest)(model, jnp.zeros((queries, features)))
    largest = max(made.aval.size for x in equations(traced.jaxpr) for made in x.outvars)
    assert samples * features <= largest <= 2**22 < samples * queries * features


def test_thresholds_classifiers_and_sets_of_queries_can_be_mapped():
    models = [fit(gaussian(30, 5), random.integers(0, 3, 30)) for _ in range(2)]
    queries = np.stack([gaussian(9, 5), gaussian(9, 5)])
    stacked = jax.tree.map(lambda *x: np.stack(x), *models)
    mapped = jax.jit(jax.vmap(classify, in_axes=(0, 0, None)))(stacked, queries, 3.0)
    mapped = jax.tree.map(np.asarray, mapped)
    for index, model in enumerate(models):
        for a, b in zip(mapped, classify(model, queries[index], 3.0), strict=True):
            np.testing.assert_array_equal(a[index], b)
    thresholds = np.array([0.0, 2.0, 100.0])
    over_thresholds = jax.jit(jax.vmap(classify, in_axes=(None, None, 0)))
    several = jax.tree.map(np.asarray, over_thresholds(models[0], queries[0], thresholds))
    assert (several.labels[0] == NOVEL).all() and (several.labels[2] != NOVEL).all()


def test_accuracy_counts_known_tasks_as_known_and_right_and_novel_ones_as_novel():
    # Two tasks far apart, one query of each kind of mistake.
    model = fit([[0.0], [0.1], [10.0], [10.1]], [0, 0, 1, 1], neighbours=2)
    queries = np.array([[0.0], [0.2], [10.0], [60.0]])
    known = accuracy(classify(model, queries, 5.0), 0)
    assert known.correct == 0.5 and known.not_novel == 0.75 and known.right_task == 0.5
    novel = accuracy(classify(model, queries, 5.0), NOVEL)
    assert novel.correct == 0.25 and novel.right_task == 0
    each = accuracy(classify(model, queries, 5.0), jnp.array([0, 0, 1, NOVEL]))
    assert each.correct == 1


def test_the_suggested_threshold_keeps_the_share_of_known_samples_it_promises():
    train, fresh = gaussian(400, 20), gaussian(4000, 20)
    model = fit(train, np.zeros(400, int))
    for quantile in (0.5, 0.95):
        threshold = suggest_threshold(model, quantile=quantile)
        share = accuracy(classify(model, fresh, threshold), 0).not_novel
        assert abs(share - quantile) < 0.06


def test_the_suggested_threshold_follows_the_scale_and_tells_tasks_apart_at_any():
    for scale in (0.1, 1.0, 40.0):
        known, novel = gaussian(200, 30, scale), gaussian(200, 30, scale, offset=6 * scale)
        model = fit(known[:100], np.zeros(100, int))
        threshold = suggest_threshold(model)
        assert accuracy(classify(model, known[100:], threshold), 0).correct > 0.85
        assert accuracy(classify(model, novel, threshold), NOVEL).correct == 1


def test_the_suggested_threshold_by_hand_and_by_groups():
    model = fit([[0.0], [1.0], [10.0], [12.0]], [0, 0, 0, 0], neighbours=1)
    # Distances to the nearest other sample: 1, 1, 2, 2; to the nearest of the other group: 10, 9,
    # 9, 11. Of 4 samples the quantile 0.5 is the ceil(5 / 2) = 3rd.
    assert suggest_threshold(model, quantile=0.5) == 2
    assert suggest_threshold(model, quantile=0.5, groups=[0, 0, 1, 1]) == 10
    assert suggest_threshold(model, quantile=0.5, groups=[0, 0, 0, 0]) == np.inf


def test_thresholds_of_the_thesis_scale_with_the_number_of_features():
    assert latent_task_thresholds(230) == (50, 70, 90)
    assert latent_task_thresholds(460) == (100, 140, 180)


@pytest.mark.parametrize(
    ("latents", "labels", "message"),
    [
        (np.zeros((6, 2)), np.zeros(5, int), r"latents \[S, M\] and labels \[S\]"),
        (np.zeros((4, 2)), np.zeros(4, int), "4 samples for 5 neighbours"),
        (np.zeros((6, 2)), -np.ones(6, int), "from 0; got -1"),
        (np.zeros((6, 2)), np.zeros(6), "got dtype float"),
        (np.full((6, 2), np.nan), np.zeros(6, int), "must be finite"),
    ],
)
def test_samples_that_make_no_classifier_are_refused(latents, labels, message):
    with pytest.raises(ValueError, match=message):
        fit(latents, labels)


def test_misuse_of_a_classifier_is_refused():
    model = fit(np.zeros((6, 2)), np.zeros(6, int))
    with pytest.raises(ValueError, match=r"latents \[S, 2\].*got \(3, 4\)"):
        classify(model, jnp.zeros((3, 4)), 1.0)
    with pytest.raises(ValueError, match="Expected one threshold"):
        classify(model, jnp.zeros((3, 2)), jnp.ones(3))
    with pytest.raises(ValueError, match="share in"):
        suggest_threshold(model, quantile=1.0)
    with pytest.raises(ValueError, match="one group for each of 6 samples"):
        suggest_threshold(model, groups=[0, 1])
