"""Every setting of an agent and of its training, as frozen dataclasses, and four presets.

The defaults are those of the thesis (sections 3.1 and 4.2.2) and of Dreamer version 1.
"""

import dataclasses
import difflib
from dataclasses import dataclass, field
from typing import Any, Literal, NamedTuple

from dreamer_jax.ranges import check_ranges, setting

COMPONENTS = ("encoder", "decoder", "dynamics", "reward", "termination", "value", "actor")


_DEVIATION = "a standard deviation must be positive"


def _require(condition: bool, message: str) -> None:
    if not condition:
        raise ValueError(message)


@dataclass(frozen=True)
class NetworkConfig:
    """Sizes of the networks."""

    image_size: Literal[32, 64] = 64
    """Height and width of the images, in pixels."""
    encoder_depth: int = setting(32, 1, 1024)
    """Channels of the first convolution; every further one doubles them."""
    stochastic_size: int = setting(30, 1, 4096)
    """Size of the stochastic part of the latent state."""
    deterministic_size: int = setting(200, 1, 16_384)
    """Size of the deterministic part of the latent state (the units of the GRU)."""
    hidden_size: int = setting(200, 1, 16_384)
    """Units of the hidden layers inside the dynamics."""
    head_units: int = setting(400, 1, 16_384)
    """Units of the hidden layers of the reward, value, actor and termination heads."""
    reward_layers: int = setting(2, 0, 100)
    """Hidden layers of the reward head."""
    value_layers: int = setting(3, 0, 100)
    """Hidden layers of the value head."""
    actor_layers: int = setting(4, 0, 100)
    """Hidden layers of the actor."""
    termination: bool = False
    """Whether to learn a termination head that predicts where episodes end."""
    termination_layers: int = setting(3, 0, 100)
    """Hidden layers of the termination head."""
    minimum_std: float = setting(0.1, 0, 10, above=True)
    """Smallest standard deviation of the latent Gaussians."""
    precision: Literal["float32", "bfloat16"] = "float32"
    """Precision of activations; parameters, sums, what heads give and distributions are always
    float32 (but for images, whose mean is rounded)."""
    matmul_precision: Literal["default", "float32"] = "default"
    """Precision in which float32 matrices are multiplied. default: JAX's for the device (on NVIDIA
    cards TensorFloat-32, with 10 bits after the point, on TPUs bfloat16; on CPUs float32)."""
    convolutions: Literal["auto", "matmul", "library"] = "auto"
    """How convolutions are computed: as matrix products, or by the library's layers, which are
    compiled in a third less time and slower at most sizes. auto: as products on CPUs and NVIDIA
    cards."""

    def __post_init__(self):
        _require(
            self.image_size in (32, 64),
            f"image_size is {self.image_size}, but the encoder takes images of 32 or 64 pixels",
        )
        check_ranges(self)

    @property
    def feature_size(self) -> int:
        """M, the size of the latent features: stochastic and deterministic parts joined."""
        return self.stochastic_size + self.deterministic_size


HOW_COMPUTED = ("precision", "matmul_precision", "convolutions")
"""Settings of networks that say nothing of their parameters."""


@dataclass(frozen=True)
class LearningConfig:
    """Losses, imagination and optimisers of one update."""

    batch_size: int = setting(50, 1, 100_000)
    """B, sequences in a batch."""
    sequence_length: int = setting(50, 1, 100_000)
    """L, records in a sequence."""
    horizon: int = setting(15, 2, 1000, why="but a return needs at least 2")
    """H, imagined steps."""
    imagination_starts: int | None = setting(None, 0, 10**9)
    """Posterior states of a batch from which to imagine; none given: all B * L of them."""
    discount: float = setting(0.99, 0, 1)
    """Discount factor of a reward one agent step later (gamma)."""
    return_lambda: float = setting(0.95, 0, 1)
    """Weight of longer returns in the lambda-return (lambda of equation 16)."""
    free_nats: float = setting(3.0, 0, 1e6)
    """Floor of the mean KL divergence between posterior and prior, in nats."""
    kl_scale: float = setting(1.0, 0, 1e6)
    """Weight of the KL divergence in the model's loss."""
    image_std: float = setting(1.0, 0, 1e6, above=True, why=_DEVIATION)
    """Standard deviation of the image's Gaussian likelihood, in units of the pixel range. The
    image loss is divided by its square: 0.5 at 32 x 32 pixels weighs a picture as 64 x 64 does."""
    reward_std: float = setting(
        1.0, 0, 1e6, above=True, why="a standard deviation must be positive"
    )
    """Standard deviation of the reward's Gaussian likelihood, in rewards."""
    termination_scale: float = setting(10.0, 0, 1e6)
    """Weight of the termination head in the model's loss."""
    model_learning_rate: float = setting(6e-4, 0, 1, above=True)
    """Adam's step size for encoder, decoder, dynamics, reward and termination."""
    value_learning_rate: float = setting(8e-5, 0, 1, above=True)
    """Adam's step size for the value head."""
    actor_learning_rate: float = setting(8e-5, 0, 1, above=True)
    """Adam's step size for the actor."""
    entropy_scale: float = setting(0.0, 0, 1000)
    """Weight of the policy's entropy in the actor's loss, in rewards per nat (the thesis has
    none). It keeps an actor from settling on one action early."""
    entropy_scale_end: float | None = setting(None, 0, 1000)
    """What entropy_scale has fallen to after entropy_decay updates; none given: it stays."""
    entropy_decay: int = setting(10_000, 1, 10**9)
    """Updates over which entropy_scale falls linearly to entropy_scale_end."""
    gradient_norm: float = setting(100.0, 0, 1e9, above=True)
    """Largest norm of the gradient of each of the three groups; larger ones are scaled down."""
    adam_epsilon: float = setting(1e-7, 0, 1, above=True)
    """Adam's epsilon."""
    frozen: tuple[str, ...] = ()
    """What takes no update: components, parts of them, or single leaves, by their paths (such as
    encoder, dynamics/gru, or dynamics/prior/out/kernel)."""

    def __post_init__(self):
        unknown = {name for name in self.frozen if name.partition("/")[0] not in COMPONENTS}
        _require(
            not unknown,
            f"cannot freeze {sorted(unknown)}: the components are {', '.join(COMPONENTS)}",
        )
        check_ranges(self)
        _require(
            self.entropy_scale > 0 or not self.entropy_scale_end,
            f"entropy_scale is 0 and would rise to {self.entropy_scale_end}: give both, or neither",
        )
        starts, states = self.imagination_starts, self.batch_size * self.sequence_length
        _require(
            starts is None or 0 < starts <= states,
            f"imagination_starts is {starts}, but a batch has {states} posterior states",
        )


@dataclass(frozen=True)
class ExplorationConfig:
    """What is added to the actor's samples while collecting."""

    exploration_kind: Literal["gaussian", "epsilon_greedy"] = "gaussian"
    """Gaussian noise (continuous actions) or epsilon-greedy (always used if discrete)."""
    exploration_noise: float = setting(0.3, 0, 10)
    """Standard deviation of the Gaussian noise, in units of the action range [-1, 1]."""
    exploration_hold: float = setting(1.0, 1, 1e6, why="but an action lasts at least 1 step")
    """Agent steps for which random actions and Gaussian noise are held, on average: how long is
    geometrically distributed. 1 draws them anew at every step, as the thesis does."""
    evaluation_action: Literal["mode", "mean"] = "mode"
    """What is played in evaluation, of continuous actions: the most likely of 100 samples, or the
    tanh of the Gaussian's mean."""
    epsilon_start: float = setting(0.4, 0, 1)
    """Probability of a random action before the first update."""
    epsilon_end: float = setting(0.1, 0, 1)
    """Probability of a random action after epsilon_decay updates."""
    epsilon_decay: int = setting(200_000, 1, 10**9)
    """Updates over which epsilon falls linearly."""

    def __post_init__(self):
        check_ranges(self)


@dataclass(frozen=True)
class ScheduleConfig:
    """When to collect, update, evaluate and save. Environment steps count the action repeat."""

    environment_steps: int = setting(1_000_000, 1, 10**12)
    """Length of the run in environment steps, summed over tasks, prefill included."""
    phase_environment_steps: int = setting(1000, 1, 10**6)
    """Environment steps of one task in a phase."""
    action_repeat: int = setting(2, 1, 1000)
    """Environment steps for which an action is repeated."""
    supersample: int = setting(1, 1, 16)
    """Pictures are drawn this many times as large, and averaged down to the agent's size."""
    prefill_phases: int = setting(5, 1, 10**6)
    """Phases of random actions before the first update (several tasks: 1 phase of each)."""
    updates_per_phase: int = setting(100, 0, 10**6)
    """Updates for each phase collected."""
    collect: Literal["before", "beside"] = "before"
    """When a phase is collected. before: between updates, with the newest policy, as the thesis
    does. beside: on a thread, beside the updates of the round before it and with the policy from
    before them, so that simulators on the host and the device do not wait for one another; a round
    is then the least that can be stopped."""
    evaluate_every: int = setting(10_000, 1, 10**12)
    """Environment steps between evaluations."""
    checkpoint_every: int = setting(10_000, 1, 10**12)
    """Environment steps between checkpoints."""
    replay_keep: int | None = setting(None, 1, 10**12)
    """Newest records of each task that are sampled, older ones being deleted from the disk; none
    given: all of them."""
    replay: Literal["auto", "files", "device"] = "auto"
    """Where updates take records from. Files; or a copy of them in the device's memory, with which
    the updates of a round are one program (without simulators on the host, its phase is a part of
    it). auto: the device on an accelerator, where that takes at most half of its memory; else
    files."""
    replay_threads: int | None = setting(None, 1, 256)
    """Threads that put a batch together from files; none given: 4, or as many as there are cores if
    these are fewer."""
    mapping: Literal["auto", "vmap", "chunks"] = "auto"
    """How members of a population are mapped in an update; auto: chunks on CPU, vmap elsewhere."""
    mapping_chunk: int = setting(1, 1, 10**6)
    """Members in a chunk."""

    def __post_init__(self):
        check_ranges(self)
        _require(
            self.phase_environment_steps % self.action_repeat == 0,
            f"phase_environment_steps is {self.phase_environment_steps}, which is no multiple of "
            f"the action repeat {self.action_repeat}",
        )

    @property
    def phase_ticks(self) -> int:
        """Agent steps of one task in a phase; a phase has one record more (the reset)."""
        return self.phase_environment_steps // self.action_repeat


@dataclass(frozen=True)
class Config:
    """All settings of a run but its tasks, seeds and sources."""

    network: NetworkConfig = field(default_factory=NetworkConfig)
    learning: LearningConfig = field(default_factory=LearningConfig)
    exploration: ExplorationConfig = field(default_factory=ExplorationConfig)
    schedule: ScheduleConfig = field(default_factory=ScheduleConfig)

    def __post_init__(self):
        keep, length = self.schedule.replay_keep, self.learning.sequence_length
        _require(
            keep is None or keep >= length,
            f"replay_keep is {keep}, but a sequence has {length} records",
        )
        check_prefill(self, 1)


def check_prefill(config: Config, tasks: int) -> None:
    """Whether what is collected before the first update holds one sequence.

    Args:
      config: all settings.
      tasks: K; several are played for one phase each.

    Raises:
      ValueError: it does not.
    """
    phases = config.schedule.prefill_phases if tasks == 1 else 1
    records, length = phases * (config.schedule.phase_ticks + 1), config.learning.sequence_length
    _require(
        length <= records,
        f"sequence_length is {length}, but before the first update each task has {records} records "
        f"({phases} {'phases' if phases > 1 else 'phase'} of {config.schedule.phase_ticks + 1}): "
        f"expected a whole number in [1, {records}], or longer phases",
    )


def _presets() -> dict[str, Config]:
    small = NetworkConfig(
        image_size=32,
        encoder_depth=8,
        stochastic_size=20,
        deterministic_size=100,
        hidden_size=100,
        head_units=128,
    )
    # What 32 x 32 pixels need to be learned from on two cores, by measurement (docs/learning.md):
    # pictures that outweigh the divergence, a faster model, an actor that is kept from settling
    # before there is one, and exploration that shows the model something.
    learns: dict[str, Any] = {
        "free_nats": 0.0,
        "kl_scale": 0.03,
        "model_learning_rate": 3e-3,
        "value_learning_rate": 3e-4,
        "actor_learning_rate": 2e-4,
        "entropy_scale": 0.1,
        "entropy_scale_end": 0.01,
        "entropy_decay": 6000,
    }
    explores = ExplorationConfig(exploration_hold=8.0, evaluation_action="mean")
    tiny = NetworkConfig(
        image_size=32,
        encoder_depth=2,
        stochastic_size=4,
        deterministic_size=8,
        hidden_size=8,
        head_units=8,
        # Layers that are alike add nothing but time to compile them.
        reward_layers=1,
        value_layers=1,
        actor_layers=1,
        termination_layers=1,
        # Nothing this small runs for longer than it is compiled.
        convolutions="library",
    )
    return {
        "thesis": Config(),
        "cpu": Config(
            network=small,
            learning=LearningConfig(
                batch_size=8, sequence_length=40, imagination_starts=128, **learns
            ),
            exploration=explores,
            schedule=ScheduleConfig(environment_steps=300_000, supersample=4),
        ),
        "demo": Config(
            network=small,
            learning=LearningConfig(
                batch_size=8, sequence_length=20, imagination_starts=64, **learns
            ),
            exploration=explores,
            schedule=ScheduleConfig(
                supersample=4,
                environment_steps=6000,
                prefill_phases=3,
                updates_per_phase=100,
                evaluate_every=1000,
                checkpoint_every=3000,
            ),
        ),
        "debug": Config(
            network=tiny,
            learning=LearningConfig(batch_size=2, sequence_length=5, horizon=3),
            schedule=ScheduleConfig(
                environment_steps=160,
                phase_environment_steps=40,
                prefill_phases=1,
                updates_per_phase=2,
                evaluate_every=40,
                checkpoint_every=40,
            ),
        ),
    }


PRESETS = _presets()


def to_dict(config: Config) -> dict:
    """A configuration as nested dicts that JSON can hold."""
    return dataclasses.asdict(config)


def from_dict(values: dict) -> Config:
    """A configuration from `to_dict`'s result, by way of JSON too.

    Raises:
      ValueError: a group or setting is unknown; one that is missing takes its default.
    """
    groups: dict[str, Any] = {
        entry.name: entry.default_factory for entry in dataclasses.fields(Config)
    }
    unknown = set(values) - set(groups)
    _require(not unknown, f"unknown settings {sorted(unknown)}: the groups are {list(groups)}")
    built = {}
    for name, settings in values.items():
        known = {entry.name for entry in dataclasses.fields(groups[name])}
        unknown = set(settings) - known
        _require(not unknown, f"unknown settings {sorted(unknown)} in the group {name}")
        # JSON turns tuples into lists.
        settings = {k: tuple(v) if isinstance(v, list) else v for k, v in settings.items()}
        built[name] = groups[name](**settings)
    return Config(**built)


class Difference(NamedTuple):
    """A setting in which two things differ.

    Attributes:
      path: its name, such as "learning.batch_size".
      one, other: its value in the first and in the second; None where one has no such setting.
    """

    path: str
    one: Any
    other: Any

    def __str__(self) -> str:
        return f"{self.path}: {self.one} / {self.other}"


def differences(one: Config, other: Config) -> tuple[Difference, ...]:
    """Settings in which two configurations differ."""
    first, second = to_dict(one), to_dict(other)
    return tuple(
        Difference(f"{group}.{name}", first[group][name], second[group][name])
        for group in first
        for name in first[group]
        if first[group][name] != second[group][name]
    )


def preset(name: str) -> Config:
    """Returns the preset of that name: thesis, cpu (two cores), demo (minutes), debug (seconds).

    Raises:
      ValueError: there is no such preset.
    """
    if name not in PRESETS:
        near = difflib.get_close_matches(name, PRESETS, n=1)
        hint = f" (did you mean {near[0]!r}?)" if near else ""
        raise ValueError(f"unknown preset {name!r}{hint}; the presets are {', '.join(PRESETS)}")
    return PRESETS[name]
