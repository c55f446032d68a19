"""Results folders beside each other, of made-up evaluations."""

import json

import pytest

from dreamer_jax.config import preset
from dreamer_jax.files import write_json_atomically
from experiments.cli.main import main
from experiments.methods.fractional import FractionalTransfer
from experiments.methods.scratch import Scratch
from experiments.reports import summary, tidy
from experiments.reports.levels import draw_levels
from experiments.reports.outcomes import curves, read_run
from experiments.runs.spec import RunSpec

SCRATCH = Scratch()
TRANSFER = FractionalTransfer(sources=("source",), omegas=(0.0, 0.2), baseline=True)


@pytest.fixture
def folder(tmp_path):
    """Writes a run whose every evaluation of a task gives that task's return."""

    def make(name, returns, method=SCRATCH, steps=(40, 80)):
        directory = tmp_path / name
        directory.mkdir(parents=True)
        spec = RunSpec(tuple(returns), (0, 1), preset("debug"), method)
        write_json_atomically(directory / "run.json", {"spec": spec.to_dict()})
        rows = [
            {"kind": "evaluation", "member": number, "seed": member.seed, "label": member.label}
            | {"env_steps": env_steps, "task": task, "return": score}
            for env_steps in steps
            for number, member in enumerate(spec.members)
            for task, score in returns.items()
        ]
        lines = "".join(json.dumps(row) + "\n" for row in rows)
        (directory / "metrics.jsonl").write_text(lines)
        return directory

    return make


def read(*folders):
    return [read_run(folder) for folder in folders]


def texts(panels):
    return {panel.title: [curve.text for curve in panel.curves] for panel in panels}


def test_one_task_on_two_simulators_shares_a_panel(folder):
    runs = read(folder("ours", {"bullet/hopper": 3.0}), folder("other", {"brax/hopper": 5.0}))
    assert texts(summary.compared_panels(runs)) == {"Hopper": ["ours", "other"]}
    summaries = summary.compare(runs)
    assert [(s.label, s.task, s.overall) for s in summaries] == [
        ("ours", "bullet/hopper", (3.0, 0.0)),
        ("other", "brax/hopper", (5.0, 0.0)),
    ]


def test_curves_are_told_apart_by_folder_label_and_simulator(folder):
    both = folder("a/run", {"bullet/hopper": 0.0, "brax/hopper": 0.0, "brax/ant": 0.0})
    targets = folder("b/run", {"brax/ant": 0.0}, TRANSFER)
    a, b = map(str, (both, targets))
    assert texts(summary.compared_panels(read(both, targets))) == {
        "Hopper": [f"{a}, bullet/hopper", f"{a}, brax/hopper"],
        "Ant": [a, f"{b}, ω = 0", f"{b}, ω = 0.2", f"{b}, baseline"],
    }


def test_a_folders_baseline_is_dashed_beside_its_transfers(folder):
    targets = folder("run", {"brax/ant": 0.0}, TRANSFER)
    (panel,) = summary.panels(*read(targets))
    assert [curve.text for curve in panel.curves] == ["ω = 0", "ω = 0.2", "baseline"]
    assert [curve.style.get("linestyle") for curve in panel.curves] == [None, None, "--"]


def rewritten(directory, change):
    """A folder whose rows of metrics are changed, or dropped."""
    path = directory / "metrics.jsonl"
    rows = [change(json.loads(line)) for line in path.read_text().splitlines()]
    path.write_text("".join(json.dumps(row) + "\n" for row in rows if row))
    return directory


def test_final_returns_are_the_last_planned_where_none_lies_in_the_last_tenth(folder):
    """Four evaluations are planned in 160 steps; the last tenth begins after 144."""

    def numbered(row):
        return row | {"return": float(row["env_steps"])}

    for steps, state, final in (
        ((30, 60, 90, 120), "done", (120.0, 0.0)),
        ((30, 60, 90), "cut", None),
        ((30, 60, 150), "cut", (150.0, 0.0)),
    ):
        made = folder(f"run {steps}", {"bullet/hopper": 0.0}, steps=steps)
        (run,) = read(rewritten(made, numbered))
        assert {outcome.state for outcome in run.outcomes} == {state}
        assert summary.summarise(run)[0].final == final


@pytest.mark.parametrize(
    "sign",
    [
        {"healthy": False},
        {"return": "NaN"},
        {"kind": "update", "healthy": False},
    ],
)
def test_a_member_that_failed_is_named_and_left_out(folder, sign):
    def fail(row):
        if row["seed"] == 1:
            row |= {"return": 1000.0}
            row |= sign if row["env_steps"] == 80 else {}
        return row

    (run,) = read(rewritten(folder("run", {"bullet/hopper": 7.0}), fail))
    assert [outcome.failed_at for outcome in run.outcomes] == [None, 80]
    (one,) = summary.summarise(run)
    assert (one.seeds, one.failed, one.overall) == (1, (1,), (7.0, 0.0))
    assert "Failed and left out: baseline, seed 1." in summary.table([one])
    steps, returns = curves(run.outcomes, "bullet/hopper")
    assert steps.tolist() == [40, 80] and returns.tolist() == [[7.0, 7.0]]


def test_an_evaluation_of_some_tasks_only_does_not_count(folder):
    def kill(row):
        return None if (row["env_steps"], row["task"]) == (80, "bullet/ant") else row

    made = folder("run", {"bullet/hopper": 1.0, "bullet/ant": 2.0})
    (run,) = read(rewritten(made, kill))
    assert [outcome.env_steps for outcome in run.outcomes] == [(40,), (40,)]
    assert run.outcomes[0].returns == {"bullet/hopper": (1.0,), "bullet/ant": (2.0,)}


def test_metrics_of_another_run_are_refused(folder):
    made = folder("run", {"bullet/hopper": 1.0})
    with pytest.raises(ValueError, match="does not belong to its run.json of 2 members"):
        read(rewritten(made, lambda row: row | {"member": 2}))


def test_all_evaluations_are_a_table_that_pandas_reads(folder, tmp_path):
    pandas = pytest.importorskip("pandas")
    targets = folder("targets", {"brax/ant": 5.0}, TRANSFER)
    both = folder("both", {"bullet/hopper": 3.0, "bullet/ant": 4.0})
    path = tidy.write_evaluations(read(targets, both), tmp_path / "new" / "results.csv")
    frame = pandas.read_csv(path)
    assert len(frame) == 6 * 2 + 2 * 2 * 2
    assert list(frame.columns[:3]) == ["folder", "cell", "member"]
    means = frame.groupby(["folder", "task"])["return"].mean().to_dict()
    assert means == {
        ("targets", "brax/ant"): 5.0,
        ("both", "bullet/hopper"): 3.0,
        ("both", "bullet/ant"): 4.0,
    }
    transfers = frame[frame["method"] == "fractional"]
    assert sorted(transfers["omega"].unique()) == [0.0, 0.2]
    assert set(transfers["from"]) == {"source"}
    # Two evaluations are all of a run of two tasks, and half of those of a run of one.
    assert frame.groupby("folder")["state"].unique().map(list).to_dict() == {
        "targets": ["cut"],
        "both": ["done"],
    }
    assert frame[frame["method"] == "scratch"]["omega"].isna().all()


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
