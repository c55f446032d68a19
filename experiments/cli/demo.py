"""The command demo: a trained source, targets of it and agents from scratch, and what came of it.

What takes long to import is imported where it is used, so that bad input is told at once.
"""

import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import tyro

from dreamer_jax import config as configs
from dreamer_jax.ranges import setting
from experiments.cli.exits import STOPPED, usage_errors
from experiments.cli.options import AtOnce, Devices, Simulators


@dataclass(frozen=True)
class Demo:
    """See a transfer in minutes: from a trained agent of the zoo to agents that begin.

    Trains, as one population, targets of two fractions and agents from scratch, five seeds each;
    says what the difference is, and shows it as learning curves and as a video.
    """

    results: Path = Path("results")
    """The folder of all results; the demo's are in one of its preset's name."""
    source: str = "zoo:brax-inverted_pendulum-balanced"
    """The agent to transfer from: zoo:NAME, a .safetensors file, or a results folder."""
    task: str = "bullet/inverted_pendulum"
    """The target."""
    omegas: tuple[float, ...] = setting((0.0, 0.2), 0, 1)
    """Fractions of the source's last reward and value layers to add."""
    seeds: tuple[int, ...] = setting((0, 1, 2, 3, 4), 0, 2**31 - 1)
    """Of the targets, and of the agents from scratch."""
    preset: Literal["demo", "cpu", "debug"] = "demo"
    """Settings; debug runs in seconds, from a source of its own sizes."""
    devices: Devices = setting("all", 1, 10_000)
    """Devices to spread the agents over, each agent on one of them."""
    at_once: tyro.conf.OmitArgPrefixes[AtOnce] = AtOnce()
    simulators: tyro.conf.OmitArgPrefixes[Simulators] = Simulators()


def demo(command: Demo) -> int:
    """Trains what is missing, and shows what came of it."""
    from experiments.methods.fractional import FractionalTransfer
    from experiments.reports import showcase, summary
    from experiments.reports.outcomes import read_run
    from experiments.runs.agents import load_source
    from experiments.runs.evaluate import load_agents
    from experiments.runs.memory import in_memory, mapped
    from experiments.runs.run import carry_out, make_run
    from experiments.runs.spec import RunSpec
    from experiments.runs.ways_out import DEMO

    folder = command.results / command.preset / "demo"
    workers, timeout = command.simulators.workers, command.simulators.simulator_timeout
    with usage_errors():
        source = load_source(command.source)
        method = FractionalTransfer(sources=(command.source,), omegas=command.omegas, baseline=True)
        spec = RunSpec(
            (command.task,), command.seeds, configs.preset(command.preset), method=method
        )
        spec = mapped(spec, command.at_once.mapping, command.at_once.mapping_chunk)
        run = make_run(
            in_memory(spec, command.devices),
            folder,
            resume=True,
            workers=workers,
            timeout=timeout,
            devices=command.devices,
        )
    if carry_out(run, DEMO) == "stopped":
        print(f"stopped and saved in {folder}: the same command goes on")
        return STOPPED
    print("\nWhat was transferred, leaf by leaf (norms are means over the targets)\n")
    print((folder / "transfer.txt").read_text())
    outcome = read_run(folder)
    print("Return of evaluation episodes, mean ± standard deviation\n")
    print(summary.table(summary.summarise(outcome)) + "\n")
    panels = []
    try:
        panels.append(showcase.source_panel(source, command.task, workers=workers, timeout=timeout))
    except ModuleNotFoundError as error:
        print(f"the video is without the source: {error}", file=sys.stderr)
    agents = load_agents(folder)
    panels += showcase.member_panels(agents, outcome, workers=workers, timeout=timeout)
    film = showcase.write_film(panels, folder / "videos" / "beside_each_other.mp4")
    for path in (*summary.plot_curves(outcome), film):
        print(f"wrote {path}")
    print("\n" + showcase.sentence(outcome, command.task, command.source))
    return 0
