"""The command line on real PyBullet tasks, at sizes of seconds."""

import contextlib
import io
import json
import os
import random
import re
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from dreamer_jax.logs import read_metrics
from experiments.cli.main import main

pytest.importorskip("pybullet")

ROOT = Path(__file__).parent.parent
TRAIN = ("train", "--task", "bullet/inverted_pendulum", "--preset", "debug", "--seeds", "0", "1")
TRAIN += ("--workers", "1")


def run(*arguments):
    """Runs a command, which is to succeed, and returns what it printed."""
    printed = io.StringIO()
    with contextlib.redirect_stdout(printed):
        assert main([str(word) for word in arguments]) == 0
    return printed.getvalue()


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    directory = tmp_path_factory.mktemp("whole") / "run"
    run(*TRAIN, "--out", directory)
    return directory


def test_a_run_killed_at_a_random_moment_and_resumed_is_the_same_to_the_byte(whole, tmp_path):
    lines = len(read_metrics(whole))
    directory = tmp_path / "run"
    command = [sys.executable, "-m", "experiments", *TRAIN, "--out", str(directory)]
    process = subprocess.Popen(command, cwd=ROOT, stdout=subprocess.DEVNULL)
    wanted, deadline = random.randrange(1, lines - 1), time.monotonic() + 400
    metrics = directory / "metrics.jsonl"
    while process.poll() is None and time.monotonic() < deadline:
        if metrics.exists() and metrics.read_bytes().count(b"\n") >= wanted:
            break
        time.sleep(0.002)
    os.kill(process.pid, signal.SIGKILL)
    process.wait()
    run(*TRAIN, "--out", directory, "--resume")
    assert metrics.read_bytes() == (whole / "metrics.jsonl").read_bytes(), f"killed at {wanted}"


def test_evaluation_prints_a_row_per_agent_and_repeats_itself(whole):
    run("evaluate", whole, "--episodes", "2", "--workers", "1")
    first = json.loads((whole / "evaluation.json").read_text())["episodes"]
    output = run("evaluate", whole, "--episodes", "2", "--video")
    assert json.loads((whole / "evaluation.json").read_text())["episodes"] == first
    assert len(first) == 4
    assert len({row["return"] for row in first}) == 4
    assert "baseline, seed 0, bullet/inverted_pendulum" in output
    assert "prediction_bullet_inverted_pendulum.mp4" in output


def test_a_gymnasium_environment_with_choices_is_trained_on_by_its_id(tmp_path, capsys):
    pytest.importorskip("pygame")
    directory = tmp_path / "cartpole"
    words = ["--task", "gymnasium/CartPole-v1", "--preset", "debug", "--termination"]
    words += ["--action-repeat", "1", "--environment-steps", "80"]
    assert main(["train", *words, "--out", str(directory)]) == 0
    rows = [row for row in read_metrics(directory) if row["kind"] == "evaluation"]
    # A step is worth 1 until the pole has fallen.
    assert len(rows) == 2 and all(row["return"] == row["length"] for row in rows)
    assert all(row["fell"] or row["length"] == 40 for row in rows)
    assert main(["evaluate", str(directory), "--episodes", "1", "--video"]) == 0
    output = capsys.readouterr().out.replace("\n", "")
    assert f"{directory}/videos/evaluate_gymnasium_CartPole-v1.mp4" in output


def test_a_report_says_that_a_run_is_incomplete(whole, tmp_path, capsys):
    shutil.copytree(whole, tmp_path / "cut")
    path = tmp_path / "cut" / "metrics.jsonl"
    rows = path.read_text().splitlines(keepends=True)
    path.write_text("".join(rows[: len(rows) // 2]))
    assert main(["report", str(tmp_path / "cut")]) == 0
    assert "of 8, incomplete" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--task", "bullet/hoper"], "Did you mean bullet/hopper"),
        (["--task", "hopper"], "expected one of bullet/ant"),
        (["--task", "gymnasium/CartPol-v1"], "Did you mean gymnasium/CartPole-v1"),
        (["--task", "bullet/hopper", "gymnasium/CartPole-v1"], "must all be of one kind"),
        (["--preset", "thsis"], "did you mean 'thesis'"),
        (["--seeds", "1", "1"], "a seed is named twice"),
        (["--omega", "0.2"], "add --source DIR"),
        (["--source", "nowhere"], "--omega 0 0.2"),
        (["--source", "nowhere", "--omega", "0.2"], "nowhere holds no run"),
        (["--source", "nowhere", "--omega", "1.2"], "must lie in \\[0, 1\\]"),
        (["--imagination-starts", "11"], "10 posterior states"),
        (["--frozen", "encodr"], "components are encoder"),
    ],
)
def test_bad_input_ends_with_code_2_and_a_way_out(arguments, message, tmp_path, capsys):
    words = ["train", "--preset", "debug", "--out", str(tmp_path / "run")]
    if "--task" not in arguments:
        words += ["--task", "bullet/hopper"]
    try:
        code = main(words + arguments)
    except SystemExit as error:
        code = error.code
    assert code == 2
    captured = capsys.readouterr()
    text = " ".join((captured.out + captured.err).replace("│", " ").split())
    assert re.search(message, text), text
    assert not (tmp_path / "run").exists()


def test_a_source_of_other_sizes_is_refused_naming_both(whole, tmp_path, capsys):
    code = main(
        ["train", "--task", "bullet/hopper", "--preset", "debug", "--head-units", "9"]
        + ["--source", str(whole), "--omega", "0.2", "--out", str(tmp_path / "run")]
    )
    assert code == 2
    assert "head_units: 8 in the source, 9 here" in capsys.readouterr().err


def test_a_source_without_that_member_is_refused(whole, tmp_path, capsys):
    code = main(
        ["train", "--task", "bullet/hopper", "--preset", "debug", "--source-member", "2"]
        + ["--source", str(whole), "--omega", "0.2", "--out", str(tmp_path / "run")]
    )
    assert code == 2
    assert "has members 0 to 1, member 2 was asked for" in capsys.readouterr().err


def test_a_folder_of_another_run_is_refused_with_the_difference(whole, capsys):
    assert main([*TRAIN, "--out", str(whole)]) == 2
    assert "add --resume" in capsys.readouterr().err
    code = main([*TRAIN, "--batch-size", "3", "--out", str(whole), "--resume"])
    assert code == 2
    assert "learning.batch_size: 2 / 3" in capsys.readouterr().err


def test_evaluating_a_folder_without_a_run_is_refused(tmp_path, capsys):
    assert main(["evaluate", str(tmp_path)]) == 2
    assert "holds no run" in capsys.readouterr().err


def test_help_explains_every_setting_with_the_presets_values(capsys):
    with pytest.raises(SystemExit) as exit_:
        main(["train", "--help", "--preset", "debug"])
    assert exit_.value.code == 0
    text = " ".join(capsys.readouterr().out.replace("│", " ").split())
    assert "--batch-size INT B, sequences in a batch. (default: 2)" in text
    assert "in environment steps" in text
