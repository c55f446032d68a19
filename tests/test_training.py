"""The schedule, and runs that are stopped, killed, resumed or broken."""

import dataclasses
import json
import shutil
import signal

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from compilation import update_with_quick_code
from dreamer_jax import config as configs
from dreamer_jax import population
from dreamer_jax.agent import Agent
from dreamer_jax.config import preset
from dreamer_jax.logs import read_metrics
from dreamer_jax.population import Member, update_members
from dreamer_jax.schedule import Counters, Schedule
from dreamer_jax.training import NonFiniteError, Run
from probes import BrokenProbe, Probe, Walk

CONFIG = preset("debug")
# Shared, so that all runs of these tests share their compiled functions.
AGENT, ENV = Agent(CONFIG, 2), Probe()
MEMBERS = (Member(0, "one"), Member(7, "two", {"omega": 0.2}))


def run_in(directory, **options):
    options = {"videos": 0, **options}
    return Run(options.pop("agent", AGENT), options.pop("env", ENV), ("probe/point",),
               options.pop("members", MEMBERS), directory, **options)  # fmt: skip


def trained(directory, **options):
    run = run_in(directory, **options)
    outcome = run.train()
    run.close()
    return run, outcome


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    directory = tmp_path_factory.mktemp("finished")
    run, outcome = trained(directory, videos=2)
    assert outcome == "finished"
    return directory, run


def test_the_schedule_of_the_thesis_for_one_task():
    schedule = Schedule(preset("thesis").schedule, tasks=1)
    assert schedule.prefill_rounds == 5
    assert schedule.rounds == 1000
    assert schedule.evaluations == 100
    # 100 updates before each of 995 phases, and after the last.
    assert schedule.updates == 99_600
    assert preset("thesis").schedule.phase_ticks == 500


def test_the_schedule_of_the_thesis_for_several_tasks():
    schedule = Schedule(preset("thesis").schedule, tasks=4)
    assert schedule.prefill_rounds == 1
    assert schedule.environment_steps(1) == 4000
    assert schedule.updates_due(1) == 400
    assert schedule.rounds == 250


def test_actions_follow_in_the_order_of_algorithm_3():
    schedule = Schedule(dataclasses.replace(CONFIG.schedule, evaluate_every=80), tasks=1)
    done, order = Counters(), []
    while (action := schedule.next(done)) != "done":
        order.append(action[0])
        steps = schedule.environment_steps(done.rounds)
        change = {
            "update": {"updates": done.updates + 1},
            "evaluate": {"evaluations": steps // 80},
        }.get(action, {"rounds": done.rounds + 1})
        done = dataclasses.replace(done, **change)
    assert "".join(order) == "p" + "uu" + "c" + "uue" + "c" + "uu" + "c" + "uue"
    assert done.updates == schedule.updates


def test_a_run_writes_a_row_for_every_member_and_event(finished):
    directory, _ = finished
    rows = read_metrics(directory)
    counts = {}
    for row in rows:
        counts[row["kind"], row["member"]] = counts.get((row["kind"], row["member"]), 0) + 1
    for member in range(2):
        assert counts["collect", member] == 4
        assert counts["update", member] == 4
        assert counts["evaluation", member] == 4
    assert {row["seed"] for row in rows} == {0, 7}
    assert {row.get("omega") for row in rows if row["label"] == "two"} == {0.2}
    assert [row["policy"] for row in rows if row["kind"] == "collect"][:3] == [
        "random", "random", "explore",
    ]  # fmt: skip
    last = [row for row in rows if row["kind"] == "evaluation"][-1]
    assert (last["env_steps"], last["updates"]) == (160, 8)


def test_a_run_fills_its_replay_and_writes_videos(finished):
    directory, run = finished
    np.testing.assert_array_equal(run.replay.lengths, np.full((2, 1), 4 * 21))
    assert len(list((directory / "videos").glob("evaluation_*.mp4"))) == 2


def test_updates_are_not_compiled_again_after_the_first(finished):
    before = update_members._cache_size()
    _, run = finished
    learning = CONFIG.learning
    batch = run.replay.sample([0, 7], 0, learning.batch_size, learning.sequence_length)
    state = jax.tree.map(jnp.copy, run.state)
    sums = jax.tree.map(jnp.copy, run.sums)
    agent = AGENT.on_any_schedule()
    update_members(agent, state, sums, batch, mapping="auto", chunk=1)
    assert update_members._cache_size() == before


def test_runs_that_differ_in_their_schedules_share_their_programs(finished, tmp_path):
    schedule = dataclasses.replace(
        CONFIG.schedule, environment_steps=120, checkpoint_every=10, updates_per_phase=1
    )
    agent = Agent(dataclasses.replace(CONFIG, schedule=schedule), 2)
    before = update_members._cache_size()
    _, outcome = trained(tmp_path, agent=agent)
    assert outcome == "finished" and update_members._cache_size() == before


def test_members_of_one_population_do_not_influence_one_another(finished, tmp_path):
    directory, whole = finished
    run, _ = trained(tmp_path, members=(Member(3, "other"), MEMBERS[1]))
    rows, others = (
        [row for row in read_metrics(folder) if row["member"] == 1]
        for folder in (tmp_path, directory)
    )
    assert rows == others
    second, other = (jax.tree.map(lambda x: x[1], one.state) for one in (run, whole))
    chex.assert_trees_all_equal(second, other)
    first = run.state.params["actor"]["out"]["kernel"][0]
    assert not np.allclose(first, whole.state.params["actor"]["out"]["kernel"][0])


def stop_after(run, actions):
    """Lets a run do some actions, then stop as a Ctrl-C in the midst of updates would."""
    original, left = population.update_members, [actions]

    def counting(*arguments, **options):
        left[0] -= 1
        if left[0] == 0:
            signal.raise_signal(signal.SIGINT)
        return original(*arguments, **options)

    population.update_members = counting
    try:
        return run.train()
    finally:
        population.update_members = original
        run.close()


@pytest.mark.parametrize("updates", [1, 2, 5])
def test_a_run_stopped_by_ctrl_c_and_resumed_equals_one_that_was_not(finished, tmp_path, updates):
    directory, whole = finished
    run = run_in(tmp_path)
    assert stop_after(run, updates) == "stopped"
    assert run.counters.updates == updates
    resumed, outcome = trained(tmp_path, resume=True)
    assert outcome == "finished"
    metrics = [(folder / "metrics.jsonl").read_bytes() for folder in (directory, tmp_path)]
    assert metrics[0] == metrics[1]
    chex.assert_trees_all_equal(resumed.state, whole.state)


class Killed(BaseException):
    """Stands for what ends a process without letting it save."""


def killing_after(updates):
    """What takes the place of `update_members` to kill a run after some updates."""
    original, left = population.update_members, [updates]

    def killing(*arguments, **options):
        left[0] -= 1
        if left[0] < 0:
            raise Killed
        return original(*arguments, **options)

    return killing


@pytest.mark.parametrize("updates", [1, 4, 7])
def test_a_run_killed_between_checkpoints_and_resumed_equals_one_that_was_not(
    finished, tmp_path, updates, monkeypatch
):
    directory, whole = finished
    run = run_in(tmp_path)
    monkeypatch.setattr(population, "update_members", killing_after(updates))
    with pytest.raises(Killed):
        run.train()
    run.close()
    monkeypatch.undo()
    resumed, _ = trained(tmp_path, resume=True)
    metrics = [(folder / "metrics.jsonl").read_bytes() for folder in (directory, tmp_path)]
    assert metrics[0] == metrics[1]
    chex.assert_trees_all_equal(resumed.state, whole.state)


def test_a_run_that_deletes_old_records_and_is_killed_goes_on_as_if_it_had_not_been(
    tmp_path, monkeypatch
):
    # Four phases of 21 records each; checkpoints name the lengths after the third and the last.
    schedule = dataclasses.replace(CONFIG.schedule, replay_keep=25)
    options = {"agent": Agent(dataclasses.replace(CONFIG, schedule=schedule), 2)}
    whole, _ = trained(tmp_path / "whole", **options)
    assert (whole.replay.lengths == 84).all() and (whole.replay.deleted == 63 - 25).all()

    killed = run_in(tmp_path / "killed", **options)
    with monkeypatch.context() as patch:
        patch.setattr(population, "update_members", killing_after(7))
        with pytest.raises(Killed):
            killed.train()
    killed.close()
    assert killed.replay.deleted.any()
    resumed, _ = trained(tmp_path / "killed", resume=True, **options)
    metrics = [(tmp_path / name / "metrics.jsonl").read_bytes() for name in ("whole", "killed")]
    assert metrics[0] == metrics[1]
    chex.assert_trees_all_equal(resumed.state, whole.state)


def test_a_run_that_goes_on_draws_no_agents_to_throw_them_away(finished, tmp_path, monkeypatch):
    directory, whole = finished
    shutil.copytree(directory, tmp_path / "run")
    monkeypatch.setattr(population, "init_members", None)
    resumed = run_in(tmp_path / "run", resume=True)
    resumed.close()
    chex.assert_trees_all_equal(resumed.state, whole.state)
    with pytest.raises(TypeError):
        run_in(tmp_path / "another")


def test_a_finished_run_that_is_resumed_changes_nothing(finished):
    directory, whole = finished
    before = (directory / "metrics.jsonl").read_bytes()
    resumed, outcome = trained(directory, resume=True)
    assert outcome == "finished"
    assert (directory / "metrics.jsonl").read_bytes() == before
    chex.assert_trees_all_equal(resumed.state, whole.state)


def test_a_folder_that_holds_a_run_is_not_overwritten(finished):
    with pytest.raises(FileExistsError, match="resume it, or choose another folder"):
        run_in(finished[0])


def test_a_simulator_that_dies_ends_the_run_with_everything_before_it_saved(finished, tmp_path):
    directory, whole = finished
    run = run_in(tmp_path, env=BrokenProbe(phases=3))
    with pytest.raises(RuntimeError, match="probe/point died"):
        run.train()
    run.close()
    assert run.counters.updates == 4
    resumed, _ = trained(tmp_path, resume=True)
    assert (tmp_path / "metrics.jsonl").read_bytes() == (directory / "metrics.jsonl").read_bytes()


def test_a_member_that_turns_not_finite_is_named_and_the_others_finish_as_without_it(
    finished, tmp_path, capsys, monkeypatch
):
    directory, whole = finished
    original, updates, rested = population.update_members, [], []
    monkeypatch.setattr(Probe, "rest", lambda self, slots: rested.append(slots.tolist()), False)

    def poisoning(agent, state, sums, batch, **options):
        updates.append(jax.tree.map(lambda x: np.array(x[1]), state.params))
        if len(updates) == 4:
            reward = batch.reward.copy()
            reward[1, 0, 0] = np.nan
            batch = batch._replace(reward=reward)
        return original(agent, state, sums, batch, **options)

    monkeypatch.setattr(population, "update_members", poisoning)
    run, outcome = trained(tmp_path)
    assert outcome == "finished" and len(updates) == 8
    message = " ".join(capsys.readouterr().out.split())
    assert "member 1 (two, seed 7) met a loss or gradient that is not finite by update 4" in message

    rows, others = ([r for r in read_metrics(d)] for d in (tmp_path, directory))
    assert [r for r in rows if r["member"] == 0] == [r for r in others if r["member"] == 0]
    second = [r for r in rows if r["member"] == 1]
    # Four updates in, after the second evaluation; what it would have played is told as unknown.
    for kind, healthy in (
        ("update", [True, False, False, False]),
        ("evaluation", [True, False, False, False]),
        ("collect", [True, True, False, False]),
    ):
        found = [r for r in second if r["kind"] == kind]
        assert [r["healthy"] for r in found] == healthy, kind
        assert [np.isfinite(r["return"]) for r in found if "return" in r] in ([], healthy)
    assert rested == [[False, healthy] for healthy in (False,) * 3 + (True,) * 5]
    # Bit for bit: the one as in the run without an accident, the other as before its own.
    first, second = (jax.tree.map(lambda x, p=p: x[p], run.state) for p in range(2))
    chex.assert_trees_all_equal(first, jax.tree.map(lambda x: x[0], whole.state))
    chex.assert_trees_all_equal(second.params, updates[3])
    assert not second.healthy and second.updates == 8


def test_a_member_that_was_frozen_stays_so_when_the_run_is_resumed(tmp_path, capsys):
    run = run_in(tmp_path)
    poisoned = run.state.params["reward"]["out"]["bias"].at[1].set(jnp.nan)
    run.state.params["reward"]["out"]["bias"] = poisoned
    assert stop_after(run, 3) == "stopped"
    assert "member 1 (two, seed 7)" in capsys.readouterr().out
    resumed, outcome = trained(tmp_path, resume=True)
    assert outcome == "finished"
    assert "is not finite" not in capsys.readouterr().out, "it was reported before"
    np.testing.assert_array_equal(resumed.state.healthy, [True, False])


def test_a_run_without_a_healthy_member_ends_with_a_clear_error(tmp_path):
    run = run_in(tmp_path)
    run.state.params["reward"]["out"]["bias"] *= jnp.nan
    with pytest.raises(NonFiniteError, match="no member of .* finite"):
        run.train()
    run.close()


def test_an_environment_of_other_sizes_is_refused_naming_both(tmp_path):
    with pytest.raises(ValueError, match="size 3, the agent gives 2"):
        run_in(tmp_path, env=Probe(action_size=3))
    with pytest.raises(ValueError, match="renders 64 pixels, the agent reads 32"):
        run_in(tmp_path, env=Probe(image_size=64))
    with pytest.raises(ValueError, match="takes continuous actions, the agent gives discrete"):
        run_in(tmp_path, agent=Agent(CONFIG, 2, discrete=True))


def learning_config(environment_steps, prefill_phases, **exploration):
    """Small networks, which solve a probe in some hundred updates."""
    return dataclasses.replace(
        CONFIG,
        network=dataclasses.replace(
            CONFIG.network,
            convolutions="auto",
            head_units=32,
            hidden_size=64,
            deterministic_size=16,
            stochastic_size=8,
        ),
        learning=dataclasses.replace(
            CONFIG.learning,
            batch_size=8,
            sequence_length=8,
            horizon=5,
            discount=0.5,
            # Without a floor, below which the prior does not learn; and with an actor that does
            # not settle before there is a model.
            free_nats=0.0,
            entropy_scale=0.1,
            model_learning_rate=6e-3,
            value_learning_rate=3e-3,
            actor_learning_rate=1e-3,
        ),
        exploration=dataclasses.replace(CONFIG.exploration, **exploration),
        schedule=dataclasses.replace(
            CONFIG.schedule,
            environment_steps=environment_steps,
            phase_environment_steps=100,
            prefill_phases=prefill_phases,
            updates_per_phase=60,
            evaluate_every=environment_steps,
            checkpoint_every=environment_steps,
        ),
    )


def test_the_probe_is_solved_in_seconds(tmp_path, monkeypatch):
    update_with_quick_code(monkeypatch)
    # The best action is 0.5 everywhere, with reward 1 a step; a random one scores -1/3, and none
    # at all 0. Eight seeds of eight scored 0.77 to 0.97.
    config = learning_config(600, prefill_phases=1, evaluation_action="mean")
    learning = dataclasses.replace(config.learning, actor_learning_rate=2e-3)
    config = dataclasses.replace(config, learning=learning)
    agent, env = Agent(config, 2), Probe(falls=False)
    trained(tmp_path, agent=agent, env=env, members=(Member(0, "probe"),))
    score = [row for row in read_metrics(tmp_path) if row["kind"] == "evaluation"][-1]["return"]
    assert score > 0.7 * config.schedule.phase_ticks


def test_discrete_choices_are_learned_with_their_values(tmp_path, monkeypatch):
    update_with_quick_code(monkeypatch)
    # All experience is random.
    always = {"epsilon_start": 1.0, "epsilon_end": 1.0}
    config = learning_config(1100, prefill_phases=3, **always)
    agent, env, ticks = Agent(config, 3, discrete=True), Walk(), config.schedule.phase_ticks
    # Of eight seeds six learned it: a second one is asked if the first has not.
    for seed in range(2):
        folder = tmp_path / f"seed-{seed}"
        run, _ = trained(folder, agent=agent, env=env, members=(Member(seed, "probe"),))
        rows = read_metrics(folder)
        random = [row["return"] for row in rows if row.get("policy") == "random"]
        assert np.mean(random) < 0.5 * ticks
        # From any cell the best choices lose a tick at most.
        (score,) = (row["return"] for row in rows if row["kind"] == "evaluation")
        assert score <= ticks
        if learned := score > 0.8 * ticks:
            break
    assert learned
    batch = jax.tree.map(lambda x: x[0], run.replay.sample([0], 10**6, 50, 8))
    params = jax.tree.map(lambda x: np.asarray(x)[0], run.state.params)
    posterior, _, _ = jax.jit(agent.observe)(params, batch, jax.random.key(0))
    values = np.asarray(agent.value(params, posterior.features))
    distance = np.abs(Walk.cell_of(batch.image) - Walk.middle)
    near, one, two = (values[~batch.first & (distance == d)].mean() for d in range(3))
    # Discount 0.5: 2, 1 and 0.5 for the best choices, less for an actor that is kept random.
    assert 2.2 > near > 1.4 > one > near / 4 and 1.2 > one > two > -0.2


def test_a_configuration_survives_json():
    config = dataclasses.replace(
        CONFIG, learning=dataclasses.replace(CONFIG.learning, frozen=("encoder",))
    )
    assert configs.from_dict(json.loads(json.dumps(configs.to_dict(config)))) == config


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda: preset("thsis"), "did you mean 'thesis'"),
        (lambda: configs.NetworkConfig(image_size=48), "32 or 64"),
        (lambda: configs.LearningConfig(frozen=("encodr",)), "components are encoder"),
        (lambda: configs.LearningConfig(horizon=1), "at least 2"),
        (lambda: configs.LearningConfig(imagination_starts=0), "2500 posterior states"),
        (lambda: configs.ScheduleConfig(phase_environment_steps=5), "no multiple"),
        (lambda: configs.Config(schedule=configs.ScheduleConfig(replay_keep=49)), "has 50 records"),
        (lambda: configs.from_dict({"network": {"image": 32}}), "unknown settings"),
    ],
)
def test_bad_settings_are_refused_with_a_way_out(change, message):
    with pytest.raises(ValueError, match=message):
        change()
