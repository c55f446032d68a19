"""Measurements of this machine that are kept, and the question before long runs."""

import dataclasses

import pytest

from dreamer_jax.config import preset
from experiments.cli import thesis
from experiments.cli.main import main
from experiments.runs.spec import RunSpec
from experiments.thesis import speeds
from experiments.thesis.measurement import Speed

HOPPER = RunSpec(("bullet/hopper",), (0,), preset("debug"))
ANT = RunSpec(("bullet/ant",), (0,), preset("debug"))


@pytest.fixture
def measured(monkeypatch):
    """The tasks of each measurement that was asked for; each finds another speed."""
    found = []

    def measure(specs, tell, *, timeout):
        tasks = [task for spec in specs for task in spec.tasks]
        found.append(tasks)
        ticks = dict.fromkeys(tasks, 0.001 * len(found))
        return Speed(len(found), (0.5, 2.0), 1000, 0.0, ticks, 0.0, ticks, 1)

    monkeypatch.setattr(speeds, "measure", measure)
    return found


def test_a_machine_is_measured_once(measured, tmp_path):
    first = speeds.speed_of([HOPPER], tmp_path)
    again = speeds.speed_of([HOPPER], tmp_path)
    assert (first.kept, again.kept) == (False, True) and first.speed == again.speed
    assert measured == [["bullet/hopper"]] and again.path.parent == tmp_path


def test_it_is_measured_anew_for_another_simulator_and_keeps_the_first(measured, tmp_path):
    speeds.speed_of([HOPPER], tmp_path)
    both = speeds.speed_of([HOPPER, ANT], tmp_path)
    assert not both.kept and both.speed.tick_seconds["bullet/hopper"] == 0.002
    assert speeds.speed_of([ANT], tmp_path).kept and speeds.speed_of([HOPPER], tmp_path).kept
    assert not speeds.speed_of([HOPPER], tmp_path, again=True).kept
    assert set(speeds.speed_of([ANT], tmp_path).speed.tick_seconds) == {
        "bullet/hopper",
        "bullet/ant",
    }


@pytest.mark.parametrize(
    "group, change, kept",
    [
        ("learning", {"batch_size": 3}, False),
        ("schedule", {"supersample": 2}, False),
        ("schedule", {"environment_steps": 1000, "evaluate_every": 500}, True),
    ],
)
def test_settings_that_change_an_update_or_a_tick_are_measured_anew(
    measured, tmp_path, group, change, kept
):
    speeds.speed_of([HOPPER], tmp_path)
    changed = dataclasses.replace(getattr(HOPPER.config, group), **change)
    config = dataclasses.replace(HOPPER.config, **{group: changed})
    assert speeds.speed_of([dataclasses.replace(HOPPER, config=config)], tmp_path).kept == kept


def test_another_machine_is_measured_anew(measured, tmp_path, monkeypatch):
    speeds.speed_of([HOPPER], tmp_path)
    monkeypatch.setattr(speeds.platform, "node", lambda: "another")
    assert not speeds.speed_of([HOPPER], tmp_path).kept


def test_what_cannot_be_read_is_measured_anew(measured, tmp_path):
    path = speeds.speed_of([HOPPER], tmp_path).path
    path.write_text('{"speed": {"update_seconds": 1}}')
    assert not speeds.speed_of([HOPPER], tmp_path).kept
    assert speeds.speed_of([HOPPER], tmp_path).kept


@pytest.fixture
def asked(monkeypatch, measured, tmp_path):
    """A terminal that answers no; the questions it was asked, and what was begun all the same."""
    questions, begun = [], []
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    monkeypatch.setattr(thesis.sys.stdin, "isatty", lambda: True, raising=False)
    monkeypatch.setattr("builtins.input", lambda question: questions.append(question) or "n")

    def carry_out(entries, sweep, execution):
        begun.append(entries)
        raise KeyboardInterrupt

    monkeypatch.setattr(thesis, "_carry_out", carry_out)
    return questions, begun


def test_anything_longer_than_an_hour_is_begun_only_after_a_question(asked, tmp_path, capsys):
    questions, begun = asked
    command = ["table", "7", "--preset", "cpu", "--results", str(tmp_path)]
    assert main(command) == 130
    assert len(questions) == 1 and not begun
    printed = capsys.readouterr().out
    assert "days" in printed and "nothing was begun" in printed
    main([*command, "--yes"])
    assert len(questions) == 1 and len(begun) == 1


def test_short_runs_are_begun_without_a_question_or_a_measurement(asked, measured, tmp_path):
    questions, begun = asked
    main(["table", "7", "--preset", "debug", "--results", str(tmp_path), "--seeds", "0"])
    assert not questions and not measured and len(begun) == 1
