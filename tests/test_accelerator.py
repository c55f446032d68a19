"""The benchmark of a card: whole, on the CPU and as small as can be, and what becomes of failures.

Of the processes that measure, those of the first part and of the peer that fails are real ones; the
others are this process in the first tests, and shell scripts in those on failures.
"""

import dataclasses
import io
import json
import signal
import subprocess
import time

import jax
import pytest

from benchmarks.__main__ import main
from benchmarks.accelerator import command, measures
from benchmarks.accelerator.peaks import known_peaks
from benchmarks.accelerator.plan import LEARNING_TASK, MINUTES, SIZES, Part, parts
from benchmarks.accelerator.table import at_once
from dreamer_jax.agent import Agent
from dreamer_jax.config import preset
from experiments.thesis.measurement import operations

CASES = [(part.name, case) for part in parts(SIZES["debug"]) for case in part.cases]


def executable(path, text):
    path.write_text(f"#!/bin/sh\n{text}\n")
    path.chmod(0o755)
    return str(path)


# Seconds of each case on an NVIDIA H100, the start of its part's process in the first. Those of 57
# members, of 256 and 1024 rollouts and of the second round are guesses: their time ended before.
ON_A_CARD = {
    "update float32": (22, 18, 18, 36, 60),
    "update bfloat16": (23, 19, 20, 18, 60),
    "peer": (50,),
    "rollout": (30, 15, 15, 15, 20, 30),
    "round": (83, 83),
}


def test_the_time_that_parts_have_by_default_is_enough_on_a_card():
    *measured, learning = parts(SIZES["thesis"])
    assert sum(part.share for part in (*measured, learning)) == pytest.approx(1)
    now = until = 0.0
    for part in measured:
        until += part.share * 60 * MINUTES
        now += sum(ON_A_CARD[part.name])
        assert len(ON_A_CARD[part.name]) == len(part.cases) and now <= until, part.name


def read(path):
    def refuse(name):
        raise AssertionError(f"{name} is no JSON")

    return json.loads(path.read_text(), parse_constant=refuse)


def rows_of(path):
    return {(row["part"], row["case"]): row for row in read(path)["rows"]}


class InThisProcess:
    """In the place of a process that measures a part: all of them share what one has traced and
    compiled."""

    returncode = 0

    def __init__(self, words, **options):
        *_, part, request = words
        self.stdout = io.StringIO()
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(measures, "own_output", lambda: self._say)
            patch.setattr(measures, "keep_freed_memory", lambda: None)
            measures.main(part, json.loads(request))
        self.stdout.seek(0)

    def _say(self, event):
        self.stdout.write(json.dumps(event) + "\n")

    def wait(self, seconds):
        return self.returncode


class FakeUpdates:
    """Updates of which the device has room for so many members'."""

    room = 4
    compiled: list[tuple[str, int]] = []

    def __init__(self, config, actions, members, mapping, chunk):
        self.compiled.append((mapping, chunk))
        self.working_bytes, self.program_bytes = 100 * chunk, 0
        self.compile_seconds = 1.0
        self.chunk = chunk

    def __call__(self):
        if self.chunk > self.room:
            raise jax.errors.JaxRuntimeError("RESOURCE_EXHAUSTED: Out of memory")
        return 0.5


@pytest.fixture(scope="module")
def measured(tmp_path_factory):
    folder = tmp_path_factory.mktemp("accelerator")
    peer = executable(
        folder / "peer", """echo '{"torch": "made up", "on": "paper", "s_per_update": 0.5}'"""
    )
    words = ["accelerator", "--sizes", "debug", "--out", str(folder / "card.json")]
    words += ["--peer", peer, "--peak-tflops", "0.5", "2"]
    first = parts(SIZES["debug"])[0].name
    popen, real, made_up = subprocess.Popen, measures.Updates, []

    def updates(config, *arguments):
        """Of one precision they are real, for another program of updates takes seconds more."""
        if config.network.precision == "float32":
            return real(config, *arguments)
        made_up.append(config.network.precision)
        return FakeUpdates(config, *arguments)

    def begun(arguments, **options):
        measures_here = arguments[:-2] == command.MEASURES and arguments[-2] != first
        return (InThisProcess if measures_here else popen)(arguments, **options)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(subprocess, "Popen", begun)
        patch.setattr(measures, "Updates", updates)
        assert main(words) == 0
    assert made_up == ["bfloat16"]
    return folder, words


def test_every_case_has_figures_in_one_file_and_one_table(measured):
    folder, _ = measured
    rows = rows_of(folder / "card.json")
    assert list(rows) == CASES
    assert all("figures" in row for row in rows.values())
    table = (folder / "card.md").read_text()
    for part, case in CASES[:-1]:
        assert f"| {part}, {case} |" in table
    assert f"**Learning** ({LEARNING_TASK}, preset `debug`" in table
    assert "made up on paper" in table and "failure" not in table
    assert sorted(path.name for path in folder.iterdir()) == [
        "card-learning", "card.json", "card.md", "peer",
    ]  # fmt: skip


def test_shares_are_counted_operations_over_the_peak_of_the_precision(measured):
    rows = rows_of(measured[0] / "card.json")
    config = preset("debug")
    for precision, peak in (("float32", 0.5e12), ("bfloat16", 2e12)):
        network = dataclasses.replace(config.network, precision=precision)
        count = operations(Agent(dataclasses.replace(config, network=network), 1))
        figures = rows[f"update {precision}", "P=2"]["figures"]
        assert figures["mapped"] == "vmap" and figures["operations"] == count
        rate = 2 / figures["seconds_per_update"]
        assert figures["member_updates_per_second"] == pytest.approx(rate)
        assert figures["share_of_peak"] == pytest.approx(rate * count / peak)


def test_figures_are_of_what_was_run(measured):
    rows = rows_of(measured[0] / "card.json")
    peer = rows["peer", "P=1"]["figures"]
    assert peer["ratio"] == pytest.approx(peer["seconds_per_update"] / 0.5)
    for _, case in [pair for pair in CASES if pair[0] == "round"]:
        figures = rows["round", case]["figures"]
        assert figures["updates"] == 2 and figures["agent_steps"] == 20
        assert 0 < figures["seconds_per_round"] < figures["first_round_seconds"]
    learning = rows["learning", LEARNING_TASK]["figures"]
    assert learning["ended"] == "at its end" and learning["updates"] == 8
    assert [one["env_steps"] for one in learning["evaluations"]] == [40, 80, 120, 160]
    assert all(len(one["returns"]) == 1 for one in learning["evaluations"])
    seconds = [one["seconds"] for one in learning["evaluations"]]
    assert seconds == sorted(seconds) and seconds[-1] <= learning["seconds"]
    assert all(row["figures"]["peak_bytes"] > 1e8 for row in rows.values() if row["part"] != "peer")


def test_a_second_start_measures_what_is_missing_and_nothing_else(measured, monkeypatch, capsys):
    folder, words = measured
    before = (folder / "card.json").read_bytes()
    values = json.loads(before)
    values["rows"] = [row for row in values["rows"] if row["part"] != "peer"]
    (folder / "card.json").write_text(json.dumps(values))
    failing = executable(folder / "failing", "echo Traceback >&2; echo no torch here >&2; exit 3")
    begun, popen = [], subprocess.Popen
    monkeypatch.setattr(
        subprocess, "Popen", lambda *words, **rest: begun.append(words) or popen(*words, **rest)
    )
    assert main([*words, "--peer", failing]) == 1
    assert len(begun) == 1
    rows = rows_of(folder / "card.json")
    assert rows["peer", "P=1"]["failure"] == f"RuntimeError: {failing}: no torch here"
    assert "| peer, P=1 | failure: RuntimeError" in (folder / "card.md").read_text()
    assert "without figures: peer, P=1" in capsys.readouterr().out
    old = {(row["part"], row["case"]): row for row in json.loads(before)["rows"]}
    assert {key: row for key, row in rows.items() if key[0] != "peer"} == {
        key: row for key, row in old.items() if key[0] != "peer"
    }
    (folder / "card.json").write_bytes(before)
    begun.clear()
    assert main(words) == 0 and not begun


def test_figures_of_other_sizes_or_another_card_are_kept_apart(
    measured, tmp_path, monkeypatch, capsys
):
    folder, _ = measured
    words = ["accelerator", "--out", str(folder / "card.json")]
    assert main(words) == 2
    assert "holds sizes debug, thesis were asked for" in capsys.readouterr().err
    values = read(folder / "card.json")
    here = json.dumps({"machine": {"revision": "r", **values["machine"]}})
    script = executable(tmp_path / "measures", f"echo '{here}'; exec sleep 60")
    monkeypatch.setattr(command, "MEASURES", [script])
    values["machine"]["card"], values["rows"] = "another", []
    (tmp_path / "card.json").write_text(json.dumps(values))
    assert main(["accelerator", "--sizes", "debug", "--out", str(tmp_path / "card.json")]) == 2
    assert "was measured with card 'another', here it is 'cpu'" in capsys.readouterr().err
    (tmp_path / "other.json").write_text('{"some": "thing"}')
    assert main(["accelerator", "--out", str(tmp_path / "other.json")]) == 2
    assert "no file of this benchmark" in capsys.readouterr().err


# Processes that fail.

MACHINE = {
    "card": "a card", "platform": "gpu", "devices": 1, "memory_bytes": 1, "cores": 1,
    "python": "3", "jax": "1", "revision": "r", "xla_flags": "", "matmul_precision": "default",
    "compilation_cache": False,
}  # fmt: skip


@pytest.fixture
def with_process(tmp_path, monkeypatch):
    """Runs the command with a part of three cases that a shell script measures."""

    def run(script, minutes="1", name="rollout", cases=("P=1", "P=2", "P=3")):
        start = f"echo '{json.dumps({'machine': MACHINE})}'\nn=$(echo $2 | grep -o P= | wc -l)"
        program = executable(tmp_path / "measures", f"{start}\n{script}")
        monkeypatch.setattr(command, "MEASURES", [program])
        monkeypatch.setattr(command, "parts", lambda sizes: (Part(name, cases, 1.0),))
        code = main(["accelerator", "--out", str(tmp_path / "x.json"), "--minutes", minutes])
        return code, rows_of(tmp_path / "x.json")

    return run


def figures(case, rate=5):
    told = {"case": case, "figures": {"agent_steps_per_second": rate, "task": "t"}}
    told["figures"] |= {"compile_seconds": 1, "peak_bytes": 1}
    return f"""echo '{json.dumps({"begins": case})}'; echo '{json.dumps(told)}'"""


def test_a_process_that_is_killed_takes_no_other_case_along(with_process):
    killed = """echo '{"begins": "P=2"}'; kill -9 $$"""
    script = f"if [ $n = 3 ]; then {figures('P=1')}; {killed}; fi\n{figures('P=3')}"
    code, rows = with_process(script)
    assert code == 1
    assert rows["rollout", "P=2"]["failure"] == (
        "its process was ended by SIGKILL, perhaps for want of memory"
    )
    assert [case for (_, case), row in rows.items() if "figures" in row] == ["P=1", "P=3"]


def test_a_process_that_never_begins_says_why_in_every_row(with_process):
    code, rows = with_process("echo 'no such thing' >&2; exit 4")
    assert code == 1
    assert {row["failure"] for row in rows.values()} == {
        "its process ended with code 4: no such thing"
    }


def test_what_takes_too_long_is_ended_and_told_and_tried_again(with_process):
    slow = """echo '{"begins": "P=2"}'; exec sleep 60"""
    code, rows = with_process(f"{figures('P=1')}; {slow}", minutes="0.04")
    assert code == 1
    assert [row.get("failure", "")[:9] for row in rows.values()] == ["", "not done ", "not begun"]
    code, rows = with_process(f"{figures('P=2', 6)}; {figures('P=3', 7)}")
    assert code == 0
    found = [row["figures"]["agent_steps_per_second"] for row in rows.values()]
    assert found == [5, 6, 7]


def test_ctrl_c_ends_the_process_and_keeps_what_there_is(with_process, tmp_path, monkeypatch):
    told = command.Command._say

    def interrupted(self, words):
        told(self, words)
        if words.strip().startswith("P=2"):
            signal.raise_signal(signal.SIGINT)

    monkeypatch.setattr(command.Command, "_say", interrupted)
    marker = tmp_path / "ended"
    # It begins only when it can be told to end.
    trap = f"""trap 'touch {marker}; kill $! 2>/dev/null; exit' INT"""
    slow = f"""{trap}; echo '{{"begins": "P=2"}}'; sleep 60 & wait"""
    code, rows = with_process(f"{figures('P=1')}; {slow}")
    assert code == 130 and list(rows) == [("rollout", "P=1")] and marker.exists()


def test_without_pytorch_the_peer_is_skipped_in_words_and_nothing_is_begun(
    with_process, monkeypatch, tmp_path
):
    monkeypatch.setattr(command.importlib.util, "find_spec", lambda name: None)
    code, rows = with_process("touch $0.begun", name="peer", cases=("P=1",))
    assert code == 0 and list(rows) == [("peer", "P=1")]
    assert rows["peer", "P=1"]["skipped"].startswith("no Python with PyTorch was found: name one")
    assert "| peer, P=1 | skipped: no Python" in (tmp_path / "x.md").read_text()
    assert not (tmp_path / "measures.begun").exists()


# What a process measures.


def update_part(monkeypatch, limit):
    monkeypatch.setattr(measures, "Updates", FakeUpdates)
    monkeypatch.setattr(measures, "memory_limit", lambda: limit)
    monkeypatch.setattr(measures, "bytes_of", lambda *_: 0)
    monkeypatch.setattr(measures, "operations", lambda agent: 1.0)
    FakeUpdates.compiled.clear()
    return measures.UpdatePart(SIZES["debug"], {}, "float32")


def test_where_memory_is_short_members_are_updated_in_chunks_and_the_row_says_so(monkeypatch):
    part = update_part(monkeypatch, limit=10_000)
    told = []
    found = part("P=9", told.append)
    # By the compiler's count all fit; the device says otherwise of 9, and of 8 as 5 and 4.
    assert FakeUpdates.compiled == [("vmap", 9), ("chunks", 5), ("chunks", 3)]
    assert found["mapped"] == "chunks of 3" and found["without_memory"] == ["vmap", "chunks of 5"]
    assert found["member_updates_per_second"] == 9 / 0.5
    assert told == [{"told": "vmap: no memory for it"}, {"told": "chunks of 5: no memory for it"}]
    said = at_once(found["mapped"], found["without_memory"])
    assert said == "chunks of 3 (no memory for vmap, chunks of 5)"


def test_what_is_known_to_be_far_too_large_is_not_even_compiled(monkeypatch):
    part = update_part(monkeypatch, limit=500)
    part("P=1", print)
    # 0.8 of the memory holds four members' updates, 1.3 times as much six.
    assert part("P=18", print)["mapped"] == "chunks of 4"
    assert FakeUpdates.compiled == [("vmap", 1), ("chunks", 4)]


def test_where_not_even_one_fits_the_row_says_what_was_tried(monkeypatch):
    monkeypatch.setattr(FakeUpdates, "room", 0)
    part = update_part(monkeypatch, limit=10_000)
    with pytest.raises(MemoryError, match="no memory for any of vmap, chunks of 2, chunks of 1"):
        part("P=3", print)


def test_a_run_that_learns_ends_by_the_clock_saved_and_goes_on(tmp_path, monkeypatch):
    endless = preset("debug")
    schedule = dataclasses.replace(endless.schedule, environment_steps=10**6)
    endless = dataclasses.replace(endless, schedule=schedule)
    monkeypatch.setattr(measures, "preset", lambda name: endless)
    request = {"folder": tmp_path / "run", "seconds": 1, "until": time.time() + 100}
    part = measures.LearningPart(SIZES["debug"], request)
    first = part(LEARNING_TASK, lambda event: None)
    assert first["ended"] == "by the clock" and first["seconds"] > 0
    second = part(LEARNING_TASK, lambda event: None)
    reached = [(one["env_steps"], one["updates"]) for one in (first, second)]
    assert reached[0] < reached[1] and second["seconds"] > first["seconds"]
    assert second["evaluations"][: len(first["evaluations"])] == first["evaluations"]


@pytest.mark.parametrize(
    ("card", "peaks"),
    [
        ("NVIDIA H100 80GB HBM3", (494, 989)),
        ("NVIDIA H100 PCIe", (378, 756)),
        ("NVIDIA A100-SXM4-40GB", (156, 312)),
        ("NVIDIA L40S", (183, 362)),
        ("TPU v5 lite", (197, 197)),
        ("NVIDIA H100 80GB HBM3 MIG 1g.10gb", None),
        ("NVIDIA L400", None),
        ("cpu", None),
    ],
)
def test_peaks_are_those_of_whole_cards_that_are_known(card, peaks):
    assert known_peaks(card) == peaks
