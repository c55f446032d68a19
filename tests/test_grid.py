"""The thesis's grid: how many agents each table and figure has, and what they need."""

import dataclasses
import itertools

import pytest

from experiments.thesis import grid
from experiments.thesis.grid import FIGURES, TABLES, closure, on_backend, shown

EVERYTHING = [*TABLES.values(), *FIGURES.values()]


def cells_of(entries, seeds=grid.SEEDS):
    return closure(cell for entry in entries for cell in shown(entry, seeds))


def test_the_whole_grid_has_418_agents_each_once():
    cells = cells_of(EVERYTHING)
    # 6 targets x (54 fractional + 9 meta-models + 3 baselines), 16 sources, 6 on the autoencoder.
    assert len(cells) == 6 * (54 + 9 + 3) + 16 + 6 == 418
    assert len({cell.name for cell in cells}) == 418


def test_tables_need_all_that_figures_do():
    assert set(cells_of(FIGURES.values())) == set(cells_of(TABLES.values()))


@pytest.mark.parametrize(
    ("name", "shows", "needs"),
    [
        ("table-3", 57, 3),
        ("table-4", 57, 3),
        ("table-13", 1, 0),
        # The autoencoder, and an agent of each task on it.
        ("table-16", 54 + 18, 1 + 6),
        ("figure-12", 21, 1),
        ("figure-30", 9 + 3, 1 + 4),
        ("figure-36", 18, 0),
        ("figure-39", 1 + 12, 0),
        ("figure-10", 0, 0),
    ],
)
def test_how_many_agents_an_entry_shows_and_what_else_it_needs(name, shows, needs):
    cells = shown((TABLES | FIGURES)[name])
    assert len(cells) == len(set(cells)) == shows
    assert len(closure(cells)) == shows + needs


def test_what_is_needed_comes_before_what_needs_it():
    cells = cells_of(EVERYTHING)
    for place, cell in enumerate(cells):
        assert all(cells.index(needed) < place for needed in cell.needs)


def test_a_target_is_never_among_its_own_sources():
    for target, sources in grid.SOURCES.items():
        assert target not in sources
        assert len(set(sources)) == 4


def test_a_source_agent_is_the_same_whatever_order_its_tasks_are_named_in():
    agents = {grid.multitask("bullet", order, 0) for order in itertools.permutations(grid.TASKS, 6)}
    assert [agent.tasks for agent in agents] == [grid.TASKS]


def test_source_agents_have_the_first_seed_and_targets_all():
    cells = cells_of([TABLES["table-3"]], seeds=(4, 7))
    assert {cell.seed for cell in cells if len(cell.tasks) > 1} == {4}
    assert {cell.seed for cell in cells if cell.method == "fractional"} == {4, 7}


def test_targets_of_other_source_seeds_have_other_names():
    both = [grid.fractional("bullet", "Hopper", 2, 0.1, seed=5, source=source) for source in (0, 5)]
    assert len({cell.name for cell in both}) == 2


def test_on_another_backend_no_agent_is_shared():
    here, there = (
        {cell.name for cell in cells_of([on_backend(TABLES["table-3"], backend)])}
        for backend in ("bullet", "brax")
    )
    assert len(here) == len(there) and not here & there


def test_methods_of_comparison_are_rows_where_they_were_asked_for_or_are_there():
    table = TABLES["table-3"]
    whole = dataclasses.replace(table, compared=grid.may_be_compared())
    # Two methods of three numbers of sources and three seeds.
    assert set(shown(table)) < set(shown(whole)) and len(shown(whole)) == 57 + 18
    assert grid.with_compared(table, ()) == table
    (cell, *_) = grid.entries(whole)["Hopper", 2, "frozen-source"]
    assert grid.with_compared(table, {cell.name}).compared == ("frozen-source",)
    assert grid.with_compared(whole, ()) == whole
    assert grid.with_compared(FIGURES["figure-12"], {cell.name}) == FIGURES["figure-12"]
    meta = TABLES["table-16"]
    assert grid.with_compared(meta, {cell.name}) == meta


@pytest.mark.parametrize("name", ["table-3", "table-16"])
def test_a_table_shows_the_cells_of_its_entries(name):
    found = grid.entries(TABLES[name])
    assert {cell for cells in found.values() for cell in cells} == set(shown(TABLES[name]))
    for (target, count, omega), cells in found.items():
        assert [cell.seed for cell in cells] == list(grid.SEEDS)
        assert {cell.tasks for cell in cells} == {(target,)}
        assert {cell.omega for cell in cells} == {omega}
        for cell in cells:
            sources = cell.reward_sources or (cell.source.tasks if cell.source else None)
            assert (None if sources is None else len(sources)) == count
