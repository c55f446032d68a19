"""Agents whose losses were not finite any more: named in plans, and refused as sources."""

import dataclasses
import json

import pytest

from experiments.cli.main import main
from experiments.runs.agents import load_source
from experiments.runs.export import export
from experiments.runs.exported import read_card, read_params
from experiments.runs.folder import failed_members
from experiments.runs.start import load_sources
from experiments.thesis import grid
from experiments.thesis.estimate import plan_table
from experiments.thesis.graph import plan_runs
from runs import CONFIG, finish, spec_of, write_run
from transfer_trees import bits


def row(member, **columns):
    return {"kind": "update", "member": member, "env_steps": 80, "healthy": True} | columns


def write_rows(folder, *rows):
    lines = "".join(json.dumps(one) + "\n" for one in rows)
    (folder / "metrics.jsonl").write_text(lines)


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """Two agents, the second of which failed."""
    folder = tmp_path_factory.mktemp("runs") / "run"
    write_run(folder, spec_of("hopper", seeds=(0, 1)), counters={"rounds": 2, "updates": 2})
    write_rows(folder, row(0), row(1), row(1, env_steps=120, healthy=False))
    return folder


def test_a_row_that_says_so_or_a_return_that_is_no_number_is_a_failure(tmp_path):
    assert failed_members(tmp_path) == set()
    evaluation = {"kind": "evaluation", "member": 2, "env_steps": 80, "return": float("nan")}
    write_rows(tmp_path, row(0), row(1, healthy=False), row(1), evaluation)
    assert failed_members(tmp_path) == {1, 2}


def test_a_failed_agent_is_no_source_unless_one_insists(run):
    assert load_source(run, 0).spec.seeds == (0, 1)
    message = "member 1 of .*run failed: .* Take member 0, or insist with --accept-failed"
    with pytest.raises(ValueError, match=message):
        load_source(run, 1)
    spec = spec_of("hopper", method="fine-tuning", sources=(run,), source_member=1)
    with pytest.raises(ValueError, match=message):
        load_sources(spec)
    assert load_sources(spec, accept_failed=True).agents[0].directory == run


def test_the_command_line_refuses_it_with_the_way_out(run, tmp_path, capsys):
    words = ["train", "--task", "bullet/hopper", "--preset", "debug", "--source", str(run)]
    words += ["--source-member", "1", "--method", "fine-tuning", "--out", str(tmp_path / "out")]
    assert main(words) == 2
    assert "insist with --accept-failed" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def test_a_failed_agent_is_not_exported_unless_one_insists(run, tmp_path, monkeypatch, capsys):
    file = tmp_path / "agent.safetensors"
    with pytest.raises(ValueError, match="member 1 of .*run failed"):
        export(run, file, member=1)
    words = ["export", str(run), "--member", "1", "--out", str(file)]
    assert main(words) == 2
    assert "insist with --accept-failed" in capsys.readouterr().err and not file.exists()
    played = {"bullet/hopper": (1.0, 2.0)}
    monkeypatch.setattr("experiments.runs.export._play", lambda *_, **__: played)
    assert main([*words, "--accept-failed"]) == 0
    assert read_card(file).returns == played
    assert bits(read_params(file)) == bits(load_source(run, 1, accept_failed=True).params)


def test_a_plan_names_the_cells_that_failed(tmp_path):
    small = dataclasses.replace(grid.TABLES["table-3"], counts=(2,), omegas=(0.1,))
    cells = grid.shown(small, (0, 1))
    runs = plan_runs(cells, CONFIG, tmp_path)
    for one in runs:
        finish(one, tmp_path)
    targets = runs[-1]
    with open(tmp_path / targets.name / "metrics.jsonl", "a") as file:
        file.write(json.dumps(row(2, healthy=False)) + "\n")
    (targets,) = plan_runs(cells, CONFIG, tmp_path)
    assert (targets.state, targets.failed) == ("done", (targets.cells[2],))
    assert "1 failed" in plan_table([targets], None)
