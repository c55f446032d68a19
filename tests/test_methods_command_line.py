"""The methods from the command line on real PyBullet tasks, at sizes of seconds."""

import dataclasses
import json
import shutil

import numpy as np
import pytest
from numpy.testing import assert_array_equal

from dreamer_jax.checkpoint import Checkpointer
from dreamer_jax.logs import read_metrics
from dreamer_jax.stopping import StopRequest
from experiments.cli.exits import STOPPED
from experiments.cli.main import main
from experiments.runs.agents import load_source
from experiments.runs.latents import own_latents
from experiments.runs.start import load_sources
from runs import spec_of, write_run
from transfer_trees import bits

pytest.importorskip("pybullet")

# Tasks of one action size share their compiled functions.
TASKS = ("inverted_pendulum", "inverted_double_pendulum")


def train(out, task, *arguments, code=0):
    words = ["train", "--preset", "debug", "--task", f"bullet/{task}", "--out", str(out)]
    words += ["--workers", "1"]
    assert main(words + [str(word) for word in arguments]) == code


@pytest.fixture(scope="module")
def source(tmp_path_factory):
    """An agent for two tasks whose encoder is not trained, which is all one to what uses it."""
    directory = tmp_path_factory.mktemp("runs") / "source"
    write_run(directory, spec_of("hopper", "ant"))
    return directory


@pytest.fixture(scope="module")
def runs(source):
    """The folder of two agents on the source's encoder, the first begun by the command and stopped
    at once, and of a target, which is trained with them."""
    runs, on = source.parent, ("--source", source)

    def stopped(request):
        request.requested = True
        return request

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(StopRequest, "__enter__", stopped)
        train(runs / TASKS[0], TASKS[0], "--method", "uae", *on, code=STOPPED)
    write_run(runs / TASKS[1], spec_of(TASKS[1], method="uae", sources=[source]), seed=1)
    train(
        runs / "target", TASKS[0], "--method", "meta", *on,
        "--reward-sources", *(runs / task for task in TASKS), "--reward-counts", 1, 2,
    )  # fmt: skip
    return runs


def test_agents_begin_on_the_frozen_encoder_of_a_universal_autoencoder(runs):
    source, agent = (load_source(runs / name).params for name in ("source", TASKS[0]))
    assert bits(agent["encoder"]) == bits(source["encoder"])
    report = (runs / TASKS[0] / "transfer.txt").read_text()
    assert "copy(), frozen" in report
    records = json.loads((runs / TASKS[0] / "transfer.json").read_text())
    assert {r["leaf"].split("/")[0] for r in records if r["frozen"]} == {"encoder"}


def test_a_target_learns_on_that_encoder_and_it_stays_to_the_bit(runs):
    source, target = (load_source(runs / name).params for name in ("source", "target"))
    assert bits(target["encoder"]) == bits(source["encoder"])
    assert bits(target["decoder"]) != bits(source["decoder"])
    rows = [row for row in read_metrics(runs / "target") if row["kind"] == "update"]
    assert rows and all(np.isfinite(row["model_loss"]) for row in rows)


def test_a_meta_models_stored_models_are_those_of_its_sources_when_training_ends(runs):
    for member, count in enumerate((1, 2)):
        reward = load_source(runs / "target", member).params["reward"]
        assert reward["stored"]["present"].tolist() == [True] * count + [False] * (4 - count)
        for place, task in enumerate(TASKS[:count]):
            stored = {
                name: {leaf: x[place] for leaf, x in layer.items()}
                for name, layer in reward["stored"]["params"].items()
            }
            assert bits(stored) == bits(load_source(runs / task).params["reward"])
    labels = {row["label"]: row["sources"] for row in read_metrics(runs / "target")}
    assert labels == {"sources=1": 1, "sources=2": 2}


def test_a_meta_run_that_is_resumed_is_the_same_to_the_byte(runs, tmp_path):
    shutil.copytree(runs / "target", tmp_path / "target")
    checkpoints = Checkpointer(tmp_path / "target" / "checkpoints")
    newest = checkpoints.latest()
    shutil.rmtree(checkpoints.path(newest))
    assert checkpoints.latest() < newest
    spec = json.loads((runs / "target" / "run.json").read_text())["spec"]["method"]
    train(
        tmp_path / "target", TASKS[0], "--method", "meta", "--source", *spec["sources"],
        "--reward-sources", *spec["reward_sources"], "--reward-counts", 1, 2, "--resume",
    )  # fmt: skip
    again, once = (x / "target" / "metrics.jsonl" for x in (tmp_path, runs))
    assert again.read_bytes() == once.read_bytes()


def test_a_meta_run_is_evaluated_with_its_stored_models(runs, capsys):
    assert main(["evaluate", str(runs / "target"), "--episodes", "1"]) == 0
    assert "sources=2, seed 0" in capsys.readouterr().out


def test_a_switching_target_knows_the_tasks_of_its_sources(tmp_path):
    write_run(tmp_path / "source", spec_of(*TASKS))
    on = {"dynamics": "frozen", "sources": [tmp_path / "source"]}
    for seed, task in enumerate(TASKS, start=1):
        write_run(tmp_path / task, spec_of(task, method="uae", **on), seed)
    stored = [tmp_path / task for task in TASKS]
    spec = spec_of(TASKS[0], method="meta", reward_sources=stored, switching=True, **on)
    classifier = spec.method.known_tasks(load_sources(spec).stored, own_latents)
    assert np.bincount(classifier["labels"]).tolist() == [100, 100]
    assert len(np.unique(classifier["latents"], axis=0)) == 200
    assert 0 < classifier["threshold"] < np.inf
    given = dataclasses.replace(spec.method, threshold=7.0)
    given = given.known_tasks(load_sources(spec).stored, own_latents)
    assert given["threshold"] == 7
    assert_array_equal(given["latents"], classifier["latents"])


def test_tasks_are_classified_and_drawn(source, tmp_path, capsys):
    words = ["classify", "--source", str(source), "--out", str(tmp_path), "--task"]
    words += ["bullet/hopper", "bullet/ant", "bullet/inverted_pendulum"]
    words += ["--known", "bullet/hopper", "bullet/ant", "--workers", "1"]
    assert main(words) == 0
    output = capsys.readouterr().out
    (header,) = [line for line in output.splitlines() if line.startswith("threshold")]
    assert header.split() == ["threshold", "InvertedPendulum,", "novel", "Hopper", "Ant"]
    found = json.loads((tmp_path / "classification.json").read_text())
    thresholds = dict.fromkeys(row["threshold"] for row in found["accuracies"])
    # M = 12 of the thesis's 230 features; the suggested threshold comes last.
    scaled = [xi * 12 / 230 for xi in (50, 70, 90)]
    assert list(thresholds) == pytest.approx([*scaled, found["suggested_threshold"]])
    assert all(len(values) == 100 for values in found["distances"].values())
    assert sum(found["votes"]["bullet/hopper"].values()) == 100
    for row in found["accuracies"]:
        distances = np.array(found["distances"][row["task"]])
        assert row["not_novel"] == pytest.approx((distances <= row["threshold"]).mean())
        if not row["known"]:
            assert row["correct"] == pytest.approx(1 - row["not_novel"], abs=1e-6)
        else:
            right = found["votes"][row["task"]].get(row["task"], 0)
            assert row["right_task"] == pytest.approx(right / 100)
    for name in ("latents.png", "latents.svg"):
        assert (tmp_path / name).stat().st_size > 10_000
        assert str(tmp_path / name) in output


def test_samples_of_trained_agents_are_classified(runs, tmp_path):
    names = [f"bullet/{task}" for task in TASKS]
    words = ["classify", "--source", str(runs / TASKS[0]), "--samples", "20", "--task", *names]
    words += ["--workers", "1"]
    words += ["--known", names[0], "--policy", "trained", "--actors"]
    words += [str(runs / task) for task in TASKS]
    assert main([*words, "--out", str(tmp_path)]) == 0
    found = json.loads((tmp_path / "classification.json").read_text())
    assert found["settings"]["policy"] == "trained"
    assert all(len(values) == 20 for values in found["distances"].values())
    main([*words[: words.index("--policy")], "--out", str(tmp_path)])
    other = json.loads((tmp_path / "classification.json").read_text())
    assert other["settings"]["policy"] == "random"
    assert other["distances"] != found["distances"]


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--known", "bullet/ant"], "bullet/ant is known but not among the tasks"),
        (["--known"], "--known"),
        (["--known", "bullet/hopper", "--policy", "trained", "--actors", "x", "y"],
         "2 agents for 1 tasks"),
        (["--known", "bullet/hopper", "--neighbours", "300"], r"must lie in [1, 100]"),
        (["--known", "bullet/hoper"], "Did you mean bullet/hopper"),
        (["--known", "bullet/hopper", "--quantile", "2"], "expected a number in [0 to 1]"),
        (["--known", "bullet/hopper"], "takes actions of size 3"),
    ],
)  # fmt: skip
def test_bad_requests_end_with_code_2_and_a_way_out(runs, arguments, message, tmp_path, capsys):
    words = ["classify", "--source", str(runs / TASKS[0]), "--task", "bullet/hopper"]
    try:
        code = main([*words, "--out", str(tmp_path / "out"), *arguments])
    except SystemExit as error:
        code = error.code
    assert code == 2
    captured = capsys.readouterr()
    assert message in " ".join((captured.out + captured.err).replace("│", " ").split())
    assert not (tmp_path / "out").exists()
