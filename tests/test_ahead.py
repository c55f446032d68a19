"""Phases collected beside updates: which policy plays them, and that a round is done or is not.

P = 2 members, one task, 5 rounds of 2 updates, the first of random actions. With the replay in
files and on the device. Agents are of one number.
"""

import dataclasses
import signal
import threading

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from accidents import Killed, full_disk, in_call, raising
from dreamer_jax import device_round, population
from dreamer_jax.config import preset
from dreamer_jax.logs import read_metrics
from dreamer_jax.population import Member, Population
from dreamer_jax.training import Run
from probes import Inside, Probe
from small_agent import Small

pytestmark = pytest.mark.usefixtures("small_agents_are_diagnosed")

ENV = Probe()
MEMBERS = (Member(0, "one"), Member(7, "two"))
UPDATES = {"files": (population, "update_members"), "device": (device_round, "store_and_update")}


def agent_with(replay, collect="beside"):
    config = preset("debug")
    settings = {"environment_steps": 200, "checkpoint_every": 80}
    settings |= {"replay": replay, "collect": collect}
    schedule = dataclasses.replace(config.schedule, **settings)
    return Small(dataclasses.replace(config, schedule=schedule), 2)


def run_in(directory, agent, env=ENV, **options):
    return Run(agent, env, ("probe/point",), MEMBERS, directory, **({"videos": 0} | options))


def trained(directory, agent, **options):
    run = run_in(directory, agent, **options)
    outcome = run.train()
    run.close()
    return run, outcome


def metrics(directory):
    return (directory / "metrics.jsonl").read_bytes()


@pytest.fixture(scope="module", params=UPDATES)
def agent(request):
    return agent_with(request.param)


@pytest.fixture(scope="module")
def finished(tmp_path_factory, agent):
    directory = tmp_path_factory.mktemp("beside")
    run, outcome = trained(directory, agent)
    assert outcome == "finished"
    return directory, run


def assert_goes_on_as(finished, directory, agent):
    whole_directory, whole = finished
    resumed, outcome = trained(directory, agent, resume=True)
    assert outcome == "finished"
    assert metrics(directory) == metrics(whole_directory)
    chex.assert_trees_all_equal(resumed.state, whole.state)
    for member in range(2):
        held = [run.replay.path(member, 0).read_bytes() for run in (whole, resumed)]
        assert held[0] == held[1]


def in_update(patch, agent, number, what):
    """Does something in the midst of the program of updates of that number."""
    in_call(patch, *UPDATES[agent.config.schedule.replay], number, what)


def first_update(agent, rounds):
    """The number of the first program of updates after so many rounds."""
    return 2 * rounds - 1 if agent.config.schedule.replay == "files" else rounds


# --- which policy ---------------------------------------------------------------------------------


def test_phases_are_played_by_the_policy_from_before_the_updates_beside_them(
    agent, finished, tmp_path, monkeypatch
):
    played, collect = {}, Population.collect

    def noting(self, state, phase, mode):
        if mode != "evaluate":
            played[phase] = np.asarray(state.updates).tolist()
        return collect(self, state, phase, mode)

    monkeypatch.setattr(Population, "collect", noting)
    trained(tmp_path, agent)
    # The second is the first for which there is a policy: it waits for its first updates.
    assert played == {0: [0, 0], 1: [2, 2], 2: [2, 2], 3: [4, 4], 4: [6, 6]}
    assert metrics(tmp_path) == metrics(finished[0])


def test_rows_are_those_of_a_run_without_as_long_as_the_policy_is(agent, finished, tmp_path):
    trained(tmp_path, agent_with(agent.config.schedule.replay, collect="before"))
    own, others = (metrics(folder).splitlines() for folder in (finished[0], tmp_path))
    # Of two members: two phases, and the updates and evaluations after each.
    assert own[:12] == others[:12]
    assert own[12:14] != others[12:14] and '"collect"' in own[12].decode()
    # What comes after tells of the same steps in the same order.
    columns = ("kind", "member", "env_steps", "updates", "policy", "healthy")
    same = [[[row.get(x) for x in columns] for row in read_metrics(y)]
            for y in (finished[0], tmp_path)]  # fmt: skip
    assert same[0] == same[1] and len(own) == 5 * 6


def test_updates_are_made_while_the_phase_is_played(agent, tmp_path, monkeypatch):
    updating, waited = threading.Event(), []
    in_update(monkeypatch, agent, first_update(agent, 2), updating.set)

    class Waiting(Probe):
        def check(self):
            if threading.current_thread() is not threading.main_thread():
                waited.append(updating.wait(60))

    assert trained(tmp_path, agent, env=Waiting())[1] == "finished"
    assert waited == [True] * 3


def test_an_environment_without_a_host_is_played_beside_updates_too(agent, finished, tmp_path):
    assert trained(tmp_path, agent, env=Inside())[1] == "finished"
    assert metrics(tmp_path) == metrics(finished[0])


# --- all of a round, or nothing of it -------------------------------------------------------------


def test_ctrl_c_ends_the_round_with_its_phase(agent, finished, tmp_path, monkeypatch):
    run = run_in(tmp_path, agent)
    with monkeypatch.context() as patch:
        in_update(patch, agent, first_update(agent, 3), lambda: signal.raise_signal(signal.SIGINT))
        assert run.train() == "stopped"
    run.close()
    assert (run.counters.rounds, run.counters.updates) == (4, 6)
    assert_goes_on_as(finished, tmp_path, agent)


@pytest.mark.parametrize("earlier", [0, 1])
def test_a_run_killed_in_the_midst_of_a_round_equals_one_that_was_not(
    agent, finished, tmp_path, monkeypatch, earlier
):
    run = run_in(tmp_path, agent)
    with monkeypatch.context() as patch, pytest.raises(Killed):
        in_update(patch, agent, first_update(agent, 3) - earlier, raising(Killed()))
        run.train()
    run._ahead.wait()  # a process that is killed takes its thread along
    run.close()
    assert_goes_on_as(finished, tmp_path, agent)


class Broken(Probe):
    """A probe whose simulators report an error once the phase of that number was played, by the
    thread or in evaluation."""

    def __init__(self, phases, on_thread, what=lambda: None):
        super().__init__()
        self.left, self.on_thread, self.what = phases, on_thread, what

    def check(self):
        if (threading.current_thread() is not threading.main_thread()) == self.on_thread:
            self.left -= 1
            if self.left == 0:
                self.what()
                raise RuntimeError("the simulator of probe/point died")


# Beside the third round: the second phase on the thread; or the fifth off it, after two phases and
# an evaluation after each of two rounds.
@pytest.mark.parametrize(
    ("phases", "on_thread"), [(2, True), (5, False)], ids=["ahead", "evaluate"]
)
def test_a_simulator_that_dies_leaves_the_run_as_it_was_before_the_round(
    agent, finished, tmp_path, phases, on_thread
):
    env = Broken(phases, on_thread)
    run = run_in(tmp_path, agent, env=env)
    with pytest.raises(RuntimeError, match="probe/point died"):
        run.train()
    run.close()
    assert (run.counters.rounds, run.counters.updates) == (3, 4)
    assert not [x for x in threading.enumerate() if x.name.startswith("collect")]
    assert_goes_on_as(finished, tmp_path, agent)


def test_no_more_batches_are_learned_from_once_the_phase_beside_them_has_failed(
    tmp_path, monkeypatch
):
    agent, made = agent_with("files"), []
    run, update = run_in(tmp_path, agent, env=Broken(2, on_thread=True)), population.update_members

    def counting(*arguments, **options):
        made.append(len(made))
        if len(made) == first_update(agent, 3):
            run._ahead.wait()
        return update(*arguments, **options)

    monkeypatch.setattr(population, "update_members", counting)
    with pytest.raises(RuntimeError, match="probe/point died"):
        run.train()
    run.close()
    assert len(made) == first_update(agent, 3)


def test_a_simulator_given_up_after_ctrl_c_is_told_and_ends_the_run_before_the_round(
    agent, finished, tmp_path, monkeypatch, capsys
):
    """As one that is stuck is, when it is hurried."""
    interrupted = threading.Event()
    env = Broken(2, on_thread=True, what=lambda: interrupted.wait(60))
    run = run_in(tmp_path, agent, env=env)

    def interrupt():
        signal.raise_signal(signal.SIGINT)
        interrupted.set()

    with monkeypatch.context() as patch:
        in_update(patch, agent, first_update(agent, 3), interrupt)
        assert run.train() == "stopped"
    run.close()
    assert "this phase is given up: the simulator of probe/point died" in capsys.readouterr().out
    assert (run.counters.rounds, run.counters.updates) == (3, 4)
    assert_goes_on_as(finished, tmp_path, agent)


def test_a_phase_that_cannot_be_written_leaves_the_run_as_it_was_before_the_round(
    agent, finished, tmp_path, monkeypatch
):
    run = run_in(tmp_path, agent)
    with monkeypatch.context() as patch, pytest.raises(OSError, match="no space left"):
        full_disk(patch, 3 * 21)
        run.train()
    run.close()
    assert (run.counters.rounds, run.counters.updates) == (3, 4)
    assert_goes_on_as(finished, tmp_path, agent)


def test_updates_that_fail_leave_the_run_as_it_was_before_the_round(
    agent, finished, tmp_path, monkeypatch
):
    run = run_in(tmp_path, agent)
    with monkeypatch.context() as patch, pytest.raises(RuntimeError, match="no such kernel"):
        in_update(patch, agent, first_update(agent, 3), raising(RuntimeError("no such kernel")))
        run.train()
    run.close()
    assert (run.counters.rounds, run.counters.updates) == (3, 4)
    assert_goes_on_as(finished, tmp_path, agent)


def test_a_member_that_turns_not_finite_is_frozen_and_the_other_goes_on(
    agent, finished, tmp_path, capsys
):
    directory, whole = finished
    run = run_in(tmp_path, agent)
    run.state.params["loss"]["shift"] = jnp.array([0.0, jnp.nan])
    assert run.train() == "finished"
    run.close()
    assert "member 1 (two, seed 7) met a loss" in " ".join(capsys.readouterr().out.split())
    np.testing.assert_array_equal(run.state.healthy, [True, False])
    rows, others = ([r for r in read_metrics(d)] for d in (tmp_path, directory))
    assert [r for r in rows if r["member"] == 0] == [r for r in others if r["member"] == 0]
    chex.assert_trees_all_equal(*(jax.tree.map(lambda x: x[0], r.state) for r in (run, whole)))
