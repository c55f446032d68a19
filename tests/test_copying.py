"""Fine-tuning and frozen sources: what of a source is taken over, and what of it trains."""

import jax
import numpy as np
import pytest

from dreamer_jax.population import init_members, init_program
from experiments.runs.agents import make_agent
from experiments.runs.start import load_sources, transferred_members
from runs import batch_for, spec_of, write_run
from transfer_trees import bits


@pytest.fixture(scope="module")
def sources(tmp_path_factory):
    """An agent of the target's action size, and one of another."""
    folder = tmp_path_factory.mktemp("copied")
    write_run(folder / "same", spec_of("hopper"), seed=1)
    write_run(folder / "wider", spec_of("halfcheetah"), seed=2)
    return folder


def member(tree, place):
    return jax.tree.map(lambda x: x[place], tree)


OF_ACTIONS = {"dynamics/action_in/kernel", "actor/out/bias", "actor/out/kernel"}


def test_methods_share_the_program_that_draws_fresh_agents(sources):
    # Before any other test of one of them.
    sizes = []
    for method in ("fine-tuning", "frozen-source"):
        spec = spec_of("hopper", method=method, sources=(sources / "same",), seeds=(3, 4))
        transferred_members(spec, load_sources(spec))
        sizes.append(init_program()._cache_size())
    assert sizes[0] == sizes[1] > 0


@pytest.mark.parametrize("method", ["fine-tuning", "frozen-source"])
@pytest.mark.parametrize(("source", "fresh"), [("same", set()), ("wider", OF_ACTIONS)])
def test_everything_is_copied_where_shapes_fit(sources, method, source, fresh):
    spec = spec_of("hopper", method=method, sources=(sources / source,), seeds=(3, 4))
    read = load_sources(spec)
    state, report = transferred_members(spec, read)
    given = bits(read.agents[0].params)
    from_scratch = make_agent(spec_of("hopper")).on_any_schedule()
    drawn = init_members(from_scratch, spec.seeds).params
    for place in range(2):
        target, scratch = bits(member(state.params, place)), bits(member(drawn, place))
        assert {path for path in target if target[path] != given[path]} == fresh
        assert all(target[path] == scratch[path] for path in fresh)
    assert {row.leaf for row in report.rows if row.operation == "keep"} == fresh


def test_the_baseline_of_fine_tuning_is_from_scratch(sources):
    spec = spec_of("hopper", method="fine-tuning", sources=(sources / "same",), baseline=True)
    assert [member.label for member in spec.members] == ["fine-tuning", "baseline"]
    read = load_sources(spec)
    params = transferred_members(spec, read)[0].params
    given = bits(read.agents[0].params)
    assert bits(member(params, 0)) == given
    scratch = bits(member(params, 1))
    assert all(scratch[path] != given[path] for path in given)
    assert not np.any(params["actor"]["out"]["bias"][1])


def test_sources_that_do_not_all_fit_are_refused_naming_both(sources):
    both = (sources / "same", sources / "wider")
    spec = spec_of("hopper", method="fine-tuning", sources=both)
    with pytest.raises(ValueError, match="in the source .*same and .* in .*wider: targets of one"):
        transferred_members(spec, load_sources(spec))


def test_heads_and_the_kernel_of_the_action_alone_train_on_a_frozen_source(sources):
    spec = spec_of("hopper", method="frozen-source", sources=(sources / "same",), seeds=(3, 4))
    agent = make_agent(spec)
    before = member(transferred_members(spec, load_sources(spec))[0], 0)
    after, metrics = jax.jit(agent.update)(before, batch_for(agent))
    one, other = bits(before.params), bits(after.params)
    moved = {path.split("/")[0] for path in one if one[path] != other[path]}
    assert moved >= {"reward", "value", "actor"}
    still = {path for path in one if one[path] == other[path]}
    assert all(
        path in still
        for path in one
        if path.split("/")[0] in ("encoder", "decoder", "dynamics") and "action_in" not in path
    )
    assert other["dynamics/action_in/kernel"] != one["dynamics/action_in/kernel"]
