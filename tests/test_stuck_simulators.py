"""Simulators that do not answer: warned of, given up, and never waited for in vain."""

import os
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from dreamer_jax.stopping import StopRequest
from dreamer_jax.waiting import to_host
from envs import pool
from envs.base import SimulatorError, TaskSpec
from envs.bridge import HostEnv

KEY = jax.random.key(0)


def fake(title):
    name = f"fake/{title.lower()}"
    return TaskSpec(name, title, 2, f"fake_simulators:{title}", "")


@pytest.fixture
def env_of(monkeypatch):
    made = []

    def make(*titles, **options):
        made.append(HostEnv([fake(title) for title in titles], 1, 4, 1, 2, **options))
        return made[-1]

    yield make
    for env in made:
        env.close()


def start(env):
    state, _ = jax.vmap(env.reset)(jnp.arange(2), jax.random.split(KEY, 2))
    env.check()
    return state


def step(env, state):
    return jax.jit(jax.vmap(env.step))(state, jnp.zeros((2, 2)))


def test_a_stuck_simulator_is_warned_of_and_given_up_with_task_and_slot(env_of, monkeypatch):
    env = env_of("Counting", "Stuck", workers=1, timeout=2.0)
    state = start(env)
    monkeypatch.setattr(pool, "_PATIENCE", 0.5)
    process = env._pool._workers[0].process
    began = time.monotonic()
    with pytest.warns(UserWarning, match="slot 1, fake/stuck, has not answered for 0 seconds.*2$"):
        jax.block_until_ready(step(env, state))
        with pytest.raises(SimulatorError, match="slot 1, fake/stuck, has not answered for [23] s"):
            env.check()
    assert 2 <= time.monotonic() - began < 10
    assert process.poll() == -signal.SIGKILL
    # As after a death: whoever asks again is told.
    env.reset(jnp.int32(0), KEY)
    with pytest.raises(SimulatorError, match="signal 9"):
        env.check()


def test_a_slow_simulator_is_waited_for(env_of):
    env = env_of("Counting", "Slow", timeout=30.0)
    _, time_step = step(env, start(env))
    env.check()
    assert not np.asarray(time_step.first).any()


def test_the_first_interrupt_ends_the_wait_for_a_stuck_simulator(env_of, monkeypatch):
    monkeypatch.setattr(pool, "_HURRY", 1.0)
    env, said = env_of("Counting", "Stuck", workers=2), []
    state = start(env)
    monkeypatch.setattr(pool, "_PATIENCE", 0.5)
    timer = threading.Timer(1.5, signal.raise_signal, [signal.SIGINT])
    timer.daemon = True
    began = time.monotonic()
    with pytest.warns(UserWarning, match="fake/stuck"), StopRequest(said.append, env.hurry) as stop:
        timer.start()
        to_host(step(env, state))
        with pytest.raises(SimulatorError, match="slot 1, fake/stuck.*the run is to stop"):
            env.check()
        assert stop.requested
    assert time.monotonic() - began < 15
    assert said == ["stopping: saving first (once more to quit without)"]


PARENT = """
import os, signal, sys, time
from test_stuck_simulators import fake
from envs.pool import SimulatorPool
import numpy as np
pool = SimulatorPool([fake("Stuck")], 4, 2, 1)
pool.reset(np.arange(1), np.zeros((1, 2), np.uint32))
pool._workers[0].connection.send((2, "step", [0], [None]))
time.sleep(0.5)
print(pool._workers[0].process.pid, flush=True)
os.kill(os.getpid(), signal.SIGKILL)
"""


@pytest.mark.skipif(sys.platform != "linux", reason="reads /proc")
def test_a_stuck_simulator_ends_with_the_process_that_waits_for_it():
    paths = os.pathsep.join(map(os.path.abspath, filter(None, sys.path)))
    environment = os.environ | {"PYTHONPATH": paths, "JAX_PLATFORMS": "cpu"}
    done = subprocess.run(
        [sys.executable, "-c", PARENT], capture_output=True, text=True, env=environment, timeout=120
    )
    pid = int(done.stdout)
    deadline = time.monotonic() + 5
    while Path(f"/proc/{pid}").exists() and time.monotonic() < deadline:
        status = Path(f"/proc/{pid}/stat").read_text()
        if status.rpartition(")")[2].split()[0] == "Z":
            return
        time.sleep(0.05)
    assert not Path(f"/proc/{pid}").exists()
