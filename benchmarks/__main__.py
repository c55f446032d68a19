"""Runs the benchmarks one after another and writes a table: python -m benchmarks [OUT] [NAME ...].

OUT is a folder (runs/benchmarks by default): lines.jsonl takes what each benchmark prints,
table.md what people read. Names choose among the benchmarks below; all run by default. One that
fails is named at the end, and the others go on.

    python -m benchmarks accelerator --help

is a command of its own, which measures a card in at most 20 minutes.
"""

import datetime
import json
import os
import platform
import shlex
import subprocess
import sys
from pathlib import Path

import envs

BRAX = ",".join(name for name in envs.task_names() if name.startswith("brax/"))

COMMANDS = {
    "convolutions": "convolutions",
    "update-small": "update depth=8 deter=100 stoch=20 units=200 B=16 L=20 n=15",
    "update-medium": "update depth=16 deter=100 stoch=30 units=200 B=16 L=32 n=9",
    "update-thesis": "update n=3",
    "update-bfloat16": "update depth=8 deter=100 stoch=20 units=200 B=16 L=20 precision=bfloat16",
    "population": "population",
    "rollout": "rollout",
    "rollout-brax": f"rollout task={BRAX} P=1,8 image_size=32",
    "rollout-brax-64": f"rollout task={BRAX} P=1,8 image_size=64",
    "brax": "brax",
    "replay": "replay",
    "collecting": "collecting",
    "transfer": "transfer",
    "streaming": "streaming",
    "train": "train",
}


def flat(values: dict, prefix: str = "") -> list[str]:
    """The figures of one result as "name value", nested names joined by dots."""
    words = []
    for name, value in values.items():
        if isinstance(value, dict):
            words += flat(value, f"{prefix}{name}.")
        elif not isinstance(value, list):
            words.append(f"{prefix}{name} {value}")
    return words


def rows(name: str, line: dict) -> list[str]:
    """Rows of the table: one for each of a benchmark's results, or one for all it printed."""
    results = line.get("results") or [line]
    return [f"| {name} | {', '.join(flat(result))} |" for result in results]


def main(arguments: list[str]) -> int:
    if arguments[:1] == ["accelerator"]:
        from benchmarks.accelerator import command

        return command.main(arguments[1:])
    names = [word for word in arguments if word in COMMANDS] or list(COMMANDS)
    folders = [word for word in arguments if word not in COMMANDS]
    if len(folders) > 1:
        sys.exit(f"error: unknown benchmarks {folders[1:]}: choose from {', '.join(COMMANDS)}")
    folder = Path(folders[0] if folders else "runs/benchmarks")
    folder.mkdir(parents=True, exist_ok=True)
    table = [
        f"{datetime.date.today()}, {platform.machine()}, {os.cpu_count()} cores, "
        f"Python {platform.python_version()}",
        "",
        "| benchmark | figures |",
        "|---|---|",
    ]
    failed = []
    with open(folder / "lines.jsonl", "a") as lines:
        for number, name in enumerate(names, start=1):
            command = [sys.executable, "-m", *shlex.split(f"benchmarks.{COMMANDS[name]}")]
            print(f"[{number}/{len(names)}] {' '.join(command[1:])}", flush=True)
            done = subprocess.run(command, stdout=subprocess.PIPE, text=True)
            if done.returncode:
                failed.append(name)
                continue
            line = json.loads(done.stdout.splitlines()[-1])
            lines.write(json.dumps(line) + "\n")
            lines.flush()
            table += rows(name, line)
            (folder / "table.md").write_text("\n".join(table) + "\n")
    print("\n".join(table))
    print(f"wrote {folder / 'table.md'} and {folder / 'lines.jsonl'}")
    if failed:
        print(f"error: these benchmarks failed: {', '.join(failed)}", file=sys.stderr)
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
