"""Compiled functions are kept on disk, so that tests, and the processes they start, share them."""

import os
from pathlib import Path

# Before JAX is imported anywhere, and inherited by subprocesses.
os.environ.setdefault(
    "JAX_COMPILATION_CACHE_DIR", str(Path(__file__).parent.parent / ".pytest_cache" / "jax")
)
os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", "0.5")
