"""Quick code for tests that run it for long; the others compile quickly instead (conftest.py)."""

import os

from dreamer_jax import population

QUICK_CODE = {"xla_backend_optimization_level": 2}
"""Options of `jax.jit` and of `compile`."""
if "xla_cpu_use_fusion_emitters" in os.environ["XLA_FLAGS"]:
    QUICK_CODE["xla_cpu_use_fusion_emitters"] = True


def update_with_quick_code(monkeypatch):
    """Lets runs compile their updates, the same ones, to quick code."""
    original, compiled = population.update_members, {}

    def update(agent, *arguments, **options):
        key = (agent, *options.items())
        if key not in compiled:
            compiled[key] = original.lower(agent, *arguments, **options).compile(QUICK_CODE)
        return compiled[key](*arguments)

    monkeypatch.setattr(population, "update_members", update)
