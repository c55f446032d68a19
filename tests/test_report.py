"""Results folders beside each other, of made-up evaluations."""

import json

import pytest

from dreamer_jax.config import preset
from dreamer_jax.files import write_json_atomically
from experiments.__main__ import main
from experiments.methods.fractional import FractionalTransfer
from experiments.methods.scratch import Scratch
from experiments.reports import summary
from experiments.reports.levels import draw_levels
from experiments.runs.spec import RunSpec

SCRATCH = Scratch()


@pytest.fixture
def folder(tmp_path):
    """Writes a run whose every evaluation of a task gives that task's return."""

    def make(name, returns, method=SCRATCH):
        directory = tmp_path / name
        directory.mkdir(parents=True)
        spec = RunSpec(tuple(returns), (0, 1), preset("debug"), method)
        write_json_atomically(directory / "run.json", {"spec": spec.to_dict()})
        rows = [
            {"kind": "evaluation", "member": number, "seed": member.seed, "label": member.label}
            | {"env_steps": env_steps, "task": task, "return": score}
            for env_steps in (40, 80)
            for number, member in enumerate(spec.members)
            for task, score in returns.items()
        ]
        lines = "".join(json.dumps(row) + "\n" for row in rows)
        (directory / "metrics.jsonl").write_text(lines)
        return directory

    return make


def drawn(monkeypatch):
    """What is to be drawn: the texts of each panel's curves."""
    panels = {}

    def note(found, stem):
        panels.update({title: [curve.text for curve in curves] for title, curves in found.items()})
        return [stem.with_suffix(".png")]

    monkeypatch.setattr(summary, "_draw", note)
    return panels


def test_one_task_on_two_simulators_shares_a_panel(folder, monkeypatch):
    panels = drawn(monkeypatch)
    ours = folder("ours", {"bullet/hopper": 3.0})
    other = folder("other", {"brax/hopper": 5.0})
    summary.plot_comparison([ours, other], "picture")
    assert panels == {"Hopper": ["ours", "other"]}
    summaries = summary.compare([ours, other])
    assert [(s.label, s.task, s.overall) for s in summaries] == [
        ("ours", "bullet/hopper", (3.0, 0.0)),
        ("other", "brax/hopper", (5.0, 0.0)),
    ]


def test_curves_are_told_apart_by_folder_label_and_simulator(folder, tmp_path, monkeypatch):
    panels = drawn(monkeypatch)
    both = folder("a/run", {"bullet/hopper": 0.0, "brax/hopper": 0.0, "brax/ant": 0.0})
    targets = folder(
        "b/run",
        {"brax/ant": 0.0},
        FractionalTransfer(sources=("source",), omegas=(0.0, 0.2), baseline=True),
    )
    summary.plot_comparison([both, targets], "picture")
    a, b = map(str, (both, targets))
    assert panels == {
        "Hopper": [f"{a}, bullet/hopper", f"{a}, brax/hopper"],
        "Ant": [a, f"{b}, ω = 0", f"{b}, ω = 0.2", f"{b}, baseline"],
    }


def test_reports_of_several_folders_print_a_table_and_draw_a_picture(folder, tmp_path, capsys):
    folders = [str(folder(name, {"bullet/hopper": 7.0})) for name in ("one", "two")]
    picture = tmp_path / "new" / "both.png"
    assert main(["report", *folders, "--out", str(picture)]) == 0
    printed = capsys.readouterr().out
    assert "one" in printed and "two" in printed and printed.count("7 ± 0") == 2
    assert picture.stat().st_size > 1000 and picture.with_suffix(".svg").exists()


def test_a_folder_without_a_run_or_evaluations_is_named(folder, tmp_path, capsys):
    whole, empty = folder("whole", {"bullet/hopper": 7.0}), folder("empty", {"bullet/hopper": 7.0})
    (empty / "metrics.jsonl").write_text("")
    for other, message in ((empty, "no evaluations to draw"), (tmp_path, "holds no run")):
        assert main(["report", str(whole), str(other)]) == 2
        said = capsys.readouterr().err
        assert str(other) in said and message in said
    assert main(["report"]) == 2
    assert "name a results folder" in capsys.readouterr().err


def axis_with(*returns):
    from matplotlib.figure import Figure

    axis = Figure().subplots()
    axis.plot(range(len(returns)), returns)
    return axis


def test_levels_near_the_curves_are_drawn_with_their_names():
    axis = axis_with(-900.0, 100.0)
    draw_levels(axis, ["bullet/inverted_pendulum", "bullet/inverted_pendulum"])
    assert [text.get_text() for text in axis.texts] == [
        "no action (-1000)",
        "random actions (-875)",
        "constant action (-837)",
        "balanced (880)",
    ]
    drawn = [line.get_ydata()[0] for line in axis.lines[1:]]
    assert drawn == [-1000, -875, -837, 880]
    assert axis.get_ylim()[1] > 880


def test_levels_far_from_the_curves_are_left_out():
    # Episodes of 40 environment steps have other returns than those of 1000.
    axis = axis_with(-40.0, -30.0)
    before = axis.get_ylim()
    draw_levels(axis, ["bullet/inverted_pendulum"])
    assert not axis.texts and axis.get_ylim() == before


def test_an_environment_whose_levels_are_not_known_has_none():
    axis = axis_with(0.0, 100.0)
    draw_levels(axis, ["gymnasium/CartPole-v1"])
    assert not axis.texts
