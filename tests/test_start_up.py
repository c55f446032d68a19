"""What the command line does before it imports what takes long: help, typos, files of settings."""

import json
import os
import resource
import subprocess
import sys
from pathlib import Path

import pytest

from dreamer_jax import config as configs
from experiments.cli.main import COMMANDS, main
from experiments.cli.options import read_base
from experiments.methods.fractional import FractionalTransfer
from experiments.runs.spec import RunSpec
from runs import spec_of

ROOT = Path(__file__).parent.parent


def cpu_seconds(*arguments, folder=ROOT, code=0):
    """User time of a command in a process of its own, and what it printed."""
    before = resource.getrusage(resource.RUSAGE_CHILDREN).ru_utime
    done = subprocess.run(
        [sys.executable, "-m", "experiments", *arguments],
        cwd=folder,
        env=os.environ | {"PYTHONPATH": str(ROOT)},
        capture_output=True,
        text=True,
        timeout=60,
    )
    assert done.returncode == code, done.stdout + done.stderr
    after = resource.getrusage(resource.RUSAGE_CHILDREN).ru_utime
    return after - before, done.stdout + done.stderr


HEAVY = ("jax", "flax", "PIL", "yaml", "matplotlib", "envs.pool", "dreamer_jax.training")
"""What no answer to bad input needs."""
OF_TASKS = ("envs", "gymnasium", "numpy")
"""What only those need that look at names of tasks."""


@pytest.mark.parametrize(
    ("arguments", "code", "expected"),
    [
        (["--help"], 0, "usage: python -m experiments COMMAND"),
        (["trian"], 2, "no command 'trian' (did you mean 'train'?)"),
        (["train", "--help"], 0, "config.network options"),
        (["train", "--omeega", "1"], 2, "--omeega"),
        (["train", "--preset", "cpuu", "--help"], 2, "did you mean 'cpu'"),
        (["train", "--task", "bullet/hoper", "--out", "x"], 2, "Did you mean bullet/hopper"),
        (["table", "99"], 2, "unknown table '99': choose from 1 to 17"),
    ],
)
def test_help_and_typos_import_nothing_that_takes_long(arguments, code, expected):
    """Less than half a second; of what is measured here a part is the machine's other work."""
    seconds, output = cpu_seconds(*arguments, code=code)
    assert expected in output
    assert seconds < 1.0
    names = HEAVY if "--task" in arguments else HEAVY + OF_TASKS
    check = (
        "import sys\nfrom experiments.cli.main import main\n"
        f"try: main({arguments!r})\nexcept SystemExit: pass\n"
        f"print('imported:', *(name for name in {names!r} if name in sys.modules))"
    )
    done = subprocess.run([sys.executable, "-c", check], cwd=ROOT, text=True, capture_output=True)
    assert done.stdout.splitlines()[-1].strip() == "imported:", done.stdout + done.stderr


def test_a_folder_that_hides_a_package_of_this_program_is_told(tmp_path):
    (tmp_path / "envs").mkdir()
    (tmp_path / "envs" / "__init__.py").touch()
    _, output = cpu_seconds("--help", folder=tmp_path, code=2)
    assert f"envs ({tmp_path}/envs/__init__.py)" in output
    assert "dreamer-transfer" in output
    # The console script does not look in the working folder.
    script = "import sys\nfrom experiments.cli.main import console\nsys.argv = ['x', '--help']\n"
    done = subprocess.run(
        [sys.executable, "-P", "-c", script + "console()"],
        cwd=tmp_path,
        env=os.environ | {"PYTHONPATH": str(ROOT)},
        capture_output=True,
        text=True,
    )
    assert "usage: dreamer-transfer COMMAND" in done.stdout


@pytest.mark.parametrize("command", COMMANDS)
def test_every_command_has_help(command, capsys):
    with pytest.raises(SystemExit) as exit_:
        main([command, "--help"])
    assert exit_.value.code == 0
    assert f"python -m experiments {command}" in capsys.readouterr().out


@pytest.fixture
def asked(monkeypatch):
    """The specs of the runs that were asked for, which here are not begun."""
    specs = []
    monkeypatch.setattr("experiments.runs.run.make_run", lambda spec, out, **_: specs.append(spec))
    monkeypatch.setattr("experiments.runs.run.carry_out", lambda run: "stopped")
    monkeypatch.setattr("experiments.runs.trust.check_trust", lambda *_: None)
    monkeypatch.setattr("pathlib.Path.read_text", read_text)
    return specs


_read_text = Path.read_text


def read_text(path, *arguments, **keywords):
    return "" if path.name == "transfer.txt" else _read_text(path, *arguments, **keywords)


FILE = """
tasks: bullet/hopper
seeds: [3, 4]
preset: debug
config:
  learning: {batch_size: 3, actor_learning_rate: 1e-4}
method:
  name: fractional
  sources: a
  omegas: [0.0, 0.2]
"""


def test_options_by_name_are_over_the_file_and_the_file_over_the_preset(tmp_path, asked):
    (tmp_path / "settings.yaml").write_text(FILE)
    words = ["train", "--config", str(tmp_path / "settings.yaml"), "--out", "nowhere"]
    assert main(words) == 130
    assert main([*words, "--batch-size", "4", "--omega", "0.5", "--preset=debug"]) == 130
    first, second = asked
    assert first.tasks == ("bullet/hopper",) and first.seeds == (3, 4)
    assert first.method == FractionalTransfer(sources=("a",), omegas=(0.0, 0.2))
    assert first.config.learning.batch_size == 3
    assert first.config.learning.actor_learning_rate == 1e-4
    assert first.config.network == configs.preset("debug").network
    assert second.config.learning.batch_size == 4 and second.method.omegas == (0.5,)


def test_a_runs_own_settings_are_a_file_of_settings(tmp_path, asked):
    spec = spec_of("hopper", seeds=(5,), method="uae", sources=("a",), dynamics="copied")
    (tmp_path / "run.json").write_text(json.dumps({"spec": spec.to_dict(), "revision": "x"}))
    assert main(["train", "--config", str(tmp_path / "run.json"), "--out", "nowhere"]) == 130
    assert asked == [spec]
    assert isinstance(asked[0], RunSpec)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("colour: red", "expected some of preset, tasks, seeds, config, method"),
        ("[1, 2]", "is no file of settings"),
        ("a: [", "is neither YAML nor JSON"),
        ("config: {learning: {batch_sise: 1}}", "batch_sise"),
        ("config: {lerning: {batch_size: 1}}", "lerning"),
        ("method: {omega: [1]}", "unknown settings of a method: omega"),
        ("config: {learning: {batch_size: -1}}", "batch_size is -1"),
    ],
)
def test_a_file_of_something_else_is_refused_naming_it(tmp_path, capsys, text, message):
    path = tmp_path / "settings.yaml"
    path.write_text(text)
    words = ["train", "--task", "bullet/hopper", "--out", "nowhere", "--config", str(path)]
    assert main(words) == 2
    assert message in capsys.readouterr().err
    assert main([*words[:-1], str(tmp_path / "absent.yaml")]) == 2
    assert "there is no file of settings" in capsys.readouterr().err


def test_a_table_takes_settings_and_seeds_of_a_file_and_no_method(tmp_path, capsys):
    path = tmp_path / "settings.yaml"
    path.write_text("seeds: [4]\nconfig: {learning: {batch_size: 9}}")
    sweep = COMMANDS["table"].defaults(read_base(["7", "--config", str(path)])).sweep
    assert sweep.seeds == (4,) and sweep.config.learning.batch_size == 9
    path.write_text(FILE)
    assert main(["table", "7", "--config", str(path)]) == 2
    assert "the settings method, tasks are not those of a table" in capsys.readouterr().err
