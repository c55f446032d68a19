"""Settings of JAX for tests and the processes they start, made before JAX is imported anywhere."""

import gc
import os
import signal
from importlib.metadata import version
from pathlib import Path

import pytest

# Compiled functions are kept on disk, so that tests and their subprocesses share them.
os.environ.setdefault(
    "JAX_COMPILATION_CACHE_DIR", str(Path(__file__).parent.parent / ".pytest_cache" / "jax")
)
os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", "0.1")
# Where in the sources each operation comes from is for profiles; tracing is faster without.
os.environ.setdefault("JAX_TRACEBACK_IN_LOCATIONS_LIMIT", "0")
# What tests compile runs for milliseconds: quick compilation matters more than quick code.
_flags = [os.environ.get("XLA_FLAGS", ""), "--xla_backend_optimization_level=0"]
# A sixth of what is left are passes over loops, each of which is run thirteen times.
_passes = "simplify-while-loops,while-loop-invariant-code-motion,while-loop-constant-sinking"
_flags += [f"--xla_disable_hlo_passes={_passes}"]
# Later versions do not know the first of these flags, and end the process that sets it.
if tuple(map(int, version("jaxlib").split(".")[:2])) < (0, 11):
    # In one part, since there is a core for each process of tests, and less to do in all.
    _flags += ["--xla_cpu_use_fusion_emitters=false", "--xla_cpu_parallel_codegen_split_count=1"]
os.environ["XLA_FLAGS"] = " ".join(_flags).strip()

if signal.getsignal(signal.SIGINT) == signal.SIG_IGN:
    # As in what a script starts in the background: many tests here are of Ctrl-C.
    signal.signal(signal.SIGINT, signal.default_int_handler)

LONGEST = (
    "test_brax",
    "test_training",
    "test_tables",
    "test_accelerator",
    "test_devices",
    "test_agent",
    "test_command_line",
    "test_methods_command_line",
    "test_device_round",
    "test_methods",
    "test_precision",
    "test_ray_casting",
    "test_api",
    "test_bridge",
    "test_convolutions",
    "test_demo",
    "test_transfer_surgery",
    "test_ahead",
    "test_golden",
    "test_memory",
    "test_copying",
    "test_two_cores",
    "test_transfer_safety",
    "test_transfer_foreign",
    "test_transfer_recipes",
    "test_docs",
    "test_start_up",
    "test_envs",
    "test_transfer_docs",
    "test_package",
    "test_sweep",
)
"""Files that take a worker longest come first, so that none is begun when the rest is done."""


def pytest_collection_modifyitems(items):
    place = {name: number for number, name in enumerate(LONGEST)}
    items.sort(key=lambda item: place.get(item.path.stem, len(place)))


def pytest_collection_finish():
    # What imports have made stays; garbage is looked for in what tests make.
    gc.collect()
    gc.freeze()
    # Programs are traced in millions of objects, few of them garbage.
    gc.set_threshold(50_000, 20, 50)


@pytest.fixture(scope="session", autouse=True)
def compiled_programs_are_kept():
    """What tests have compiled serves later ones, and takes seconds to free."""
    import jax

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(jax, "clear_caches", lambda: None)
        yield


@pytest.fixture(scope="module")
def small_agents_are_diagnosed():
    """Runs diagnose agents of one number (small_agent.py), which have no networks to ask."""
    from dreamer_jax import population
    from small_agent import diagnose

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(population, "diagnose", diagnose)
        yield
