"""Running the graph: in order, once each, going on where one fails; and what it will take."""

import contextlib
import dataclasses
import functools
import os
import socket
from types import SimpleNamespace

import jax
import numpy as np
import pytest

from dreamer_jax.checkpoint import Checkpointer, CorruptCheckpointError
from envs import SimulatorError
from experiments.runs import memory
from experiments.runs.agents import make_agent
from experiments.runs.folder import folders
from experiments.thesis import estimate, jobs
from experiments.thesis.engines import local
from experiments.thesis.engines.local import one_by_one
from experiments.thesis.estimate import plan_table
from experiments.thesis.graph import plan_runs
from experiments.thesis.grid import TABLES, closure, shown
from experiments.thesis.measurement import Speed
from experiments.thesis.reservations import planned
from experiments.thesis.sweep import carry_out_runs
from runs import CONFIG, Trainer, finish

TWO_TARGETS = (
    dataclasses.replace(TABLES["table-3"], counts=(2,), omegas=(0.1, 0.2)),
    dataclasses.replace(TABLES["table-5"], counts=(2,), omegas=(0.1, 0.2)),
)
HOPPER, WALKER = "bullet-Hopper-fractional", "bullet-Walker2D-fractional"
HOPPERS_SOURCE = "bullet-HalfCheetah+Walker2D-seed-0"
WALKERS_SOURCE = "bullet-HalfCheetah+Hopper-seed-0"


def cells_of(*entries, seeds=(0, 1)):
    return [cell for entry in entries or TWO_TARGETS for cell in shown(entry, seeds)]


def plan(root, *entries, seeds=(0, 1)):
    return plan_runs(cells_of(*entries, seeds=seeds), CONFIG, root)


def sweep(root, *entries, **behaviour):
    trainer, said = Trainer(**behaviour), []
    engine = functools.partial(one_by_one, train=trainer, poll=0.01)
    with planned(cells_of(*entries), CONFIG, root) as runs:
        progress = carry_out_runs(runs, root, engine=engine, say=said.append)
    return progress, trainer.trained, said


def test_every_run_is_trained_once_after_those_it_needs(tmp_path):
    runs = plan(tmp_path)
    progress, trained, said = sweep(tmp_path)
    assert progress.complete
    assert trained == progress.finished == [run.name for run in runs]
    assert said[1].startswith("run 2 of 4, bullet-Hopper-fractional: 6 agents on bullet/hopper")
    cells = {cell.name for entry in TWO_TARGETS for cell in closure(shown(entry, (0, 1)))}
    assert set(folders(tmp_path)) == cells


def test_a_second_sweep_trains_nothing(tmp_path):
    sweep(tmp_path)
    progress, trained, _ = sweep(tmp_path)
    assert progress.complete and trained == []


def test_a_sweep_that_is_stopped_goes_on_with_the_run_that_was_cut(tmp_path):
    progress, trained, _ = sweep(tmp_path, stop_at=HOPPER)
    assert progress.stopped and not progress.complete
    assert trained == [HOPPERS_SOURCE, HOPPER]
    progress, trained, said = sweep(tmp_path)
    assert progress.complete
    assert trained[0] == HOPPER and HOPPERS_SOURCE not in trained
    assert "goes on at 50%" in said[0]


def test_a_run_that_fails_is_named_and_what_needs_it_is_skipped_and_the_others_go_on(tmp_path):
    failing = {HOPPERS_SOURCE: SimulatorError("the contact solver diverged")}
    progress, trained, _ = sweep(tmp_path, failing=failing)
    assert "the contact solver diverged" in progress.failed[HOPPERS_SOURCE]
    assert progress.skipped == {HOPPER: f"it needs {HOPPERS_SOURCE}"}
    assert WALKER in progress.finished and HOPPER not in trained
    # What it had is kept, and goes on.
    progress, trained, _ = sweep(tmp_path)
    assert progress.complete and trained == [HOPPERS_SOURCE, HOPPER]


@pytest.mark.parametrize("error", [CorruptCheckpointError("leaf 3"), ValueError("byte 7")])
def test_a_run_that_cannot_be_resumed_is_set_aside_and_trained_anew_the_next_time(tmp_path, error):
    progress, _, _ = sweep(tmp_path, failing={HOPPER: error})
    assert f"set aside as {HOPPER}.corrupt-1" in progress.failed[HOPPER]
    assert (tmp_path / f"{HOPPER}.corrupt-1" / "run.json").exists()
    assert not (tmp_path / HOPPER).exists()
    progress, trained, _ = sweep(tmp_path)
    assert progress.complete and trained == [HOPPER]


def test_a_damaged_folder_is_set_aside_before_anything_is_trained(tmp_path):
    finish(plan(tmp_path)[0], tmp_path)
    (tmp_path / HOPPERS_SOURCE / "run.json").write_text("{")
    progress, trained, _ = sweep(tmp_path)
    assert "run.json is not valid JSON" in progress.failed[HOPPERS_SOURCE]
    assert list(progress.skipped) == [HOPPER] and WALKER in trained
    assert (tmp_path / f"{HOPPERS_SOURCE}.corrupt-1").is_dir()
    progress, trained, _ = sweep(tmp_path)
    assert progress.complete and trained == [HOPPERS_SOURCE, HOPPER]


def test_a_source_with_damaged_parameters_is_set_aside_and_not_its_targets(tmp_path):
    finish(plan(tmp_path)[0], tmp_path)
    checkpoints = Checkpointer(tmp_path / HOPPERS_SOURCE / "checkpoints")
    files = [path for path in checkpoints.path(checkpoints.latest()).rglob("*") if path.is_file()]
    damaged = max(files, key=lambda path: (path.suffix != ".json", path.stat().st_size))
    data = bytearray(damaged.read_bytes())
    data[len(data) // 2] ^= 1
    damaged.write_bytes(data)
    progress, trained, _ = sweep(tmp_path)
    assert list(progress.failed) == [HOPPERS_SOURCE]
    assert list(progress.skipped) == [HOPPER] and HOPPER not in trained


def test_two_sweeps_at_once_share_the_work_and_train_nothing_twice(tmp_path, monkeypatch):
    def interrupted(seconds):
        raise KeyboardInterrupt

    monkeypatch.setattr(local.time, "sleep", interrupted)
    second = []

    def train(run, root, means):
        if not second:  # while this run, the first, is in training
            second.append(None)
            second[:] = sweep(tmp_path)
        return Trainer()(run, root, means)

    with planned(cells_of(), CONFIG, tmp_path) as runs:
        engine = functools.partial(one_by_one, train=train)
        first = carry_out_runs(runs, tmp_path, engine=engine, say=lambda _: None)
    progress, trained, said = second
    # What is ready is done at once; what is in training, or needs it, is waited for.
    assert trained == progress.finished == [WALKERS_SOURCE, WALKER] and progress.stopped
    holder = f"process {os.getpid()} on {socket.gethostname()}, since 20"
    assert said[-1].startswith(f"waiting: {HOPPERS_SOURCE} is trained by {holder}")
    assert first.complete
    assert first.finished == [HOPPERS_SOURCE, HOPPER]
    assert first.shared == [WALKERS_SOURCE, WALKER]


@pytest.mark.parametrize("error", [None, ValueError("byte 7")])
def test_what_a_run_compiled_is_freed_after_it(tmp_path, monkeypatch, error):
    happened = []

    def carry_out(run, _):
        happened.append("trained")
        if error is not None:
            raise error
        return "finished"

    monkeypatch.setattr(jobs, "make_run", lambda *_, **__: 1)
    monkeypatch.setattr(jobs, "carry_out", carry_out)
    monkeypatch.setattr(jax, "clear_caches", lambda: happened.append("freed"))
    source, *_ = plan(tmp_path)
    with contextlib.nullcontext() if error is None else pytest.raises(ValueError, match="byte 7"):
        assert jobs.train(source, tmp_path) == "finished"
    assert happened == ["trained", "freed"]


# --- what it will take ------------------------------------------------------------------------

TASKS = ("bullet/hopper", "bullet/walker2d", "bullet/halfcheetah")
SPEED = Speed(
    update_seconds=0.5,
    update_range=(0.4, 1.0),
    update_bytes=1000,
    policy_seconds=0.0,
    tick_seconds=dict.fromkeys(TASKS, 0.01),
    compile_seconds=0.0,
    tick_compile_seconds=dict.fromkeys(TASKS, 0.0),
    workers=1,
)


def test_an_estimate_is_what_can_be_counted_by_hand(tmp_path):
    _, targets, *_ = plan(tmp_path)
    found = estimate.estimate(targets, SPEED)
    # 4 rounds and 4 evaluations of 20 ticks, and 8 updates, of each of 6 agents.
    assert found.seconds == pytest.approx(6 * (8 * 0.5 + 8 * 20 * 0.01))
    # Records of 32 x 32 x 3 bytes, three actions, a reward and two flags: 21 a phase.
    records = 6 * 4 * 21 * (32 * 32 * 3 + 4 * 3 + 4 + 2)
    assert records < found.disk < records + 2 * 6 * 10**6


def test_what_a_schedule_keeps_on_the_device_counts_as_its_memory(tmp_path):
    _, run, *_ = plan(tmp_path)
    config = run.spec.config

    def needed(**settings):
        schedule = dataclasses.replace(config.schedule, **settings)
        spec = dataclasses.replace(run.spec, config=dataclasses.replace(config, schedule=schedule))
        return estimate.estimate(dataclasses.replace(run, spec=spec), SPEED).memory

    # The same records as on the disk; and agents from before the updates.
    records = 6 * 4 * 21 * (32 * 32 * 3 + 4 * 3 + 4 + 2)
    assert needed(replay="device") - needed() == records
    kept = 6 * memory.member_bytes(make_agent(run.spec))
    assert needed(collect="beside") - needed() == kept


def test_time_is_linear_in_each_speed_and_falls_with_what_is_done(tmp_path):
    _, targets, *_ = plan(tmp_path)

    def seconds(run=targets, **changes):
        return estimate.estimate(run, dataclasses.replace(SPEED, **changes)).seconds

    ticks = SPEED.tick_seconds
    doubled = {task: 2 * x for task, x in ticks.items()}
    slower = seconds(update_seconds=1.0) - seconds()
    assert slower == pytest.approx(seconds() - seconds(update_seconds=0.0))
    assert seconds(tick_seconds=doubled) - seconds() == pytest.approx(
        seconds() - seconds(tick_seconds=dict.fromkeys(ticks, 0.0))
    )
    assert seconds(workers=2, update_seconds=0.0) == seconds(update_seconds=0.0) / 2
    compiling = dict.fromkeys(TASKS, 7.0)
    assert seconds(tick_compile_seconds=compiling) == seconds() + 7.0 * len(targets.spec.tasks)
    half = dataclasses.replace(targets, state="cut", progress=0.5)
    assert seconds(half) == pytest.approx(seconds() / 2)


def test_time_memory_and_disk_are_linear_in_the_number_of_agents(tmp_path):
    one, two, three = (
        estimate.estimate(plan(tmp_path, TWO_TARGETS[0], seeds=range(n))[1], SPEED)
        for n in (1, 2, 3)
    )
    for name in ("seconds", "memory", "disk"):
        first, second, third = (getattr(x, name) for x in (one, two, three))
        assert third - second == pytest.approx(second - first)
        assert second > first


def test_memory_of_chunks_is_that_of_one_chunk(tmp_path):
    _, targets, *_ = plan(tmp_path)

    def memory(**mapping):
        schedule = dataclasses.replace(CONFIG.schedule, **mapping)
        spec = dataclasses.replace(
            targets.spec, config=dataclasses.replace(CONFIG, schedule=schedule)
        )
        return estimate.estimate(dataclasses.replace(targets, spec=spec), SPEED).memory

    chunks = [memory(mapping="chunks", mapping_chunk=n) for n in (1, 2, 6, 10)]
    assert np.diff(chunks).tolist() == [1000, 4000, 0]
    assert memory(mapping="vmap") == chunks[-1]


def from_files(run):
    """The run with nothing of its replay on an accelerator."""
    config = run.spec.config
    schedule = dataclasses.replace(config.schedule, replay="files")
    spec = dataclasses.replace(run.spec, config=dataclasses.replace(config, schedule=schedule))
    return dataclasses.replace(run, spec=spec)


# Of 6 agents: where 3, 4 or 5 fit, they go in two turns of 3.
@pytest.mark.parametrize(
    ("fitting", "chunk"), [(0.5, 1), (2.5, 2), (3.5, 3), (5.9, 3), (6.1, None)]
)
def test_updates_go_in_chunks_of_as_many_agents_as_an_accelerator_has_memory_for(
    tmp_path, monkeypatch, fitting, chunk
):
    targets = from_files(plan(tmp_path)[1])
    one = SimpleNamespace(temp_size_in_bytes=10**6)
    beside = estimate.estimate(targets, dataclasses.replace(SPEED, update_bytes=0)).memory
    limit = (beside + fitting * 10**6) / memory.MEMORY_SHARE
    device = SimpleNamespace(memory_stats=lambda: {"bytes_limit": limit})
    monkeypatch.setattr(memory.jax, "default_backend", lambda: "gpu")
    monkeypatch.setattr(memory.jax, "local_devices", lambda: [device])
    monkeypatch.setattr(
        memory, "compiled_update", lambda _: SimpleNamespace(memory_analysis=lambda: one)
    )
    schedule = memory.in_memory(targets.spec).config.schedule
    expected = ("auto", 1) if chunk is None else ("chunks", chunk)
    assert (schedule.mapping, schedule.mapping_chunk) == expected


def test_several_accelerators_work_at_once_and_each_has_memory_for_its_own(tmp_path, monkeypatch):
    targets = from_files(plan(tmp_path)[1])  # of 6 agents
    one = SimpleNamespace(temp_size_in_bytes=10**6)
    fixed = dataclasses.replace(SPEED, update_bytes=0, tick_seconds=dict.fromkeys(TASKS, 0.0))
    alone = estimate.estimate(targets, fixed)
    limit = (alone.memory / 2 + 2.5 * 10**6) / memory.MEMORY_SHARE
    device = SimpleNamespace(memory_stats=lambda: {"bytes_limit": limit})
    monkeypatch.setattr(memory.jax, "default_backend", lambda: "gpu")
    monkeypatch.setattr(memory.jax, "local_devices", lambda: [device, device])
    monkeypatch.setattr(
        memory, "compiled_update", lambda _: SimpleNamespace(memory_analysis=lambda: one)
    )
    both = estimate.estimate(targets, fixed)
    assert both.seconds == alone.seconds / 2 and both.memory == alone.memory // 2
    assert estimate.estimate(targets, fixed, devices=1) == alone
    # Of the 3 agents of each, 2 at once.
    assert memory.in_memory(targets.spec).config.schedule.mapping_chunk == 2


def test_on_a_cpu_agents_are_updated_one_by_one_as_they_are(tmp_path):
    _, targets, *_ = plan(tmp_path)
    assert memory.in_memory(targets.spec) == targets.spec


def test_the_plan_names_runs_needs_states_and_totals(tmp_path):
    source, targets, *_ = plan(tmp_path)
    finish(source, tmp_path)
    (tmp_path / "elsewhere").mkdir()
    lines = plan_table(plan(tmp_path), SPEED).splitlines()
    rows = {}
    for line in lines[2:-1]:
        first, *others = line.split()
        if first.isdecimal():
            rows[others[0]] = [first, *others[1:]]
            name = others[0]
        else:  # the rest of a long name
            rows[name + first] = rows.pop(name)
            name += first
    assert set(rows) == {run.name for run in plan(tmp_path)}
    assert max(map(len, lines)) <= 100
    number, *source_row = rows[HOPPERS_SOURCE]
    assert source_row[-4:] == ["done", "-", "-", "-"]
    assert rows[HOPPER][1:4] == ["6", number, "missing"]
    agents = sum(len(run.cells) for run in plan(tmp_path))
    assert lines[-1].split()[:2] == ["together", str(agents)]


def test_times_are_ranges_of_the_measured_updates_and_of_what_is_not_counted():
    # The fastest tenth takes 0.8 of the middle one, the slowest twice, and half as much again.
    assert estimate.span(100.0, SPEED) == "1.3 to 5.0 min"
    assert estimate.span(10.0, SPEED) == "8 to 30 s"
    assert estimate.span(20_000.0, SPEED) == "4.4 to 16.7 h"
    assert estimate.span(1e6, SPEED) == "9.3 to 34.7 days"


def test_a_plan_of_what_is_done_needs_no_measurement(tmp_path):
    sweep(tmp_path)
    assert "done" in plan_table(plan(tmp_path), None)


def test_runs_of_every_method_can_be_estimated():
    hopper = dataclasses.replace(TABLES["table-16"], targets=("Hopper",))
    runs = plan_runs(shown(hopper), CONFIG, "nowhere")
    assert {run.spec.method.NAME for run in runs} == {"scratch", "uae", "meta"}
    ticks = {task: 0.01 for run in runs for task in run.spec.tasks}
    speed = dataclasses.replace(SPEED, tick_seconds=ticks, tick_compile_seconds=ticks)
    assert all(estimate.estimate(run, speed).memory > 0 for run in runs)
