"""Reading a results folder runs no code that it names."""

import json
import subprocess
import sys

import pytest

import envs
from dreamer_jax.config import preset
from dreamer_jax.integrity import write_sealed_json
from experiments.cli.main import main
from experiments.runs.spec import RunSpec, read_spec

TASK = "gymnasium/evil_module:Evil-v0"


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """A results folder whose task names a module that leaves a mark when it is imported."""
    module = tmp_path / "modules" / "evil_module.py"
    module.parent.mkdir()
    module.write_text(f"open({str(tmp_path / 'mark')!r}, 'w')\n")
    monkeypatch.syspath_prepend(str(module.parent))
    spec = RunSpec((TASK,), (0,), preset("debug"))
    (tmp_path / "run").mkdir()
    write_sealed_json(tmp_path / "run" / "run.json", {"spec": spec.to_dict()})
    row = {"kind": "evaluation", "member": 0, "seed": 0, "label": "baseline", "task": TASK}
    row |= {"updates": 2, "length": 20, "fell": False}
    rows = [row | {"env_steps": 40 * n, "return": n + 0.5} for n in range(1, 5)]
    text = "".join(json.dumps(row) + "\n" for row in rows)
    (tmp_path / "run" / "metrics.jsonl").write_text(text)
    return tmp_path / "run"


def test_reports_and_verify_import_nothing_that_a_folder_names(folder, capsys):
    assert main(["report", str(folder)]) == 0
    assert "baseline" in capsys.readouterr().out
    assert main(["verify", str(folder)]) == 0
    assert read_spec(folder).tasks == (TASK,)
    assert not (folder.parent / "mark").exists()


@pytest.mark.parametrize(
    "words",
    [
        ["evaluate", "{folder}"],
        ["export", "{folder}", "--out", "{folder}/agent.safetensors"],
        ["classify", "--source", "{folder}", "--task", "bullet/ant", "bullet/hopper"]
        + ["--known", "bullet/ant"],
        ["train", "--task", "bullet/hopper", "--source", "{folder}", "--omega", "0.2"]
        + ["--preset", "debug", "--out", "{folder}-target"],
    ],
    ids=lambda words: words[0],
)
def test_what_would_play_a_folders_task_asks_for_trust(folder, words, capsys):
    assert main([word.format(folder=folder) for word in words]) == 2
    error = capsys.readouterr().err
    assert TASK in error and "module evil_module" in error and "--trust" in error
    assert not (folder.parent / "mark").exists()


def test_a_task_is_described_by_its_name_alone():
    assert envs.described("gymnasium/evil_module:Evil-v0").title == "evil_module:Evil-v0"
    assert envs.described("bullet/hopper") == envs.spec("bullet/hopper")
    assert envs.described("brax/ant@spring") == envs.spec("brax/ant@spring")
    assert not envs.names_module("gymnasium/CartPole-v1")
    with pytest.raises(ValueError, match="Did you mean bullet/hopper"):
        envs.described("bullet/hoper")
    code = "import envs, sys; envs.described('gymnasium/a:B'); print('a' in sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert done.stdout == "False\n", done.stderr
