"""Memory and time to load a checkpoint by a plan, leaf by leaf and at once: one JSON line.

    python -m benchmarks.streaming [GiB=1] [ways=stream,load]

A ``.safetensors`` file of so many GiB of float32, in leaves of 64 MiB, becomes bfloat16 arrays,
half as large. `beyond_MiB` is the peak of a process's memory beyond that result, read from the
kernel (Linux); `stream` reads the file as the plan goes, `load` reads it first.
"""

import json
import re
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

import transfer
from benchmarks.update import read_arguments

DEFAULTS = {"GiB": 1, "ways": "stream,load"}
LEAF = 2**24


def peak_mib() -> float:
    status = Path("/proc/self/status").read_text()
    return int(re.search(r"VmHWM:\s*(\d+) kB", status)[1]) / 1024


def measure(way: str, path: Path, leaves: int) -> dict:
    import jax
    import jax.numpy as jnp

    plan = transfer.Plan((transfer.Rule("{i}", "copy"),))
    shapes = {str(i): jax.ShapeDtypeStruct((LEAF,), jnp.bfloat16) for i in range(leaves)}
    jnp.zeros(8).block_until_ready()
    before, started = peak_mib(), time.perf_counter()
    if way == "stream":
        with transfer.open_file(path) as source:
            new, _ = transfer.stream(plan, shapes, source, measure=False)
    else:
        new, _ = transfer.stream(plan, shapes, transfer.load(path), measure=False)
    jax.block_until_ready(new)
    result = leaves * LEAF * 2 / 2**20
    return {
        "seconds": round(time.perf_counter() - started, 2),
        "beyond_MiB": round(peak_mib() - before - result),
    }


def main():
    if sys.argv[1:2] == ["child"]:
        print(json.dumps(measure(sys.argv[2], Path(sys.argv[3]), int(sys.argv[4]))))
        return
    a = read_arguments(sys.argv[1:], DEFAULTS)
    leaves = int(float(a["GiB"]) * 2**28 / LEAF)
    results = {}
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "source.safetensors"
        ones = np.ones(LEAF, np.float32)
        transfer.save(path, {str(i): ones for i in range(leaves)})
        for way in a["ways"].split(","):
            command = [sys.executable, "-m", "benchmarks.streaming", "child", way, path, leaves]
            found = subprocess.run([*map(str, command)], check=True, capture_output=True, text=True)
            results[way] = json.loads(found.stdout)
    print(json.dumps({"benchmark": "streaming", "results": results, **a}))


if __name__ == "__main__":
    main()
