"""Trained agents as files: weights, cards, the zoo, and starting from them."""

import dataclasses
import json
import shutil

import numpy as np
import pytest

import transfer
from dreamer_jax.checkpoint import Checkpointer
from experiments.cli.main import main
from experiments.runs import export as export_module
from experiments.runs import exported
from experiments.runs.agents import check_source, load_params, load_source
from experiments.runs.export import export
from experiments.runs.exported import Card, is_exported, read_card, read_params, weights_path
from experiments.runs.start import load_sources
from runs import spec_of, write_run
from transfer_trees import bits

PENDULUM = "bullet/inverted_pendulum"


@pytest.fixture
def played(monkeypatch):
    """Returns of episodes that need not be played."""
    found = {PENDULUM: (10.0, 20.0, 30.0)}
    monkeypatch.setattr(export_module, "_play", lambda *_, **__: found)
    return found


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """A run of two agents with random parameters, and what it has logged."""
    directory = tmp_path_factory.mktemp("runs") / "run"
    spec = spec_of("inverted_pendulum", seeds=(3, 4))
    write_run(directory, spec, counters={"rounds": 2, "updates": 7})
    rows = [
        {"kind": "evaluation", "member": member, "env_steps": steps, "task": PENDULUM}
        | {"return": 100.0 * member + steps}
        for steps in (40, 80, 120)
        for member in (0, 1)
    ]
    text = "".join(json.dumps(row) + "\n" for row in rows)
    (directory / "metrics.jsonl").write_text(text)
    return directory


def card(returns, task=PENDULUM):
    spec = dataclasses.replace(spec_of("inverted_pendulum"), tasks=(task,))
    return Card(spec, 0, "baseline", 1, 1, {}, {task: returns}, "r", {}, "0" * 64)


def test_what_is_exported_is_the_member_to_the_bit(run, tmp_path, played):
    file = tmp_path / "agent.safetensors"
    export(run, file, member=1)
    assert bits(read_params(file)) == bits(load_source(run, 1).params)


def test_a_card_says_what_the_agent_is_and_how_it_did(run, tmp_path, played):
    file = tmp_path / "agent.safetensors"
    written = export(run, file, member=1, note="for a test")
    assert read_card(file) == written
    assert (written.seed, written.label, written.updates) == (4, "baseline", 7)
    assert written.environment_steps == 80
    # The evaluation at 120 environment steps is later than the checkpoint.
    assert written.curves == {PENDULUM: ((40, 140.0), (80, 180.0))}
    assert written.returns == played
    assert written.spec == spec_of("inverted_pendulum", seeds=(3, 4))
    assert written.note == "for a test"


def test_an_exported_agent_is_a_source(run, tmp_path, played):
    file = tmp_path / "agent.safetensors"
    export(run, file, member=1)
    source = load_source(file.name, base=tmp_path)
    assert bits(source.params) == bits(load_source(run, 1).params)
    assert source.spec.tasks == (PENDULUM,)
    with pytest.raises(ValueError, match="holds one agent, member 1 was asked for"):
        load_source(file, 1)


def test_nothing_is_overwritten(run, tmp_path, played):
    file = tmp_path / "agent.safetensors"
    file.with_suffix(".json").write_text("mine")
    with pytest.raises(FileExistsError, match="agent.json is there already"):
        export(run, file)
    assert file.with_suffix(".json").read_text() == "mine" and not file.exists()


def test_weights_that_are_not_finite_are_not_exported(run, tmp_path, played):
    broken = tmp_path / "run"
    shutil.copytree(run, broken)
    params = load_params(broken)
    params["value"]["out"]["bias"] = np.stack([params["value"]["out"]["bias"][0] * np.nan, [0.0]])
    checkpoints = Checkpointer(broken / "checkpoints")
    checkpoints.save(1, {"agent": {"params": params}}, checkpoints.metadata())
    with pytest.raises(ValueError, match="value/out/bias of member 0 .* is not finite"):
        export(broken, tmp_path / "agent.safetensors")
    export(broken, tmp_path / "agent.safetensors", member=1)


@pytest.mark.parametrize("place", (8, 2000, -1))
def test_a_damaged_file_is_told_from_its_card(run, tmp_path, played, place):
    file = tmp_path / "agent.safetensors"
    export(run, file)
    data = bytearray(file.read_bytes())
    data[place] ^= 1
    file.write_bytes(data)
    with pytest.raises(ValueError, match="agent.safetensors is not the file that its card"):
        read_params(file)


@pytest.mark.parametrize(
    "change",
    (
        {"format": 2},
        {"seed": None},
        {"curves": 3},
        {"returns": {PENDULUM: ["many"]}},
        {"spec": {"tasks": ["bullet/nothing"]}},
        {"spec": None},
    ),
)
def test_a_card_of_another_shape_is_told_by_its_name(run, tmp_path, played, change):
    file = tmp_path / "agent.safetensors"
    export(run, file)
    path = file.with_suffix(".json")
    path.write_text(json.dumps(json.loads(path.read_text()) | change))
    with pytest.raises(ValueError, match="agent.json is not the card of an exported agent"):
        read_card(file)


def test_what_is_missing_is_named(run, tmp_path, played):
    file = tmp_path / "agent.safetensors"
    with pytest.raises(ValueError, match="there is no .*agent.json, the card"):
        load_source(file)
    export(run, file)
    file.unlink()
    with pytest.raises(ValueError, match="there is no .*agent.safetensors, the weights"):
        load_source(file)
    with pytest.raises(ValueError, match="the zoo has no agent 'nobody': choose from "):
        load_source("zoo:nobody")
    with pytest.raises(ValueError, match="members 0 to 1, member 2 was asked for"):
        export(run, tmp_path / "other.safetensors", member=2)
    with pytest.raises(ValueError, match=r"written as \.safetensors, and .*agent.npz"):
        export(run, tmp_path / "agent.npz")


def test_names_tell_exported_agents_from_folders():
    assert is_exported("zoo:agent") and is_exported("some/agent.safetensors")
    assert not is_exported("results/cpu/agent")


def test_every_agent_of_the_zoo_can_be_read_and_is_small():
    for name in exported.zoo():
        found = read_card(f"zoo:{name}")
        assert set(found.returns) == set(found.curves) == set(found.spec.tasks)
        assert all(len(returns) >= 10 for returns in found.returns.values())
        assert weights_path(f"zoo:{name}").stat().st_size < 2e6
        leaves = transfer.flatten(read_params(f"zoo:{name}"))
        assert all(np.all(np.isfinite(leaf)) for leaf in leaves.values())


def test_a_verdict_compares_with_those_who_know_nothing():
    # Balanced 880, constant action -837: (860 + 837) / (880 + 837) is 0.988.
    assert card((850.0, 860.0, 870.0)).verdict(PENDULUM) == (
        "860 ± 8 in 3 episodes; 99 % of the way from constant action -837 to balanced 880"
    )
    assert "has not learned it (constant action -837)" in card((-834.0, -841.0)).verdict(PENDULUM)
    # A mean above the level is not enough where episodes differ as much as these.
    assert "has not learned it" in card((-1000.0, 880.0)).verdict(PENDULUM)
    assert "has not learned it" in card((880.0,)).verdict(PENDULUM)
    assert (
        card((50.0, 51.0), "bullet/hopper").verdict("bullet/hopper").endswith("above no action 44")
    )


def test_an_agent_is_exported_and_trained_from_on_the_command_line(run, tmp_path, played, capsys):
    file = tmp_path / "agent.safetensors"
    assert main(["export", str(run), "--out", str(file), "--member", "1"]) == 0
    assert f"{PENDULUM}: 20 ± 8 in 3 episodes" in capsys.readouterr().out
    assert main(["export", str(run), "--out", str(file)]) == 2
    assert "agent.safetensors is there already" in capsys.readouterr().err
    spec = spec_of("inverted_pendulum", sources=(file,), omegas=(0.0, 0.5))
    sources = load_sources(spec)
    assert bits(sources.agents[0].params) == bits(load_source(run, 1).params)
    words = ["train", "--preset", "cpu", "--task", PENDULUM, "--out", str(tmp_path / "target")]
    assert main([*words, "--source", str(file), "--omega", "0"]) == 2
    error = capsys.readouterr().err
    assert "agent.safetensors has other networks (" in error


def test_how_networks_are_computed_may_differ_from_the_source_and_their_sizes_may_not(run):
    source, spec = load_source(run, 0), spec_of("inverted_pendulum")
    network = spec.config.network

    def with_network(**settings):
        changed = dataclasses.replace(network, **settings)
        return dataclasses.replace(spec, config=dataclasses.replace(spec.config, network=changed))

    others = {"precision": "bfloat16", "matmul_precision": "float32", "convolutions": "matmul"}
    assert all(getattr(network, name) != value for name, value in others.items())
    check_source(source, with_network(**others))
    message = r"other networks \(head_units: 8 in the source, 9 here\)"
    with pytest.raises(ValueError, match=message):
        check_source(source, with_network(**others, head_units=9))


def test_the_zoo_is_listed_and_told(run, tmp_path, played, capsys, monkeypatch):
    monkeypatch.setattr(exported, "ZOO", tmp_path)
    assert main(["zoo"]) == 0
    assert "is empty" in capsys.readouterr().out
    export(run, tmp_path / "pendulum.safetensors", note="for a test")
    assert main(["zoo"]) == 0
    output = capsys.readouterr().out
    assert "pendulum: 80 environment steps" in output and "20 ± 8 in 3 episodes" in output
    assert main(["zoo", "pendulum"]) == 0
    output = capsys.readouterr().out
    assert "episodes: 10, 20, 30" in output and "40 at 40, 80 at 80" in output
    assert "for a test" in output and "--source zoo:pendulum" in output
    assert main(["zoo", "nobody"]) == 2
    assert "choose from pendulum" in capsys.readouterr().err
    assert bits(load_source("zoo:pendulum").params) == bits(load_source(run).params)
