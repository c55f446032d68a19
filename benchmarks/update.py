"""Seconds per update of a population on random data: one JSON line.

    python -m benchmarks.update depth=32 deter=200 stoch=30 units=400 B=50 L=50 H=15 A=6 n=5

Further arguments: image (64 or 32), P members, precision (float32 or bfloat16), starts
(imagination starts; 0 for all), mapping (auto, vmap or chunks) and chunk.
"""

import dataclasses
import json
import resource
import statistics
import sys
import time

import jax
import jax.numpy as jnp
import numpy as np

from dreamer_jax.agent import Agent
from dreamer_jax.config import Config, LearningConfig, NetworkConfig, preset
from dreamer_jax.host_memory import keep_freed_memory
from dreamer_jax.population import init_members, update_members, zero_sums
from dreamer_jax.records import Records

SIZES = {
    "depth": 32,
    "deter": 200,
    "stoch": 30,
    "units": 400,
    "B": 50,
    "L": 50,
    "H": 15,
    "A": 6,
    "image": 64,
    "precision": "float32",
    "starts": 0,
}
DEFAULTS = {**SIZES, "n": 5, "P": 1, "mapping": "auto", "chunk": 1}


def read_arguments(words, defaults):
    """The defaults, changed by words of the form name=value."""
    values = dict(defaults)
    for word in words:
        name, _, value = word.partition("=")
        if name not in values:
            sys.exit(f"unknown argument {name!r}: choose from {', '.join(defaults)}")
        values[name] = type(defaults[name])(value)
    return values


def settings(a) -> Config:
    """A configuration of the sizes given by short names; others are the thesis's."""
    a = {**SIZES, **a}
    network = NetworkConfig(
        image_size=a["image"],
        encoder_depth=a["depth"],
        stochastic_size=a["stoch"],
        deterministic_size=a["deter"],
        hidden_size=a["deter"],
        head_units=a["units"],
        precision=a["precision"],
    )
    learning = LearningConfig(
        batch_size=a["B"],
        sequence_length=a["L"],
        horizon=a["H"],
        imagination_starts=a["starts"] or None,
    )
    return dataclasses.replace(preset("thesis"), network=network, learning=learning)


def prepare(a):
    """A function without arguments that makes one update of P members and returns its seconds."""
    agent = Agent(settings(a), a["A"])
    random = np.random.default_rng(0)
    shape = (a["P"], a["B"], a["L"])
    batch = Records(
        image=random.integers(0, 256, (*shape, a["image"], a["image"], 3), dtype=np.uint8),
        action=random.uniform(-1, 1, (*shape, a["A"])).astype(np.float32),
        reward=random.normal(size=shape).astype(np.float32),
        first=np.zeros(shape, bool),
        terminal=np.zeros(shape, bool),
    )
    batch = jax.device_put(batch)
    state = init_members(agent, jnp.arange(a["P"]))
    sums = zero_sums(agent, state, a["B"], a["L"])

    def step():
        nonlocal state, sums
        started = time.perf_counter()
        state, sums, loss = update_members(
            agent, state, sums, batch, mapping=a["mapping"], chunk=a["chunk"]
        )
        loss.block_until_ready()
        return time.perf_counter() - started

    return step


def main():
    a = read_arguments(sys.argv[1:], DEFAULTS)
    # As the command line does.
    keep_freed_memory()
    step = prepare(a)
    first = step()
    seconds = [step() for _ in range(a["n"])]
    device = jax.devices()[0]
    statistics_of_memory = device.memory_stats() or {}
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024
    result = {
        "benchmark": "update",
        "device": device.device_kind,
        "jax": jax.__version__,
        "s_per_update": round(statistics.median(seconds), 5),
        "compile_s": round(first - statistics.median(seconds), 2),
        "peak_bytes": statistics_of_memory.get("peak_bytes_in_use", peak),
        **a,
    }
    print(json.dumps(result))


if __name__ == "__main__":
    main()
