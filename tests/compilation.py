"""Quick code for tests that run it for long; the others compile quickly instead (conftest.py)."""

from dreamer_jax import population

QUICK_CODE = {
    "xla_backend_optimization_level": 1,
    "xla_llvm_disable_expensive_passes": True,
}
"""Options of `jax.jit` and of `compile`: updates take a tenth of the time then, and several times
as long to compile. Higher levels compile for longer than they save here."""


def update_with_quick_code(monkeypatch):
    """Lets runs compile their updates, the same ones, to quick code."""
    original, compiled = population.update_members, {}

    def update(agent, *arguments, **options):
        key = (agent, *options.items())
        if key not in compiled:
            compiled[key] = original.lower(agent, *arguments, **options).compile(QUICK_CODE)
        return compiled[key](*arguments)

    monkeypatch.setattr(population, "update_members", update)
