"""A device that has no memory left, with errors and devices that are made up."""

import dataclasses
from types import SimpleNamespace

import jax
import pytest

from dreamer_jax.agent import Agent
from dreamer_jax.config import preset
from dreamer_jax.training import Run
from experiments.cli.main import main
from experiments.runs import memory
from experiments.runs.memory import OutOfMemoryError
from experiments.runs.run import carry_out

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
    (advice,) = [part for part in message.split(". ") if part.startswith("`train` goes on with ")]
    options = advice.removeprefix("`train` goes on with ").partition(" (")[0].split()
    assert main([*words, *options]) == 130
    assert seen == [("vmap", 1), ("chunks", 1)]


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
