"""The report: tables and figures beside the published numbers, and the page that holds them all.

The runs are made up; see `made_up_results`.
"""

import base64
import csv
import dataclasses
import html
import re
from collections import namedtuple

import numpy as np
import pytest

from dreamer_jax.config import preset
from dreamer_jax.video import write_video
from envs import SimulatorError
from experiments.cli import thesis
from experiments.reports import comparison, figures, page, publication, summary
from experiments.reports.outcomes import Outcome, read_outcomes
from experiments.thesis import grid
from experiments.thesis.contradictions import CONTRADICTIONS
from experiments.thesis.grid import FIGURES, TABLES
from made_up_results import write_folder

SEEDS = (0, 1)
TARGET = "InvertedPendulum"

# As `experiments.reports.outcomes` gives them.
Share = namedtuple("Share", "threshold scaled task known not_novel correct right_task")
Classification = namedtuple("Classification", "table samples feature_size shares")


def baselines(task=TARGET):
    return [grid.baseline("bullet", task, seed) for seed in SEEDS]


def targets(omegas, count=2, task=TARGET):
    return [
        grid.fractional("bullet", task, count, omega, seed, SEEDS[0])
        for omega in omegas
        for seed in SEEDS
    ]


def rising(cell, task, count):
    """10 more at each evaluation; seed 1 is 10 ahead, and a transfer 100."""
    return 10.0 * (np.arange(count) + cell.seed) + (100 if cell.source else 0)


@pytest.fixture
def root(tmp_path):
    """Four evaluations a run: a baseline, ω = 0 complete, ω = 0.1 with two evaluations each."""
    root = tmp_path / "debug"
    write_folder(root, "scratch", baselines(), rising)
    write_folder(root, "targets", targets([0.0]), rising)
    write_folder(root, "more", targets([0.1]), rising, done=2)
    return root


@pytest.fixture(autouse=True)
def classification(monkeypatch):
    """What latent task classification gives: nothing, unless a test puts tables in here."""
    found = {}
    for module in (page, publication):
        monkeypatch.setattr(
            module,
            "read_classification",
            lambda root, table, seeds=grid.SEEDS: found.get(table.name),
        )
    return found


def entries(root, name="table-7"):
    table = TABLES[name]
    outcomes = read_outcomes(root, grid.shown(table, SEEDS))
    return comparison.compare(table, outcomes, SEEDS)


def records(root, tmp_path, name="table-7"):
    publication.write_table(TABLES[name], root, SEEDS, tmp_path / "out")
    with open(tmp_path / "out" / f"{name}.csv", encoding="utf-8") as file:
        return {(row["target"], row["sources"], row["omega"]): row for row in csv.DictReader(file)}


# --- what is compared -----------------------------------------------------------------------------


def test_overall_takes_all_evaluations_of_all_seeds_and_final_the_last_tenth(root):
    # 0, 10, 20, 30 and 10, 20, 30, 40; their last ones are 30 and 40.
    overall = entries(root, "table-7")[TARGET, None, None]
    final = entries(root, "table-8")[TARGET, None, None]
    assert overall.ours == (20.0, np.sqrt(150)) and overall.scores == (15.0, 25.0)
    assert final.ours == (35.0, 5.0) and final.scores == (30.0, 40.0)


def test_a_transfer_is_compared_with_its_baseline(root):
    entry = entries(root)[TARGET, 2, 0.0]
    assert entry.ours[0] == 120.0 and entry.average.value == 120.0
    assert entry.transfer.difference.value == 100.0 and entry.transfer.verdict == "positive"
    assert entry.transfer.improvement == (1.0, 1.0, 1.0)
    assert entry.transfer.jumpstart == 100.0  # of one evaluation, a twentieth of four or more
    # The baseline's mean curve is 5, 15, 25, 35; nine tenths of the way from 5 to 35 is 32.
    assert entry.threshold == comparison.Threshold(32.0, 40)
    assert entries(root)[TARGET, None, None].threshold == comparison.Threshold(32.0, 160)


def test_an_incomplete_entry_has_counts_and_no_number(root):
    incomplete, missing = (entries(root)[key] for key in ((TARGET, 2, 0.1), (TARGET, 3, 0.0)))
    assert (incomplete.done, incomplete.planned) == (4, 8)
    assert (missing.done, missing.planned) == (0, 8)
    for entry in (incomplete, missing):
        assert not entry.complete and not entry.scores
        assert entry.ours is entry.average is entry.transfer is entry.threshold is None


def test_an_entry_that_lacks_a_seed_is_incomplete(tmp_path):
    root = tmp_path / "debug"
    write_folder(root, "scratch", baselines()[:1], rising)
    entry = entries(root)[TARGET, None, None]
    assert (entry.done, entry.planned, entry.ours) == (4, 8, None)


def test_without_a_complete_baseline_there_is_no_verdict(tmp_path):
    root = tmp_path / "debug"
    write_folder(root, "scratch", baselines(), rising, done=3)
    write_folder(root, "targets", targets([0.0]), rising)
    entry = entries(root)[TARGET, 2, 0.0]
    assert entry.ours[0] == 120.0 and entry.transfer is None
    sheet = publication.read_sheet(TABLES["table-7"], root, SEEDS)
    assert any(row[2] == "baseline incomplete" for row in sheet.statistics)


def test_curves_end_where_the_slowest_run_that_has_begun_is(tmp_path):
    root = tmp_path / "debug"
    one, other = baselines()
    write_folder(root, "one", [one], rising)
    write_folder(root, "other", [other], rising, done=3)
    missing = grid.baseline("bullet", TARGET, 2)
    outcomes = read_outcomes(root, [one, other, missing])
    steps, returns = comparison.curves(list(outcomes.values()), TARGET)
    assert steps.tolist() == [40, 80, 120]
    assert returns.tolist() == [[0, 10, 20], [10, 20, 30]]
    steps, returns = comparison.curves([outcomes[missing]], TARGET)
    assert steps.shape == (0,) and returns.shape == (0, 0)


def test_targets_are_joined_each_on_its_own_scale():
    def group(target, base, transfer):
        def entry(sources, scores):
            outcome = Outcome(baselines()[0], (1,), {}, 1, 1)
            return comparison.Entry(target, sources, None, (outcome,), 1, None, scores)

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
    assert (complete["verdict"], complete["difference"]) == ("positive", "100.0")
    known = {"table", "target", "sources", "omega", "metric", "complete", "evaluations", "planned"}
    known |= {"published_mean", "published_std"}
    assert {name for name, value in incomplete.items() if value} == known
    assert (incomplete["complete"], incomplete["evaluations"]) == ("False", "4")


@pytest.mark.parametrize("name", [name for name, table in TABLES.items() if table.kind != "ltc"])
def test_without_any_run_every_table_shows_the_published_numbers_alone(tmp_path, name):
    sheet = publication.read_sheet(TABLES[name], tmp_path / "thesis", SEEDS)
    boxes = [box for _, row in sheet.rows for box in row if box is not None]
    assert len(boxes) == (24 if TABLES[name].kind == "meta" else 19)
    assert {(box.ours, box.complete) for box in boxes} == {("not run", False)}
    assert all(re.fullmatch(r"\d+ ± \d+\*?", box.published) for box in boxes)
    assert not any("±" in text for row in sheet.statistics for text in row)


def test_copied_deviations_are_marked(tmp_path):
    for name, copies in (("table-8", 6), ("table-7", 0), ("table-2", 0)):
        sheet = publication.read_sheet(TABLES[name], tmp_path / "thesis", SEEDS)
        boxes = [box for _, row in sheet.rows for box in row if box is not None]
        assert sum(box.published.endswith("*") for box in boxes) == copies
        assert any("copied" in note for note in sheet.notes) == bool(copies)


def test_what_is_not_comparable_is_said(root, tmp_path):
    def notes(entry, folder, seeds):
        return " ".join(publication.read_sheet(entry, folder, seeds).notes)

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
    sheet = publication.read_sheet(TABLES["table-16"], root, SEEDS)
    assert sheet.header == ("", "2 Tasks", "3 Tasks", "4 Tasks", "Baseline")
    rows = dict(sheet.rows)
    assert list(rows) == list(TABLES["table-16"].targets)
    assert [str(box) for box in rows["Ant"]] == [
        "not run | 1423 ± 788",
        "120 ± 12 | 1366 ± 687",
        "not run | 1765 ± 764",
        "not run | 1589 ± 771",
    ]


def test_a_single_seed_has_numbers_and_no_verdict(root):
    outcomes = read_outcomes(root, grid.shown(TABLES["table-7"], SEEDS[:1]))
    sheet = publication.returns_sheet(TABLES["table-7"], outcomes, SEEDS[:1], None)
    box = sheet.rows[0][1][0]
    assert box.complete and box.verdict is None
    assert any(row[1:3] == ("100", "no interval") for row in sheet.statistics)


# --- latent task classification -------------------------------------------------------------------


def classified(table):
    shares = tuple(
        Share(threshold, scaled, task, task in table.known, 0.25, 0.75, 0.5)
        for threshold, scaled in ((50.0, 5.0), (70.0, 7.0), (90.0, 9.0), (None, 6.5))
        for task in (*table.targets, *table.known)
    )
    return Classification(table, 100, 23, shares)


def test_a_classification_has_the_thesiss_form(classification, tmp_path):
    table = TABLES["table-15"]
    classification["table-15"] = classified(table)
    text = publication.write_table(table, tmp_path / "cpu", SEEDS, tmp_path / "out")
    sheet = publication.read_sheet(table, tmp_path / "cpu", SEEDS)
    assert sheet.header == ("Threshold", "Ant, novel", "InvertedPendulum, novel", *table.known)
    rows = dict(sheet.rows)
    assert list(rows) == ["50", "70", "90", "suggested: 6.5"]
    assert [str(box) for box in rows["50"][:3]] == [
        "0.75 | 1.00",
        "0.75 | 1.00",
        "0.25/0.50 | 1.00/0.60",
    ]
    assert [str(box) for box in rows["suggested: 6.5"][1:3]] == ["0.75 | -", "0.25/0.50 | -"]
    assert "0.25/0.50 | 1.00/0.60" in text and "scaled by 23 / 230" in text


def test_a_classification_that_has_not_been_made_shows_the_published_shares_alone(tmp_path):
    sheet = publication.read_sheet(TABLES["table-13"], tmp_path / "thesis", SEEDS)
    rows = dict(sheet.rows)
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
    shown = {cell for panel in panels for curve in panel.curves for cell in curve.cells}
    assert shown == set(grid.shown(FIGURES[name], SEEDS))
    assert all(panel.curves[-1].label == "baseline" for panel in panels)


@pytest.mark.parametrize("name", FIGURES)
def test_a_figure_says_what_it_shows(name):
    assert figures.caption(FIGURES[name]).startswith(f"Figure {name.removeprefix('figure-')}: ")


def test_captions_follow_the_grid():
    assert figures.caption(FIGURES["figure-29"]) == (
        "Figure 29: fractional transfer from HalfCheetah, Walker2D, Hopper and InvertedPendulum "
        "to Ant"
    )


def test_learning_curves_are_drawn_with_incomplete_ones_labelled(root, tmp_path):
    figure = dataclasses.replace(FIGURES["figure-21"], omegas=(0.0, 0.1, 0.2))
    paths = publication.write_figure(figure, root, SEEDS, tmp_path / "out")
    assert [path.name for path in paths] == ["figure-21.png", "figure-21.svg"]
    assert paths[0].read_bytes().startswith(b"\x89PNG")
    # The SVG names each text in a comment.
    labels = re.findall(r"<!-- (.*?) -->", paths[1].read_text(encoding="utf-8"))
    assert labels.count("transfer") == 1 and labels.count("baseline") == 3
    assert labels.count("transfer, incomplete: 4 of 8 evaluations") == 1
    assert labels.count("transfer, not run") == 1
    assert any("preset debug: not comparable in size" in label for label in labels)


def test_curves_are_the_mean_over_seeds_with_their_deviation(root):
    from matplotlib.figure import Figure

    outcomes = read_outcomes(root, baselines())
    axis = Figure().subplots()
    curve = figures.Curve("baseline", figures.BASELINE, tuple(baselines()))
    figures._draw_curve(axis, curve, TARGET, list(outcomes.values()))
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


# --- the page -------------------------------------------------------------------------------------

PIXEL = base64.b64decode(
    "iVBORw0KGgoAAAANSUhEUgAAAAEAAAABCAYAAAAfFcSJAAAADUlEQVR42mNk+M9QDwADhgGAWjR9awAAAABJRU5ErkJg"
    "gg=="
)


@pytest.fixture
def drawn(monkeypatch):
    """The figures that a page asks for, drawn as a single pixel."""
    found = []

    def draw(figure, *arguments, **settings):
        stem = next(a for a in arguments if hasattr(a, "with_name"))
        found.append(figure.name)
        path = stem.with_name(stem.name + ".png")
        path.write_bytes(PIXEL)
        return [path]

    monkeypatch.setattr(figures, "draw_curves", draw)
    monkeypatch.setattr(figures, "draw_tasks", draw)
    return found


@pytest.fixture
def text(root, drawn, classification, tmp_path):
    """A page of the made-up results, with a video."""
    classification["table-13"] = classified(TABLES["table-13"])
    frames = np.zeros((3, 16, 16, 3), np.uint8)
    for steps in (40, 160):
        write_video(root / "scratch" / "videos" / f"evaluation_{steps:09d}.mp4", frames)
    path = page.write_page(root, SEEDS, "bullet", tmp_path / "deep" / "index.html")
    assert path == tmp_path / "deep" / "index.html"
    return path.read_text(encoding="utf-8")


def test_a_page_has_every_table_and_figure_and_leads_to_each(text):
    for name in (*TABLES, *FIGURES):
        assert text.count(f'id="{name}"') == 1
        assert f'href="#{name}"' in text
    anchors = set(re.findall(r'id="([^"]+)"', text))
    assert set(re.findall(r'href="#([^"]+)"', text)) <= anchors


def test_a_page_needs_no_other_file(text):
    assert "http" not in re.sub(r"base64,[\w+/=]+", "", text)
    assert all(source.startswith("data:") for source in re.findall(r'src="([^"]{0,9})', text))
    assert all(target.startswith("#") for target in re.findall(r'href="([^"]*)"', text))
    assert not re.search(r"<script|<link|@import|url\(", text)


def test_a_page_shows_both_values_verdicts_in_words_and_counts(text):
    assert '<span class="ours">120 ± 12</span><span class="told">847 ± 135</span>' in text
    assert '<span class="verdict positive">positive</span>' in text
    assert '<span class="ours open">4 of 8 evaluations</span>' in text
    assert "0.25/0.50" in text and "1.00/0.61" in text
    assert "4 are complete, 2 incomplete and" in text
    assert "Preset debug: not comparable in size" in text


def test_a_page_says_where_its_numbers_come_from(text):
    assert "0" * 40 in text and "jax 0.10.2" in text
    row = '<th scope="row">more</th><td>2</td><td>4</td>'
    assert row in text


def test_a_page_lists_the_contradictions(text):
    assert len(CONTRADICTIONS) > 8
    for contradiction in CONTRADICTIONS:
        assert page._text(contradiction.what) in text and page._text(contradiction.choice) in text


def test_a_page_draws_the_figures_of_runs_that_have_begun_and_no_others(text, drawn):
    assert set(drawn) == {
        *("figure-10", "figure-11", "figure-21", "figure-22", "figure-23", "figure-33"),
        *("figure-36", "figure-37", "figure-38", "figure-39"),
    }
    assert re.search(r'id="figure-12"><p class="open">not run</p>', text)


def test_a_page_holds_the_newest_video_of_each_run(text):
    videos = re.findall(r'<video controls preload="metadata" src="data:video/mp4;base64,', text)
    assert len(videos) == 1 and "scratch/videos/evaluation_000000160.mp4" in text


def test_videos_that_do_not_fit_are_left_out_and_named(root, drawn, monkeypatch, tmp_path):
    for name, size in (("scratch", 700), ("targets", 400), ("more", 200)):
        folder = root / name / "videos"
        folder.mkdir()
        (folder / "evaluation_000000040.mp4").write_bytes(bytes(size))
    monkeypatch.setattr(page, "LARGEST_VIDEOS", 1000)
    text = page.write_page(root, SEEDS, "bullet", tmp_path / "index.html").read_text()
    assert text.count("<video") == 2  # in the folders' order: 200, 700, and then no more
    assert re.search(r"Left out, .*: targets/videos/evaluation_000000040.mp4\.</p>", text)


def test_a_page_without_any_run_is_written(drawn, tmp_path):
    path = page.write_page(tmp_path / "thesis", grid.SEEDS, "bullet", tmp_path / "index.html")
    text = path.read_text(encoding="utf-8")
    assert "0 are complete, 0 incomplete" in text and "not comparable" not in text
    assert "No target is complete yet." in text and 'class="verdict' not in text


@pytest.mark.parametrize(
    "error",
    [
        ModuleNotFoundError("pybullet is not installed: pip install 'x[bullet]'"),
        SimulatorError("MUJOCO_GL=egl does not work"),
    ],
)
def test_pictures_of_tasks_without_their_simulator_leave_a_note(
    root, drawn, monkeypatch, tmp_path, error
):
    def refuse(*arguments, **settings):
        raise error

    monkeypatch.setattr(figures, "draw_tasks", refuse)
    text = page.write_page(root, SEEDS, "bullet", tmp_path / "index.html").read_text()
    assert html.escape(str(error)) in text and 'id="figure-10"' in text


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


def test_tables_of_both_simulators_stand_beside_one_another(root, drawn):
    write_folder(root, "other", [grid.baseline("brax", TARGET, 0)], rising)
    for backend in ("bullet", "brax"):
        table = grid.on_backend(TABLES["table-7"], backend)
        thesis._write([table], root, SEEDS, backend)
    for folder, baseline, simulator in [
        ("report", " 20 ± 12 |", "PyBullet"),
        ("report-brax", "4 of 8 evaluations", "Brax"),
    ]:
        text = (root / folder / "table-7.txt").read_text(encoding="utf-8")
        assert baseline in text and ("Ours are on Brax" in text) == (simulator == "Brax")
        assert f"{simulator}, seeds 0, 1" in (root / folder / "index.html").read_text("utf-8")


def test_the_demo_is_a_table_too(tmp_path):
    root = tmp_path / "debug"
    write_folder(root, "all", [*targets(grid.DEMO.omegas), *baselines()], rising)
    text = publication.write_table(grid.DEMO, root, SEEDS, tmp_path / "out")
    assert text.startswith("Demo: InvertedPendulum, overall return")
    assert "120 ± 12 | 856 ± 121" in text


def test_settings_that_are_not_the_presets_are_named(tmp_path):
    root = tmp_path / "cpu"

    def write(name, cells, environment_steps):
        schedule = dataclasses.replace(preset("cpu").schedule, environment_steps=environment_steps)
        config = dataclasses.replace(preset("cpu"), schedule=schedule)
        write_folder(root, name, cells, lambda cell, task, count: [0.0] * count, config)

    length = preset("cpu").schedule.environment_steps
    write("alone", [grid.baseline("bullet", "Ant", 0)], length)
    assert publication.size_note(root) == "preset cpu: not comparable in size"
    # An agent for two tasks takes twice the environment steps.
    write("source", [grid.multitask("bullet", ("Hopper", "Ant"), 0)], 60_000)
    write("short", [grid.baseline("bullet", "Hopper", 0)], 30_000)
    expected = "preset cpu, environment_steps 30000: not comparable in size"
    assert publication.size_note(root) == expected
