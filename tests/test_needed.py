"""The command that says which seeds comparisons still need. The runs are made up."""

import pytest

from experiments.cli.main import main
from experiments.reports import needed
from experiments.reports.outcomes import read_outcomes
from experiments.thesis import grid
from made_up_results import baselines, rising, targets, write_folder

FIVE = (0, 1, 2, 3, 4)


def words(root, seeds, omegas=(0.0, 0.1), **settings):
    """What is said of each comparison of Table 7 with two source tasks."""
    table = grid.ReturnsTable(
        "table-7", "ftl", ("InvertedPendulum",), "overall", counts=(2,), omegas=omegas
    )
    outcomes = read_outcomes(root, grid.shown(table, seeds))
    found = needed.needed(table, outcomes, seeds, **settings)
    return [needed.in_words(need) for need in found]


def test_a_comparison_needs_the_seeds_up_to_the_next_look(tmp_path):
    root = tmp_path / "debug"
    assert words(root, (0,)) == ["needs seeds 0 to 4"] * 2
    write_folder(root, "scratch", baselines((0, 1, 2)), rising)
    write_folder(root, "targets", targets([0.0], FIVE), rising)
    assert words(root, FIVE) == [
        "needs from scratch seeds 3 to 4",
        "needs seeds 0 to 4, from scratch seeds 3 to 4",
    ]


def test_seeds_that_failed_are_replaced_and_those_that_were_cut_are_finished(tmp_path):
    root = tmp_path / "debug"
    write_folder(root, "scratch", baselines(FIVE), rising)
    write_folder(root, "targets", targets([0.0], FIVE), rising, failed=[1])
    write_folder(root, "more", targets([0.1], FIVE[:2]), rising, done=2)
    assert words(root, FIVE) == ["needs seed 5", "needs seeds 0 to 4"]


def test_a_clear_difference_is_decided_and_none_is_not(tmp_path):
    root, ten = tmp_path / "debug", tuple(range(10))
    write_folder(root, "scratch", baselines(ten), rising)
    write_folder(root, "targets", targets([0.0], ten), rising)
    same = targets([0.1], ten)
    write_folder(root, "same", same, lambda cell, task, count: rising(cell, task, count) - 100)
    assert words(root, ten) == ["decided, positive, by 10 seeds", "needs seeds 10 to 14"]
    assert words(root, ten, most=10)[1] == "not decided, with at most 10 seeds"


def test_the_command_names_what_to_run_next(tmp_path, capsys):
    root = tmp_path / "debug"
    write_folder(root, "scratch", baselines(FIVE), rising)
    write_folder(root, "targets", targets([0.0], FIVE), rising)
    command = ["seeds", "7", "--preset", "debug", "--results", str(tmp_path)]
    command += ["--omegas", "0", "0.1", "--counts", "2"]
    assert main(command) == 0
    printed = capsys.readouterr().out
    assert "Table 7, overall return" in printed and "the 2 comparisons above" in printed
    assert "InvertedPendulum, 2 tasks, ω = 0.1  0 / 5" in printed
    assert (
        "next: python -m experiments table 7 --preset debug --seeds 0 1 2 3 4 5 6 7 8 9 "
        f"--omegas 0.0 0.1 --counts 2 --results {tmp_path}" in printed
    )


@pytest.mark.parametrize(
    "arguments, message",
    [
        (["13"], "table-13 compares no returns"),
        (["99"], "unknown table '99'"),
        (["7", "--group", "1"], "a group has at least 2 seeds"),
    ],
)
def test_what_cannot_be_answered_is_refused(arguments, message, capsys):
    assert main(["seeds", *arguments]) == 2
    assert message in capsys.readouterr().err
