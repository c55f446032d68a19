"""Commands on trained agents as files: export, zoo. Their options, and what they do.

What takes long to import is imported where it is used, so that bad input is told at once.
"""

from dataclasses import dataclass
from pathlib import Path

import tyro

from dreamer_jax.ranges import setting
from experiments.cli.exits import usage_errors
from experiments.cli.options import Simulators


@dataclass(frozen=True)
class Export:
    """Write a trained agent as weights (.safetensors) and a card (.json), to share or start from.

    Episodes are played with it for the card. `train --source FILE.safetensors` starts from it.
    """

    directory: tyro.conf.Positional[Path]
    """The results folder; its newest checkpoint is exported."""
    out: Path
    """The file of weights to write; the card is written beside it."""
    member: int = setting(0, 0, 10**6)
    """Which member of the population."""
    episodes: int = setting(10, 1, 10**6)
    """Episodes of each task to play for the card."""
    note: str = ""
    """A sentence for the card."""
    accept_failed: bool = False
    """Export an agent whose losses were not finite any more, as it was before."""
    simulators: tyro.conf.OmitArgPrefixes[Simulators] = Simulators()
    trust: bool = False
    """Import the modules that the tasks of a folder made by others name, and so run their code."""


@dataclass(frozen=True)
class Zoo:
    """List the trained agents that come with this package, or tell all that is known of one.

    `train --source zoo:NAME` transfers from one.
    """

    name: tyro.conf.Positional[str | None] = None
    """Which agent to tell of; by default all of them, in short."""


def export(command: Export) -> int:
    """Writes an agent and its card."""
    from dreamer_jax.progress import reported
    from experiments.runs.export import export
    from experiments.runs.trust import check_trust

    with usage_errors():
        check_trust([command.directory], command.trust)
    with usage_errors(), reported("playing") as report:
        card = export(
            command.directory,
            command.out,
            member=command.member,
            episodes=command.episodes,
            note=command.note,
            accept_failed=command.accept_failed,
            workers=command.simulators.workers,
            timeout=command.simulators.simulator_timeout,
            report=report,
        )
    for task in card.spec.tasks:
        print(f"{task}: {card.verdict(task)}")
    print(f"wrote {command.out} and {command.out.with_suffix('.json').name}")
    return 0


def zoo(command: Zoo) -> int:
    """Lists the zoo."""
    from experiments.runs import exported

    if command.name is not None:
        with usage_errors():
            name = exported.PREFIX + command.name.removeprefix(exported.PREFIX)
            print(_told(name, exported.read_card(name)))
        return 0
    titles = exported.zoo()
    if not titles:
        print("the zoo of this package is empty: python -m experiments export makes agents for it")
        return 0
    for title in titles:
        card = exported.read_card(exported.PREFIX + title)
        print(f"{title}: {card.environment_steps:,} environment steps")
        for task in card.spec.tasks:
            print(f"  {task}: {card.verdict(task)}")
    print("\nmore of one: python -m experiments zoo NAME; to transfer from it: --source zoo:NAME")
    return 0


def _told(name: str, card) -> str:
    """All that a card says, for a terminal."""
    from dreamer_jax import config as configs
    from experiments.runs import exported

    lines = [f"{name}: seed {card.seed}, {card.environment_steps:,} environment steps, "]
    lines[0] += f"{card.updates:,} updates, revision {card.revision}"
    for task in card.spec.tasks:
        lines.append(f"  {task}: {card.verdict(task)}")
        lines.append(f"    episodes: {', '.join(f'{score:.0f}' for score in card.returns[task])}")
        curve = card.curves.get(task, ())
        shown = curve[:: max(1, len(curve) // 10)]
        points = ", ".join(f"{score:.0f} at {steps:,}" for steps, score in shown)
        lines.append(f"    evaluations in training: {points or 'none'}")
    sizes = configs.to_dict(card.spec.config)["network"]
    lines.append("  networks: " + ", ".join(f"{name} {value}" for name, value in sizes.items()))
    if card.note:
        lines.append(f"  {card.note}")
    lines.append(f"  weights: {exported.weights_path(name)}, SHA-256 {card.sha256}")
    lines.append(f"  to transfer from it: python -m experiments train --source {name} ...")
    return "\n".join(lines)
