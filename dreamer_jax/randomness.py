"""Every stream of random numbers, and what keeps them apart.

All keys derive from a member's seed: by what they are for (`Purpose`), and then by counters of the
run. What is derived here is a law: with another order of the same steps a run that is resumed
would go on with other numbers.

Axis letters: K task.
"""

import enum

import jax
import numpy as np

from dreamer_jax.config import COMPONENTS


class Purpose(enum.IntEnum):
    """What a member's key is for."""

    INIT = 0
    UPDATE = 1
    COLLECT = 2
    EVALUATE = 3
    DIAGNOSE = 4
    ACT = 5
    PREDICT = 6


# Phases are numbered. What plays phases outside of a training has a range of numbers of its own,
# so that simulators start in states that the training has not seen.
TRAINING_PHASES = range(0, 1_000_000)
EVALUATION_PHASES = range(1_000_000, 2_000_000)
LATENT_PHASES = range(2_000_000, 3_000_000)

# Set apart from a key's other use: whether what was drawn from it takes the place of what is held.
_HOLD = 1


def member_key(seed: jax.Array | int, purpose: jax.Array | int) -> jax.Array:
    """The key of a member for one purpose; members with one seed share it."""
    return jax.random.fold_in(jax.random.key(seed), purpose)


def component_key(key: jax.Array, component: str) -> jax.Array:
    """The key that one component is drawn from.

    It depends on the component's name alone, so options that add components leave the others as
    they were.
    """
    return jax.random.fold_in(key, COMPONENTS.index(component))


def update_key(seed: jax.Array, updates: jax.Array) -> jax.Array:
    """The key of the update that follows on so many."""
    return jax.random.fold_in(member_key(seed, Purpose.UPDATE), updates)


def phase_key(
    seed: jax.Array | int,
    purpose: jax.Array | int,
    task: jax.Array | int,
    phase: jax.Array | int,
) -> jax.Array:
    """The key of one phase: of (member seed, collect or evaluate, task, phase)."""
    return jax.random.fold_in(jax.random.fold_in(member_key(seed, purpose), task), phase)


def diagnosis_key(seed: jax.Array, phase: jax.Array, task: jax.Array | int) -> jax.Array:
    """The key of the comparison of a model with what it has played."""
    return jax.random.fold_in(jax.random.fold_in(member_key(seed, Purpose.DIAGNOSE), phase), task)


def latent_key(seed: int, phase: int, task: int) -> jax.Array:
    """The key of the posterior's samples where latent states are inferred after a training.

    It may be the key of an update, or of a component at the start: nothing is drawn from those
    themselves, only from keys that derive from them.
    """
    return jax.random.fold_in(jax.random.fold_in(jax.random.key(seed), phase), task)


def acting_key(step: jax.Array | int) -> jax.Array:
    """The key of an action of an agent that acts outside of a run, after so many of its episode.

    It is the same in every episode, and for every agent: the same images get the same actions.
    """
    return jax.random.fold_in(member_key(0, Purpose.ACT), step)


def prediction_key(member: jax.Array | int) -> jax.Array:
    """The key of the prediction that a video shows of a member of a population."""
    return jax.random.fold_in(member_key(0, Purpose.PREDICT), member)


def hold_key(key: jax.Array) -> jax.Array:
    """A key to draw from beside `key`: it decides whether what was held before is kept.

    A key that is split must not be given: what `jax.random.split` makes second of it is this key.
    """
    return jax.random.fold_in(key, _HOLD)


def choice_generator(seed: int) -> np.random.Generator:
    """What chooses latent states among all that were inferred; a generator on the host."""
    return np.random.Generator(np.random.PCG64(seed))


def batch_generator(seed: int, update: int) -> np.random.Generator:
    """What the sequences of one member's batch are drawn with; a generator on the host."""
    return np.random.Generator(np.random.Philox(np.random.SeedSequence([seed, update])))
