"""Options that several commands share."""

import pytest

from experiments.cli.main import main
from runs import spec_of, write_run


class Asked(Exception):
    """What was asked for is known."""


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    folder = tmp_path_factory.mktemp("runs") / "run"
    write_run(folder, spec_of("inverted_pendulum"), counters={"rounds": 2, "updates": 2})
    return folder


@pytest.mark.parametrize(
    "words",
    [
        ["train", "--task", "bullet/hopper", "--preset", "debug", "--out", "OUT"],
        ["evaluate", "RUN"],
        ["export", "RUN", "--out", "OUT/agent.safetensors"],
        ["classify", "--source", "RUN", "--task", "bullet/inverted_pendulum", "--known"]
        + ["bullet/inverted_pendulum"],
        ["demo", "--preset", "debug", "--source", "RUN", "--results", "OUT"],
        ["table", "7", "--preset", "debug", "--results", "OUT"],
        ["figure", "12", "--preset", "debug", "--results", "OUT"],
        ["sweep", "--table", "7", "--preset", "debug", "--results", "OUT"],
        ["plan", "--table", "7", "--preset", "debug", "--results", "OUT"],
    ],
    ids=lambda words: words[0],
)
def test_every_command_that_simulates_says_how_long_a_simulator_may_take(
    words, run, tmp_path, monkeypatch
):
    asked = []

    def note(*_, timeout, **__):
        asked.append(timeout)
        raise Asked

    places = ("experiments.runs.run.make_env", "experiments.runs.evaluate.make_env")
    for place in places:
        monkeypatch.setattr(place, lambda spec, workers, timeout, **_: note(timeout=timeout))
    for place in ("envs.make", "experiments.thesis.speeds.measure"):
        monkeypatch.setattr(place, note)
    monkeypatch.setattr("experiments.runs.run.transferred_members", lambda *_, **__: (None, None))
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    words = [word.replace("RUN", str(run)).replace("OUT", str(tmp_path / "out")) for word in words]
    with pytest.raises(Asked):
        main([*words, "--simulator-timeout", "7.5"])
    assert asked == [7.5]
