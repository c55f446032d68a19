"""What make sets up, and what it makes of a run that Ctrl-C ends, another program being Python."""

import importlib.metadata
import os
import re
import shutil
import signal
import subprocess
import tomllib
from pathlib import Path

import pytest
from packaging.requirements import Requirement

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


TARGETS = """setup demo table-3 figure-12 tables figures plan test lint hooks docs train sweep
evaluate report bench bench-accelerator""".split()


def planned(tmp_path, target, **settings):
    """What make would do for a target where nothing is set up."""
    environment = {name: x for name, x in os.environ.items() if name != "ACCELERATOR"}
    words = [f"{name}={value}" for name, value in settings.items()]
    return subprocess.run(
        ["make", "-n", "-C", str(ROOT), f"VENV={tmp_path / 'venv'}", "SOURCE=x", target, *words],
        capture_output=True,
        text=True,
        env=environment,
    )


def extras(done):
    """The sets of extras that pip would be asked for."""
    found = re.findall(r'pip install .*-c constraints.txt -e "\.\[(.*)\]"', done.stdout)
    return [one.split(",") for one in found]


@pytest.mark.parametrize("target", TARGETS)
def test_every_target_sets_up_the_accelerator_that_is_asked_for(tmp_path, target):
    (usual,) = extras(planned(tmp_path, target))
    assert usual and not {"cuda12", "cuda13", "tpu"} & set(usual)
    assert extras(planned(tmp_path, target, ACCELERATOR="cpu")) == [usual]
    for accelerator in ("cuda12", "cuda13", "tpu"):
        found = extras(planned(tmp_path, target, ACCELERATOR=accelerator))
        assert found == [[*usual, accelerator]]


@pytest.mark.parametrize("value", ["cuda11", "", "cuda12 tpu"])
def test_an_unknown_accelerator_is_one_message_that_names_those_there_are(tmp_path, value):
    done = planned(tmp_path, "train", ACCELERATOR=value)
    assert done.returncode != 0 and not done.stdout.count("pip")
    (line,) = done.stderr.splitlines()
    assert f"ACCELERATOR is '{value}': expected one of cpu cuda12 cuda13 tpu" in line


@pytest.mark.parametrize("accelerator", ["cuda12", "cuda13", "tpu"])
def test_an_accelerators_jax_is_that_of_the_constraints(accelerator):
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    (asked,) = map(Requirement, project["optional-dependencies"][accelerator])
    assert (asked.name, asked.extras) == ("jax", {accelerator})
    lines = (ROOT / "constraints.txt").read_text().splitlines()
    pins = dict(line.split("==") for line in lines)
    assert asked.specifier.contains(pins["jax"])
    if importlib.metadata.version("jax") != pins["jax"]:
        pytest.skip("another version of JAX is installed than the constraints name")
    # What JAX itself asks for on the accelerator: everything that is pinned may be had.
    needs = [Requirement(line) for line in importlib.metadata.requires("jax")]
    brings = [
        need
        for need in needs
        if need.marker
        and need.marker.evaluate({"extra": accelerator})
        and not need.marker.evaluate({"extra": ""})
    ]
    assert "jaxlib" in {need.name for need in brings} and len(brings) > 1
    for need in brings:
        assert need.name not in pins or need.specifier.contains(pins[need.name]), need
