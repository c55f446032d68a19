"""What tables of returns compare, and the seeds that are there. The runs are made up."""

import numpy as np
import pytest

from experiments.reports import comparison, sheet
from experiments.reports.outcomes import Outcome, curves, read_outcomes, seeds_on_disk
from experiments.thesis import grid
from experiments.thesis.grid import TABLES
from made_up_results import baselines, rising, targets, write_done_and_cut, write_folder

SEEDS = (0, 1)
TARGET = "InvertedPendulum"


@pytest.fixture
def root(tmp_path):
    return write_done_and_cut(tmp_path / "debug", SEEDS)


def entries(root, name="table-7", seeds=SEEDS):
    table = TABLES[name]
    outcomes = read_outcomes(root, grid.shown(table, seeds))
    return comparison.compare(table, outcomes, seeds)


def test_overall_takes_all_evaluations_of_all_seeds_and_final_the_last_tenth(root):
    # 0, 10, 20, 30 and 10, 20, 30, 40; their last ones are 30 and 40.
    overall = entries(root, "table-7")[TARGET, None, None]
    final = entries(root, "table-8")[TARGET, None, None]
    assert overall.ours == (20.0, np.sqrt(150)) and overall.scores == (15.0, 25.0)
    assert final.ours == (35.0, 5.0) and final.scores == (30.0, 40.0)


def test_a_transfer_is_compared_with_its_baseline(root):
    entry = entries(root)[TARGET, 2, 0.0]
    assert entry.ours[0] == 120.0 and entry.average.value == 120.0
    assert entry.transfer.difference.value == 100.0
    assert entry.transfer.improvement.value == 1.0
    assert entry.transfer.jumpstart == 100.0  # of one evaluation, a twentieth of four or more
    # The baseline's mean curve is 5, 15, 25, 35; nine tenths of the way from 5 to 35 is 32.
    assert entry.threshold == comparison.Threshold(32.0, 40)
    assert entries(root)[TARGET, None, None].threshold == comparison.Threshold(32.0, 160)


@pytest.mark.parametrize("seeds, verdict", [(5, "positive"), (4, None)])
def test_a_verdict_takes_five_seeds_on_both_sides(tmp_path, seeds, verdict):
    root, five, some = tmp_path / "debug", tuple(range(5)), tuple(range(seeds))
    write_folder(root, "scratch", baselines(five), rising)
    write_folder(root, "targets", targets([0.0], some), rising)
    entry = entries(root, seeds=five)[TARGET, 2, 0.0]
    assert len(entry.scores) == seeds and entry.transfer.difference.low > 0
    assert entry.transfer.verdict == verdict


def test_a_verdict_is_corrected_for_all_comparisons_of_the_table(tmp_path):
    """A difference that counts alone does not beside many of which none is one."""
    root, five = tmp_path / "debug", tuple(range(5))

    def returns(cell, task, count):
        ahead = 30.0 * (cell.omega == 0.0 and cell.source is not None)
        return np.full(count, 10.0 * cell.seed + ahead)

    write_folder(root, "scratch", baselines(five), returns)
    write_folder(root, "targets", targets([0.0], five), returns)
    alone = entries(root, seeds=five)[TARGET, 2, 0.0].transfer
    write_folder(root, "more", targets(grid.OMEGAS[1:], five), returns)
    among = entries(root, seeds=five)[TARGET, 2, 0.0].transfer
    assert alone.verdict == "positive" and among.verdict == "undecided"
    assert among.chance == pytest.approx(6 * alone.chance, rel=0.01)


def test_an_entry_without_a_seed_that_is_done_has_counts_and_no_number(root):
    cut, missing = (entries(root)[key] for key in ((TARGET, 2, 0.1), (TARGET, 3, 0.0)))
    assert (cut.done, cut.planned, cut.cut) == (4, 8, SEEDS)
    assert (missing.done, missing.planned, missing.begun) == (0, 0, False)
    for entry in (cut, missing):
        assert not entry.scores
        assert entry.ours is entry.average is entry.transfer is entry.threshold is None


def test_an_entry_is_that_of_the_seeds_that_are_done(tmp_path):
    root, three = tmp_path / "debug", (0, 1, 2)
    write_folder(root, "scratch", baselines(three[:2]), rising, done=3)
    write_folder(root, "more", baselines(three[2:]), rising)
    entry = entries(root, seeds=three)[TARGET, None, None]
    assert entry.scores == (35.0,) and entry.cut == (0, 1)
    assert (entry.done, entry.planned) == (10, 12)


def test_a_seed_that_failed_is_named_and_left_out(tmp_path):
    root = tmp_path / "debug"
    write_folder(root, "scratch", baselines(SEEDS), rising, failed=[1])
    write_folder(root, "targets", targets([0.0], SEEDS), rising, failed=[0, 1])
    found = entries(root)
    base, entry = found[TARGET, None, None], found[TARGET, 2, 0.0]
    assert base.scores == (15.0,) and base.failed == (1,)
    assert not entry.scores and entry.failed == SEEDS and entry.begun


def test_without_a_baseline_there_is_no_verdict(tmp_path):
    root = tmp_path / "debug"
    write_folder(root, "scratch", baselines(SEEDS), rising, done=3)
    write_folder(root, "targets", targets([0.0], SEEDS), rising)
    entry = entries(root)[TARGET, 2, 0.0]
    assert entry.ours[0] == 120.0 and entry.transfer is None
    shown = sheet.read_sheet(TABLES["table-7"], root, SEEDS)
    assert any(row[4] == "no baseline yet" for row in shown.statistics)


def test_curves_end_where_the_slowest_run_that_has_begun_is(tmp_path):
    root = tmp_path / "debug"
    one, other = baselines(SEEDS)
    write_folder(root, "one", [one], rising)
    write_folder(root, "other", [other], rising, done=3)
    missing = grid.baseline("bullet", TARGET, 2)
    outcomes = read_outcomes(root, [one, other, missing])
    steps, returns = curves(list(outcomes.values()), TARGET)
    assert steps.tolist() == [40, 80, 120]
    assert returns.tolist() == [[0, 10, 20], [10, 20, 30]]
    steps, returns = curves([outcomes[missing]], TARGET)
    assert steps.shape == (0,) and returns.shape == (0, 0)


def test_targets_are_joined_each_on_its_own_scale():
    def group(target, base, transfer):
        def entry(sources, scores):
            outcome = Outcome((1,), {}, 1, 1)
            return comparison.Entry(target, sources, None, (outcome,), (0,), None, scores)

        return {
            (target, None, None): entry(None, base),
            (target, 2, None): entry(2, transfer),
        }

    # On scales from 0 to 1: 0, 0 and 0.5, 1; 0, 1 and 0.5, 0.5. One table holds both targets.
    table = group("Hopper", (-5.0, -5.0), (0.0, 5.0)) | group("Ant", (0.0, 1.0), (0.5, 0.5))
    names, (baseline, transfer) = comparison.across_targets([table])
    assert names == ["Hopper", "Ant"]
    assert baseline.average.value == 0.0 and baseline.improvement is None
    assert transfer.average.value == 0.5
    assert transfer.improvement.value == (1.0 + 0.5) / 2


def test_targets_with_an_incomplete_entry_are_left_out_of_what_is_joined(root):
    assert comparison.across_targets([entries(root)]) == ([], [])


# --- seeds ----------------------------------------------------------------------------------------


def test_all_seeds_on_disk_are_shown_whichever_were_asked_for(tmp_path):
    root = tmp_path / "debug"
    write_folder(root, "scratch", baselines((0, 1, 2)), rising)
    write_folder(root, "later", targets([0.0], (0, 5)), rising)
    tables = list(TABLES.values())
    assert seeds_on_disk(root, tables, "bullet") == (0, 1, 2)
    assert seeds_on_disk(root, tables, "bullet", (0, 1)) == (0, 1, 2)
    assert seeds_on_disk(root, tables, "bullet", (7,)) == (7, 0, 1, 2)
    assert seeds_on_disk(root, tables, "brax") == ()


def test_the_first_seed_is_that_of_the_sources(tmp_path):
    root, seeds = tmp_path / "debug", (2, 0, 1)
    write_folder(root, "scratch", baselines((0, 1, 2)), rising)
    write_folder(root, "targets", targets([0.0], seeds), rising)
    found = seeds_on_disk(root, [TABLES["table-7"]], "bullet")
    assert found == seeds
    assert len(entries(root, seeds=found)[TARGET, 2, 0.0].scores) == 3
