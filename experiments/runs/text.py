"""Text that commands and reports share: names of tasks, and aligned columns."""

from collections import Counter
from collections.abc import Iterable, Sequence

import envs


def titles(tasks: Iterable[str]) -> dict[str, str]:
    """What each of some tasks is called beside the others: its title, or its name where another
    simulator's has the same."""
    found = {task: envs.described(task).title for task in tasks}
    count = Counter(found.values())
    return {task: title if count[title] == 1 else task for task, title in found.items()}


def aligned(header: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """A table as text: the first column to the left, the others to the right."""
    lines = [list(header), *(list(row) for row in rows)]
    widths = [max(len(line[i]) for line in lines) for i in range(len(header))]
    lines.insert(1, ["-" * width for width in widths])
    return "\n".join(
        "  ".join(
            cell.ljust(width) if i == 0 else cell.rjust(width)
            for i, (cell, width) in enumerate(zip(line, widths, strict=True))
        ).rstrip()
        for line in lines
    )
