"""Results folders compared with their checksums, as text, and the checkpoints of one listed."""

from collections.abc import Iterable
from pathlib import Path

from dreamer_jax.checkpoint import Checkpointer, CorruptCheckpointError
from dreamer_jax.schedule import Counters, Schedule
from dreamer_jax.verification import Finding, sealed_file, verify
from experiments.runs.folder import CELLS, read_cells
from experiments.runs.spec import read_spec
from experiments.runs.text import aligned


def folders_of(directories: Iterable[Path]) -> list[Path]:
    """The runs' folders among some folders and those in them.

    Raises:
      ValueError: there is none in one of them.
    """
    found = []
    for directory in directories:
        inside = [path.parent for path in sorted(directory.glob("*/run.json"))]
        marks = ("run.json", "checkpoints", "replay", "metrics.jsonl")
        if any((directory / name).exists() for name in marks):
            found.append(directory)
        elif inside:
            found += inside
        else:
            raise ValueError(f"{directory} holds no run")
    return found


def findings_of(folder: Path) -> list[Finding]:
    """All that is found of one run's folder."""
    findings = []
    if not (folder / "run.json").exists():
        findings.append(Finding("run.json", "damaged", f"{folder / 'run.json'} is missing"))
    else:
        findings.append(sealed_file(folder, "run.json"))
    try:
        members = len(read_spec(folder).members) if findings[0].state != "damaged" else None
        if (folder / CELLS).exists():
            cells = read_cells(folder)
            if members is not None and len(cells) != members:
                raise ValueError(f"{folder / CELLS} names {len(cells)} cells of {members} members")
            findings.append(Finding(CELLS, "sound", f"{len(cells)} cells, as in run.json"))
    except (OSError, ValueError, KeyError, TypeError) as error:
        findings.append(Finding("run.json and cells.json", "damaged", str(error)))
    return findings + verify(folder)


def report_of(directories: Iterable[Path]) -> tuple[str, bool]:
    """A table for each run's folder, and whether nothing is damaged."""
    texts, sound = [], True
    for folder in folders_of(directories):
        findings = findings_of(folder)
        damaged = [finding for finding in findings if finding.state == "damaged"]
        sound = sound and not damaged
        lines = [f"{folder}: {f'{len(damaged)} DAMAGED' if damaged else 'nothing is damaged'}"]
        lines += [f"  {one.state:9}  {one.part}: {one.text}" for one in findings]
        texts.append("\n".join(lines))
    return "\n\n".join(texts), sound


def checkpoint_table(directory: Path) -> str:
    """The checkpoints of a results folder, newest first, as a table.

    Raises:
      ValueError: the folder holds no run, or no checkpoint.
    """
    spec = read_spec(directory)
    checkpoints = Checkpointer(directory / "checkpoints")
    if not checkpoints.steps():
        raise ValueError(f"{directory} has no checkpoint")
    schedule, rows = Schedule(spec.config.schedule, len(spec.tasks)), []
    for step in checkpoints.steps()[::-1]:
        try:
            checkpoints.check(step)
            counters = Counters(**checkpoints.metadata(step)["counters"])
        except CorruptCheckpointError as error:
            rows.append([str(step), "-", "-", str(error)])
            continue
        steps = schedule.environment_steps(counters.rounds)
        rows.append([str(step), f"{steps:,}", f"{counters.updates:,}", "sound"])
    return aligned(["checkpoint", "environment steps", "updates", ""], rows)
