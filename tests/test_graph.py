"""The graph of runs: how cells become populations, in which order, and what is left to do."""

import dataclasses
import shutil

import pytest

from dreamer_jax.config import preset
from experiments.reports.outcomes import read_outcomes
from experiments.runs.folder import folders, read_cells
from experiments.thesis import grid
from experiments.thesis.graph import plan_runs
from experiments.thesis.grid import FIGURES, TABLES, closure, shown
from runs import CONFIG, finish


def cells_of(*entries, seeds=grid.SEEDS):
    return [cell for entry in entries for cell in shown(entry, seeds)]


def plan(*entries, root="nowhere", seeds=grid.SEEDS, config=CONFIG):
    return plan_runs(cells_of(*entries, seeds=seeds), config, root)


EVERYTHING = (*TABLES.values(), *FIGURES.values())
SMALL = dataclasses.replace(TABLES["table-3"], counts=(2,), omegas=(0.1, 0.2))


def finish_all(runs, root, **settings):
    for run in runs:
        finish(run, root, **settings)


def test_runs_are_a_partition_of_the_cells_that_are_needed():
    names = [cell for run in plan(*EVERYTHING) for cell in run.cells]
    assert sorted(names) == sorted(cell.name for cell in closure(cells_of(*EVERYTHING)))


def test_the_targets_and_baselines_of_a_table_are_one_population_of_57():
    *sources, targets = plan(TABLES["table-3"])
    assert [len(run.cells) for run in sources] == [1, 1, 1]
    assert len(targets.cells) == len(targets.spec.members) == 57
    assert targets.needs == tuple(run.name for run in sources)


def test_targets_with_meta_models_of_two_to_four_sources_are_one_population():
    runs = plan(TABLES["table-16"])
    # An autoencoder, 6 agents on it, and for each target 9 of meta-models and 3 baselines.
    assert sorted(len(run.cells) for run in runs) == sorted([1] + 6 * [1] + 6 * [9] + 6 * [3])
    (run,) = (run for run in runs if run.name == "bullet-Hopper-meta")
    assert run.spec.method.reward_counts == (2, 3, 4)
    assert run.spec.method.reward_sources == tuple(
        f"bullet-{task}-uae-seed-0" for task in grid.SOURCES["Hopper"]
    )


@pytest.mark.parametrize("entries", [(TABLES["table-7"],), EVERYTHING])
def test_each_agent_is_the_member_that_its_cell_says(entries):
    cells = {cell.name: cell for cell in closure(cells_of(*entries))}
    places = {}
    for run in plan(*entries):
        assert len(run.spec.members) == len(run.cells)
        for name, member in zip(run.cells, run.spec.members, strict=True):
            cell = places[name] = cells[name]
            assert member.seed == cell.seed
            assert member.tags.get("omega") == cell.omega
            if cell.method == "meta":
                assert member.tags["sources"] == len(cell.reward_sources)
            if cell.method == "fractional" and len(run.spec.method.sources) > 1:
                assert member.tags["source"] == "bullet-" + "+".join(cell.source.tasks) + "-seed-0"


def test_a_run_comes_after_those_it_needs():
    done = set()
    for run in plan(*EVERYTHING):
        assert set(run.needs) <= done
        done.add(run.name)


def test_agents_for_several_tasks_take_twice_the_environment_steps():
    steps = {len(run.spec.tasks): run.spec.config.schedule for run in plan(*EVERYTHING)}
    assert {tasks: schedule.environment_steps for tasks, schedule in steps.items()} == {
        1: 160, 2: 320, 3: 320, 4: 320,
    }  # fmt: skip


def test_what_is_done_is_not_planned_again(tmp_path):
    finish_all(plan(TABLES["table-3"]), tmp_path)
    # The same cells, by another metric and as a figure.
    for entry in (TABLES["table-3"], TABLES["table-4"], FIGURES["figure-16"]):
        assert {run.state for run in plan(entry, root=tmp_path)} == {"done"}


def test_agents_that_another_table_made_are_shared(tmp_path):
    finish_all(plan(FIGURES["figure-36"]), tmp_path)
    (targets,) = (run for run in plan(TABLES["table-3"], root=tmp_path) if len(run.cells) > 3)
    assert len(targets.cells) == 54 and not targets.spec.method.baseline


def test_what_is_missing_of_a_population_is_made_in_another(tmp_path):
    finish_all(plan(SMALL, seeds=(0,)), tmp_path)
    runs = plan(SMALL, seeds=(0, 1, 2), root=tmp_path)
    (new,) = (run for run in runs if run.state == "missing")
    assert new.name == "bullet-Hopper-fractional-2"
    assert new.spec.seeds == (1, 2) and new.spec.method.baseline
    finish(new, tmp_path)
    assert {run.state for run in plan(SMALL, root=tmp_path)} == {"done"}
    outcomes = read_outcomes(tmp_path, cells_of(SMALL))
    assert {outcome.state for outcome in outcomes.values()} == {"done"}


def test_what_is_missing_and_no_product_is_split_into_products(tmp_path):
    whole, more = SMALL, dataclasses.replace(SMALL, omegas=(0.1, 0.2, 0.3))
    finish_all(plan(dataclasses.replace(whole, omegas=(0.1,)), seeds=(0,)), tmp_path)
    runs = [run for run in plan(more, seeds=(0, 1), root=tmp_path) if run.state == "missing"]
    # Fraction 0.1 lacks seed 1, the others both; the baseline lacks seed 1.
    assert {(run.spec.method.omegas, run.spec.seeds, run.spec.method.baseline) for run in runs} == {
        ((0.1,), (1,), True),
        ((0.2, 0.3), (0, 1), False),
    }


def test_other_source_seeds_are_other_agents(tmp_path):
    finish_all(plan(SMALL, seeds=(0, 1)), tmp_path)
    runs = [run for run in plan(SMALL, seeds=(1,), root=tmp_path) if run.state == "missing"]
    assert [run.name for run in runs] == [
        "bullet-HalfCheetah+Walker2D-seed-1", "bullet-Hopper-fractional-2",
    ]  # fmt: skip


def test_a_run_that_was_cut_comes_first_with_its_share(tmp_path):
    source, targets = plan(SMALL)
    finish(source, tmp_path)
    finish(targets, tmp_path, share=0.5)
    first, *others = plan(TABLES["table-3"], root=tmp_path)
    assert (first.name, first.state, first.needs) == (targets.name, "cut", ())
    assert 0.3 < first.progress < 0.7
    # Sources of three and four tasks, and what is missing of the targets in two products.
    assert [run.state for run in others] == ["done"] + 4 * ["missing"]


def test_sources_of_what_is_done_are_not_missed(tmp_path):
    source, targets = plan(SMALL)
    finish(targets, tmp_path)
    assert [run.state for run in plan(SMALL, root=tmp_path)] == ["done"]


def test_results_that_were_copied_are_done_there_too(tmp_path):
    finish_all(plan(SMALL), tmp_path / "here" / "debug")
    shutil.copytree(tmp_path / "here", tmp_path / "there")
    shutil.rmtree(tmp_path / "here")
    root = tmp_path / "there" / "debug"
    assert {run.state for run in plan(SMALL, root=root)} == {"done"}
    outcomes = read_outcomes(root, cells_of(SMALL))
    assert {outcome.state for outcome in outcomes.values()} == {"done"}
    # Where checkpoints were left behind, what is evaluated to the end counts.
    for folder in root.iterdir():
        shutil.rmtree(folder / "checkpoints")
    assert {run.state for run in plan(SMALL, root=root)} == {"done"}


def test_a_run_of_which_nothing_was_kept_is_begun_anew_under_its_name(tmp_path):
    _, targets = plan(SMALL, seeds=(0,))
    finish(targets, tmp_path)
    shutil.rmtree(tmp_path / targets.name / "checkpoints")
    (tmp_path / targets.name / "metrics.jsonl").unlink()
    assert folders(tmp_path) == {}
    runs = plan(SMALL, seeds=(0, 1), root=tmp_path)
    assert [(run.name, run.state) for run in runs][1] == (targets.name, "missing")


def test_a_folder_of_something_else_keeps_its_name(tmp_path):
    (tmp_path / "bullet-Hopper-fractional").mkdir()
    assert plan(SMALL, root=tmp_path)[-1].name == "bullet-Hopper-fractional-2"


def test_results_of_other_settings_are_refused_with_the_difference(tmp_path):
    finish_all(plan(SMALL), tmp_path)
    learning = dataclasses.replace(CONFIG.learning, batch_size=3)
    other = dataclasses.replace(CONFIG, learning=learning)
    with pytest.raises(ValueError, match=r"other settings.*learning.batch_size: 2 / 3.*--results"):
        plan(SMALL, root=tmp_path, config=other)


def test_how_members_are_mapped_is_no_other_setting(tmp_path):
    finish_all(plan(SMALL), tmp_path)
    schedule = dataclasses.replace(CONFIG.schedule, mapping="chunks", mapping_chunk=3)
    other = dataclasses.replace(CONFIG, schedule=schedule)
    assert {run.state for run in plan(SMALL, root=tmp_path, config=other)} == {"done"}


@pytest.mark.parametrize("name", ["run.json", "cells.json", "metrics.jsonl"])
def test_a_damaged_run_is_told_and_the_others_are_planned(name, tmp_path):
    source, targets = plan(SMALL)
    finish_all([source, targets], tmp_path)
    (tmp_path / targets.name / name).write_text("{\nnot JSON\n")
    states = {run.name: run for run in plan(SMALL, root=tmp_path)}
    assert states[targets.name].state == "corrupt"
    assert name in states[targets.name].problem
    with pytest.warns(UserWarning, match=name):
        outcomes = read_outcomes(tmp_path, cells_of(SMALL))
    assert {outcome.state for outcome in outcomes.values()} == {"missing"}


def test_cells_are_named_in_the_order_of_the_members(tmp_path):
    _, targets = plan(SMALL)
    finish(targets, tmp_path)
    names = read_cells(tmp_path / targets.name)
    outcomes = read_outcomes(tmp_path, cells_of(SMALL))
    # The made-up return of an evaluation is the place of the member.
    for cell in cells_of(SMALL):
        (returns,) = outcomes[cell].returns.values()
        assert set(returns) == {float(names.index(cell.name))}


def test_presets_of_the_grid_are_those_of_single_runs():
    run = plan(TABLES["table-3"], config=preset("thesis"))[-1]
    assert run.spec.config == preset("thesis")


def test_methods_of_comparison_are_populations_of_their_own_from_the_same_sources():
    table = dataclasses.replace(TABLES["table-3"], compared=grid.may_be_compared())
    cells = {cell.name: cell for cell in cells_of(table)}
    *sources, targets, tuned, frozen = plan(table)
    assert [len(run.cells) for run in (targets, tuned, frozen)] == [57, 9, 9]
    assert [run.name for run in (tuned, frozen)] == [
        "bullet-Hopper-fine-tuning", "bullet-Hopper-frozen-source",
    ]  # fmt: skip
    assert targets.needs == tuned.needs == frozen.needs == tuple(run.name for run in sources)
    for run in (tuned, frozen):
        for name, member in zip(run.cells, run.spec.members, strict=True):
            assert member.seed == cells[name].seed
            source = "bullet-" + "+".join(cells[name].source.tasks) + "-seed-0"
            assert member.tags["source"] == source
