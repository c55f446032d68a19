"""Populations start on machines of two cores, where thread pools that wait for themselves hang."""

import json
import os
import subprocess
import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import pytest

from dreamer_jax.agent import Agent
from dreamer_jax.config import preset
from dreamer_jax.population import init_program

ROOT = Path(__file__).parent.parent

START = """
import os
os.sched_setaffinity(0, sorted(os.sched_getaffinity(0))[:2])
import json, sys
import jax, jax.numpy as jnp, numpy as np
from dreamer_jax.agent import Agent
from dreamer_jax.config import preset
from dreamer_jax.population import init_members, update_members, zero_sums
from dreamer_jax.records import Records

members, (batch, length, size, actions) = 3, (2, 5, 32, 2)
agent = Agent(preset("debug"), actions)
# Compiled quickly. Not by an environment variable: there is none that a user must know.
quick = json.loads(sys.argv[1])
state = jax.device_put(init_members(agent, range(members)))
shape = (members, batch, length)
batches = Records(
    np.zeros((*shape, size, size, 3), np.uint8),
    np.zeros((*shape, actions), np.float32),
    np.zeros(shape, np.float32),
    np.zeros(shape, bool),
    np.zeros(shape, bool),
)
sums = zero_sums(agent, state, batch, length)
options = dict(mapping="auto", chunk=1)
update = update_members.lower(agent, state, sums, batches, **options).compile(quick)
state, _, loss = update(state, sums, batches)
print("updated", state.updates.tolist(), bool(jnp.isfinite(loss).all()))
"""


def quick_compilation():
    """The flags of tests/conftest.py, as options of a compilation."""
    given = dict(word.removeprefix("--").split("=") for word in os.environ["XLA_FLAGS"].split())
    names = ["xla_backend_optimization_level"]
    names += ["xla_cpu_use_fusion_emitters", "xla_cpu_parallel_codegen_split_count"]
    found = {name: json.loads(given[name]) for name in names if name in given}
    return found | {"xla_disable_hlo_passes": given["xla_disable_hlo_passes"]}


@pytest.mark.skipif(not hasattr(os, "sched_setaffinity"), reason="needs Linux")
def test_a_population_starts_and_updates_whatever_the_environment_variables():
    # None of those of this process but where programs and compiled functions are kept.
    wanted = ("PATH", "HOME", "PYTHONPATH", "JAX_COMPILATION", "JAX_PERSISTENT")
    kept = {name: value for name, value in os.environ.items() if name.startswith(wanted)}
    done = subprocess.run(
        [sys.executable, "-c", START, json.dumps(quick_compilation())],
        cwd=ROOT,
        env=kept,
        capture_output=True,
        text=True,
        timeout=400,
    )
    assert done.stdout == "updated [1, 1, 1] True\n", done.stderr


def test_nothing_that_starts_a_population_calls_lapack():
    # Its calls side by side are what hung.
    agent = Agent(preset("debug"), 2)
    program = init_program().lower(agent, 0).as_text()
    assert "stablehlo.dot" in program
    assert "lapack" not in program.lower()
    assert "lapack" in jax.jit(jnp.linalg.qr).lower(jnp.eye(3)).as_text().lower()
