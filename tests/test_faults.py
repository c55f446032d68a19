"""A few of the faults that `python -m tests.faults` does by the hundred."""

import sys
from pathlib import Path

import pytest

ROOT = str(Path(__file__).parents[1])
if ROOT not in sys.path:
    sys.path.insert(0, ROOT)

from tests.faults import damages, hostile  # noqa: E402


def test_damage_to_any_file_of_a_results_folder_is_told_or_has_no_effect(tmp_path):
    outcome = damages.damage_folders(16, tmp_path, seed=3)
    assert outcome.silent == []
    assert outcome.told + outcome.harmless == 16 and outcome.told >= 8


@pytest.mark.parametrize(
    "name", ["raises in its making", "raises a local class", "renders floats", "rewards with NaN"]
)
def test_a_hostile_environment_is_told_with_its_task(name, monkeypatch):
    said = hostile.play(name)
    assert hostile.is_clear(name, said), said
    if name != "raises in its making":  # that is noticed before it has a slot
        assert "slot 1" in said
    if name.startswith("raises"):
        assert "Traceback" in said


def test_an_environment_in_order_is_played():
    assert hostile.play("in order") is None
