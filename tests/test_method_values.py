"""Methods as values: what of the command line, of run.json and of populations is made from them."""

import json
import types

import pytest

from dreamer_jax import config as configs
from dreamer_jax.config import Difference
from experiments import methods
from experiments.cli.main import main
from experiments.cli.options import method_groups
from experiments.methods.fractional import FractionalTransfer
from experiments.methods.meta import MetaModel
from experiments.methods.scratch import Scratch
from experiments.runs.spec import RunSpec
from runs import CONFIG, spec_of

SETTINGS = {
    "scratch": {},
    "fractional": {"sources": ("a", "b"), "omegas": (0.0, 0.5), "fractions": ("value",)},
    "fine-tuning": {"sources": ("a", "b"), "baseline": True},
    "frozen-source": {"sources": ("a",), "source_member": 1},
    "uae": {"sources": ("a",), "dynamics": "copied"},
    "meta": {"sources": ("a",), "reward_sources": ("b", "c"), "reward_counts": (1, 2)},
}


def test_every_file_that_names_a_method_is_one():
    assert set(methods.known()) == set(SETTINGS)
    assert all(method.SUMMARY for method in methods.known().values())


@pytest.mark.parametrize("name", SETTINGS)
def test_a_method_is_the_same_after_json(name):
    spec = spec_of("hopper", method=name, **SETTINGS[name])
    assert spec.method.NAME == name
    assert RunSpec.from_dict(json.loads(json.dumps(spec.to_dict()))) == spec


def old(**settings):
    """A spec as it was written when the settings of all methods stood beside the others."""
    defaults = {
        "sources": [], "source_member": 0, "omegas": [], "baseline": False, "method": "fractional",
        "fractions": ["reward", "value", "termination"], "dynamics": "fresh", "reward_sources": [],
        "reward_counts": [], "meta": ["reward"], "meta_layers": 1, "switching": False,
        "threshold": None,
    }  # fmt: skip
    plain = {"tasks": ["bullet/hopper"], "seeds": [3], "config": configs.to_dict(CONFIG)}
    return plain | defaults | settings


@pytest.mark.parametrize(
    ("settings", "method"),
    [
        ({}, Scratch()),
        (
            {"sources": ["x"], "omegas": [0.2], "baseline": True},
            FractionalTransfer(sources=("x",), omegas=(0.2,), baseline=True),
        ),
        (
            {"sources": ["x"], "method": "meta", "reward_sources": ["y"], "meta_layers": 2},
            MetaModel(sources=("x",), reward_sources=("y",), meta_layers=2),
        ),
    ],
)
def test_settings_of_runs_that_were_made_before_are_read(settings, method):
    assert RunSpec.from_dict(old(**settings)) == RunSpec(("bullet/hopper",), (3,), CONFIG, method)


def test_settings_that_no_run_has_are_refused():
    with pytest.raises(ValueError, match="unknown settings of a run: colour"):
        RunSpec.from_dict(old(colour="red"))
    with pytest.raises(ValueError, match="no method 'magic': choose from .*fractional"):
        RunSpec.from_dict(spec_of("hopper").to_dict() | {"method": {"name": "magic"}})


@pytest.mark.parametrize("name", SETTINGS)
def test_each_combination_along_the_axes_is_a_member_and_seeds_follow_one_another(name):
    spec = spec_of("hopper", seeds=(3, 4), method=name, **SETTINGS[name])
    count = 1
    for values in spec.method.axes.values():
        count *= len(values)
    members = spec.members
    assert len(members) == 2 * (count + spec.method.baseline)
    assert [member.seed for member in members] == [3, 4] * (len(members) // 2)
    labels = [member.label for member in members[::2]]
    assert len(set(labels)) == len(labels)
    assert ("baseline" in labels) == (spec.method.baseline or name == "scratch")


def test_the_last_axis_of_combinations_is_the_fastest():
    assert methods.combinations({"a": "xy", "b": (1, 2)}) == [
        {"a": "x", "b": 1}, {"a": "x", "b": 2}, {"a": "y", "b": 1}, {"a": "y", "b": 2},
    ]  # fmt: skip


def test_differences_of_runs_are_values():
    one = spec_of("hopper", method="uae", sources=("a",))
    other = spec_of("hopper", seeds=(1,), method="uae", sources=("a",), dynamics="frozen")
    assert one.differences(one) == ()
    assert one.differences(other) == (
        Difference("seeds", (0,), (1,)), Difference("dynamics", "fresh", "frozen"),
    )  # fmt: skip
    assert str(Difference("seeds", (0,), (1,))) == "seeds: (0,) / (1,)"
    scratch = spec_of("hopper")
    assert Difference("method", "scratch", "uae") in scratch.differences(one)
    assert Difference("sources", None, ("a",)) in scratch.differences(one)


@pytest.fixture
def clipping(monkeypatch):
    """A method of another file, with a setting of its own and one that others have."""
    import dataclasses
    from typing import ClassVar

    from experiments.methods.base import setting
    from experiments.methods.targets import Targets

    @dataclasses.dataclass(frozen=True)
    class Clipping(Targets):
        NAME: ClassVar[str] = "clipping"
        SUMMARY: ClassVar[str] = "weights cut off"
        COMPARED: ClassVar[bool] = True
        limits: tuple[float, ...] = setting((1.0,), "limit", "Largest weights.")

    found = dict(methods.known()) | {"clipping": Clipping}
    monkeypatch.setattr(methods, "known", lambda: found)
    method_groups.cache_clear()
    from experiments.cli.runs import train_options

    train_options.cache_clear()
    yield Clipping
    method_groups.cache_clear()
    train_options.cache_clear()


def test_a_new_method_has_its_options_without_another_file_being_touched(clipping, monkeypatch):
    asked = []
    monkeypatch.setattr(
        "experiments.runs.run.make_run",
        lambda spec, out, **_: asked.append(spec) or types.SimpleNamespace(),
    )
    monkeypatch.setattr("experiments.runs.run.carry_out", lambda run: "stopped")
    monkeypatch.setattr("experiments.runs.trust.check_trust", lambda *_: None)
    monkeypatch.setattr("pathlib.Path.read_text", lambda *_, **__: "")
    words = ["train", "--task", "bullet/hopper", "--preset", "debug", "--out", "nowhere"]
    words += ["--method", "clipping", "--source", "a", "--limit", "0.5", "2", "--baseline"]
    assert main(words) == 130
    (spec,) = asked
    assert spec.method == clipping(sources=("a",), limits=(0.5, 2.0), baseline=True)
    assert main([*words[:-1], "--omega", "0.2"]) == 2


@pytest.mark.parametrize("words", [["table", "7"], ["plan", "--table", "7"], ["seeds", "7"]])
def test_tables_choose_rows_of_their_own_among_the_methods_that_say_so(
    words, clipping, monkeypatch, capsys
):
    from experiments.cli.main import COMMANDS

    asked = []
    command = COMMANDS[words[0]]._replace(carry_out=lambda options: asked.append(options) or 0)
    monkeypatch.setitem(COMMANDS, words[0], command)
    assert main([*words, "--compared", "clipping", "fine-tuning"]) == 0
    (options,) = asked
    assert getattr(options, "sweep", options).compared == ("clipping", "fine-tuning")
    with pytest.raises(SystemExit) as ended:
        main([*words, "--compared", "uae"])
    assert ended.value.code == 2
    told = capsys.readouterr().err
    for name in ("fine-tuning", "frozen-source", "clipping"):
        assert repr(name) in told


def test_a_method_that_says_so_has_cells_of_a_table(clipping):
    from experiments.thesis import grid

    table = grid.beside(grid.TABLES["table-7"], grid.may_be_compared())
    cells = grid.entries(table)["InvertedPendulum", 2, "clipping"]
    assert {cell.method for cell in cells} == {"clipping"}
