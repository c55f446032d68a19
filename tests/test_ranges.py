"""Every setting that is a number has a range, which is checked before anything is written."""

import contextlib
import dataclasses
import io
import math
from typing import Literal

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dreamer_jax import config as configs
from dreamer_jax.config import Config, check_prefill, preset
from dreamer_jax.ranges import Range, check_ranges, kinds_of, ranges, setting
from experiments.cli.main import COMMANDS, main
from experiments.cli.options import Simulators

BAD = [0, -1, -40, 0.0, -0.5, math.nan, math.inf, -math.inf, 10**30, 1e300]
GROUPS = {entry.name: entry.type for entry in dataclasses.fields(Config)}


def numbers_of(kind):
    """Fields of a dataclass that are numbers, or tuples of them."""
    return [
        entry.name
        for entry in dataclasses.fields(kind)
        if {int, float} & set(filter(callable, kinds_of(entry.type)))
    ]


def bad_values(allowed):
    return [value for value in BAD if value not in allowed]


@pytest.mark.parametrize("group", GROUPS.values(), ids=GROUPS)
def test_every_number_of_a_configuration_refuses_what_is_not_in_its_range(group):
    allowed = ranges(group())
    for name in numbers_of(group):
        values = bad_values(allowed[name])
        assert {"nan", "inf", "-1"} <= set(map(str, values)), name
        for value in values:
            with pytest.raises(
                ValueError, match=f"{name} is {value!r}".replace("+", r"\+")
            ) as raised:
                group(**{name: value})
            assert str(allowed[name]) in str(raised.value)


@pytest.mark.parametrize(
    "command", [*(command.options() for command in COMMANDS.values()), Simulators]
)
def test_every_number_of_a_command_has_a_range(command):
    declared = {entry.name for entry in dataclasses.fields(command) if "range" in entry.metadata}
    assert set(numbers_of(command)) - {"from_checkpoint"} == declared


SETTINGS = [
    (name, value)
    for group in GROUPS.values()
    for name, allowed in ranges(group()).items()
    for value in bad_values(allowed)
] + [
    (name, value)
    for name in ("workers", "simulator_timeout", "source_member", "meta_layers", "seeds", "omega")
    for value in (-1, math.nan, math.inf, 10**30)
]


OF_METHODS = {
    "source_member": ["--source", "nowhere", "--omega", "0"],
    "omega": ["--source", "nowhere"],
    "meta_layers": ["--method", "meta", "--source", "nowhere", "--reward-sources", "nowhere"],
}
"""What settings of methods are asked for with."""


@given(st.sampled_from(SETTINGS))
@settings(max_examples=12, deadline=None)
def test_a_bad_value_on_the_command_line_ends_with_code_2_and_name_value_and_range(
    tmp_path_factory, chosen
):
    name, value = chosen
    out = tmp_path_factory.getbasetemp() / "nothing"
    option = "--" + name.replace("_", "-")
    words = ["train", "--task", "bullet/hopper", "--preset", "debug", "--out", str(out)]
    words += OF_METHODS.get(name, [])
    output = io.StringIO()
    with contextlib.redirect_stdout(output), contextlib.redirect_stderr(output):
        try:
            code = main([*words, option, str(value)])
        except SystemExit as error:
            code = error.code
    text = " ".join(output.getvalue().replace("│", " ").split())
    assert code == 2, text
    assert name in text or option in text, text
    assert str(value) in text or str(float(value)) in text, text
    # Of what is no number of that kind, tyro says so.
    assert any(word in text for word in ("expected", "must", "invalid literal", "Error parsing")), (
        text
    )
    assert not out.exists()


def test_sequences_must_fit_what_is_collected_before_the_first_update():
    debug = preset("debug")  # 1 phase of 21 records
    learning = dataclasses.replace(debug.learning, sequence_length=22)
    with pytest.raises(ValueError, match=r"sequence_length is 22, .* has 21 records .*\[1, 21\]"):
        dataclasses.replace(debug, learning=learning)
    schedule = dataclasses.replace(debug.schedule, prefill_phases=2)
    longer = dataclasses.replace(debug, learning=learning, schedule=schedule)
    check_prefill(longer, 1)
    with pytest.raises(ValueError, match="sequence_length is 22"):
        check_prefill(longer, 2)  # several tasks are played for one phase each


def test_values_of_other_kinds_are_refused_too():
    for group, name, value, message in [
        ("learning", "batch_size", 2.5, "not a whole number: expected a whole number"),
        ("learning", "batch_size", "8", "batch_size is '8'"),
        ("learning", "batch_size", True, "batch_size is True"),
        ("network", "termination", 1, "expected true or false"),
        ("network", "precision", "float16", "expected one of 'float32', 'bfloat16'"),
    ]:
        with pytest.raises(ValueError, match=message):
            configs.from_dict({group: {name: value}})


@dataclasses.dataclass(frozen=True)
class Example:
    share: tuple[float, ...] = setting((), 0, 1, above=True)
    count: int | None = setting(None, 1, 10)
    devices: int | Literal["all"] = setting("all", 1, 10)
    step: int | Literal["list"] | None = None


def test_a_tuple_is_checked_entry_by_entry_and_none_may_be_left_out():
    check_ranges(Example())
    check_ranges(Example((0.5, 1), 10))
    with pytest.raises(ValueError, match=r"share is 0, must be positive: .* \(0 to 1\]"):
        check_ranges(Example((0.5, 0)))
    with pytest.raises(ValueError, match="count is 11, is too large"):
        check_ranges(Example(count=11))
    check_ranges(Example(devices=10, step=5))
    check_ranges(Example(step="list"))
    with pytest.raises(ValueError, match="devices is 0, must be positive"):
        check_ranges(Example(devices=0))
    for name, value in (("devices", "some"), ("step", "last"), ("step", 0.5)):
        with pytest.raises(ValueError, match=f"{name} is {value!r}"):
            check_ranges(Example(**{name: value}))
    assert 0.0 not in Range(0, 1, above=True) and 0.0 in Range(0, 1)
