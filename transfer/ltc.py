"""Latent task classification: which known task a latent state belongs to, or none (thesis §3.3.3).

The nearest neighbours of a latent state among stored ones vote for its task; if even the nearest is
farther than a threshold ξ, the task is novel (equation 22). Distances are Manhattan distances
(equation 21). Everything is a pure function of arrays, for `jit` and `vmap`.

Axis letters: S samples, M latent feature size, K neighbours.
"""

import dataclasses
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike

Array = jax.Array

NOVEL = -1
"""The label of a task that is none of the known ones."""

NEIGHBOURS = 5
"""K of §4.3.2."""

# Differences held at once, in numbers: queries go in chunks of as many as fit, 16 MB of float32.
_CHUNK = 2**22


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Classifier:
    """A fitted classifier: the samples themselves.

    Attributes:
      latents: float32 [S, M].
      labels: int32 [S], the task of each, 0 or more.
      neighbours: K; static.
    """

    latents: Array
    labels: Array
    neighbours: int = dataclasses.field(default=NEIGHBOURS, metadata={"static": True})


class Neighbours(NamedTuple):
    """The nearest stored samples of each of S queries, nearest first.

    Attributes:
      labels: int32 [S, K], their tasks.
      distances: float32 [S, K], their Manhattan distances.
      indices: int32 [S, K], their places among the stored samples.
    """

    labels: Array
    distances: Array
    indices: Array


class Classification(NamedTuple):
    """What each of S queries was taken for.

    Attributes:
      labels: int32 [S], the task, or `NOVEL` (-1).
      votes: int32 [S], the task that the neighbours vote for, whatever the distance; `NOVEL`
        for a latent that is not finite, which has no neighbours.
      distances: float32 [S], the Manhattan distance to the nearest sample; infinite for a latent
        that is not finite.
      finite: bool [S], whether every number of the latent is finite. One that is not, as a
        diverged model gives it, is novel.
    """

    labels: Array
    votes: Array
    distances: Array
    finite: Array


class Accuracy(NamedTuple):
    """Shares of one set of samples, float32 [] (§4.3.3).

    Attributes:
      correct: classified correctly: as novel where the task is novel; else as not novel and as
        the right task, both.
      not_novel: within the threshold of a known sample.
      right_task: voted for the right task, whatever the distance; 0 for a novel task.
      not_finite: latents that are not finite, which are taken for novel.
    """

    correct: Array
    not_novel: Array
    right_task: Array
    not_finite: Array


def fit(latents: Any, labels: Any, *, neighbours: int = NEIGHBOURS) -> Classifier:
    """A classifier of the tasks of given samples.

    Args:
      latents: float [S, M].
      labels: int [S], tasks numbered from 0.
      neighbours: K, the number of votes.

    Raises:
      ValueError: shapes that do not fit, fewer samples than neighbours, a negative label, or a
        latent that is not finite (values are checked outside `jit` only).

    >>> model = fit([[0.0], [1.0], [9.0]], [0, 0, 1], neighbours=1)
    >>> result = classify(model, jnp.array([[0.4], [8.0], [30.0]]), threshold=2.0)
    >>> result.labels, result.votes, result.distances
    (Array([ 0,  1, -1], dtype=int32), Array([0, 1, 1], dtype=int32), \
Array([ 0.4,  1. , 21. ], dtype=float32))
    """
    latents, labels = jnp.asarray(latents, jnp.float32), jnp.asarray(labels)
    if latents.ndim != 2 or labels.shape != latents.shape[:1]:
        raise ValueError(
            f"Expected latents [S, M] and labels [S], got {latents.shape} and {labels.shape}."
        )
    if not jnp.issubdtype(labels.dtype, jnp.integer):
        raise ValueError(f"Labels number the tasks from 0; got dtype {labels.dtype}.")
    if not 1 <= neighbours <= len(latents):
        raise ValueError(f"Got {len(latents)} samples for {neighbours} neighbours.")
    if not isinstance(latents, jax.core.Tracer) and not np.isfinite(latents).all():
        raise ValueError("Latents must be finite; some are not.")
    if not isinstance(labels, jax.core.Tracer) and (least := np.asarray(labels).min()) < 0:
        raise ValueError(f"Labels number the tasks from 0; got {least}.")
    return Classifier(latents, labels.astype(jnp.int32), neighbours)


@jax.jit
def nearest(model: Classifier, latents: ArrayLike) -> Neighbours:
    """The K nearest stored samples; of samples equally far the first stored come first.

    Memory is bounded: queries are taken in chunks, and S queries x S samples x M is never held.

    Args:
      model: from `fit`.
      latents: float [S, M].

    Raises:
      ValueError: latents of another M.
    """
    latents = jnp.asarray(latents, jnp.float32)
    if latents.ndim != 2 or latents.shape[1] != model.latents.shape[1]:
        raise ValueError(
            f"Expected latents [S, {model.latents.shape[1]}], as the classifier was fitted on; "
            f"got {latents.shape}."
        )

    def one(latent):
        return _closest(jnp.abs(model.latents - latent).sum(-1), model.neighbours)

    distances, indices = _in_chunks(one, latents, model.latents.size)
    return Neighbours(model.labels[indices], distances, indices)


def _closest(distances: Array, count: int) -> tuple[Array, Array]:
    negated, indices = jax.lax.top_k(-distances, count)
    return -negated, indices


def _in_chunks(function, queries: Any, numbers_each: int) -> Any:
    """`function` of every query, as many at once as the memory for differences allows."""
    return jax.lax.map(function, queries, batch_size=max(1, _CHUNK // numbers_each))


@jax.jit
def vote(labels: Array) -> Array:
    """The most frequent label, the smallest of those that are equally frequent.

    Args:
      labels: int [..., K].

    Returns:
      int [...].

    >>> vote(jnp.array([[3, 1, 3, 1, 2], [2, 2, 0, 0, 0]]))
    Array([1, 0], dtype=int32)
    """
    counts = (labels[..., :, None] == labels[..., None, :]).sum(-1)
    winners = counts == counts.max(-1, keepdims=True)
    return jnp.where(winners, labels, jnp.iinfo(labels.dtype).max).min(-1)


def classify(model: Classifier, latents: ArrayLike, threshold: Any) -> Classification:
    """The task of each latent state, or `NOVEL` (equation 22).

    Args:
      model: from `fit`.
      latents: float [S, M]. One that holds NaN or infinity is novel.
      threshold: ξ, a scalar: the task is novel if the nearest sample is farther.

    Raises:
      ValueError: latents of another M, or a threshold that is not a scalar, or is NaN (where it
        is concrete; a traced NaN makes every task novel).
    """
    if not isinstance(threshold, jax.core.Tracer) and np.isnan(threshold).any():
        raise ValueError(f"Expected a threshold that is a number, got {threshold}.")
    return _classify(model, latents, threshold)


@jax.jit
def _classify(model: Classifier, latents: ArrayLike, threshold: Any) -> Classification:
    if jnp.ndim(threshold):
        raise ValueError(
            f"Expected one threshold, got shape {jnp.shape(threshold)}; map over several with "
            "jax.vmap(classify, in_axes=(None, None, 0))."
        )
    neighbours = nearest(model, latents)
    finite = jnp.isfinite(jnp.asarray(latents, jnp.float32)).all(axis=-1)
    votes = jnp.where(finite, vote(neighbours.labels), NOVEL)
    distances = jnp.where(finite, neighbours.distances[:, 0], jnp.inf)
    known = finite & (distances <= threshold)
    return Classification(jnp.where(known, votes, NOVEL), votes, distances, finite)


@jax.jit
def accuracy(result: Classification, task: Any) -> Accuracy:
    """The accuracy of a set of samples of one task (§4.3.3).

    Args:
      result: from `classify`, of samples of one task.
      task: int scalar, the true task, or `NOVEL`; or [S], where samples are of several.

    >>> found = [0, NOVEL, 1], [0, 0, 1], [3.0, 90.0, 5.0], [True, True, True]
    >>> result = Classification(*map(jnp.array, found))
    >>> accuracy(result, 0).correct.item(), accuracy(result, NOVEL).correct.item()
    (0.3333333432674408, 0.3333333432674408)
    """
    return Accuracy(
        correct=(result.labels == task).mean(dtype=jnp.float32),
        not_novel=(result.labels != NOVEL).mean(dtype=jnp.float32),
        right_task=((result.votes == task) & (result.votes != NOVEL)).mean(dtype=jnp.float32),
        not_finite=(~result.finite).mean(dtype=jnp.float32),
    )


def suggest_threshold(model: Classifier, *, quantile: float = 0.95, groups: Any = None) -> Array:
    """A threshold ξ from the fitted samples' own distances (beyond the thesis: one for any scale).

    The distance from each sample to the nearest other one is what a known task looks like. ξ is
    the smallest value that holds at least the share `quantile` of these, with the small-sample
    correction of conformal prediction: a fresh sample drawn like the fitted ones is then taken for
    novel with probability at most 1 - `quantile`, nearly.

    Args:
      model: from `fit`.
      quantile: share of known samples that should be within ξ, in (0, 1).
      groups: int [S], such as the episode each sample comes from; neighbours in the same group
        do not count. Samples of one episode are closer than those of different ones, and a
        fresh sample is of a fresh episode. By default each sample is its own group.

    Returns:
      float32 [], infinite where no sample has a neighbour in another group.

    Raises:
      ValueError: a quantile outside (0, 1), or groups of another shape.

    >>> model = fit([[0.0], [1.0], [3.0], [7.0]], [0, 0, 0, 0], neighbours=1)
    >>> suggest_threshold(model, quantile=0.5)
    Array(2., dtype=float32)
    """
    if not 0 < quantile < 1:
        raise ValueError(f"The quantile is a share in (0, 1), got {quantile}.")
    samples = len(model.latents)
    groups = jnp.arange(samples) if groups is None else jnp.asarray(groups)
    if groups.shape != (samples,):
        raise ValueError(f"Expected one group for each of {samples} samples, got {groups.shape}.")

    rank = min(samples, int(np.ceil((samples + 1) * quantile)))
    return _distance_of_rank(model.latents, groups, rank)


@jax.jit
def _distance_of_rank(latents: Array, groups: Array, rank: int) -> Array:
    """The distance of that rank, from 1, of those from each sample to the nearest of another
    group."""

    def one(query):
        latent, group = query
        distances = jnp.abs(latents - latent).sum(-1)
        return jnp.where(groups == group, jnp.inf, distances).min()

    return jnp.sort(_in_chunks(one, (latents, groups), latents.size))[rank - 1]
