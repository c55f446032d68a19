"""Streams of random numbers never meet, and stay as they are."""

import ast
from itertools import combinations
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from dreamer_jax import randomness
from dreamer_jax.config import COMPONENTS, PRESETS
from dreamer_jax.randomness import Purpose
from dreamer_jax.schedule import Schedule

ROOT = Path(__file__).parent.parent
RANGES = (
    randomness.TRAINING_PHASES, randomness.EVALUATION_PHASES, randomness.LATENT_PHASES,
)  # fmt: skip


def words(key):
    return tuple(np.asarray(jax.random.key_data(key)).tolist())


def test_ranges_of_phases_are_disjoint_and_hold_the_longest_training():
    for one, other in combinations(RANGES, 2):
        assert one[-1] < other[0] or other[-1] < one[0]
    longest = max(Schedule(config.schedule, 1).rounds for config in PRESETS.values())
    assert longest < len(randomness.TRAINING_PHASES) / 100


def test_keys_of_all_purposes_members_tasks_phases_and_updates_differ():
    phases = [number for phases in RANGES for number in (*phases[:3], phases[-1])]
    keys = [
        *(randomness.member_key(seed, Purpose.INIT) for seed in range(3)),
        *(randomness.update_key(seed, n) for seed in range(3) for n in range(20)),
        *(
            randomness.phase_key(seed, purpose, task, phase)
            for seed in range(3)
            for purpose in (Purpose.COLLECT, Purpose.EVALUATE)
            for task in range(3)
            for phase in phases
        ),
        *(
            randomness.diagnosis_key(seed, phase, task)
            for seed in range(3)
            for phase in range(3)
            for task in range(3)
        ),
        *(randomness.acting_key(step) for step in range(20)),
        *(randomness.prediction_key(member) for member in range(20)),
    ]
    components = [randomness.component_key(keys[0], name) for name in COMPONENTS]
    assert len(set(map(words, [*keys, *components]))) == len(keys) + len(components)
    # What is drawn from: the halves of the keys of updates, phases and comparisons.
    drawn = [
        *jax.vmap(jax.random.split)(jnp.stack(keys[3:])).reshape(-1),
        *(
            randomness.latent_key(seed, phase, task)
            for seed in range(3)
            for phase in range(4)
            for task in range(3)
        ),
    ]
    assert len(set(map(words, drawn))) == len(drawn)


def test_what_is_drawn_beside_a_key_is_not_what_is_drawn_from_it():
    key = jax.random.key(3)
    assert words(randomness.hold_key(key)) != words(key)
    assert jax.random.uniform(randomness.hold_key(key)) != jax.random.uniform(key)


def test_batches_of_other_seeds_and_updates_are_drawn_from_other_streams():
    generators = [
        *(randomness.batch_generator(seed, n) for seed in range(10) for n in range(10)),
        *(randomness.choice_generator(seed) for seed in range(10)),
    ]
    assert len({tuple(one.integers(2**63, size=2)) for one in generators}) == 110


def test_streams_are_those_of_runs_that_were_made_before():
    # Written down once: a run of an earlier version that is resumed goes on with the same numbers.
    key = randomness.member_key(7, Purpose.INIT)
    assert words(key) == words(jax.random.fold_in(jax.random.key(7), 0))
    for purpose, salt in ((Purpose.COLLECT, 2), (Purpose.EVALUATE, 3)):
        member = jax.random.fold_in(jax.random.key(7), salt)
        expected = jax.random.fold_in(jax.random.fold_in(member, 1), 5)
        assert words(randomness.phase_key(7, purpose, 1, 5)) == words(expected)
    update = jax.random.fold_in(jax.random.fold_in(jax.random.key(7), 1), 9)
    assert words(randomness.update_key(7, 9)) == words(update)
    found = jax.random.fold_in(jax.random.fold_in(jax.random.fold_in(jax.random.key(7), 4), 5), 1)
    assert words(randomness.diagnosis_key(7, 5, 1)) == words(found)
    acting = jax.random.fold_in(jax.random.fold_in(jax.random.key(0), 5), 9)
    assert words(randomness.acting_key(9)) == words(acting)
    chosen = randomness.choice_generator(7).permutation(20)
    assert chosen.tolist() == np.random.default_rng(7).permutation(20).tolist()


def attributes(path):
    nodes = ast.walk(ast.parse(path.read_text()))
    return {node.attr for node in nodes if isinstance(node, ast.Attribute)}


@pytest.mark.parametrize("path", sorted((ROOT / "dreamer_jax").glob("*.py")), ids=lambda p: p.stem)
def test_keys_and_generators_are_derived_in_one_file(path):
    if path.stem != "randomness":
        assert not attributes(path) & {"fold_in", "SeedSequence", "default_rng", "PRNGKey"}


# Generators are there for what is drawn of results, of which no agent and no simulator knows.
@pytest.mark.parametrize(
    "path", sorted((ROOT / "experiments").rglob("*.py")), ids=lambda p: "/".join(p.parts[-2:])
)
def test_experiments_derive_no_keys_of_their_own(path):
    assert not attributes(path) & {"fold_in", "SeedSequence", "PRNGKey"}
