"""What a results folder is a run of: tasks, seeds, settings, and how knowledge is transferred."""

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import envs
from dreamer_jax import config as configs
from dreamer_jax.config import Config
from dreamer_jax.files import read_json
from dreamer_jax.training import Member
from transfer.recipes import fractional_transfer, meta_model

BASELINE = "baseline"
FRACTIONS = ("reward", "value", "termination")
PLACES = 4
"""Places for stored models in a meta-model; targets with fewer share one shape (section 4.4)."""

Method = Literal["fractional", "uae", "meta"]


@dataclass(frozen=True)
class RunSpec:
    """What a results folder is a run of.

    Attributes:
      tasks: names of the K tasks; several make a multi-task agent.
      seeds: one member (or one for each omega) per seed.
      config: the settings.
      sources: folders of the runs whose agents are transferred; none for training from scratch.
        Fractional transfer takes several: each has targets of its own in one population.
      source_member: which member of each source's population.
      omegas: fractions of equation 19, one target per source, fraction and seed.
      baseline: whether agents from scratch, one per seed, join the transfer targets.
      method: "fractional" (section 3.2), "uae" (the universal autoencoder, 3.3.1) or "meta"
        (meta-models on it, 3.3.2); not used from scratch.
      fractions: the components whose last layer a fraction is transferred of.
      dynamics: of a target on a universal autoencoder, see `transfer.recipes`.
      reward_sources: folders of the runs, each on the same autoencoder, whose models a
        meta-model reads.
      reward_counts: numbers of them, one target per number and seed; all of them by default.
      meta: the components that are meta-models.
      meta_layers: hidden layers of a meta-model of reward or value.
      switching: whether the stored reward model of a known task takes the meta-model's place.
      threshold: ξ for switching; by default suggested by the samples.
    """

    tasks: tuple[str, ...]
    seeds: tuple[int, ...]
    config: Config
    sources: tuple[str, ...] = ()
    source_member: int = 0
    omegas: tuple[float, ...] = ()
    baseline: bool = False
    method: Method = "fractional"
    fractions: tuple[str, ...] = FRACTIONS
    dynamics: Literal["fresh", "copied", "frozen"] = "fresh"
    reward_sources: tuple[str, ...] = ()
    reward_counts: tuple[int, ...] = ()
    meta: tuple[str, ...] = ("reward",)
    meta_layers: int = 1
    switching: bool = False
    threshold: float | None = None

    def __post_init__(self):
        choices = ", ".join([*envs.task_names(), "gymnasium/ID"])
        _require(self.tasks, f"no task given: choose from {choices}")
        envs.specs(self.tasks)
        _require(len(set(self.tasks)) == len(self.tasks), f"a task is named twice: {self.tasks}")
        _require(self.seeds, "no seed given")
        _require(len(set(self.seeds)) == len(self.seeds), f"a seed is named twice: {self.seeds}")
        _require(
            all(0 <= seed < 2**31 for seed in self.seeds),
            f"seeds {self.seeds} must lie in [0, 2^31)",
        )
        _require(
            len(set(self.sources)) == len(self.sources), f"a source is named twice: {self.sources}"
        )
        self._check_method()
        if self.method == "fractional":
            self._check_fractional()
        else:
            self._check_on_autoencoder()

    def _check_method(self) -> None:
        """Settings that belong to other methods than the run's are left alone."""
        owners = {
            "omegas": ("--omega", ("fractional",)),
            "baseline": ("--baseline", ("fractional",)),
            "fractions": ("--fractions", ("fractional",)),
            "dynamics": ("--dynamics", ("uae", "meta")),
            "reward_sources": ("--reward-sources", ("meta",)),
            "reward_counts": ("--reward-counts", ("meta",)),
            "meta": ("--meta", ("meta",)),
            "meta_layers": ("--meta-layers", ("meta",)),
            "switching": ("--switching", ("meta",)),
            "threshold": ("--threshold", ("meta",)),
        }
        defaults = {entry.name: entry.default for entry in dataclasses.fields(self)}
        for name, (option, methods) in owners.items():
            _require(
                self.method in methods or getattr(self, name) == defaults[name],
                f"{option} belongs to --method {' or '.join(methods)}, and the method here is "
                f"{self.method}",
            )

    def _check_fractional(self) -> None:
        if not self.sources:
            _require(not self.omegas, "--omega needs a source agent: add --source DIR")
            return
        _require(self.omegas, "--source needs the fractions to transfer: add --omega 0 0.2")
        _require(
            all(0 <= omega <= 1 for omega in self.omegas),
            f"omega {self.omegas} must lie in [0, 1] (equation 19)",
        )
        fractional_transfer(fractions=self.fractions)

    def _check_on_autoencoder(self) -> None:
        _require(
            len(self.sources) == 1,
            f"--method {self.method} needs the agent whose autoencoder is used: add --source DIR, "
            "one only",
        )
        if self.method == "uae":
            return
        meta_model(self.dynamics, components=self.meta, switching=self.switching)
        count = len(self.reward_sources)
        _require(
            count,
            "--method meta needs the agents whose models are stored: add --reward-sources DIR DIR",
        )
        _require(
            all(1 <= chosen <= count for chosen in self.reward_counts),
            f"--reward-counts {self.reward_counts} must lie in [1, {count}], the number of "
            "--reward-sources",
        )
        _require(
            len(set(self.reward_counts)) == len(self.reward_counts),
            f"a number of reward sources is named twice: {self.reward_counts}",
        )
        _require(self.meta_layers >= 0, f"meta_layers is {self.meta_layers}, must not be negative")
        _require(
            self.threshold is None or self.switching,
            "--threshold is that of --switching: add it, or leave both out",
        )
        if self.switching:
            _require(
                self.dynamics == "frozen",
                "--switching uses stored reward models as they are, and they read the latent "
                "states of the dynamics they were trained with: add --dynamics frozen, here and "
                "in the runs of the reward sources",
            )
            _require(
                not self.reward_counts,
                "--switching uses all reward sources: leave out --reward-counts",
            )

    @property
    def places(self) -> int:
        """N of a meta-model, those without a stored model included."""
        return max(PLACES, len(self.reward_sources))

    @property
    def members(self) -> tuple[Member, ...]:
        """The population: seeds within fractions within sources, or within numbers of stored
        models; then the baseline."""
        if not self.sources:
            return tuple(Member(seed, BASELINE) for seed in self.seeds)
        if self.method == "uae":
            return tuple(Member(seed, "uae", {"dynamics": self.dynamics}) for seed in self.seeds)
        if self.method == "meta":
            return tuple(
                Member(seed, f"sources={count}", {"sources": count})
                for count in self.reward_counts or (len(self.reward_sources),)
                for seed in self.seeds
            )
        targets = tuple(
            Member(seed, f"omega={omega:g}{ending}", {"omega": omega} | tags)
            for ending, tags in self._source_marks()
            for omega in self.omegas
            for seed in self.seeds
        )
        scratch = tuple(Member(seed, BASELINE) for seed in self.seeds)
        return targets + (scratch if self.baseline else ())

    def _source_marks(self) -> list[tuple[str, dict[str, str]]]:
        """What tells the targets of several sources apart: the end of their labels, and a tag."""
        if len(self.sources) == 1:
            return [("", {})]
        names = [Path(source).name for source in self.sources]
        if len(set(names)) < len(names):
            names = list(self.sources)
        return [(f" from {name}", {"source": name}) for name in names]

    def to_dict(self) -> dict[str, Any]:
        """As JSON can hold it."""
        return dataclasses.asdict(self)

    @classmethod
    def from_dict(cls, values: Mapping[str, Any]) -> "RunSpec":
        """From `to_dict`'s result, by way of JSON too."""
        known = {field.name for field in dataclasses.fields(cls)}
        _require(
            set(values) <= known,
            f"unknown settings of a run: {', '.join(sorted(set(values) - known))}. Another version "
            "of this program wrote them: use that one, or train anew in another folder",
        )
        values = {k: tuple(v) if isinstance(v, list) else v for k, v in values.items()}
        return cls(**{**values, "config": configs.from_dict(values["config"])})

    def differences(self, other: "RunSpec") -> list[str]:
        """What differs between two, as "name: this / other"."""
        names = [field.name for field in dataclasses.fields(self) if field.name != "config"]
        pairs = [(name, getattr(self, name), getattr(other, name)) for name in names]
        return [f"{name}: {one} / {two}" for name, one, two in pairs if one != two] + (
            configs.differences(self.config, other.config)
        )


def _require(condition, message: str) -> None:
    if not condition:
        raise ValueError(message)


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
    return RunSpec.from_dict(read_json(path)["spec"])


def action_size(tasks: tuple[str, ...]) -> int:
    """A of an agent for several tasks: the largest of theirs (equation 18)."""
    return max(task.action_size for task in envs.specs(tasks))
