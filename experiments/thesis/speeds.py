"""How fast this machine is: measured once for its settings, and kept.

A measurement is a file in the folder of caches, named after what it depends on: the machine, its
device, the version of JAX, and the settings that change what an update or a tick takes.
"""

import dataclasses
import hashlib
import json
import os
import platform
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import jax

from dreamer_jax import config as configs
from dreamer_jax.config import Config
from dreamer_jax.files import write_json_atomically
from dreamer_jax.progress import Report, unreported
from envs import SIMULATOR_TIMEOUT
from envs.pool import available_cores
from experiments.runs.spec import RunSpec
from experiments.thesis.measurement import Speed, measure

# Of the schedule, what a tick takes; the rest says how many there are.
_OF_TICKS = ("action_repeat", "supersample", "phase_environment_steps")


class Known(NamedTuple):
    """A measurement.

    Attributes:
      speed: what was measured.
      path: where it is kept.
      kept: whether it was there already.
    """

    speed: Speed
    path: Path
    kept: bool


def cache_folder() -> Path:
    """Where measurements are kept unless another folder is named."""
    cache = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
    return cache / "dreamer-transfer" / "speed"


def speed_of(
    specs: Sequence[RunSpec],
    folder: Path,
    *,
    again: bool = False,
    timeout: float = SIMULATOR_TIMEOUT,
    report: Report = unreported,
) -> Known:
    """How fast this machine is at runs of one preset.

    A measurement that is kept counts if it has all simulators of the runs; what is measured anew
    has those that were kept before, too.

    Args:
      specs: the runs.
      folder: where measurements are kept.
      again: measures in any case.
      timeout: seconds after which a simulator that does not answer is given up.
      report: called before each measurement with what it is of.
    """
    path = folder / f"{_key(specs[0].config)}.json"
    before = _read(path)
    tasks = {task for spec in specs for task in spec.tasks}
    if before is not None and not again and tasks <= set(before.tick_seconds):
        return Known(before, path, kept=True)
    found = measure(specs, report, timeout=timeout)
    if before is not None:
        found = dataclasses.replace(
            found,
            tick_seconds={**before.tick_seconds, **found.tick_seconds},
            tick_compile_seconds={**before.tick_compile_seconds, **found.tick_compile_seconds},
        )
    folder.mkdir(parents=True, exist_ok=True)
    write_json_atomically(path, {"machine": _machine(), "speed": dataclasses.asdict(found)})
    return Known(found, path, kept=False)


def kept(specs: Sequence[RunSpec], folder: Path) -> Known | None:
    """What was measured on this machine before of runs of one preset, if all of it was."""
    path = folder / f"{_key(specs[0].config)}.json"
    found = _read(path)
    tasks = {task for spec in specs for task in spec.tasks}
    if found is None or not tasks <= set(found.tick_seconds):
        return None
    return Known(found, path, kept=True)


def _machine() -> dict[str, object]:
    """What a measurement depends on beside the settings."""
    return {
        "node": platform.node(),
        "processor": platform.machine(),
        "cores": available_cores(),
        "device": jax.local_devices()[0].device_kind,
        "jax": jax.__version__,
    }


def _key(config: Config) -> str:
    settings = configs.to_dict(config)
    settings["schedule"] = {name: settings["schedule"][name] for name in _OF_TICKS}
    text = json.dumps([_machine(), settings], sort_keys=True)
    return hashlib.sha256(text.encode()).hexdigest()[:24]


def _read(path: Path) -> Speed | None:
    """A measurement that is kept; none if there is none, or one of another version."""
    try:
        values = json.loads(path.read_text(encoding="utf-8"))["speed"]
        return Speed(**{**values, "update_range": tuple(values["update_range"])})
    except (OSError, ValueError, KeyError, TypeError):
        return None
