"""Engines: each gets jobs with their needs, and tells how they end. What trains for long on them is
in tests/engines."""

import dataclasses
import sys

import pytest

from experiments.cli.main import main
from experiments.thesis import estimate, jobs
from experiments.thesis.engines import Resources, Task, demands, on_ray, on_slurm
from experiments.thesis.engines.on_slurm import Perform, levels, slurm_engine
from experiments.thesis.graph import plan_runs
from experiments.thesis.grid import TABLES, shown
from experiments.thesis.jobs import Job
from experiments.thesis.reservations import planned
from experiments.thesis.sweep import carry_out_runs
from runs import CONFIG, Trainer, finish

try:  # here, as it closes all streams of logging when it is imported
    import submitit
except ModuleNotFoundError:
    submitit = None

with_submitit = pytest.mark.skipif(submitit is None, reason="submitit is not installed")
SMALL = dataclasses.replace(TABLES["table-3"], counts=(2, 3), omegas=(0.1,))
CELLS = shown(SMALL, (0, 1))
PART = ["--preset", "debug", "--seeds", "0", "--counts", "2", "--omegas", "0.1"]


def runs_of(cells):
    return plan_runs(cells, CONFIG, "nowhere")


def tasks_of(root, runs):
    return [Task(Job(root, run.name), run, run.needs) for run in runs]


def test_levels_of_a_graph_hold_what_needs_only_those_before():
    meta = shown(dataclasses.replace(TABLES["table-16"], targets=("Hopper",), counts=(2,)), (0,))
    tasks = tasks_of("nowhere", runs_of(meta))
    found = levels(tasks)
    # The autoencoder's agent; agents on it, and those from scratch; targets that read theirs.
    assert [len(level) for level in found] == [2, 2, 1]
    seen = set()
    for level in found:
        assert all(seen.issuperset(task.needs) for task in level)
        seen |= {task.name for task in level}
    assert seen == {task.name for task in tasks}


# --- what runs get -------------------------------------------------------------------------------


def test_what_is_asked_for_goes_before_what_is_estimated(tmp_path, monkeypatch):
    (tmp_path / "measured.json").write_text("{}")
    runs = runs_of(CELLS)
    one = estimate.Estimate(seconds=7200.0, memory=2**30, disk=0)
    known = {run.name: one for run in runs[:1]}

    class Here:
        """Calls in this process what others call in one of their own."""

        def __init__(self, *_, **__):
            pass

        def __enter__(self):
            return self

        def __exit__(self, *_):
            pass

        def submit(self, call, *arguments):
            self.result = lambda: known
            return self

    monkeypatch.setattr(demands, "ProcessPoolExecutor", Here)
    asked = Resources(cpus=3, hours=1.0)
    demand = demands.demands(runs, asked, tmp_path)
    assert demand(runs[0]) == dataclasses.replace(asked, memory=demands.PROGRAM_GIB + 1.0)
    assert demand(runs[1]) == asked
    demand = demands.demands(runs, Resources(memory=5.0), tmp_path)
    assert demand(runs[0]) == Resources(memory=5.0, hours=estimate.SLACK * 2.0)


def test_where_nothing_was_measured_nothing_is_estimated(tmp_path):
    asked = Resources(gpus=1.0)
    assert demands.demands(runs_of(CELLS), asked, tmp_path)(runs_of(CELLS)[0]) == asked


# --- options -------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--gpus", "1"], "--gpus is for --executor ray or slurm"),
        (["--hours", "3", "--executor", "ray"], "--hours is for --executor slurm"),
        (["--slurm", "partition=gpu"], "--slurm is for --executor slurm"),
        (["--cpus", "0", "--executor", "ray"], "cpus is 0, must be positive"),
        (["--memory", "-1", "--executor", "ray"], "memory is -1"),
        (["--executor", "cloud"], "invalid choice 'cloud'"),
    ],
)
def test_options_of_another_engine_and_out_of_range_are_refused(options, message, tmp_path, capsys):
    try:
        code = main(["table", "3", *PART, *options, "--results", str(tmp_path / "results")])
    except SystemExit as error:
        code = error.code
    assert code == 2
    told = capsys.readouterr()
    assert message in " ".join((told.out + told.err).split())
    assert not (tmp_path / "results").exists()


@pytest.mark.parametrize(
    ("executor", "module", "extra"), [("ray", "ray", "ray"), ("slurm", "submitit", "slurm")]
)
def test_an_engine_that_is_not_installed_is_told_with_what_installs_it(
    executor, module, extra, tmp_path, monkeypatch, capsys
):
    monkeypatch.setitem(sys.modules, module, None)
    words = ["table", "3", *PART, "--executor", executor, "--results", str(tmp_path / "results")]
    assert main(words) == 2
    assert f"pip install 'dreamer-transfer[{extra}]'" in capsys.readouterr().err
    assert not (tmp_path / "results").exists()


# --- Slurm ---------------------------------------------------------------------------------------


@with_submitit
def test_a_queue_without_slurm_is_refused_naming_the_way_to_try(tmp_path, capsys, monkeypatch):
    monkeypatch.setenv("PATH", "")
    words = ["table", "3", *PART, "--executor", "slurm", "--results", str(tmp_path / "results")]
    assert main(words) == 2
    assert "--slurm cluster=local tries it without" in capsys.readouterr().err


@with_submitit
@pytest.mark.parametrize(
    ("option", "message"),
    [
        ("partition", "'partition' is no option of a job: expected NAME=VALUE"),
        ("color=red", "Unknown argument 'color'"),
        ("dependency=afterok:1", "this program's to say"),
    ],
)
def test_an_option_that_slurm_does_not_know_is_refused(option, message):
    with pytest.raises(ValueError, match=message):
        slurm_engine([option, "cluster=debug"])


@with_submitit
def test_a_job_that_is_interrupted_is_submitted_again_as_it_was(tmp_path):
    job = Job(tmp_path, "run")
    again = Perform().checkpoint(job)
    assert isinstance(again, submitit.helpers.DelayedSubmission)
    assert isinstance(again.function, Perform) and again.args == (job,)


@with_submitit
def test_a_graph_is_submitted_level_by_level_each_after_the_one_before(tmp_path, monkeypatch):
    """What submitit is told, with its commands to Slurm replaced."""
    scripts = []

    def sbatch(self, command):
        scripts.append(self._make_submission_file_text(command, "id"))
        return submitit.SlurmJob(self.folder, str(100 + len(scripts)), tasks=[0])

    monkeypatch.setattr(submitit.SlurmExecutor, "affinity", classmethod(lambda cls: 2))
    monkeypatch.setattr(submitit.SlurmExecutor, "_submit_command", sbatch)
    monkeypatch.setattr(submitit.SlurmJob, "done", lambda self: True)
    endings = iter(range(9))
    monkeypatch.setattr(
        on_slurm, "_ending", lambda name, job: jobs.Ending(name, "finished", str(next(endings)))
    )
    with planned(CELLS, CONFIG, tmp_path) as runs:
        progress = carry_out_runs(
            runs,
            tmp_path,
            engine=slurm_engine(["partition=gpu", "account=ours"]),
            resources=lambda run: Resources(1.0, 4, 10.5, 2.0),
            say=lambda _: None,
        )
    assert progress.finished == [run.name for run in runs]
    sources, targets = scripts
    for line in ("--partition=gpu", "--account=ours", "--gpus-per-node=1", "--cpus-per-task=4"):
        assert f"#SBATCH {line}\n" in sources and f"#SBATCH {line}\n" in targets
    assert "#SBATCH --mem=11GB\n" in sources and "#SBATCH --time=120\n" in sources
    assert "#SBATCH --array=0-1%2\n" in sources and "--dependency" not in sources
    assert "#SBATCH --dependency=afterany:101\n" in targets and "--array" not in targets


@with_submitit
def test_ctrl_c_leaves_the_jobs_in_the_queue_and_says_how_to_cancel_them(tmp_path, monkeypatch):
    said = []

    def interrupted(seconds):
        raise KeyboardInterrupt

    monkeypatch.setattr(submitit.SlurmExecutor, "affinity", classmethod(lambda cls: 2))
    monkeypatch.setattr(
        submitit.SlurmExecutor,
        "_submit_command",
        lambda self, _: submitit.SlurmJob(self.folder, "7", tasks=[0]),
    )
    monkeypatch.setattr(submitit.SlurmJob, "done", lambda self: False)
    monkeypatch.setattr(on_slurm.time, "sleep", interrupted)
    with planned(CELLS, CONFIG, tmp_path) as runs:
        progress = carry_out_runs(runs, tmp_path, engine=slurm_engine(), say=said.append)
    assert progress.stopped and progress.left and not progress.finished
    assert said[-1] == "the jobs go on without this command; to cancel them: scancel 7"


@with_submitit
def test_jobs_in_this_process_train_what_they_are_given_in_order(tmp_path, monkeypatch):
    trainer = Trainer()
    monkeypatch.setattr(jobs, "_train", lambda run, root, workers, **_: trainer(run, root, workers))
    # What a process of its own settles for itself.
    monkeypatch.setattr(on_slurm.signal, "signal", lambda *_: None)
    monkeypatch.setattr(jobs, "keep_freed_memory", lambda: None)
    with planned(CELLS, CONFIG, tmp_path) as runs:
        engine = slurm_engine(["cluster=debug"])
        progress = carry_out_runs(runs, tmp_path, engine=engine, say=lambda _: None)
    assert progress.complete
    assert trainer.trained == [run.name for run in runs]


@with_submitit
def test_jobs_in_processes_of_their_own_tell_their_endings(tmp_path, monkeypatch):
    monkeypatch.setattr(on_slurm, "POLL_SECONDS", 0.5)
    elsewhere(tmp_path, slurm_engine(["cluster=local"]))


# --- Ray -----------------------------------------------------------------------------------------


def test_tasks_on_ray_tell_their_endings(tmp_path, monkeypatch):
    """Ray's own processes: half a minute."""
    ray = pytest.importorskip("ray")
    monkeypatch.setenv("RAY_USAGE_STATS_ENABLED", "0")
    ray.init(num_cpus=2, include_dashboard=False, logging_level="error")
    try:
        elsewhere(tmp_path, on_ray.on_ray)
    finally:
        ray.shutdown()


def elsewhere(root, engine):
    """What becomes of a run that another process has finished since it was planned, of one that
    cannot begin, and of one that needs both, where others train them."""
    said = []
    with planned(CELLS, CONFIG, root) as runs:
        there, broken, targets = runs
        finish(there, root)
        # A file in the way of its folder.
        (root / broken.name).write_text("")
        progress = carry_out_runs(runs, root, engine=engine, say=said.append)
    assert progress.shared == [there.name]
    assert list(progress.failed) == [broken.name]
    assert "is, or lies in, a file" in progress.failed[broken.name]
    assert progress.skipped == {targets.name: f"it needs {broken.name}"}
