"""Seconds per update of a population on made-up data: one JSON line.

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

from dreamer_jax.agent import Agent
from dreamer_jax.config import Config, LearningConfig, NetworkConfig, preset
from dreamer_jax.host_memory import keep_freed_memory
from dreamer_jax.population import update_members, zero_sums
from experiments.thesis.measurement import made_up

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


class Updates:
    """The compiled update of a population, and made-up members and batches for it.

    Args:
      config: their settings.
      action_size: A.
      members: P.
      mapping, chunk: see `dreamer_jax.population.map_members`.

    Attributes:
      compile_seconds: what tracing and compiling took.
      program_bytes: memory of the program, arguments and results included.
      working_bytes: what of it an update needs beside these.
    """

    def __init__(
        self, config: Config, action_size: int, members: int, mapping: str = "auto", chunk: int = 1
    ):
        agent = Agent(config, action_size).on_any_schedule()
        self._one, self._members = made_up(agent), members
        learning = config.learning
        state, batch = jax.eval_shape(self._mapped, self._one)
        self._zeros = jax.eval_shape(
            lambda: zero_sums(agent, state, learning.batch_size, learning.sequence_length)
        )
        started = time.perf_counter()
        lowered = update_members.lower(
            agent, state, self._zeros, batch, mapping=mapping, chunk=chunk
        )
        self._program = lowered.compile()
        self.compile_seconds = time.perf_counter() - started
        memory = self._program.memory_analysis()
        self.working_bytes = memory.temp_size_in_bytes
        given = memory.argument_size_in_bytes + memory.output_size_in_bytes
        self.program_bytes = self.working_bytes + given - memory.alias_size_in_bytes
        self._state = None

    def _mapped(self, tree):
        return jax.tree.map(lambda x: jnp.repeat(x[None], self._members, axis=0), tree)

    def __call__(self) -> float:
        """Makes one update of all members, and returns its seconds."""
        if self._state is None:
            self._state, self._batch = jax.jit(self._mapped)(self._one)
            self._sums = jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), self._zeros)
            self._one = None  # its memory is free for the members
        jax.block_until_ready((self._state, self._batch))
        started = time.perf_counter()
        self._state, self._sums, loss = self._program(self._state, self._sums, self._batch)
        loss.block_until_ready()
        return time.perf_counter() - started


def prepare(a) -> Updates:
    """The updates of sizes given by short names."""
    return Updates(settings(a), a["A"], a["P"], a["mapping"], a["chunk"])


def peak_bytes() -> int:
    """The most memory that this process has had: of the device, or its own on a CPU."""
    own = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024
    return (jax.devices()[0].memory_stats() or {}).get("peak_bytes_in_use", own)


def main():
    a = read_arguments(sys.argv[1:], DEFAULTS)
    # As the command line does.
    keep_freed_memory()
    step = prepare(a)
    step()
    seconds = [step() for _ in range(a["n"])]
    result = {
        "benchmark": "update",
        "device": jax.devices()[0].device_kind,
        "jax": jax.__version__,
        "s_per_update": round(statistics.median(seconds), 5),
        "compile_s": round(step.compile_seconds, 2),
        "peak_bytes": peak_bytes(),
        **a,
    }
    print(json.dumps(result))


if __name__ == "__main__":
    main()
