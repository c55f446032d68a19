"""Tables and figures beside the published numbers, as text and files. The runs are made up."""

import csv
import dataclasses
import re

import pytest

from dreamer_jax.config import preset
from experiments.reports import curves, figures, findings, publication, sheet, summary
from experiments.reports.classification import Classification, Share
from experiments.reports.outcomes import read_outcomes
from experiments.runs.folder import folders
from experiments.thesis import grid
from experiments.thesis.grid import FIGURES, TABLES, ReturnsTable
from made_up_results import baselines, rising, targets, write_done_and_cut, write_folder

SEEDS = (0, 1)
TARGET = "InvertedPendulum"


@pytest.fixture
def root(tmp_path):
    return write_done_and_cut(tmp_path / "debug", SEEDS)


@pytest.fixture(autouse=True)
def classification(monkeypatch):
    """What latent task classification gives: nothing, unless a test puts tables in here."""
    found = {}
    monkeypatch.setattr(
        sheet,
        "read_classification",
        lambda root, table, seeds=grid.SEEDS: found.get(table.name),
    )
    return found


def records(root, tmp_path, name="table-7"):
    publication.write_table(TABLES[name], root, SEEDS, tmp_path / "out")
    with open(tmp_path / "out" / f"{name}.csv", encoding="utf-8") as file:
        return {(row["target"], row["sources"], row["omega"]): row for row in csv.DictReader(file)}


# --- tables ---------------------------------------------------------------------------------------


def test_a_table_has_the_thesiss_form_with_both_values(root, tmp_path):
    text = publication.write_table(TABLES["table-7"], root, SEEDS, tmp_path / "out")
    lines = text.splitlines()
    assert lines[0] == "Table 7: InvertedPendulum, overall return"
    assert re.split("  +", lines[3]) == ["ω", "2 Tasks", "3 Tasks", "4 Tasks"]
    rows = [re.split("  +", line) for line in lines[5:12]]
    assert [row[0] for row in rows] == ["0.0", "0.1", "0.2", "0.3", "0.4", "0.5", "Baseline"]
    assert rows[0][1:] == ["120 ± 12 | 847 ± 135", "not run | 779 ± 259", "not run | 838 ± 169"]
    assert rows[1][1] == "4 of 8 evaluations | 857 ± 145"
    assert rows[6][1:] == ["20 ± 12 | 723 ± 364"]


def test_methods_of_comparison_have_rows_beside_the_baseline(root, tmp_path):
    others = [grid.compared("bullet", TARGET, 2, "fine-tuning", seed, SEEDS[0]) for seed in SEEDS]
    write_folder(root, "tuned", others, rising)
    table = grid.with_compared(TABLES["table-7"], folders(root), SEEDS)
    lines = publication.write_table(table, root, SEEDS, tmp_path / "out").splitlines()
    rows = {row[0]: row[1:] for row in (re.split("  +", line) for line in lines[5:13])}
    assert list(rows)[-2:] == ["Fine-tuning", "Baseline"]
    assert rows["Fine-tuning"] == ["120 ± 12 | -", "not run | -", "not run | -"]
    records = list(csv.DictReader((tmp_path / "out" / "table-7.csv").open(encoding="utf-8")))
    (record,) = [one for one in records if one["method"] == "fine-tuning" and one["sources"] == "2"]
    assert (record["omega"], record["difference"]) == ("", "100.0")
    # Each method is told of alone.
    outcomes = read_outcomes(root, grid.shown(table, SEEDS))
    finding, tuned = findings.findings([table], outcomes, SEEDS)
    assert (finding.method, tuned.method) == ("Fractional transfer", "Fine-tuning")
    compared = [c.entry for group in finding.comparisons["overall"].values() for c in group]
    assert {entry.method for entry in compared} == {None} and compared


def test_a_table_is_written_as_text_csv_and_pictures(root, tmp_path):
    text = publication.write_table(TABLES["table-7"], root, SEEDS, tmp_path / "out")
    folder = tmp_path / "out"
    assert (folder / "table-7.txt").read_text(encoding="utf-8") == text + "\n"
    assert (folder / "table-7.png").read_bytes().startswith(b"\x89PNG")
    assert "<svg" in (folder / "table-7.svg").read_text(encoding="utf-8")


def test_the_csv_has_a_line_for_each_entry_and_leaves_empty_what_is_not_known(root, tmp_path):
    rows = records(root, tmp_path)
    assert len(rows) == 19
    complete, incomplete = rows[TARGET, "2", "0.0"], rows[TARGET, "2", "0.1"]
    assert (complete["ours_mean"], complete["published_mean"]) == ("120.0", "847")
    assert (complete["seeds"], complete["difference"]) == ("2", "100.0")
    known = {"table", "target", "sources", "omega", "metric", "evaluations", "planned", "seeds"}
    known |= {"failed", "published_mean", "published_std"}
    assert {name for name, value in incomplete.items() if value} == known
    assert (incomplete["seeds"], incomplete["evaluations"]) == ("0", "4")


@pytest.mark.parametrize(
    "name", [name for name, table in TABLES.items() if isinstance(table, ReturnsTable)]
)
def test_without_any_run_every_table_shows_the_published_numbers_alone(tmp_path, name):
    found = sheet.read_sheet(TABLES[name], tmp_path / "thesis", SEEDS)
    boxes = [box for _, row in found.rows for box in row if box is not None]
    assert len(boxes) == (24 if TABLES[name].kind == "meta" else 19)
    assert {(box.ours, box.complete) for box in boxes} == {("not run", False)}
    assert all(re.fullmatch(r"\d+ ± \d+\*?", box.published) for box in boxes)
    assert not any("±" in text for row in found.statistics for text in row)


def test_copied_deviations_are_marked(tmp_path):
    for name, copies in (("table-8", 6), ("table-7", 0), ("table-2", 0)):
        found = sheet.read_sheet(TABLES[name], tmp_path / "thesis", SEEDS)
        boxes = [box for _, row in found.rows for box in row if box is not None]
        assert sum(box.published.endswith("*") for box in boxes) == copies
        assert any("copied" in note for note in found.notes) == bool(copies)


def test_what_is_not_comparable_is_said(root, tmp_path):
    def notes(entry, folder, seeds):
        return " ".join(sheet.read_sheet(entry, folder, seeds).notes)

    small = notes(TABLES["table-7"], root, SEEDS)
    assert "preset debug: not comparable in size" in small and "of 2 seeds" in small
    brax = grid.on_backend(TABLES["table-7"], "brax")
    assert "the published ones on PyBullet" in notes(brax, root, SEEDS)
    assert notes(TABLES["table-7"], tmp_path / "thesis", grid.SEEDS) == ""
    assert "features of another dynamics model" in notes(
        TABLES["table-16"], tmp_path / "thesis", grid.SEEDS
    )


def test_a_meta_models_table_has_a_row_for_each_target_and_its_baseline(tmp_path):
    root = tmp_path / "debug"
    cells = [grid.meta("bullet", "Ant", 3, seed, SEEDS[0]) for seed in SEEDS]
    write_folder(root, "ant", cells, rising)
    found = sheet.read_sheet(TABLES["table-16"], root, SEEDS)
    assert found.header == ("", "2 Tasks", "3 Tasks", "4 Tasks", "Baseline")
    rows = dict(found.rows)
    assert list(rows) == list(TABLES["table-16"].targets)
    assert [str(box) for box in rows["Ant"]] == [
        "not run | 1423 ± 788",
        "120 ± 12 | 1366 ± 687",
        "not run | 1765 ± 764",
        "not run | 1589 ± 771",
    ]


def test_a_single_seed_has_numbers_and_no_verdict(root):
    outcomes = read_outcomes(root, grid.shown(TABLES["table-7"], SEEDS[:1]))
    found = sheet.returns_sheet(TABLES["table-7"], outcomes, SEEDS[:1], None)
    box = found.rows[0][1][0]
    assert box.complete and box.seeds == 1 and box.verdict is None
    assert any(row[2:5] == ("+100", "-", "too few seeds") for row in found.statistics)


def test_what_failed_is_named_in_the_table(tmp_path):
    root = tmp_path / "debug"
    write_folder(root, "scratch", baselines(SEEDS), rising, failed=[1])
    write_folder(root, "targets", targets([0.0], SEEDS), rising, failed=[0, 1])
    found = sheet.read_sheet(TABLES["table-7"], root, SEEDS)
    assert str(found.rows[0][1][0]) == "failed | 847 ± 135"
    assert found.rows[-1][1][0].ours == "15 ± 11"
    notes = " ".join(found.notes)
    assert "left out: InvertedPendulum, baseline: seed 1; " in notes
    assert "InvertedPendulum, 2 tasks, ω = 0: seeds 0, 1." in notes and "of 1 seed," in notes


def test_a_long_title_is_wrapped_to_the_width_of_its_picture(monkeypatch, tmp_path):
    drawn = []
    monkeypatch.setattr(curves, "save", lambda picture, stem: drawn.append(picture) or [])
    title = "Table 7: InvertedPendulum, overall return (preset cpu: not comparable in size) " * 2
    figures.draw_table(title, ["ω", "2 Tasks"], [["0.0", ("1 ± 2 | 3 ± 4", None)]], tmp_path)
    (picture,) = drawn
    canvas = picture.canvas.get_renderer()
    ends = picture._suptitle.get_window_extent(canvas)
    assert ends.x0 >= 0 and ends.x1 <= picture.bbox.width and ends.y1 <= picture.bbox.height


# --- latent task classification -------------------------------------------------------------------


def classified(table):
    shares = tuple(
        Share(threshold, scaled, task, task in table.known, 0.25, 0.75, 0.5)
        for threshold, scaled in ((50.0, 5.0), (70.0, 7.0), (90.0, 9.0), (None, 6.5))
        for task in table.tasks
    )
    return Classification(table, 100, 23, shares)


def test_a_classification_has_the_thesiss_form(classification, tmp_path):
    table = TABLES["table-15"]
    classification["table-15"] = classified(table)
    text = publication.write_table(table, tmp_path / "cpu", SEEDS, tmp_path / "out")
    found = sheet.read_sheet(table, tmp_path / "cpu", SEEDS)
    assert found.header == ("Threshold", "Ant, novel", "InvertedPendulum, novel", *table.known)
    rows = dict(found.rows)
    assert list(rows) == ["50", "70", "90", "suggested: 6.5"]
    assert [str(box) for box in rows["50"][:3]] == [
        "0.75 | 1.00",
        "0.75 | 1.00",
        "0.25/0.50 | 1.00/0.60",
    ]
    assert [str(box) for box in rows["suggested: 6.5"][1:3]] == ["0.75 | -", "0.25/0.50 | -"]
    assert "0.25/0.50 | 1.00/0.60" in text and "scaled by 23 / 230" in text


def test_a_classification_that_has_not_been_made_shows_the_published_shares_alone(tmp_path):
    found = sheet.read_sheet(TABLES["table-13"], tmp_path / "thesis", SEEDS)
    rows = dict(found.rows)
    assert list(rows) == ["50", "70", "90"]
    assert str(rows["70"][1]) == "not run | 0.97" and str(rows["70"][3]) == "not run | 1.00/0.61"


# --- figures --------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "name, titles",
    [
        ("figure-21", [f"ω = {omega}" for omega in grid.OMEGAS]),
        ("figure-33", ["2 source tasks", "3 source tasks", "4 source tasks"]),
        ("figure-36", list(grid.TASKS)),
        ("figure-38", ["InvertedPendulum", "Walker2D", "Hopper"]),
    ],
)
def test_a_figure_has_the_thesiss_panels(name, titles):
    panels = figures.panels(FIGURES[name], SEEDS)
    assert [panel.title for panel in panels] == titles
    shown = {cell for panel in panels for line in panel.lines for cell in line.cells}
    assert shown == set(grid.shown(FIGURES[name], SEEDS))
    assert all(panel.lines[-1].label == "baseline" for panel in panels)


@pytest.mark.parametrize("name", FIGURES)
def test_a_figure_says_what_it_shows(name):
    assert figures.caption(FIGURES[name]).startswith(f"Figure {name.removeprefix('figure-')}: ")


def test_captions_follow_the_grid():
    assert figures.caption(FIGURES["figure-29"]) == (
        "Figure 29: fractional transfer from HalfCheetah, Walker2D, Hopper and InvertedPendulum "
        "to Ant"
    )


def test_learning_curves_are_drawn_with_those_that_were_cut_labelled(root, tmp_path):
    figure = dataclasses.replace(FIGURES["figure-21"], omegas=(0.0, 0.1, 0.2))
    paths = publication.write_figure(figure, root, SEEDS, tmp_path / "out")
    assert [path.name for path in paths] == ["figure-21.png", "figure-21.svg"]
    assert paths[0].read_bytes().startswith(b"\x89PNG")
    # The SVG names each text in a comment.
    labels = re.findall(r"<!-- (.*?) -->", paths[1].read_text(encoding="utf-8"))
    assert labels.count("transfer, 2 seeds") == 1 and labels.count("baseline, 2 seeds") == 2
    assert labels.count("transfer, 2 seeds, cut: 4 of 8 evaluations") == 1
    assert "not run: ω = 0.2" in labels
    assert any("preset debug: not comparable in size" in label for label in labels)


def test_a_figure_of_which_only_the_baseline_was_run_is_not_drawn(tmp_path):
    root = tmp_path / "debug"
    write_folder(root, "scratch", baselines(SEEDS), rising)
    assert publication.write_figure(FIGURES["figure-21"], root, SEEDS, tmp_path / "out") == []
    assert publication.write_figure(FIGURES["figure-36"], root, SEEDS, tmp_path / "out")


def test_curves_are_the_mean_over_seeds_with_their_deviation(root):
    from matplotlib.figure import Figure

    outcomes = read_outcomes(root, baselines(SEEDS))
    axis = Figure().subplots()
    curves.draw_curve(axis, curves.Curve("baseline", list(outcomes.values()), TARGET))
    (line,), (shade,) = axis.lines, axis.collections
    assert line.get_xdata().tolist() == [40, 80, 120, 160]
    assert line.get_ydata().tolist() == [5, 15, 25, 35]
    corners = shade.get_paths()[0].vertices
    assert {y for x, y in corners if x == 80} == {10.0, 20.0}


def test_pictures_of_the_tasks_are_drawn_from_their_simulators(tmp_path):
    pytest.importorskip("pybullet")
    paths = publication.write_figure(FIGURES["figure-11"], tmp_path / "cpu", SEEDS, tmp_path)
    assert [path.name for path in paths] == ["figure-11.png", "figure-11.svg"]
    labels = re.findall(r"<!-- (.*?) -->", paths[1].read_text(encoding="utf-8"))
    assert labels == ["InvertedPendulum", "InvertedDoublePendulum"]


def test_a_task_that_a_simulator_lacks_is_refused_with_those_there_are():
    with pytest.raises(ValueError, match="no task Humanoid of bullet, the tasks are bullet/ant, "):
        figures.task_name("bullet", "Humanoid")


@pytest.mark.parametrize(
    "tasks, called",
    [
        (["bullet/hopper", "bullet/ant"], ["Hopper", "Ant"]),
        (
            ["bullet/hopper", "brax/hopper", "brax/ant"],
            ["bullet/hopper", "brax/hopper", "Ant"],
        ),
    ],
)
def test_tasks_of_one_title_are_told_apart_by_their_names(tasks, called):
    summaries = [summary.Summary("seed", task, 1, 1, 1, (1.0, 0.0), (1.0, 0.0)) for task in tasks]
    rows = summary.table(summaries).splitlines()[2:]
    assert [row.split()[:2] for row in rows] == [["seed", name] for name in called]


def test_settings_that_are_not_the_presets_are_named(tmp_path):
    root = tmp_path / "cpu"

    def write(name, cells, environment_steps):
        schedule = dataclasses.replace(preset("cpu").schedule, environment_steps=environment_steps)
        config = dataclasses.replace(preset("cpu"), schedule=schedule)
        write_folder(root, name, cells, lambda cell, task, count: [0.0] * count, config)

    length = preset("cpu").schedule.environment_steps
    write("alone", [grid.baseline("bullet", "Ant", 0)], length)
    assert sheet.size_note(root) == "preset cpu: not comparable in size"
    # An agent for two tasks takes twice the environment steps.
    write("source", [grid.multitask("bullet", ("Hopper", "Ant"), 0)], 60_000)
    write("short", [grid.baseline("bullet", "Hopper", 0)], 30_000)
    expected = "preset cpu, environment_steps 30000: not comparable in size"
    assert sheet.size_note(root) == expected


def test_of_many_changed_settings_the_number_is_told(tmp_path):
    root = tmp_path / "cpu"
    changed = {"environment_steps": 30_000, "evaluate_every": 1000, "checkpoint_every": 5000}
    schedule = dataclasses.replace(preset("cpu").schedule, **changed, updates_per_phase=50)
    config = dataclasses.replace(preset("cpu"), schedule=schedule)
    cells = baselines(SEEDS)
    write_folder(root, "run", cells, lambda cell, task, count: [0.0] * count, config)
    assert sheet.size_note(root) == "preset cpu, 4 settings changed: not comparable in size"
