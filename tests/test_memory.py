"""A device that has no memory left, with errors and devices that are made up."""

import dataclasses
from types import SimpleNamespace

import jax
import pytest

from dreamer_jax.agent import Agent
from dreamer_jax.config import preset
from dreamer_jax.training import Run
from experiments import api
from experiments.cli.main import main
from experiments.runs import memory
from experiments.runs.memory import OutOfMemoryError
from experiments.runs.run import carry_out
from experiments.thesis import jobs
from experiments.thesis.graph import PlannedRun
from runs import spec_of, write_run

EXHAUSTED = jax.errors.JaxRuntimeError(
    "RESOURCE_EXHAUSTED: Out of memory while trying to allocate 9876543210 bytes."
)
DEBUG = preset("debug")


def run_that_raises(error, members, **mapping):
    """A run of so many members on a device, whose training raises."""

    def train():
        raise error

    schedule = dataclasses.replace(DEBUG.schedule, **mapping)
    return SimpleNamespace(
        agent=Agent(dataclasses.replace(DEBUG, schedule=schedule), 2),
        placement=SimpleNamespace(each=members),
        tasks=("a task",),
        env=SimpleNamespace(has_host=True, close=lambda: None),
        train=train,
        close=lambda: None,
    )


def of_device(monkeypatch, agent, members, fitting):
    """Lets the device have memory for the updates of so many of its members at once."""
    beside = memory.bytes_of(agent, 1, members, 0, 0)
    device = SimpleNamespace(
        memory_stats=lambda: {"bytes_limit": (beside + fitting * 10**6) / memory.MEMORY_SHARE}
    )
    one = SimpleNamespace(memory_analysis=lambda: SimpleNamespace(temp_size_in_bytes=10**6))
    monkeypatch.setattr(memory.jax, "local_devices", lambda: [device])
    monkeypatch.setattr(memory, "compiled_update", lambda _: one)


def test_agents_kept_from_before_a_round_are_counted():
    def bytes_with(collect):
        schedule = dataclasses.replace(DEBUG.schedule, collect=collect)
        agent = Agent(dataclasses.replace(DEBUG, schedule=schedule), 2)
        return memory.bytes_of(agent, 1, 5, 0, 0)

    kept = bytes_with("beside") - bytes_with("before")
    assert kept == 5 * memory.member_bytes(Agent(DEBUG, 2))


@pytest.mark.parametrize(
    ("mapping", "mapped", "chunk"),
    [
        ({"mapping": "vmap"}, "12 members", 6),
        ({"mapping": "chunks", "mapping_chunk": 7}, "7 members", 3),
        ({"mapping": "chunks", "mapping_chunk": 50}, "12 members", 6),
    ],
)
def test_without_memory_half_as_many_members_at_once_are_advised(mapping, mapped, chunk):
    with pytest.raises(OutOfMemoryError) as caught:
        carry_out(run_that_raises(EXHAUSTED, 12, **mapping))
    message = str(caught.value)
    assert f"an update mapped {mapped} at once, of 12 on each device" in message
    assert f"--resume --mapping chunks --mapping-chunk {chunk} (half as many" in message
    assert caught.value.__cause__ is EXHAUSTED and "\n" not in message


@pytest.mark.parametrize(
    ("fitting", "advice"),
    [(4.5, "--mapping-chunk 4 (by the compiler's count"), (20, "--mapping-chunk 6 (half as many")],
)
def test_a_device_that_tells_its_memory_says_how_many_members_fit(monkeypatch, fitting, advice):
    run = run_that_raises(EXHAUSTED, 12, mapping="vmap")
    of_device(monkeypatch, run.agent, 12, fitting)
    with pytest.raises(OutOfMemoryError) as caught:
        carry_out(run)
    assert advice in str(caught.value)


def test_for_one_member_at_once_smaller_chunks_are_no_way_out():
    with pytest.raises(
        OutOfMemoryError, match="mapped 1 member at once.*smaller batches"
    ) as caught:
        carry_out(run_that_raises(EXHAUSTED, 12, mapping="chunks"))
    assert "--mapping" not in str(caught.value)


def test_a_round_as_one_program_without_memory_is_told_in_the_same_way():
    error = MemoryError("a round does not fit")
    error.__cause__ = EXHAUSTED
    with pytest.raises(OutOfMemoryError, match="mapped 12 members"):
        carry_out(run_that_raises(error, 12, mapping="vmap"))


@pytest.mark.parametrize("error", [jax.errors.JaxRuntimeError("INTERNAL: x"), MemoryError("host")])
def test_other_errors_stay_what_they_are(error):
    with pytest.raises(type(error)) as caught:
        carry_out(run_that_raises(error, 12))
    assert caught.value is error


TRAIN = ["train", "--task", "bullet/inverted_pendulum", "--preset", "debug", "--seeds", "0", "1"]


def test_what_the_message_says_is_what_the_run_goes_on_with(tmp_path, monkeypatch, capsys):
    """Its number of members at once is no part of what a run is."""
    seen = []

    def train(run):
        seen.append((run.agent.config.schedule.mapping, run.agent.config.schedule.mapping_chunk))
        if len(seen) == 1:
            raise EXHAUSTED
        return "stopped"

    monkeypatch.setattr(Run, "train", train)
    words = [*TRAIN, "--out", str(tmp_path / "run")]
    assert main([*words, "--mapping", "vmap"]) == 1
    message = capsys.readouterr().err
    assert message.startswith("error: a device has no memory left: an update mapped 2 members")
    assert options_of(message) == ["--resume", "--mapping", "chunks", "--mapping-chunk", "1"]
    assert main([*words, *options_of(message)]) == 130
    assert seen == [("vmap", 1), ("chunks", 1)]


def options_of(message):
    """The options with which a message says that the same command goes on."""
    return message.partition("the same command goes on with ")[2].partition(" (")[0].split()


GRID = ["--preset", "debug", "--seeds", "0", "1", "2", "--results"]
COMMANDS = {
    "table": ["table", "3", *GRID],
    "figure": ["figure", "13", *GRID],
    "sweep": ["sweep", "--table", "3", *GRID],
    "work": ["work"],
    "demo": ["demo", "--preset", "debug", "--source", "zoo:x", "--results"],
}


@pytest.fixture
def begun(monkeypatch):
    """How runs map their members that are begun; each has four, and no device has memory for more
    than two at once."""
    seen = []

    def make_run(spec, directory, *, lock=None, **_):
        schedule = spec.config.schedule
        seen.append((schedule.mapping, schedule.mapping_chunk))
        chosen = {"mapping": schedule.mapping, "mapping_chunk": schedule.mapping_chunk}
        run = run_that_raises(EXHAUSTED, 4, **chosen)
        if lock is not None:
            run.close = lock.release
        if memory.at_once(run.agent, 4) <= 2:
            run.train = lambda: "stopped"
        return run

    monkeypatch.setattr(jobs, "make_run", make_run)
    monkeypatch.setattr("experiments.runs.run.make_run", make_run)
    monkeypatch.setattr("experiments.runs.agents.load_source", lambda *_: None)
    return seen


@pytest.mark.parametrize("command", COMMANDS)
def test_every_command_that_trains_names_options_of_its_own_with_which_it_goes_on(
    tmp_path, begun, capsys, command
):
    words = [*COMMANDS[command], str(tmp_path)]
    if command == "work":
        main([*COMMANDS["sweep"], str(tmp_path)])  # plans, and leaves what it cannot train
        words = ["work", str(tmp_path / "debug")]
        capsys.readouterr()
        begun.clear()
    assert main([*words, "--mapping", "vmap"]) == 1
    message = capsys.readouterr().err
    assert "a device has no memory left: an update mapped 4 members at once" in message
    assert options_of(message) == ["--mapping", "chunks", "--mapping-chunk", "2"]
    assert "--resume" not in message and "train" not in message
    assert main([*words, *options_of(message)]) == 130
    assert begun[0] == ("vmap", 1) and begun[-1] == ("chunks", 2)


@pytest.mark.parametrize("command", COMMANDS)
def test_every_command_that_trains_maps_as_many_members_as_a_device_has_memory_for(
    tmp_path, begun, monkeypatch, command
):
    """Also of what was planned with more at once."""
    words = [*COMMANDS[command], str(tmp_path)]
    if command == "work":
        main([*COMMANDS["sweep"], str(tmp_path), "--mapping", "vmap"])
        words = ["work", str(tmp_path / "debug")]
        begun.clear()
    # As on an accelerator.
    monkeypatch.setattr(memory, "at_once", lambda agent, members: of_settings(agent))
    monkeypatch.setattr(memory, "room_for", lambda *_: 2)
    assert main(words) == 130
    assert begun[0] == ("chunks", 2)


def test_a_run_that_was_begun_on_a_larger_device_goes_on_on_a_smaller_one(
    tmp_path, begun, monkeypatch
):
    schedule = dataclasses.replace(DEBUG.schedule, mapping="chunks", mapping_chunk=7)
    config = dataclasses.replace(DEBUG, schedule=schedule)
    spec = spec_of("hopper", seeds=tuple(range(8)), config=config)
    write_run(tmp_path / "run", spec)
    run = PlannedRun("run", ("a cell",) * 8, spec)
    monkeypatch.setattr(memory, "at_once", lambda agent, members: of_settings(agent))
    monkeypatch.setattr(memory, "room_for", lambda *_: 2)
    assert jobs.train(run, tmp_path) == "stopped"
    assert jobs.train(run, tmp_path, jobs.Means(mapping="chunks", mapping_chunk=1)) == "stopped"
    assert begun == [("chunks", 2), ("chunks", 1)]


def of_settings(agent):
    schedule = agent.config.schedule
    return schedule.mapping_chunk if schedule.mapping == "chunks" else 4


@pytest.mark.parametrize(
    ("members", "fits", "chunk"),
    # 18 are 9 and 9 rather than 11 and 7; 57 are five of 10 and 7 rather than five of 11 and 2.
    [(18, 11, 9), (57, 11, 10), (57, 19, 19), (9, 8, 5), (4, 3, 2), (3, 2, 2), (5, 1, 1)],
)
def test_chunks_are_as_even_as_as_many_turns_allow(monkeypatch, members, fits, chunk):
    monkeypatch.setattr(memory, "at_once", lambda agent, each: each)
    monkeypatch.setattr(memory, "room_for", lambda *_: fits)
    schedule = memory.in_memory(
        spec_of("hopper", seeds=tuple(range(members)), config=DEBUG), 1
    ).config.schedule
    assert (schedule.mapping, schedule.mapping_chunk) == ("chunks", chunk)


def test_from_python_the_message_names_keywords(tmp_path, monkeypatch):
    seen = []

    def make_run(spec, directory, **_):
        seen.append((directory, spec.config.schedule.mapping, spec.config.schedule.mapping_chunk))
        schedule = spec.config.schedule
        return run_that_raises(
            EXHAUSTED, 4, mapping=schedule.mapping, mapping_chunk=schedule.mapping_chunk
        )

    monkeypatch.setattr(api, "make_run", make_run)
    asked = {"preset": "debug", "seeds": [0, 1, 2, 3]}
    with pytest.raises(OutOfMemoryError) as caught:
        api.train("bullet/hopper", mapping="vmap", **asked)
    given = 'the same call goes on with mapping="chunks", mapping_chunk=2 (half as many'
    assert given in str(caught.value) and "--" not in str(caught.value)
    with pytest.raises(OutOfMemoryError):
        api.train("bullet/hopper", mapping="chunks", mapping_chunk=2, **asked)
    # Where it is kept does not depend on the machine.
    assert len({directory for directory, *_ in seen}) == 1
    assert [how for _, *how in seen] == [["vmap", 1], ["chunks", 2]]


def test_train_maps_as_many_members_at_once_as_a_device_has_memory_for(tmp_path, monkeypatch):
    seen = []

    def train(run):
        seen.append((run.agent.config.schedule.mapping, run.agent.config.schedule.mapping_chunk))
        return "stopped"

    monkeypatch.setattr(Run, "train", train)
    # As on an accelerator.
    monkeypatch.setattr(memory, "at_once", lambda agent, members: members)
    monkeypatch.setattr(memory, "room_for", lambda *_: 1)
    words = [*TRAIN, "--out", str(tmp_path / "run"), "--resume"]
    assert main(words) == main(words) == 130
    assert main([*words, "--mapping", "vmap"]) == 130
    assert seen == [("chunks", 1), ("chunks", 1), ("vmap", 1)]
