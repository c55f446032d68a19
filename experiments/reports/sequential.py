"""How many seeds a comparison still needs: a sequential permutation test.

After "AdaStop: adaptive statistical testing for sound comparisons of Deep RL agents" (Mathieu et
al., 2023): runs are made in groups of a few seeds, after each group the data are looked at, and a
comparison that is decided needs no more. The probability of a false decision is held over all
looks and all comparisons: each look may spend an equal part of the level, its boundary is found by
exchanging the runs of both sides within each group of seeds, given that no boundary before was
crossed; and over comparisons the level is passed on after Holm, as in sequential tests after
Maurer and Bretz (2013).

Exchanging is exact where a transfer changes nothing: of 600 tables of 1, 3 and 6 comparisons of
noise over 3 or 4 looks, 3 to 5 % had any decision. Where transfers spread four times as far as
agents from scratch, about the same mean, it was 6 to 9 %.

Axis letters: N runs (seeds), K looks, D draws of exchanges.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from experiments.reports.verdicts import LEVEL

DRAWS = 10_000
GROUP = 5
"""Seeds between two looks."""
MOST = 20
"""Seeds at the last look."""


@dataclass(frozen=True)
class Decision:
    """What is known of one comparison so far.

    Attributes:
      state: "decided"; "open", if more seeds may decide it; or "exhausted", if the last look has
        been and did not.
      verdict: of a decided one.
      seeds: at the look that decided, at the next look of an open one, at the last look otherwise.
    """

    state: Literal["decided", "open", "exhausted"]
    verdict: Literal["positive", "negative"] | None
    seeds: int


def looks(group: int = GROUP, most: int = MOST) -> tuple[int, ...]:
    """Seeds at each look.

    Raises:
      ValueError: a group has fewer than two seeds, or more than there may be.
    """
    if not 2 <= group <= most:
        raise ValueError(
            f"--group is {group} and --most {most}: a group has at least 2 seeds, and at most as "
            "many as there may be"
        )
    return tuple(range(group, most + 1, group))


def decide(
    pairs: Sequence[tuple[np.ndarray, np.ndarray]],
    group: int = GROUP,
    most: int = MOST,
    level: float = LEVEL,
    draws: int = DRAWS,
    seed: int = 0,
) -> list[Decision]:
    """Decides comparisons as far as their runs allow.

    Args:
      pairs: scores [N] of each transfer and of its baseline, in the order of their seeds; those
        beyond the last whole group that both have are left for the next look.
      group: seeds between two looks.
      most: seeds at the last look; rounded down to whole groups.
      level: probability of any false decision, over all looks and comparisons.
      draws: D.
      seed: of the draws; the same for every comparison, so that nothing depends on their order.

    Raises:
      ValueError: see `looks`.
    """
    planned = looks(group, most)
    curves = []
    for ours, base in pairs:
        whole = min(len(ours), len(base), planned[-1]) // group
        curves.append(
            _statistics(
                np.asarray(ours, float)[: whole * group].reshape(whole, group),
                np.asarray(base, float)[: whole * group].reshape(whole, group),
                draws,
                np.random.default_rng(seed),
            )
        )
    decided: dict[int, int] = {}
    while len(decided) < len(pairs):
        part = level / (len(pairs) - len(decided))
        new = {
            number: look
            for number, curve in enumerate(curves)
            if number not in decided
            and (look := _first_crossing(curve, part, len(planned))) is not None
        }
        if not new:
            break
        decided |= new
    found = []
    for number, ((ours, base), curve) in enumerate(zip(pairs, curves, strict=True)):
        done = curve.shape[1]
        if number in decided:
            seeds = planned[decided[number]]
            better = np.mean(ours[:seeds]) > np.mean(base[:seeds])
            found.append(Decision("decided", "positive" if better else "negative", seeds))
        elif done == len(planned):
            found.append(Decision("exhausted", None, planned[-1]))
        else:
            found.append(Decision("open", None, planned[done]))
    return found


def _statistics(
    ours: np.ndarray, base: np.ndarray, draws: int, generator: np.random.Generator
) -> np.ndarray:
    """Distances of the means at each look [D + 1, K]; row 0 is as observed.

    Args:
      ours, base: scores [K, seeds of a group].
      draws: D exchanges between both within each group.
      generator: of the draws.
    """
    count, size = ours.shape
    both = np.concatenate([ours, base], 1)
    order = np.argsort(generator.random((draws, count, 2 * size), np.float32), -1)
    order = np.concatenate([np.broadcast_to(np.arange(2 * size), (1, count, 2 * size)), order])
    chosen = np.take_along_axis(both[None], order[..., :size], -1).sum(-1)
    # Of the sums of one side and of both follows that of the other.
    distance = np.abs((2 * chosen - both.sum(-1)).cumsum(-1)) / (size * np.arange(1, count + 1))
    # Relative to the scores' own scale, so that rounding tells no equal distances apart.
    scale = np.abs(both).max(initial=0.0) or 1.0
    return np.round(distance / scale, 9)


def _first_crossing(curve: np.ndarray, level: float, planned: int) -> int | None:
    """The first look whose boundary the observed statistic reaches; None if none does.

    Args:
      curve: statistics [D + 1, K], the observed ones in row 0; looks that have been.
      level: to be spent over all looks.
      planned: looks in all, each of which may spend an equal part.
    """
    inside = np.ones(len(curve), bool)
    for look in range(curve.shape[1]):
        allowed = int(level * (look + 1) / planned * len(curve)) - int((~inside).sum())
        values = curve[inside, look]
        if allowed >= 1:
            # The largest share that is allowed, equal statistics crossing together or not at all.
            descending = np.sort(values)[::-1]
            boundary = descending[min(allowed, len(values)) - 1]
            if (values >= boundary).sum() > allowed:
                above = descending[descending > boundary]
                boundary = above[-1] if len(above) else np.inf
            if curve[0, look] >= boundary:
                return look
            inside &= curve[:, look] < boundary
    return None
