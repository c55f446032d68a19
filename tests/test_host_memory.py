"""Memory that is freed is kept: seen from the page faults of a fresh process."""

import json
import subprocess
import sys

import pytest

FAULTS = """
import json, resource, sys
import numpy as np
from dreamer_jax.host_memory import keep_freed_memory

kept = len(sys.argv) > 1 and keep_freed_memory()

def faults():
    before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
    np.ones(64 << 20, np.uint8)
    return resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before

first, *later = [faults() for _ in range(4)]
print(json.dumps([kept, first, max(later)]))
"""


def in_a_fresh_process(*arguments):
    command = [sys.executable, "-c", FAULTS, *arguments]
    return json.loads(subprocess.run(command, capture_output=True, text=True, check=True).stdout)


def test_a_block_that_was_freed_is_allocated_again_without_page_faults():
    _, first, later = in_a_fresh_process()
    if later < 1000:
        pytest.skip(f"this C library keeps freed memory by itself ({first}, {later} page faults)")
    kept, _, later = in_a_fresh_process("keep")
    assert kept
    assert later < 100
