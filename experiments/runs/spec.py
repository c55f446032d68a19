"""What a results folder is a run of: tasks, seeds, settings, and how knowledge is transferred."""

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import envs
from dreamer_jax import config as configs
from dreamer_jax.config import Config, Difference
from dreamer_jax.integrity import read_sealed_json
from dreamer_jax.ranges import check_ranges
from dreamer_jax.schema import RUN, check_shape
from experiments import methods
from experiments.methods.base import Method, require
from experiments.methods.scratch import Scratch

if TYPE_CHECKING:
    from dreamer_jax.population import Member

Mapped = Literal["auto", "vmap", "chunks"]
"""The setting `mapping`."""

OF_THE_MACHINE = ("schedule.mapping", "schedule.mapping_chunk", "schedule.replay_threads")
"""How members are mapped and batches are put together depends on the machine, and changes no result
but by rounding."""


@dataclass(frozen=True)
class RunSpec:
    """What a results folder is a run of.

    Attributes:
      tasks: names of the K tasks; several make a multi-task agent.
      seeds: of the members; a method may make several members of each.
      config: the settings.
      method: how the agents begin and what of them is trained, see `experiments.methods`. Folders
        that it names may be relative.
    """

    tasks: tuple[str, ...]
    seeds: tuple[int, ...]
    config: Config
    method: Method = Scratch()

    def __post_init__(self):
        choices = ", ".join([*envs.task_names(), "gymnasium/ID"])
        require(self.tasks, f"no task given: choose from {choices}")
        for task in self.tasks:
            envs.described(task)
        require(len(set(self.tasks)) == len(self.tasks), f"a task is named twice: {self.tasks}")
        require(self.seeds, "no seed given")
        require(len(set(self.seeds)) == len(self.seeds), f"a seed is named twice: {self.seeds}")
        require(
            all(0 <= seed < 2**31 for seed in self.seeds),
            f"seeds {self.seeds} must lie in [0, 2^31)",
        )
        configs.check_prefill(self.config, len(self.tasks))
        check_ranges(self.method)

    @property
    def members(self) -> "tuple[Member, ...]":
        """The population: the method's targets, then the baseline."""
        return self.method.members(self.seeds)

    def to_dict(self) -> dict[str, Any]:
        """As JSON can hold it."""
        method = {"name": self.method.NAME, **dataclasses.asdict(self.method)}
        return {
            "tasks": self.tasks,
            "seeds": self.seeds,
            "config": configs.to_dict(self.config),
            "method": method,
        }

    @classmethod
    def from_dict(cls, values: Mapping[str, Any]) -> "RunSpec":
        """From `to_dict`'s result, by way of JSON too, or from one in which the settings of all
        methods stood beside the others.

        Raises:
          ValueError: a setting is unknown, or its value is refused.
        """
        values = dict(values)
        method = values.pop("method", None)
        if not isinstance(method, Mapping):
            settings = {key: values.pop(key) for key in methods.options() if key in values}
            # These named a method for agents from scratch, too.
            name = method if settings.get("sources") else Scratch.NAME
            method = {"name": name, **(settings if settings.get("sources") else {})}
        known = {field.name for field in dataclasses.fields(cls)}
        if unknown := sorted(set(values) - known):
            raise ValueError(
                f"unknown settings of a run: {', '.join(unknown)}. Another version of this program "
                "wrote them: use that one, or train anew in another folder"
            )
        settings = {key: _plain(value) for key, value in method.items() if key != "name"}
        return cls(
            tasks=_plain(values["tasks"]),
            seeds=_plain(values["seeds"]),
            config=configs.from_dict(values["config"]),
            method=methods.make(method["name"], settings),
        )

    def differences(self, other: "RunSpec") -> tuple[Difference, ...]:
        """What differs between two, but for `OF_THE_MACHINE`; settings of methods go by their
        names."""
        one, two = self._flat(), other._flat()
        pairs = [Difference(name, one.get(name), two.get(name)) for name in {**one, **two}]
        return (
            *(pair for pair in pairs if pair.one != pair.other),
            *(
                pair
                for pair in configs.differences(self.config, other.config)
                if pair.path not in OF_THE_MACHINE
            ),
        )

    def _flat(self) -> dict[str, Any]:
        """All but the configuration."""
        method = dataclasses.asdict(self.method)
        return {"tasks": self.tasks, "seeds": self.seeds, "method": self.method.NAME, **method}


def _plain(value: Any) -> Any:
    """JSON turns tuples into lists."""
    return tuple(value) if isinstance(value, list) else value


def read_spec(directory: str | Path) -> RunSpec:
    """The spec of a results folder.

    Raises:
      ValueError: the folder holds no run.
    """
    path = Path(directory) / "run.json"
    if not path.exists():
        raise ValueError(
            f"{directory} holds no run (there is no {path.name} in it); "
            "make one with: python -m experiments train --task ... --out " + str(directory)
        )
    header = check_shape(read_sealed_json(path), RUN, path)
    try:
        return RunSpec.from_dict(header["spec"])
    except (ValueError, KeyError, TypeError) as error:
        raise ValueError(f"{path}: {error}") from error


def action_size(tasks: tuple[str, ...]) -> int:
    """A of an agent for several tasks: the largest of theirs (equation 18)."""
    return max(task.action_size for task in envs.specs(tasks))
