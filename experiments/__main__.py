"""The command line: python -m experiments {train, evaluate, table, plan, ...}; --help names all.

Python puts the working folder first on the path of this form. The other form, `dreamer-transfer`,
is free of that.
"""

import importlib.util
import sys
from collections.abc import Sequence
from pathlib import Path

_OWN = ("dreamer_jax", "envs", "transfer")


def hidden_packages() -> dict[str, str]:
    """The packages of this program that others hide: name -> where the other of that name is."""
    home = Path(__file__).resolve().parents[1]
    found = {}
    for name in _OWN:
        spec = importlib.util.find_spec(name)
        place = None if spec is None or spec.origin is None else Path(spec.origin).resolve()
        if place is not None and place != home / name / "__init__.py":
            found[name] = str(place)
    return found


def main(arguments: Sequence[str] | None = None) -> int:
    """Runs one command, unless something in the working folder hides a part of this program.

    Args:
      arguments: by default those of this process.

    Returns:
      The exit code, see `experiments.cli.main`.
    """
    if hidden := hidden_packages():
        names = ", ".join(f"{name} ({place})" for name, place in hidden.items())
        print(
            f"error: other packages hide those of this program: {names}. Give the command as "
            "dreamer-transfer, which does not look in the working folder, or from another folder",
            file=sys.stderr,
        )
        return 2
    from experiments.cli import main as commands

    return commands.main(arguments)


if __name__ == "__main__":
    sys.exit(main())
