"""Well-formed JSON that is not what this program writes is told by file and place."""

import json

import numpy as np
import pytest

from dreamer_jax.checkpoint import Checkpointer, CorruptCheckpointError
from dreamer_jax.config import preset
from dreamer_jax.integrity import DamagedError, write_checksums
from dreamer_jax.logs import read_metrics
from dreamer_jax.replay import Replay
from dreamer_jax.schema import COUNT, METADATA, check_shape
from experiments.cli.main import main
from experiments.runs.folder import read_cells
from experiments.runs.spec import RunSpec, read_spec

SPEC = RunSpec(("bullet/hopper",), (0, 1), preset("debug")).to_dict()
VALUES = [None, 3, "text", [], {}, [1], {"spec": 1}, True]


@pytest.mark.parametrize(
    ("value", "message"),
    [
        ([1], "it is .*, expected an object"),
        ({"counters": {}, "replay": [], "metrics": 0}, "counters has no 'rounds'"),
        (
            {"counters": dict.fromkeys(METADATA["counters"], -1), "replay": [], "metrics": 0},
            "counters.rounds is -1, expected a whole number that is not negative",
        ),
        (
            {"counters": dict.fromkeys(METADATA["counters"], 0), "replay": [["3"]], "metrics": 0},
            r"replay\[0\]\[0\] is '3', expected a whole",
        ),
        (
            {"counters": dict.fromkeys(METADATA["counters"], 0), "replay": [], "metrics": True},
            "metrics is True",
        ),
    ],
)
def test_the_place_and_what_was_expected_there_are_named(value, message):
    with pytest.raises(DamagedError, match=f"file.json is not what this program writes: {message}"):
        check_shape(value, METADATA, "file.json")


def test_unknown_and_missing_names_are_told():
    check_shape({"a": 1}, {"a": COUNT, "b?": str}, "f")
    with pytest.raises(DamagedError, match="unknown 'c'"):
        check_shape({"a": 1, "c": 1}, {"a": COUNT, "b?": str}, "f")
    check_shape({"a": 1, "c": 1}, {"a": COUNT, "*": (str, COUNT, None)}, "f")


@pytest.mark.parametrize("value", VALUES, ids=repr)
def test_wrong_json_in_any_file_of_a_run_is_an_error_that_names_it(value, tmp_path):
    text = json.dumps(value)
    (tmp_path / "run.json").write_text(text)
    with pytest.raises(ValueError, match="run.json"):
        read_spec(tmp_path)
    (tmp_path / "metrics.jsonl").write_text(text + "\n")
    with pytest.raises(ValueError, match="line 1 of .*metrics.jsonl"):
        read_metrics(tmp_path)
    (tmp_path / "cells.json").write_text(text)
    if value != []:
        with pytest.raises(ValueError, match="cells.json"):
            read_cells(tmp_path)
    (tmp_path / "replay").mkdir()
    (tmp_path / "replay" / "replay.json").write_text(text)
    with pytest.raises(ValueError, match="replay"):
        Replay(tmp_path / "replay", 1, 1, 4, 1)
    checkpoints = Checkpointer(tmp_path / "checkpoints")
    checkpoints.save(1, {"a": np.zeros(2)}, {})
    (checkpoints.path(1) / "leaves.json").write_text(text)
    write_checksums(checkpoints.path(1))
    with pytest.raises(CorruptCheckpointError, match="leaves.json"):
        checkpoints.restore({"a": np.zeros(2)})


@pytest.mark.parametrize(
    "row",
    [
        {"kind": "evaluation", "member": 0, "env_steps": 1},
        {"kind": "evaluation", "member": 0, "env_steps": 1, "task": 3, "return": 1.0},
        {"kind": "evaluation", "member": "0", "env_steps": 1},
        {"member": 0, "env_steps": 1},
        [1],
    ],
)
@pytest.mark.parametrize("header", [{"spec": SPEC}, {"spec": {**SPEC, "seeds": "x"}}])
def test_a_report_tells_in_one_line_what_is_wrong(row, header, tmp_path, capsys):
    (tmp_path / "run.json").write_text(json.dumps(header))
    (tmp_path / "metrics.jsonl").write_text(json.dumps(row) + "\n")
    assert main(["report", str(tmp_path)]) in (1, 2)
    error = capsys.readouterr().err
    assert error.count("\n") == 1 and ("metrics.jsonl" in error or "run.json" in error)
