"""The published numbers: all of them, as the thesis prints them, and what they say together."""

import dataclasses
import math
import tomllib
from collections import Counter
from fnmatch import fnmatch
from pathlib import Path

import pytest

from dreamer_jax.files import read_json
from experiments.reports import page
from experiments.thesis import grid, published
from experiments.thesis.contradictions import CONTRADICTIONS
from experiments.thesis.published import PATH, classification, records, returns

KEYS = [
    "table",
    "target",
    "method",
    "sources",
    "omega",
    "metric",
    "threshold",
    "task",
    "mean",
    "std",
    "correct",
]


def test_every_record_has_every_key_in_one_order():
    assert all(list(record) == KEYS for record in read_json(PATH))


def test_each_table_has_as_many_entries_as_the_thesis_prints():
    counts = Counter(record.table for record in records())
    assert counts == {**dict.fromkeys(range(1, 13), 19), **dict.fromkeys((13, 14, 15), 18)} | {
        16: 24,
        17: 24,
    }


def test_what_does_not_apply_is_none():
    for record in records():
        if record.method == "ltc":
            assert record.target is record.sources is record.omega is record.std is None
            assert record.threshold in grid.THRESHOLDS and record.task in grid.TASKS
            assert (record.correct is None) == (record.metric == "novel")
        else:
            assert record.threshold is record.task is record.correct is None
            assert record.std >= 0 and record.metric in ("overall", "final")
            assert (record.sources is None) == (record.method == "baseline")
            assert (record.omega is None) == (record.method != "ftl")


@pytest.mark.parametrize("name", grid.TABLES)
def test_every_entry_that_a_table_shows_has_a_record_of_its_own(name):
    table = grid.TABLES[name]
    number = published.number(table)
    if isinstance(table, grid.LatentTable):
        found = [
            classification(number, task, threshold)
            for task in table.tasks
            for threshold in grid.THRESHOLDS
        ]
        metrics = {"novel", "known"}
    else:
        omegas = table.omegas if table.kind == "ftl" else (None,)
        found = [
            returns(number, target, count, omega)
            for target in table.targets
            for omega in omegas
            for count in table.counts
        ]
        found += [returns(number, target) for target in table.targets]
        metrics = {table.metric}
    assert None not in found
    assert len(set(found)) == sum(record.table == number for record in records())
    assert {record.metric for record in found} == metrics


# Copied by hand from the thesis: table, target, sources, ω, mean, deviation.
BY_HAND = [
    (1, "HalfCheetah", 2, 0.1, 2028, 993),
    (1, "HalfCheetah", 4, 0.4, 2162, 789),
    (2, "HalfCheetah", 2, 0.1, 2820, 297),
    (2, "HalfCheetah", None, None, 2264, 160),
    (3, "Hopper", 3, 0.1, 6542, 4469),
    (3, "Hopper", None, None, 1340, 1112),
    (4, "Hopper", 3, 0.1, 11124, 1645),
    (4, "Hopper", 4, 0.5, 5886, 4774),
    (5, "Walker2D", 2, 0.2, 1009, 1254),
    (5, "Walker2D", 4, 0.0, 157, 891),
    (6, "Walker2D", 4, 0.1, 1191, 1146),
    (6, "Walker2D", None, None, 547, 710),
    (7, "InvertedPendulum", 2, 0.3, 871, 93),
    (7, "InvertedPendulum", None, None, 723, 364),
    (8, "InvertedPendulum", 3, 0.1, 887, 11),
    (8, "InvertedPendulum", 4, 0.0, 881, 21),
    (9, "InvertedDoublePendulum", 3, 0.5, 1340, 230),
    (9, "InvertedDoublePendulum", 2, 0.0, 1255, 270),
    (10, "InvertedDoublePendulum", 4, 0.5, 1449, 82),
    (10, "InvertedDoublePendulum", 3, 0.3, 1506, 190),
    (11, "Ant", 2, 0.4, 1308, 735),
    (11, "Ant", 4, 0.5, 683, 498),
    (12, "Ant", 4, 0.3, 1660, 248),
    (12, "Ant", None, None, 2619, 261),
    (16, "Hopper", 2, None, 5085, 4277),
    (16, "Walker2D", 3, None, 233, 823),
    (16, "Ant", None, None, 1589, 771),
    (17, "Hopper", 3, None, 10178, 2241),
    (17, "InvertedPendulum", 4, None, 875, 21),
    (17, "InvertedDoublePendulum", 2, None, 1348, 171),
]


@pytest.mark.parametrize("table, target, sources, omega, mean, deviation", BY_HAND)
def test_returns_are_those_of_the_thesis(table, target, sources, omega, mean, deviation):
    record = returns(table, target, sources, omega)
    assert (record.mean, record.std) == (mean, deviation)


@pytest.mark.parametrize(
    "table, task, threshold, left, right",
    [
        (13, "InvertedDoublePendulum", 70, 0.97, None),
        (13, "Hopper", 50, 0.74, 1.00),
        (13, "Walker2D", 70, 1.00, 0.61),
        (14, "Walker2D", 90, 0.00, None),
        (14, "InvertedPendulum", 50, 0.73, 0.71),
        (14, "InvertedDoublePendulum", 70, 1.00, 0.65),
        (15, "Ant", 50, 1.00, None),
        (15, "Hopper", 50, 1.00, 0.60),
        (15, "InvertedDoublePendulum", 50, 0.92, 1.00),
    ],
)
def test_shares_are_those_of_the_thesis(table, task, threshold, left, right):
    record = classification(table, task, threshold)
    assert (record.mean, record.correct) == (left, right)


def test_the_baselines_of_all_tasks_but_ant_are_the_same_in_both_methods_tables():
    for i, task in enumerate(grid.TASKS):
        for metric, meta_table in enumerate((16, 17)):
            one, other = returns(2 * i + metric + 1, task), returns(meta_table, task)
            same = (one.mean, one.std) == (other.mean, other.std)
            assert same == (task != "Ant")


def test_the_deviations_of_two_source_tasks_are_copies_in_four_tables_and_in_no_others():
    for overall in range(1, 12, 2):
        (target,) = grid.TABLES[f"table-{overall}"].targets
        for count in grid.COUNTS:
            pairs = [
                (returns(overall, target, count, omega), returns(overall + 1, target, count, omega))
                for omega in grid.OMEGAS
            ]
            equal = [one.std == other.std for one, other in pairs]
            assert all(equal) or not any(equal)
            assert {other.copied for _, other in pairs} == {all(equal)}
            assert not any(one.copied for one, _ in pairs)


def test_the_overall_deviations_of_the_pendulum_are_too_large_for_deviations_of_three_seeds():
    """Among three numbers of which none exceeds M, the deviation is at most √2 (M - mean), and
    √3 (M - mean) with n - 1; M is taken from the final returns, in the same two ways."""
    settings = [(count, omega) for count in grid.COUNTS for omega in grid.OMEGAS]
    checked = 0
    for setting in [*settings, (None, None)]:
        overall = returns(7, "InvertedPendulum", *setting)
        final = returns(8, "InvertedPendulum", *setting)
        if final.copied:
            continue
        checked += 1
        for root, largest in ((math.sqrt(2), math.sqrt(2)), (math.sqrt(3), 2 / math.sqrt(3))):
            assert overall.std > root * (final.mean + largest * final.std - overall.mean)
    assert checked == 13


def test_the_bound_on_deviations_of_three_holds_and_is_reached():
    numbers = [1.0, 1.0, 0.0]
    mean = sum(numbers) / 3
    deviation = math.sqrt(sum((x - mean) ** 2 for x in numbers) / 3)
    assert deviation == pytest.approx(math.sqrt(2) * (1 - mean))


def test_a_table_stands_beside_the_one_of_its_name():
    assert published.number(grid.on_backend(grid.TABLES["table-12"], "brax")) == 12
    strange = dataclasses.replace(grid.TABLES["table-1"], name="table-18")
    with pytest.raises(ValueError, match="the thesis has no table-18, its tables are table-1, "):
        published.number(strange)


def test_what_the_thesis_did_not_try_has_no_record():
    assert returns(1, "HalfCheetah", 2, 0.7) is None
    assert classification(13, "Ant", 60) is None


def test_each_contradiction_says_what_where_and_what_is_done():
    assert all(c.what and c.where and c.choice for c in CONTRADICTIONS)
    text = " ".join(c.where for c in CONTRADICTIONS)
    for place in ("Figure 29", "Figure 33", "Table 15", "section 4.3.2", "section 3.1"):
        assert place.lower() in text.lower()


READ = (PATH, *(Path(page.__file__).with_name(name) for name in ("page.css", "page.html.j2")))


@pytest.mark.parametrize("path", READ)
def test_what_the_report_reads_is_packaged(path):
    root = Path(__file__).parent.parent
    settings = tomllib.loads((root / "pyproject.toml").read_text())["tool"]["setuptools"]
    package = ".".join(path.parent.relative_to(root).parts)
    data = settings["package-data"]
    patterns = [*data["*"], *data.get(package, [])]
    assert path.exists() and any(fnmatch(path.name, pattern) for pattern in patterns)
