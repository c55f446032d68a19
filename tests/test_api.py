"""Training, transferring, evaluating and acting from Python, as the README shows it."""

import re
from pathlib import Path

import numpy as np
import pytest

import experiments
from dreamer_jax.config import preset
from experiments import api, load, train, transfer
from experiments.methods.fine_tuning import FineTuning
from runs import spec_of, write_run
from transfer_trees import bits

ROOT = Path(__file__).parent.parent


@pytest.fixture
def asked(monkeypatch):
    """Specs and folders of the runs that were asked for, which here are not begun."""
    found = []

    def note(spec, directory, **_):
        found.append((spec, directory))

    monkeypatch.setattr(api, "make_run", note)
    monkeypatch.setattr(api, "carry_out", lambda *_: "finished")
    return found


@pytest.fixture(scope="module")
def source(tmp_path_factory):
    folder = tmp_path_factory.mktemp("runs") / "source"
    write_run(folder, spec_of("hopper", seeds=(0, 1)))
    return folder


def test_the_readme_does_what_it_says(tmp_path, monkeypatch):
    pytest.importorskip("pybullet")
    text = (ROOT / "README.md").read_text(encoding="utf-8")
    code = next(
        block for block in re.findall(r"```python\n(.*?)```", text, re.S) if "load" in block
    )
    assert len([line for line in code.splitlines() if line]) <= 10
    monkeypatch.chdir(tmp_path)
    shown, names = [], {"print": lambda *words: shown.append(words)}
    exec(compile(code, "README.md", "exec"), names)
    (words,) = shown
    assert words[0] == ("omega=0, seed 0", "omega=0.2, seed 0", "baseline, seed 0")
    assert len(words[1]) == 3 and np.isfinite(words[1]).all()
    assert names["image"].shape == (32, 32, 3) and np.isfinite(names["reward"])
    assert names["action"].shape == (3,) and names["target"].directory.parent == Path("runs")
    # Once more, the runs are there.
    before = {path: path.read_bytes() for path in Path("runs").glob("*/metrics.jsonl")}
    again = experiments.train("bullet/inverted_pendulum", preset="debug")
    assert again == names["source"]
    assert {path: path.read_bytes() for path in Path("runs").glob("*/metrics.jsonl")} == before


def test_settings_are_given_by_name(asked):
    train(("bullet/hopper", "bullet/ant"), seeds=(1, 2), preset="debug", batch_size=3, out="there")
    train("bullet/hopper", preset="debug")
    (spec, folder), (other, own) = asked
    assert spec.tasks == ("bullet/hopper", "bullet/ant") and spec.seeds == (1, 2)
    assert spec.config.learning.batch_size == 3 and folder == Path("there")
    assert other.config == preset("debug") and other.seeds == (0,)
    assert own.parent == Path("runs") and own.name.startswith("bullet-hopper-scratch-")
    with pytest.raises(ValueError, match="no setting 'bach_size': did you mean 'batch_size'"):
        train("bullet/hopper", bach_size=3)


def test_targets_have_their_sources_settings_but_those_given(asked, source):
    trained = api.Trained(source, spec_of("hopper", seeds=(0, 1)))
    transfer(trained, "bullet/ant", method="fine-tuning", source_member=1, horizon=4)
    transfer([str(source)], "bullet/ant", omegas=[0.1])
    (tuned, one), (fractional, other) = asked
    assert tuned.method == FineTuning(sources=(str(source),), source_member=1)
    assert tuned.config.learning.horizon == 4
    assert tuned.config.network == preset("debug").network
    assert fractional.method.omegas == (0.1,) and one != other
    assert trained.members == ("baseline, seed 0", "baseline, seed 1")
    with pytest.raises(ValueError, match="--omega belongs to --method fractional"):
        transfer(trained, "bullet/ant", method="fine-tuning", omegas=(0.1,))


def test_an_agent_acts_the_same_again_and_remembers_its_episode(source):
    agent = load(source, member=1)
    assert bits(agent.params) == bits(load(source, 1).params)
    image = np.full((32, 32, 3), 100, np.uint8)
    first, memory = agent.act(image, agent.start())
    again, _ = agent.act(image, agent.start())
    second, _ = agent.act(image, memory)
    assert first.shape == (3,) and (np.abs(first) <= 1).all()
    assert (first == again).all() and (first != second).any()
    with pytest.raises(ValueError, match=r"the shape \(64, 64, 3\), the agent reads \(32, 32, 3\)"):
        agent.act(np.zeros((64, 64, 3), np.uint8), memory)


def test_a_task_with_more_actions_than_the_agents_is_refused(source):
    with pytest.raises(ValueError, match="bullet/ant takes actions of size 8, the agent gives 3"):
        load(source).environment("bullet/ant")


def test_a_task_with_fewer_actions_takes_the_first(source):
    pytest.importorskip("pybullet")
    env = load(source).environment("bullet/inverted_pendulum")
    assert env.action_space.shape == (3,)
    image, _ = env.reset(seed=0)
    assert image.shape == (32, 32, 3)
    assert np.isfinite(env.step(np.ones(3, np.float32))[1])
    env.close()


def test_what_is_no_part_of_the_interface_is_no_attribute():
    with pytest.raises(AttributeError, match="no attribute 'tarin'"):
        _ = experiments.tarin
