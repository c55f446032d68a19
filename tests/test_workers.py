"""Several processes under one folder of results: what they plan, claim, wait for and leave."""

import dataclasses
import functools
import json
import os
import pickle
import shutil
import socket
import threading
import time

import pytest

from experiments.cli.main import main
from experiments.reports.outcomes import read_outcomes
from experiments.runs.folder import begun, folders
from experiments.thesis import jobs
from experiments.thesis.engines.local import one_by_one
from experiments.thesis.graph import plan_runs
from experiments.thesis.grid import TABLES, shown
from experiments.thesis.jobs import Job, perform
from experiments.thesis.reservations import claim, planned, reservations
from experiments.thesis.sweep import carry_out_runs, work
from runs import CONFIG, Trainer, finish

SMALL = dataclasses.replace(TABLES["table-3"], counts=(2, 3), omegas=(0.1,))
TARGETS = "bullet-Hopper-fractional"
SOURCES = ("bullet-HalfCheetah+Walker2D-seed-0", "bullet-HalfCheetah+Walker2D+Ant-seed-0")


def cells_of(seeds=(0, 1), entry=SMALL):
    return shown(entry, seeds)


def plan(root, seeds=(0, 1), config=CONFIG):
    return planned(cells_of(seeds), config, root)


def names(runs):
    return {run.name: set(run.cells) for run in runs}


# --- plans -------------------------------------------------------------------------------------


def test_while_somebody_is_at_work_nobody_puts_the_same_agent_into_another_run(tmp_path):
    with plan(tmp_path) as first, plan(tmp_path, seeds=(0, 1, 2)) as second:
        assert set(names(first)) == {*SOURCES, TARGETS}
        more = dict(names(second))
        assert all(more.pop(name) == cells for name, cells in names(first).items())
        (added,) = more
        assert added == f"{TARGETS}-2" and all("seed=2" in cell for cell in more[added])
        cells = [cell for run in second for cell in run.cells]
        assert len(cells) == len(set(cells))


def test_what_nobody_is_at_work_on_and_has_not_begun_may_be_planned_anew(tmp_path):
    with plan(tmp_path) as first:
        finish(first[0], tmp_path)
        assert set(reservations(tmp_path)) == set(names(first))
    with plan(tmp_path, seeds=(0, 1, 2)) as second:
        assert {run.name for run in second if run.state == "missing"} == {SOURCES[1], TARGETS}
        assert len(names(second)[TARGETS]) == 9


def test_other_settings_than_somebody_at_work_has_planned_are_refused_with_both(tmp_path):
    other = dataclasses.replace(CONFIG, learning=dataclasses.replace(CONFIG.learning, batch_size=3))
    with plan(tmp_path):
        with pytest.raises(ValueError, match="there / here: learning.batch_size: 2 / 3"):
            with plan(tmp_path, config=other):
                pass
    with plan(tmp_path, config=other) as runs:
        assert runs[-1].spec.config == other


def test_a_plan_of_what_is_done_writes_nothing(tmp_path):
    with plan(tmp_path) as runs:
        for run in runs:
            finish(run, tmp_path)
    shutil.rmtree(tmp_path / ".work")
    with plan(tmp_path) as runs:
        assert {run.state for run in runs} == {"done"}
    assert not (tmp_path / ".work").exists()


def test_a_plan_that_is_damaged_is_warned_of_and_left_out(tmp_path):
    with plan(tmp_path):
        path = tmp_path / ".work" / f"{TARGETS}.json"
        path.write_text(path.read_text().replace("0.1", "0.2"))
        with pytest.warns(UserWarning, match="its checksum differs"):
            assert set(reservations(tmp_path)) == set(SOURCES)


# --- jobs --------------------------------------------------------------------------------------


def test_a_job_travels_and_what_it_is_stands_in_the_plan(tmp_path):
    trainer = Trainer()
    with plan(tmp_path):
        job = pickle.loads(pickle.dumps(Job(tmp_path, SOURCES[0])))
        assert perform(job, train=trainer).kind == "finished"
    assert trainer.trained == [SOURCES[0]]
    assert set(folders(tmp_path).values()) == {(tmp_path / SOURCES[0], 0)}


def test_a_job_whose_needs_are_not_done_is_skipped_naming_them(tmp_path):
    trainer = Trainer()
    with plan(tmp_path) as runs:
        finish(runs[0], tmp_path)
        finish(runs[1], tmp_path, share=0.5)
        ending = perform(Job(tmp_path, TARGETS), train=trainer)
    assert (ending.kind, ending.message) == ("skipped", f"it needs {SOURCES[1]}")
    assert trainer.trained == [] and not begun(tmp_path / TARGETS)


def test_a_job_that_is_done_already_is_not_done_again(tmp_path):
    trainer = Trainer()
    with plan(tmp_path):
        kinds = [perform(Job(tmp_path, SOURCES[0]), train=trainer).kind for _ in range(2)]
    assert kinds == ["finished", "there"] and trainer.trained == [SOURCES[0]]


def test_a_job_of_a_run_that_nobody_plans_any_more_fails_and_leaves_no_folder(tmp_path):
    ending = perform(Job(tmp_path, TARGETS), train=Trainer())
    assert ending.kind == "failed" and "planned no more" in ending.message
    assert not (tmp_path / TARGETS).exists()


def test_a_job_that_was_cut_goes_on_as_it_is_found(tmp_path):
    found = []
    with plan(tmp_path) as runs:
        finish(runs[0], tmp_path, share=0.5)
    ending = perform(Job(tmp_path, SOURCES[0]), train=Trainer(), begins=found.append)
    assert ending.kind == "finished"
    assert (found[0].state, found[0].progress) == ("cut", 0.5)


def test_a_run_that_is_claimed_is_busy_and_says_by_whom(tmp_path):
    holder = f"process {os.getpid()} on {socket.gethostname()}, since 20"
    with plan(tmp_path), claim(tmp_path, SOURCES[0]):
        endings = [perform(Job(tmp_path, name), train=Trainer()) for name in (SOURCES[0], TARGETS)]
    for ending in endings:  # also what needs it: it may be there in a moment
        assert ending.kind == "busy"
        assert ending.message.startswith(f"{SOURCES[0]} is trained by {holder}")


def test_a_job_may_wait_for_the_process_that_has_claimed_its_run(tmp_path, monkeypatch):
    said = []
    with plan(tmp_path):
        claimed = claim(tmp_path, SOURCES[0])
        monkeypatch.setattr(jobs.time, "sleep", lambda _: claimed.release())
        trainer = Trainer()
        ending = perform(Job(tmp_path, SOURCES[0]), train=trainer, wait=True, say=said.append)
    assert ending.kind == "finished" and trainer.trained == [SOURCES[0]]
    (line,) = said
    assert line.startswith(f"waiting: {SOURCES[0]} is trained by process {os.getpid()}")


# --- workers -----------------------------------------------------------------------------------


def test_workers_share_what_is_planned_and_train_each_run_once_after_its_needs(tmp_path):
    trained, done = [], []

    def train(run, root, means):
        trained.append(run.name)
        assert all(name in done for name in run.needs)
        time.sleep(0.05)
        finish(run, root)
        done.append(run.name)
        return "finished"

    def run():
        progress.append(work(tmp_path, train=train, say=lambda _: None, poll=0.01))

    progress = []
    with plan(tmp_path) as runs:
        threads = [threading.Thread(target=run) for _ in range(3)]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
    assert sorted(trained) == sorted(names(runs))
    assert all(one.complete for one in progress) and len(progress) == 3
    with plan(tmp_path) as runs:
        assert {run.state for run in runs} == {"done"}


def test_a_worker_goes_on_with_what_a_command_that_is_gone_has_planned_and_begun(tmp_path):
    with plan(tmp_path) as runs:
        trainer = Trainer(stop_at=SOURCES[1])
        engine = functools.partial(one_by_one, train=trainer)
        assert carry_out_runs(runs, tmp_path, engine=engine, say=lambda _: None).stopped
    trainer, said = Trainer(), []
    progress = work(tmp_path, train=trainer, say=said.append)
    assert progress.complete and progress.finished == [SOURCES[1], TARGETS]
    assert "goes on at 67%" in said[0] and "begins" in said[1]


def test_a_worker_ends_when_all_that_is_left_needs_what_failed(tmp_path):
    with plan(tmp_path):
        failing = {SOURCES[0]: jobs.SimulatorError("the contact solver diverged")}
        progress = work(tmp_path, train=Trainer(failing), say=lambda _: None)
    assert progress.finished == [SOURCES[1]]
    assert "the contact solver diverged" in progress.failed[SOURCES[0]]
    assert progress.skipped == {TARGETS: f"it needs {SOURCES[0]}"}


def test_a_worker_leaves_copies_of_agents_that_are_there_as_they_are(tmp_path):
    with plan(tmp_path) as runs:
        for run in runs:
            finish(run, tmp_path)
        finish(dataclasses.replace(runs[0], name="copy"), tmp_path, share=0.5)
    trainer = Trainer()
    assert work(tmp_path, train=trainer, say=lambda _: None).complete and trainer.trained == []


WALKERS = dataclasses.replace(TABLES["table-5"], counts=(2, 3), omegas=(0.1,))
HERE = cells_of((0, 1))


@pytest.mark.parametrize(
    ("there", "suffix"),
    [
        # Of other targets: a source that both have is copied once, if at all.
        (cells_of((0, 1), WALKERS), ""),
        # Of other seeds, in runs of the same names: copied under others, which nothing reads.
        (cells_of((0, 2)), "-there"),
    ],
)
def test_folders_made_apart_are_merged_by_copying(tmp_path, there, suffix):
    for folder, cells in (("here", HERE), ("there", there), ("whole", [*HERE, *there])):
        with planned(cells, CONFIG, tmp_path / folder) as runs:
            for run in runs:
                finish(run, tmp_path / folder)
    for path in sorted((tmp_path / "there").glob("bullet-*")):
        copy = tmp_path / "here" / f"{path.name}{suffix}"
        if not copy.exists():
            shutil.copytree(path, copy)
    with planned([*HERE, *there], CONFIG, tmp_path / "here") as runs:
        assert {run.state for run in runs} == {"done"}
    merged, whole = (
        read_outcomes(tmp_path / folder, [*HERE, *there]) for folder in ("here", "whole")
    )
    assert {cell.name for cell in merged} == {cell.name for cell in whole}
    assert {outcome.state for outcome in merged.values()} == {"done"}


# --- commands ----------------------------------------------------------------------------------

PART = ["--preset", "debug", "--seeds", "0", "--counts", "2", "--omegas", "0.1"]


@pytest.fixture
def trainer(monkeypatch):
    """Trains in a moment what commands train."""
    trainer = Trainer()
    monkeypatch.setattr(jobs, "_train", lambda run, root, workers, **_: trainer(run, root, workers))
    return trainer


def test_a_sweep_trains_what_tables_and_figures_need_and_reports_nothing(tmp_path, trainer, capsys):
    words = ["sweep", "--table", "3", "--figure", "12", *PART, "--results", str(tmp_path)]
    assert main(words) == 0
    assert SOURCES[0] in trainer.trained and TARGETS in trainer.trained
    assert not (tmp_path / "debug" / "report").exists()
    assert main(words) == 0
    assert len(trainer.trained) == len(set(trainer.trained))


def test_one_run_of_a_table_alone_is_trained_if_what_it_needs_is_there(tmp_path, trainer, capsys):
    words = ["table", "3", *PART, "--results", str(tmp_path), "--run"]
    assert main([*words, TARGETS]) == 1
    assert f"skipped: {TARGETS}: it needs {SOURCES[0]}" in capsys.readouterr().err
    assert main([*words, "hopper"]) == 2
    assert f"no run 'hopper' in this plan; its runs are {SOURCES[0]}" in capsys.readouterr().err
    assert main([*words, SOURCES[0]]) == 0
    assert main([*words, TARGETS]) == 0
    assert trainer.trained == [SOURCES[0], TARGETS]


def test_a_worker_that_finds_nothing_says_so(tmp_path, trainer, capsys):
    assert main(["work", str(tmp_path / "nowhere")]) == 2
    assert "table, figure or sweep make it" in capsys.readouterr().err
    assert main(["work", str(tmp_path)]) == 0
    assert "0 runs were trained here; nothing is left to do" in capsys.readouterr().out


def test_the_graph_of_a_plan_is_told_as_json(tmp_path, monkeypatch, capsys):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    root = tmp_path / "debug"
    assert main(["plan", "--table", "3", *PART, "--results", str(tmp_path), "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    expected = plan_runs(cells_of((0,), dataclasses.replace(SMALL, counts=(2,))), CONFIG, root)
    assert told["root"] == str(root)
    assert [(run["name"], tuple(run["needs"]), tuple(run["cells"])) for run in told["runs"]] == [
        (run.name, run.needs, run.cells) for run in expected
    ]
    assert {run["state"] for run in told["runs"]} == {"missing"}
    assert {run["seconds"] for run in told["runs"]} == {None}
