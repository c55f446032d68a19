"""What make makes of a run that Ctrl-C ends, with another program in Python's place."""

import os
import shutil
import signal
import subprocess
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
pytestmark = pytest.mark.skipif(shutil.which("make") is None, reason="make is not installed")

PROGRAM = """#!/bin/sh
case "$*" in
  *fail*) exit 7 ;;
esac
trap 'echo saved; exit 130' INT
echo "began $*"
while :; do sleep 0.05; done
"""


@pytest.fixture
def make(tmp_path):
    """The command of a target whose tools are set up already, and whose Python is PROGRAM."""
    venv = tmp_path / "venv"
    (venv / "bin").mkdir(parents=True)
    (venv / "bin" / "python").write_text(PROGRAM)
    (venv / "bin" / "python").chmod(0o755)
    for extras in ("bullet", "bullet+brax+gymnasium"):
        (venv / f".installed-{extras}").touch()
    return lambda *words: ["make", "-C", str(ROOT), f"VENV={venv}", *words]


@pytest.mark.parametrize("target", ["train", "sweep", "demo", "table-3", "figures"])
def test_ctrl_c_that_saves_is_no_error_of_makes(make, target):
    process = subprocess.Popen(
        make(target, "SOURCE=x"),
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        start_new_session=True,
    )
    for line in process.stdout:
        if line.startswith("began"):
            break
    # As a terminal does it: to all processes.
    os.killpg(process.pid, signal.SIGINT)
    output, _ = process.communicate(timeout=30)
    assert "saved" in output
    assert "Error" not in output


def test_other_failures_keep_their_exit_code(make):
    done = subprocess.run(make("train", "ARGS=fail"), capture_output=True, text=True)
    assert done.returncode != 0 and "Error 7" in done.stderr
    assert "--task bullet/inverted_pendulum" in done.stdout
