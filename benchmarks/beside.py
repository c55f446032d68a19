"""Runs benchmarks of two programs in turn, so that both meet the same load: one JSON line.

    python -m benchmarks.beside "python -m benchmarks.update depth=8" "python peer.py depth=8" \
        [rounds=3] [figure=s_per_update]

Each command prints a JSON line last. `ratio` is the median, over the rounds, of the first
command's figure over the second's; `first` and `second` are the medians of the figures.
"""

import json
import shlex
import statistics
import subprocess
import sys
from typing import Any

from benchmarks.update import read_arguments

DEFAULTS = {"rounds": 3, "figure": "s_per_update"}


def line_of(command: str) -> dict[str, Any]:
    """The last line that a command prints, which is JSON.

    Raises:
      RuntimeError: it failed; holds what it said.
    """
    done = subprocess.run(shlex.split(command), capture_output=True, text=True)
    if done.returncode:
        raise RuntimeError(f"{command} failed:\n{done.stderr}")
    return json.loads(done.stdout.splitlines()[-1])


def main():
    commands, rest = sys.argv[1:3], sys.argv[3:]
    if len(commands) < 2:
        sys.exit(__doc__)
    a = read_arguments(rest, DEFAULTS)
    try:
        rounds = [
            [line_of(command)[a["figure"]] for command in commands] for _ in range(a["rounds"])
        ]
    except RuntimeError as error:
        sys.exit(f"error: {error}")
    first, second = (statistics.median(values) for values in zip(*rounds, strict=True))
    result = {
        "benchmark": "beside",
        "commands": commands,
        "first": first,
        "second": second,
        "ratio": round(statistics.median(one / other for one, other in rounds), 3),
        **a,
    }
    print(json.dumps(result))


if __name__ == "__main__":
    main()
