"""The command plan: what runs of the thesis's grid will take. Others ask it before they begin.

What takes long to import is imported where it is used, so that bad input is told at once.
"""

import dataclasses
import json
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import tyro

from experiments.cli.options import Base, Devices
from experiments.cli.selection import Sweep, entries_of, planned_beside_others, sweep_of

if TYPE_CHECKING:
    from experiments.thesis.graph import Graph, PlannedRun
    from experiments.thesis.speeds import Known


@dataclass(frozen=True)
class Plan:
    """Show the runs that tables and figures need, and what they will take, without running them.

    Time, memory and disk are estimates, from a short measurement on this machine: half a minute
    for each simulator and one for updates, most of it compilation. It is made once for a machine
    and its settings, and kept.
    """

    table: tuple[str, ...] = ()
    """Numbers of tables (1 to 17), or all."""
    figure: tuple[str, ...] = ()
    """Numbers of figures (10 to 39), or all."""
    measure: bool = False
    """Measure this machine anew."""
    json: bool = False
    """Print the graph as JSON, with estimates where this machine was measured before."""
    sweep: tyro.conf.OmitArgPrefixes[Sweep] = Sweep()


def plan_defaults(base: Base) -> Plan:
    """Defaults of `plan`."""
    return Plan(sweep=sweep_of(base))


def plan(command: Plan) -> int:
    """Shows the graph with an estimate."""
    from experiments.thesis import estimate, measurement
    from experiments.thesis.graph import due

    sweep = command.sweep
    entries = entries_of(command.table, command.figure, sweep, "plan")
    runs = planned_beside_others(entries, sweep)
    left = due(runs)
    timeout = sweep.simulators.simulator_timeout
    if command.json:
        if command.measure and left:
            _speed(left, timeout, again=True)
        print(json.dumps(_as_json(runs, sweep), indent=1))
        return 0
    known = _speed(left, timeout, again=command.measure) if left else None
    print(f"\n{', '.join(entry.name for entry in entries)}, preset {sweep.preset}: {sweep.root}\n")
    print(estimate.plan_table(runs, known and known.speed, sweep.devices))
    if known is not None:
        ticks = 1000 * max(known.speed.tick_seconds.values())
        when = f"kept in {known.path} (--measure measures anew)" if known.kept else "here and now"
        print(
            f"\nAn estimate, from {known.speed.update_seconds:.3g} s for an update of one agent "
            f"and {ticks:.1f} ms for a tick of the\nslowest simulator, measured {when}.\n"
            "Runs come one after another; each is compiled first."
        )
        if known.speed.scaled > 1:
            print(
                "The update was measured on smaller batches, and multiplied by "
                f"{known.speed.scaled:.3g}: its time may be off by {measurement.SCALING_ERROR:.0%}."
            )
    return 0


def _as_json(runs: "Graph", sweep: Sweep) -> dict[str, object]:
    """The graph as JSON holds it: what it is, and of each run what an engine asks."""
    from experiments.thesis.engines.demands import estimates
    from experiments.thesis.graph import PlannedRun
    from experiments.thesis.speeds import cache_folder

    known = estimates(runs, cache_folder(), sweep.devices)
    found = []
    for run in runs:
        one = known.get(run.name)
        estimated = {} if one is None else dataclasses.asdict(one)
        found.append(
            {
                "name": run.name,
                "needs": run.needs,
                "state": run.state,
                "progress": run.progress if isinstance(run, PlannedRun) else None,
                "tasks": run.spec.tasks if isinstance(run, PlannedRun) else None,
                "cells": run.cells,
                **{key: estimated.get(key) for key in ("seconds", "memory", "disk")},
            }
        )
    return {"root": str(sweep.root), "preset": sweep.preset, "runs": found}


LONG_SECONDS = 3600.0
"""What takes longer is begun at a terminal only after a question."""


def _speed(left: "Sequence[PlannedRun]", timeout: float, again: bool = False) -> "Known":
    """How fast this machine is at runs of which there is at least one."""
    from experiments.thesis.speeds import cache_folder, speed_of

    def report(number: int, count: int, what: str) -> None:
        if number == 1:
            print("measuring how fast this machine is:", file=sys.stderr)
        print(f"  [{number}/{count}] {what}", file=sys.stderr, flush=True)

    specs = [run.spec for run in left]
    return speed_of(specs, cache_folder(), again=again, timeout=timeout, report=report)


def may_begin(runs: "Graph", timeout: float, devices: Devices) -> bool:
    """Asks before anything longer than an hour. Runs of few updates are short without measuring."""
    from dreamer_jax.schedule import Schedule
    from experiments.thesis import estimate
    from experiments.thesis.graph import due

    left = due(runs)
    updates = sum(
        Schedule(run.spec.config.schedule, len(run.spec.tasks)).updates * len(run.spec.members)
        for run in left
    )
    # An update that takes a second is one of the largest sizes on a machine without accelerator.
    if updates < LONG_SECONDS:
        return True
    speed = _speed(left, timeout).speed
    total = estimate.together(runs, speed, devices)
    if total.seconds < LONG_SECONDS:
        return True
    agents = sum(len(run.cells) for run in left)
    print(
        f"{len(left)} runs of {agents} agents will take {estimate.span(total.seconds, speed)}. "
        "They can be stopped with\nCtrl-C and go on with the same command; plan shows them one by "
        "one, --yes begins without asking."
    )
    try:
        return input("Begin? [y/N] ").strip().lower() in ("y", "yes")
    except EOFError:
        return False
