"""Tables and figures from the command line on real PyBullet tasks, at sizes of seconds."""

import contextlib
import dataclasses
import io
import json
import shutil

import numpy as np
import pytest
from numpy.testing import assert_array_equal

import envs
from dreamer_jax.files import read_json
from experiments.cli import reports, thesis
from experiments.cli.engines import Execution
from experiments.cli.main import main
from experiments.cli.selection import Sweep
from experiments.reports.classification import read_classification
from experiments.reports.outcomes import read_outcomes
from experiments.runs.agents import load_source
from experiments.runs.folder import folders, latents_folder
from experiments.thesis import grid, jobs, latent_tables, measurement
from experiments.thesis.graph import plan_runs
from experiments.thesis.grid import TABLES, shown
from runs import CONFIG, finish, write_run
from small_agent import Small

pytest.importorskip("pybullet")

SOURCE = "bullet-HalfCheetah+InvertedDoublePendulum-seed-0"
TARGETS = "bullet-InvertedPendulum-fractional"
PART = ["table", "7", "--preset", "debug", "--seeds", "0", "1", "--counts", "2"]
PART += ["--omegas", "0", "0.2", "--workers", "1"]
TABLE = dataclasses.replace(TABLES["table-7"], counts=(2,), omegas=(0.0, 0.2))
META = dataclasses.replace(TABLES["table-16"], targets=("InvertedPendulum",), counts=(2,))
FEW = 30
"""Latent states of each task, of the hundred that are gathered for a table."""


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """The folder of results in which a part of Table 7 was made, its source in a moment."""
    results, trained, printed = tmp_path_factory.mktemp("results"), [], io.StringIO()

    def train(run, root, means):
        trained.append(run.name)
        if run.spec.method.sources:
            return jobs.train(run, root, means)
        finish(run, root)
        write_run(root / run.name, run.spec, keep=True)
        return "finished"

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(jobs, "_train", train)
        with contextlib.redirect_stdout(printed):
            assert main([*PART, "--results", str(results)]) == 0
    assert trained == [SOURCE, TARGETS]
    assert f"run 2 of 2, {TARGETS}" in printed.getvalue()
    assert "Table 7: InvertedPendulum, overall return" in printed.getvalue()
    return results


@pytest.fixture(scope="module")
def root(made):
    return made / "debug"


@pytest.fixture
def written(monkeypatch):
    """The tables and figures that were to be written, which here is only noted."""
    entries = []
    monkeypatch.setattr(reports, "_write", lambda some, *_: entries.extend(some))
    return entries


def metrics(root):
    return {path.parent.name: path.read_bytes() for path in root.glob("*/metrics.jsonl")}


def test_a_table_made_again_repeats_nothing(made, root, written, capsys):
    before = metrics(root)
    assert main([*PART, "--results", str(made)]) == 0
    assert metrics(root) == before
    assert [entry.name for entry in written] == ["table-7"]
    assert "run 1 of" not in capsys.readouterr().out


def test_what_was_transferred_is_written_leaf_by_leaf(root):
    records = json.loads((root / TARGETS / "transfer.json").read_text())
    by_leaf = {record["leaf"]: record for record in records}
    assert by_leaf["reward/out/kernel"]["operation"] == "fraction"
    assert by_leaf["actor/out/kernel"]["operation"] == "keep"
    assert by_leaf["dynamics/action_in/kernel"]["operation"] == "keep"
    copied = by_leaf["encoder/conv_0/kernel"]
    assert copied["norm_after"] == pytest.approx(copied["norm_source"])
    # omega = 0 and 0.2 for two seeds each.
    expected = [0.0, 0.0, 0.2, 0.2]
    assert by_leaf["value/out/bias"]["parameters"]["omega"] == pytest.approx(expected)


def test_runs_say_where_their_sources_are_from_the_folder_of_all(root):
    header = read_json(root / TARGETS / "run.json")
    assert header["spec"]["method"]["sources"] == [SOURCE]
    assert header["revision"] and header["versions"]["jax"]
    assert len(read_json(root / TARGETS / "cells.json")) == 6


def test_a_table_and_a_figure_of_agents_that_are_there_train_nothing(made, root, written):
    before = metrics(root)
    sweep = Sweep("debug", (0, 1), results=made, config=CONFIG)
    figure = dataclasses.replace(grid.FIGURES["figure-36"], tasks=("InvertedPendulum",))
    assert thesis._make([TABLE, figure], sweep, Execution()) == 0
    assert written == [TABLE, figure]
    assert metrics(root) == before
    outcomes = read_outcomes(root, [*shown(TABLE, (0, 1)), *shown(figure, (0, 1))])
    assert {outcome.state for outcome in outcomes.values()} == {"done"}


def test_a_table_of_meta_models_is_made_from_the_agents_it_needs(
    made, written, tmp_path, monkeypatch
):
    root = tmp_path / "debug"
    shutil.copytree(made / "debug", root)
    runs = plan_runs(shown(META, (0, 1)), CONFIG, root)
    *sources, targets = [run for run in runs if run.state == "missing"]
    # Made in a moment: what is begun here, on their models, is the population of targets.
    for seed, run in enumerate(sources):
        spec = run.spec
        if spec.method.sources:
            sources = tuple(str(root / name) for name in spec.method.sources)
            method = dataclasses.replace(spec.method, sources=sources)
            spec = dataclasses.replace(spec, method=method)
        finish(run, root)
        write_run(root / run.name, spec, seed, keep=True)
    begun = []

    def train_in_a_moment(run, ways):
        begun.append(([member.label for member in run.members], run.state.params["reward"]))
        run.close()
        run.env.close()
        finish(targets, root)
        return "finished"

    monkeypatch.setattr(jobs, "carry_out", train_in_a_moment)
    sweep = Sweep("debug", (0, 1), results=tmp_path, config=CONFIG)
    assert thesis._make([META], sweep, Execution()) == 0
    assert len(targets.cells) == 2
    ((labels, reward),) = begun
    assert labels == ["sources=2"] * 2
    assert reward["stored"]["present"].sum(axis=1).tolist() == [2, 2]
    for place, name in enumerate(targets.spec.method.stored):
        stored = load_source(root / name).params["reward"]["out"]["kernel"]
        assert_array_equal(reward["stored"]["params"]["out"]["kernel"][:, place], [stored] * 2)
    outcomes = read_outcomes(root, shown(META, (0, 1)))
    assert {outcome.state for outcome in outcomes.values()} == {"done"}


def test_a_report_of_all_results_is_of_what_there_is_something_of(root, written):
    before = metrics(root)
    assert main(["report", str(root), "--seeds", "0", "1"]) == 0
    # Tables of which a transfer was run, and the figures that have a curve of it, or of baselines.
    names = [entry.name for entry in written]
    assert names == ["table-7", "table-8", "figure-21", "figure-36"]
    assert metrics(root) == before


@pytest.fixture(scope="module")
def classified(tmp_path_factory):
    """Results whose universal autoencoder has not trained, and Table 13 made from it."""
    root = tmp_path_factory.mktemp("latents") / "debug"
    (cell,) = shown(TABLES["table-13"])
    (run,) = plan_runs([cell], CONFIG, root)
    finish(run, root)
    write_run(root / run.name, run.spec, keep=True)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(latent_tables, "SAMPLES", FEW)
        latent_tables.make_table(root, TABLES["table-13"], 0, workers=1)
    return root


def test_latent_states_are_gathered_once_for_three_tables(classified, monkeypatch, written):
    assert latent_tables.SAMPLES == 100
    monkeypatch.setattr(latent_tables, "SAMPLES", FEW)
    monkeypatch.setattr(latent_tables, "gather", None)
    sweep = Sweep("debug", results=classified.parent, config=CONFIG)
    entries = [TABLES[f"table-{number}"] for number in (13, 14, 15)]
    assert thesis._make(entries, sweep, Execution()) == 0
    for entry in entries:
        found = read_classification(classified, entry)
        assert (found.samples, found.feature_size) == (FEW, 12)
        assert len(found.shares) == 4 * 6
        assert (latents_folder(classified, "bullet", 0) / f"{entry.name}.png").exists()


def test_shares_are_those_of_the_tables_with_thresholds_scaled_to_the_features(classified):
    table = TABLES["table-13"]
    shares = read_classification(classified, table).shares
    assert [share.task for share in shares[:6]] == list(table.tasks)
    assert [share.threshold for share in shares[::6]] == [50, 70, 90, None]
    assert [share.scaled for share in shares[::6]][:3] == pytest.approx(
        [xi * 12 / 230 for xi in (50, 70, 90)]
    )
    found = read_json(latents_folder(classified, "bullet", 0) / "table-13.json")
    for share in shares:
        assert share.known == (share.task in table.known)
        (name,) = (task for task in found["distances"] if envs.spec(task).title == share.task)
        near = np.array(found["distances"][name]) <= share.scaled
        assert share.not_novel == pytest.approx(near.mean())
        if not share.known:
            assert share.correct == pytest.approx(1 - near.mean(), abs=1e-6)


def test_a_table_of_latent_states_that_is_not_made_is_none(classified):
    assert read_classification(classified, TABLES["table-13"], seeds=(1,)) is None


def test_damaged_samples_are_named_with_the_way_out(classified, tmp_path):
    shutil.copytree(classified, tmp_path / "debug")
    folder = latents_folder(tmp_path / "debug", "bullet", 0)
    (folder / "table-13.json").unlink()
    (folder / "samples.npz").write_bytes(b"PK")
    with pytest.raises(ValueError, match=r"samples.npz is damaged .*: delete it"):
        latent_tables.make_table(tmp_path / "debug", TABLES["table-13"], 0)


def test_a_plan_shows_runs_and_says_that_it_is_an_estimate(made, monkeypatch, tmp_path, capsys):
    # This machine is measured, by updates that compile in a moment.
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.setattr(measurement, "make_agent", lambda spec: Small(spec.config, 6))
    monkeypatch.setattr(measurement, "UPDATE_SECONDS", 0.02)
    monkeypatch.setattr(measurement, "TICKS", 5)
    words = ["plan", "--table", "7", "--preset", "debug", "--seeds", "0", "1"]
    assert main([*words, "--results", str(made)]) == 0
    output = capsys.readouterr().out
    # Long names are broken after a hyphen.
    lines = [line.strip() for line in output.splitlines()]
    assert "fractional" in lines and "fractional-2" in lines
    assert "cut" not in output and "missing" in output and "done" in output
    assert "An estimate" in output
    (kept,) = (tmp_path / "dreamer-transfer" / "speed").glob("*.json")
    assert 0 < read_json(kept)["speed"]["update_seconds"] < 60
    assert set(folders(made / "debug")) == set(
        read_json(made / "debug" / SOURCE / "cells.json")
        + read_json(made / "debug" / TARGETS / "cells.json")
    )


def test_results_of_another_preset_are_refused_with_the_difference(made, tmp_path, capsys):
    shutil.copytree(made / "debug", tmp_path / "demo")
    words = ["table", "7", "--preset", "demo", "--results", str(tmp_path)]
    assert main(words) == 2
    assert "learning.batch_size: 2 / 8" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["table", "18"], "unknown table '18': choose from 1 to 17, or all"),
        (["figure", "9"], "unknown figure '9': choose from 10 to 39, or all"),
        (["table"], "no table named: choose from 1 to 17"),
        (
            ["table", "3", "--preset", "thsis"],
            "unknown preset 'thsis' (did you mean 'thesis'?); the presets are thesis, cpu",
        ),
        (["table", "3", "--backend", "mujoco"], "Expected one of ('bullet', 'brax')"),
        (["table", "3", "--seeds", "1", "1"], "each named once"),
        (["plan"], "add --table 3"),
    ],
)
def test_bad_input_ends_with_code_2_and_the_choices(arguments, message, tmp_path, capsys):
    try:
        code = main([*arguments, "--results", str(tmp_path / "results")])
    except SystemExit as error:
        code = error.code
    assert code == 2
    captured = capsys.readouterr()
    assert message in " ".join((captured.out + captured.err).replace("│", " ").split())
    assert not (tmp_path / "results").exists()
