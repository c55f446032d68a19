"""What the thesis's tables take on accelerators, by arithmetic: prints a part of docs/scaling.md.

    python docs/arithmetic.py

Operations are counted in the trace of an update and bytes from shapes; nothing is compiled or run.
"""

import functools
import heapq
import tempfile
from collections.abc import Iterator

from dreamer_jax.config import preset
from dreamer_jax.schedule import Schedule
from experiments.runs import memory
from experiments.runs.agents import make_agent
from experiments.thesis import grid, measurement
from experiments.thesis.graph import plan_runs
from experiments.thesis.grid import FIGURES, TABLES, closure, shown

SHARE = 0.2
"""The share of a card's peak that an update is assumed to reach."""
PEAKS = (100e12, 500e12, 1000e12)
"""Operations a second of a card, at its peak in the precision that is used."""
CARDS, OF_CARDS = 64, 500e12
CONFIG = preset("thesis")


operations = functools.cache(measurement.operations)


def work_of(cells):
    """The operations of each agent behind some cells, by its name, sources before targets."""
    with tempfile.TemporaryDirectory() as nothing:
        runs = plan_runs(cells, CONFIG, nothing)
    found = {}
    for run in runs:
        updates = Schedule(run.spec.config.schedule, len(run.spec.tasks)).updates
        found |= dict.fromkeys(run.cells, updates * operations(make_agent(run.spec)))
    return found


def hours_on(cards, peak, cells, work):
    """Until all agents are trained, each alone on a card, as soon as those it needs are."""
    free, done = [0.0] * cards, {}
    by_name = {cell.name: cell for cell in closure(cells)}
    for name, count in work.items():
        begins = max([heapq.heappop(free), *(done[need.name] for need in by_name[name].needs)])
        done[name] = begins + count / (SHARE * peak) / 3600
        heapq.heappush(free, done[name])
    return max(done.values())


def number(value: float) -> str:
    return f"{value:,.0f}" if value >= 10 else f"{value:.1f}"


def row(cells) -> str:
    """The columns of what takes some cells, and those that they need."""
    work = work_of(cells)
    total = sum(work.values())
    alone = [number(total / (SHARE * peak) / 3600) for peak in PEAKS]
    together = number(hours_on(CARDS, OF_CARDS, cells, work))
    return " | ".join([f"| {len(work)}", f"{total:.2g}", *alone, f"{together} |"])


def of_one_member() -> Iterator[str]:
    """Lines on an update of one member."""
    with tempfile.TemporaryDirectory() as nothing:
        (one,) = plan_runs([grid.baseline("bullet", "Hopper", 0)], CONFIG, nothing)
    agent, learning = make_agent(one.spec), CONFIG.learning
    count = operations(agent)
    records = learning.batch_size * learning.sequence_length
    batch, state = records * memory.record_bytes(agent), memory.member_bytes(agent)
    yield "| of one member, preset `thesis` | |"
    yield "|---|---|"
    yield f"| operations of an update | {count:.3g} |"
    yield f"| parameters and moments, read and written by an update | {state / 2**20:.0f} MiB |"
    yield f"| a batch, read by an update | {batch / 2**20:.0f} MiB |"
    yield f"| operations for each of these bytes | {count / (2 * state + batch):,.0f} |"
    lies = memory.bytes_of(agent, 1, 1, 0, 0)
    yield f"| memory beside the working memory of an update | {lies / 2**20:.0f} MiB |"
    rates = ", ".join(number(SHARE * peak / count) for peak in PEAKS)
    yield f"| updates a second on a card of 100, 500 and 1000 TFLOP/s | {rates} |"


def of_tables() -> Iterator[str]:
    """Lines on tables, those that take the same as one."""
    yield "| tables | agents | operations | 100 | 500 | 1000 | 64 cards of 500 |"
    yield "|---|---|---|---|---|---|---|"
    alike: dict[str, list[str]] = {}
    for name, table in TABLES.items():
        alike.setdefault(row(shown(table)), []).append(name.removeprefix("table-"))
    for line, names in alike.items():
        yield f"| {names[0]} to {names[-1]} {line}"
    whole = {cell for entry in (*TABLES.values(), *FIGURES.values()) for cell in shown(entry)}
    yield f"| all tables and figures {row(sorted(whole, key=lambda cell: cell.name))}"


if __name__ == "__main__":
    print(*of_one_member(), "", *of_tables(), sep="\n")
