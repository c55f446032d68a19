"""The page that answers first and holds all tables and figures. The runs are made up."""

import base64
import html
import re

import numpy as np
import pytest

from dreamer_jax.video import write_video
from envs import SimulatorError
from experiments.cli import reports
from experiments.reports import figures, findings, folding, page, sheet
from experiments.reports.classification import Classification, Share
from experiments.reports.outcomes import read_outcomes
from experiments.thesis import grid
from experiments.thesis.contradictions import CONTRADICTIONS
from experiments.thesis.grid import FIGURES, TABLES, ReturnsTable
from made_up_results import baselines, rising, targets, write_folder

SEEDS = (0, 1, 2, 3, 4)
TARGET = "InvertedPendulum"
PIXEL = base64.b64decode(
    "iVBORw0KGgoAAAANSUhEUgAAAAEAAAABCAYAAAAfFcSJAAAADUlEQVR42mNk+M9QDwADhgGAWjR9awAAAABJRU5ErkJg"
    "gg=="
)


def make_root(root):
    """Four evaluations a run: five seeds from scratch and of ω = 0, where one failed of ω = 0.1;
    ω = 0.2 was cut."""
    write_folder(root, "scratch", baselines(SEEDS), rising)
    write_folder(root, "targets", targets([0.0], SEEDS), rising)
    write_folder(root, "failed", targets([0.1], SEEDS), rising, failed=[3])
    write_folder(root, "more", targets([0.2], SEEDS[:2]), rising, done=2)
    return root


@pytest.fixture
def root(tmp_path):
    return make_root(tmp_path / "debug")


def classified(table):
    shares = tuple(
        Share(threshold, scaled, task, task in table.known, 0.25, 0.75, 0.5)
        for threshold, scaled in ((50.0, 5.0), (70.0, 7.0), (90.0, 9.0), (None, 6.5))
        for task in table.tasks
    )
    return Classification(table, 100, 23, shares)


def draw_pixels(monkeypatch):
    """Has figures drawn as a single pixel; gives the names of those that are asked for."""
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
def drawn(monkeypatch):
    return draw_pixels(monkeypatch)


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """A page of the made-up results, with a video and a classification, and its figures' names."""
    folder = tmp_path_factory.mktemp("page")
    root, table = make_root(folder / "debug"), TABLES["table-13"]
    frames = np.zeros((3, 16, 16, 3), np.uint8)
    for steps in (40, 160):
        write_video(root / "scratch" / "videos" / f"evaluation_{steps:09d}.mp4", frames)
    with pytest.MonkeyPatch.context() as monkeypatch:
        found = draw_pixels(monkeypatch)
        one = {table.name: classified(table)}
        monkeypatch.setattr(page, "read_classification", lambda root, t, seeds: one.get(t.name))
        path = page.write_page(root, SEEDS, "bullet", folder / "deep" / "index.html")
    assert path == folder / "deep" / "index.html"
    return path.read_text(encoding="utf-8"), found


@pytest.fixture(scope="module")
def text(made):
    return made[0]


def section(text, id):
    return re.search(rf'<section id="{id}">(.*?)</section>', text, re.DOTALL)[1]


# --- at a glance ----------------------------------------------------------------------------------


def test_a_page_answers_first(text):
    answer = section(text, "answers")
    assert text.index('id="answers"') < text.index("<nav>") < text.index('id="tables"')
    # Of ω = 0 both metrics; of ω = 0.1 four seeds are left; ω = 0.2 is not done.
    assert (
        "Fractional transfer: of 4 comparisons with agents from scratch (InvertedPendulum; overall "
        "and final return), 2 are positive, none is negative and none is undecided (2 more have "
        "too few seeds); the best supported is InvertedPendulum, 2 tasks, ω = 0, overall return: "
        "+100 [+77, +123], better in 100% of pairs of runs, 5 seeds." in answer
    )
    assert "meta-models" not in answer
    assert answer.count('<span class="verdict positive">positive</span>') == 2
    assert answer.count("<td>too few seeds</td><td>4 / 5</td>") == 2


def test_a_forest_plot_has_zero_and_the_interval_on_one_scale(root):
    tables = [table for table in TABLES.values() if isinstance(table, ReturnsTable)]
    cells = [cell for table in tables for cell in grid.shown(table, SEEDS)]
    (finding,) = findings.findings(tables, read_outcomes(root, cells), SEEDS)
    part = page._forest("", finding.comparisons["overall"][TARGET])
    row = part["rows"][0]
    left, at, right = float(row["left"]), float(row["at"]), 100 - float(row["right"])
    zero = float(part["zero"])
    assert 0 < zero < left < at < right < 100
    # The distances are those of 0, 77, 100 and 123.
    assert (at - zero) / (right - left) == pytest.approx(100 / 46, rel=0.02)


def test_the_interval_of_few_seeds_does_not_press_the_others_together(root, tmp_path):
    write_folder(root, "wide", targets([0.3], SEEDS[:2]), lambda c, t, n: [9e3 * c.seed] * n)
    tables = [TABLES["table-7"]]
    outcomes = read_outcomes(root, grid.shown(tables[0], SEEDS))
    (finding,) = findings.findings(tables, outcomes, SEEDS)
    extent = findings.scale(finding.comparisons["overall"][TARGET])
    assert extent.high < 12_000 and extent.place(1e9) == 1.0 and extent.place(-1e9) == 0.0


@pytest.mark.parametrize("seeds", [(), (0, 1)])
def test_without_five_seeds_a_sentence_says_that_nothing_can_be_said(tmp_path, drawn, seeds):
    root = tmp_path / "debug"
    write_folder(root, "targets", targets([0.0], (0, 1)), rising)
    if seeds:
        write_folder(root, "scratch", baselines(seeds), rising)
    text = page.write_page(root, (0, 1), "bullet", tmp_path / "index.html").read_text("utf-8")
    told = "nothing can be said yet, for a verdict takes 5 seeds on both sides"
    assert (told if seeds else "no comparison with agents from scratch can be made yet") in text
    assert 'class="verdict' not in text


def test_noise_is_told_as_no_difference(tmp_path, drawn):
    root = tmp_path / "debug"

    def noise(cell, task, count):
        return np.random.default_rng(cell.seed + 10 * bool(cell.source)).normal(size=count)

    write_folder(root, "scratch", baselines(SEEDS), noise)
    write_folder(root, "targets", targets([0.0], SEEDS), noise)
    text = page.write_page(root, SEEDS, "bullet", tmp_path / "index.html").read_text("utf-8")
    assert "Fractional transfer: no difference is seen, none of 2 comparisons" in text
    assert '<span class="verdict undecided">undecided</span>' in text


def test_methods_of_comparison_have_sentences_and_forests_of_their_own(tmp_path, drawn):
    root = tmp_path / "debug"
    tuned = [grid.compared("bullet", TARGET, 2, "fine-tuning", seed, 0) for seed in SEEDS]
    write_folder(root, "scratch", baselines(SEEDS), rising)
    write_folder(root, "tuned", tuned, rising)
    text = page.write_page(root, SEEDS, "bullet", tmp_path / "index.html").read_text("utf-8")
    answer = section(text, "answers")
    assert "Fine-tuning: of 2 comparisons with agents from scratch" in answer
    assert "Fractional transfer" not in answer and "Frozen-source" not in answer
    assert '<th scope="row">2 tasks, fine-tuning</th>' in answer


# --- tables and figures ---------------------------------------------------------------------------


def test_a_page_leads_to_each_table_and_figure_of_which_something_was_run(made):
    text, drawn = made
    shown = {"table-7", "table-8", "table-13", "figure-10", "figure-11", "figure-21", "figure-36"}
    assert set(drawn) == {name for name in shown if name.startswith("figure")}
    for name in (*TABLES, *FIGURES):
        assert text.count(f'id="{name}"') == text.count(f'href="#{name}"') == (name in shown)
    anchors = re.findall(r'id="([^"]+)"', text)
    assert len(set(anchors)) == len(anchors)
    assert set(re.findall(r'href="#([^"]+)"', text)) <= set(anchors)


def test_what_was_not_run_is_one_line(text):
    (line,) = re.findall(r'id="not-run">(.*?)</p>', text)
    assert line == (
        "Not run: tables 1 to 6, 9 to 12, 14 to 17; figures 12 to 20, 22 to 35, 37 to 39."
    )
    assert folding.not_run(["table-1", "table-2", "figure-4"]) == "Not run: tables 1, 2; figures 4."
    assert folding.not_run([]) == ""


def test_rows_and_columns_of_which_nothing_was_run_are_named_below_their_table(text):
    tables = section(text, "tables")
    assert tables.count("Not run: ω 0.3, 0.4, 0.5; 3 Tasks; 4 Tasks.") == 2
    assert tables.count('<th scope="col">2 Tasks</th>') == 2 and "3 Tasks</th>" not in tables
    assert "not run" not in tables


def test_agents_from_scratch_alone_keep_no_row_of_a_table_of_several_targets(tmp_path):
    root = tmp_path / "debug"
    cells = [grid.meta("bullet", "Ant", 3, seed, 0) for seed in SEEDS]
    write_folder(root, "ant", cells, rising)
    write_folder(root, "scratch", baselines(SEEDS), rising)
    shown = folding.folded("table-16", sheet.read_sheet(TABLES["table-16"], root, SEEDS))
    assert [name for name, _ in shown.rows] == ["Ant"]
    assert shown.header == ("", "3 Tasks", "Baseline")
    missing = "HalfCheetah, Hopper, InvertedPendulum, Walker2D, InvertedDoublePendulum"
    assert f"Not run: {missing}; 2 Tasks; 4 Tasks." in shown.notes


def test_a_page_shows_both_values_verdicts_in_words_seeds_and_counts(text):
    box = '<span class="ours">135 ± 18</span><span class="seeds">n = 5</span>'
    assert box + '<span class="told">847 ± 135</span>' in text
    assert '<span class="verdict positive">positive</span></td>' in section(text, "tables")
    assert '<span class="ours open">4 of 8 evaluations</span>' in text
    assert "0.25/0.50" in text and "1.00/0.61" in text
    assert re.search(r"Of \d+ agents 14 are done, 2 cut, 1 failed and \d+ not begun; 64 ", text)
    assert "Preset debug: not comparable in size" in text


def test_agents_that_failed_are_named_at_the_top_and_below_their_table(text):
    name = targets([0.1], SEEDS)[3].name
    head = text[: text.index('id="answers"')]
    assert f"their losses were not finite: {name}." in head
    assert text.count("left out: InvertedPendulum, 2 tasks, ω = 0.1: seed 3.") == 2


# --- the rest -------------------------------------------------------------------------------------


def test_a_page_needs_no_other_file(text):
    assert "http" not in re.sub(r"base64,[\w+/=]+", "", text)
    assert all(source.startswith("data:") for source in re.findall(r'src="([^"]{0,9})', text))
    assert all(target.startswith("#") for target in re.findall(r'href="([^"]*)"', text))
    assert not re.search(r"<script|<link|@import|url\(", text)


def test_what_is_written_on_a_page_is_escaped(root, drawn, tmp_path):
    (root / "scratch").rename(root / "<b>&scratch")
    text = page.write_page(root, SEEDS, "bullet", tmp_path / "index.html").read_text("utf-8")
    assert "&lt;b&gt;&amp;scratch" in text and "<b>" not in text


def test_a_page_says_where_its_numbers_come_from(text):
    assert "0" * 40 in text and "jax 0.10.2" in text
    assert '<th scope="row">more</th><td>2</td><td>4</td>' in text


def test_a_page_lists_the_contradictions(text):
    assert len(CONTRADICTIONS) > 8
    told = html.unescape(section(text, "contradictions"))
    for contradiction in CONTRADICTIONS:
        assert contradiction.what in told and contradiction.choice in told


def test_a_page_holds_the_newest_video_of_each_run_with_a_label_for_each_tile(text):
    videos = section(text, "videos")
    assert videos.count('src="data:video/mp4;base64,') == 1
    assert "scratch: evaluation after 160 steps" in videos
    labels = re.search(r'<div class="labels">(.*?)</div>', videos)[1]
    assert re.findall(r"<span>(.*?)</span>", labels) == [f"baseline, seed {n}" for n in SEEDS]
    lines = re.search(r'<div class="lines" aria-hidden="true">(.*?)</div>', videos)[1]
    assert lines.count("<span>") == 5 and "--columns: 5; --rows: 1" in videos


def test_videos_that_do_not_fit_are_left_out_and_named(root, drawn, monkeypatch, tmp_path):
    for name, size in (("scratch", 700), ("targets", 400), ("more", 200)):
        folder = root / name / "videos"
        folder.mkdir()
        (folder / "evaluation_000000040.mp4").write_bytes(bytes(size))
    monkeypatch.setattr(page, "LARGEST_VIDEOS", 1000)
    text = page.write_page(root, SEEDS, "bullet", tmp_path / "index.html").read_text("utf-8")
    assert text.count("<video") == 2  # in the folders' order: 200, 700, and then no more
    assert re.search(r"Left out, .*: targets/videos/evaluation_000000040.mp4\.</p>", text)


def test_a_page_without_any_run_is_written(drawn, tmp_path):
    path = page.write_page(tmp_path / "thesis", grid.SEEDS, "bullet", tmp_path / "index.html")
    text = path.read_text(encoding="utf-8")
    assert "0 are done, 0 cut" in text and "not comparable" not in text
    assert "No transfer has been run yet." in text and 'class="verdict' not in text
    assert "Not run: tables 1 to 17; figures 12 to 39." in text


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
    text = page.write_page(root, SEEDS, "bullet", tmp_path / "index.html").read_text("utf-8")
    assert str(error) in html.unescape(text) and 'id="figure-10"' in text


def test_reports_of_both_simulators_stand_beside_one_another_with_all_seeds(root, drawn):
    """Two seeds are asked for; the page and the tables show all that there are."""
    write_folder(root, "other", [grid.baseline("brax", TARGET, 0)], rising)
    for backend in ("bullet", "brax"):
        table = grid.on_backend(TABLES["table-7"], backend)
        reports.write_reports([table], root, backend, (0, 1))
    for folder, baseline, simulator, seeds in [
        ("report", " 35 ± 18 |", "PyBullet", "seeds 0, 1, 2, 3, 4"),
        ("report-brax", " 15 ± 11 |", "Brax", "seeds 0, 1"),
    ]:
        text = (root / folder / "table-7.txt").read_text(encoding="utf-8")
        assert baseline in text and ("Ours are on Brax" in text) == (simulator == "Brax")
        assert f"{simulator}, {seeds}." in (root / folder / "index.html").read_text("utf-8")
        assert (root / folder / "results.csv").exists()
    assert (root / "report" / "forest-ftl.png").read_bytes().startswith(b"\x89PNG")
