"""Populations on several devices, and what is told of devices that are not there."""

import os
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from dreamer_jax import devices
from dreamer_jax.devices import on_one_device, place
from dreamer_jax.population import Member, Population, update_members
from dreamer_jax.rollout import collect
from dreamer_jax.training import Run
from experiments.cli.main import main
from over_devices import LAWS, TASKS, config_with
from probes import Inside
from runs import batch_for
from small_agent import Small

ROOT = Path(__file__).parent.parent


def test_the_laws_of_populations_on_eight_devices(tmp_path):
    count = "--xla_force_host_platform_device_count=8"
    done = subprocess.run(
        [sys.executable, str(ROOT / "tests" / "over_devices.py"), str(tmp_path)],
        cwd=ROOT,
        env=os.environ
        | {
            "XLA_FLAGS": f"{os.environ['XLA_FLAGS']} {count}",
            "PYTHONPATH": os.pathsep.join([str(ROOT), str(ROOT / "tests")]),
            "JAX_PLATFORMS": "cpu",
        },
        capture_output=True,
        text=True,
        timeout=900,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    assert [law.__name__ for law in LAWS] == [
        line for line in done.stdout.splitlines() if line in {law.__name__ for law in LAWS}
    ]


AGENT, ENV = Small(config_with(), 2), Inside()


def test_on_one_device_programs_are_those_of_the_functions_themselves():
    placement = on_one_device(2)
    members = Population(AGENT, ENV, 2, [0, 1], placement)
    assert placement.mesh is None and placement.numbers() is None
    tree = {"x": np.arange(2)}
    assert placement.spread(tree) is tree and placement.own(tree) is tree
    state = members.fresh()
    before = update_members._cache_size()
    sums, batch = members.zero_sums(state), batch_for(AGENT, 2)
    state, sums, _ = members.update(state, sums, batch)
    assert update_members._cache_size() == before + 1
    agent = AGENT.on_any_schedule()
    state, *_ = update_members(agent, state, sums, batch, mapping="auto", chunk=1)
    assert update_members._cache_size() == before + 1
    records = members.collect(state, 0, "random")
    seeds = jnp.arange(2, dtype=jnp.int32)
    expected = collect(
        AGENT, ENV, state.params, seeds, state.updates, jnp.int32(0), tasks=2, ticks=20,
        mode="random",
    )  # fmt: skip
    jax.tree.map(np.testing.assert_array_equal, records, expected)


def test_an_environment_for_other_devices_is_refused_before_anything_is_written(tmp_path):
    names, env = (Member(0, "one"),), Inside()
    env.shards = 4
    with pytest.raises(ValueError, match="made for 4 devices, the members lie on 1"):
        Run(AGENT, env, TASKS, names, tmp_path / "run", placement=on_one_device(1))
    with pytest.raises(ValueError, match="3 members are placed, 1 are named"):
        Run(AGENT, Inside(), TASKS, names, tmp_path / "run", placement=on_one_device(3))
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ("0", "devices is 0, must be positive"),
        ("-2", "devices is -2, must be positive"),
        ("2", "2 devices were asked for, and this machine has 1 (cpu)"),
        ("some", "some"),
    ],
)
@pytest.mark.parametrize("command", ["train", "table", "demo", "evaluate"])
def test_devices_that_are_not_there_end_with_code_2_before_anything_is_written(
    tmp_path, monkeypatch, capsys, command, given, message
):
    monkeypatch.chdir(tmp_path)
    words = {
        "train": ["train", "--task", "bullet/hopper", "--out", "run"],
        "table": ["table", "3", "--seeds", "0"],
        "demo": ["demo"],
        "evaluate": ["evaluate", "run"],
    }[command]
    preset = [] if command == "evaluate" else ["--preset", "debug"]
    try:
        code = main([*words, *preset, "--devices", given])
    except SystemExit as error:
        code = error.code
    assert code == 2
    assert message in " ".join(capsys.readouterr().err.replace("│", " ").split())
    assert not list(tmp_path.iterdir())


def test_devices_of_an_accelerator_are_named_and_members_are_spread_evenly(monkeypatch):
    there = [SimpleNamespace(platform="gpu") for _ in range(4)]
    monkeypatch.setattr(devices.jax, "local_devices", lambda: there)
    assert str(place(8)) == "8 members on 4 devices, 2 on each"
    assert str(place(8, 1)) == "8 members on 1 of 4 devices"
    assert str(place(1)) == "1 member on 1 of 4 devices"
    assert str(place(10)) == "10 members on 4 devices, at most 3 on each"
    with pytest.raises(ValueError, match=r"has 4 \(gpu\): expected a whole number in \[1 to 4\]"):
        place(8, 5)
