"""Meta-models over stored models, on a universal autoencoder (section 3.3.2).

Axis letters: P population member, N stored model, M latent feature size, S samples.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

from dreamer_jax.ranges import Range
from experiments.methods.autoencoder import UniversalAutoencoder
from experiments.methods.base import Cell, Held, Knowledge, Sources, require, setting

PLACES = 4
"""Places for stored models in a meta-model; targets with fewer share one shape (section 4.4)."""
KNOWN_SAMPLES = 100
"""Latent states of each task that a switching agent recognises it by (section 4.3.2)."""


@dataclass(frozen=True)
class MetaModel(UniversalAutoencoder):
    """Targets whose models read what stored models predict, one per number of these and seed."""

    NAME: ClassVar[str] = "meta"
    SUMMARY: ClassVar[str] = (
        "on a source's frozen encoder, with meta-models over further agents' models"
    )

    reward_sources: tuple[str, ...] = setting(
        (),
        "reward-sources",
        "Results folders of agents made by --method uae from the same source, whose models the "
        "meta-model reads.",
        folder=True,
    )
    reward_counts: tuple[int, ...] = setting(
        (),
        "reward-counts",
        "How many of these a target reads, the first ones; one target per number and seed.",
        allowed=Range(1, 1000),
    )
    meta: tuple[str, ...] = setting(
        ("reward",),
        "meta",
        "The components that are meta-models (any of reward, value, dynamics).",
    )
    meta_layers: int = setting(
        1,
        "meta-layers",
        "Hidden layers of a meta-model of reward or value.",
        allowed=Range(0, 100),
    )
    switching: bool = setting(
        False,
        "switching",
        "Recognise the task of each latent state, and use the stored reward model of a task that "
        "is known and the meta-model for a novel one (needs --dynamics frozen).",
    )
    threshold: float | None = setting(
        None,
        "threshold",
        "With --switching, the distance beyond which a task is novel; by default suggested by the "
        "samples of the known tasks.",
        allowed=Range(0, 1e9, above=True),
    )

    def check_settings(self) -> None:
        """Checks the source, and what goes together.

        Raises:
          ValueError: with the way out.
        """
        super().check_settings()
        self.plan()
        count = len(self.reward_sources)
        require(
            count,
            "--method meta needs the agents whose models are stored: add --reward-sources DIR DIR",
        )
        require(
            all(1 <= chosen <= count for chosen in self.reward_counts),
            f"--reward-counts {self.reward_counts} must lie in [1, {count}], the number of "
            "--reward-sources",
        )
        require(
            len(set(self.reward_counts)) == len(self.reward_counts),
            f"a number of reward sources is named twice: {self.reward_counts}",
        )
        require(self.meta_layers >= 0, f"meta_layers is {self.meta_layers}, must not be negative")
        require(
            self.threshold is None or self.switching,
            "--threshold is that of --switching: add it, or leave both out",
        )
        if self.switching:
            require(
                self.dynamics == "frozen",
                "--switching uses stored reward models as they are, and they read the latent "
                "states of the dynamics they were trained with: add --dynamics frozen, here and "
                "in the runs of the reward sources",
            )
            require(
                not self.reward_counts,
                "--switching uses all reward sources: leave out --reward-counts",
            )

    @property
    def stored(self) -> tuple[str, ...]:
        """The reward sources."""
        return self.reward_sources

    @property
    def places(self) -> int:
        """N of a meta-model, those without a stored model included."""
        return max(PLACES, len(self.reward_sources))

    @property
    def axes(self) -> dict[str, tuple[Any, ...]]:
        """Numbers of stored models."""
        return {"count": self.reward_counts or (len(self.reward_sources),)}

    def mark(self, values: Mapping[str, Any]) -> tuple[str, dict[str, Any]]:
        """The number of stored models."""
        return f"sources={values['count']}", {"sources": values["count"]}

    def plan(self):
        """Figure 9."""
        from transfer.recipes import meta_model

        return meta_model(self.dynamics, components=self.meta, switching=self.switching)

    def modules(self, agent) -> tuple[tuple[str, Any], ...]:
        """The components that are meta-models."""
        from experiments.methods.modules.meta import meta_dynamics, meta_head

        found: list[tuple[str, Any]] = []
        for name in self.meta:
            if name == "dynamics":
                found.append((name, meta_dynamics(agent.dynamics, places=self.places)))
                continue
            switching = self.switching and name == "reward"
            samples = KNOWN_SAMPLES * len(self.reward_sources) if switching else 0
            head = meta_head(
                agent.heads[name], layers=self.meta_layers, places=self.places, samples=samples
            )
            found.append((name, head))
        return tuple(found)

    def check_sources(self, sources: Sources, fresh: Any) -> None:
        """A stored model must read the features that the target's frozen parts give.

        Raises:
          ValueError: one was not trained on what the target keeps frozen, or is no plain model.
        """
        import numpy as np

        import transfer

        (agent,) = sources.agents
        wanted = transfer.flatten(agent.params)
        frozen = [
            path
            for path, rule in transfer.claims(self.plan(), fresh).items()
            if rule.frozen and rule.source == "autoencoder"
        ]
        for stored in sources.stored:
            method = stored.spec.method
            both = set(method.meta) & set(self.meta) if isinstance(method, MetaModel) else set()
            require(
                not both,
                f"the {' and '.join(sorted(both))} of {stored.directory} is a meta-model itself, "
                "which cannot be stored: name the runs of its own reward sources",
            )
            flat = transfer.flatten(stored.params)
            for path in frozen:
                component = path.partition("/")[0]
                option = " --dynamics frozen" if component == "dynamics" else ""
                require(
                    path in flat and np.array_equal(flat[path], wanted[path]),
                    f"the agent of {stored.directory} was not trained on the frozen {component} of "
                    f"{agent.directory} ({path} differs), so its models read other features: train "
                    f"it with --method uae --source {agent.directory}{option}",
                )

    def knowledge(self, agent, seeds, sources, sample) -> Knowledge:
        """The autoencoder, and the stored models of each target."""
        import transfer

        targets = self.targets(seeds)
        counts = [values["count"] for values in targets]
        stored = self.stored_models(sources.stored, counts, action_size=agent.action_size)
        if self.switching:
            classifier = self.known_tasks(sources.stored, sample)
            stored["reward"]["classifier"] = transfer.replicate(classifier, size=len(targets))
        trees = {"autoencoder": sources.agents[0].params, "stored": stored}
        return Knowledge(self.plan(), trees, stacked=("stored",))

    def stored_models(
        self, sources: Sequence[Any], counts: Sequence[int], *, action_size: int
    ) -> dict[str, dict[str, Any]]:
        """The models that each target's meta-models read, as the leaves of its parameters.

        Args:
          sources: N agents.
          counts: of each target, how many of them it reads, the first ones.
          action_size: A of the target. A stored dynamics model reads as many actions: those that
            it has not learned have no effect on it, and those that the target has not are zero.

        Returns:
          {component: {"stored": {"params": leaves [P, N, ...], "present": [P, N]}}}.
        """
        import transfer
        from transfer.meta_model import store

        found: dict[str, dict[str, Any]] = {}
        for component in self.meta:
            models = [source.params[component] for source in sources]
            if component == "dynamics":
                models = [_of_action_size(model, action_size) for model in models]
            stored = transfer.stack([store(models[:count], size=self.places) for count in counts])
            found[component] = {"stored": {"params": stored.params, "present": stored.present}}
        return found

    def known_tasks(self, sources: Sequence[Any], sample) -> dict[str, Any]:
        """The classifier of a switching agent: samples of the tasks that stored models know.

        Each source's own latent states of its tasks, by a random policy, labelled with its place.

        Args:
          sources: N agents.
          sample: see `knowledge`.

        Returns:
          latents [S, M], labels [S] and the threshold [].
        """
        import jax.numpy as jnp
        import numpy as np

        from transfer import ltc

        latents: list[Any] = []
        labels: list[int] = []
        episodes: list[Any] = []
        for place, source in enumerate(sources):
            parts = sample(source, KNOWN_SAMPLES)
            shares = np.array_split(np.arange(KNOWN_SAMPLES), len(parts))
            for part, share in zip(parts, shares, strict=True):
                drawn = part.draw(len(share), seed=place)
                latents.append(drawn.features)
                labels += [place] * len(share)
                # Distinct numbers for the episodes of all tasks of all sources.
                episodes.append(drawn.episodes + (max(map(np.max, episodes)) if episodes else 0))
        model = ltc.fit(np.concatenate(latents), np.array(labels))
        threshold: Any = self.threshold
        if threshold is None:
            threshold = ltc.suggest_threshold(model, groups=np.concatenate(episodes))
        return {
            "latents": model.latents,
            "labels": model.labels,
            "threshold": jnp.asarray(threshold, jnp.float32),
        }

    @classmethod
    def cell_words(cls, cell: Cell) -> list[str]:
        """The tasks of the stored models."""
        return ["from", "+".join(source.tasks[0] for source in cell.reward_sources)]

    @classmethod
    def run_words(cls, cell: Cell) -> list[str]:
        """The method."""
        return [cls.NAME]

    @classmethod
    def group(cls, cell: Cell) -> tuple[Any, ...]:
        """All numbers of stored models, on one autoencoder."""
        return (cls.NAME, cell.backend, cell.tasks, cell.source)

    @classmethod
    def coordinates(cls, cell: Cell) -> dict[str, Any]:
        """Its number of stored models."""
        return {"count": len(cell.reward_sources)}

    @classmethod
    def from_cells(cls, cells: Sequence[Cell], axes: Mapping[str, Sequence[Any]], held: Held):
        """Targets of several numbers of stored models, the first of one list."""
        name, member = held[cells[0].source.name]
        stored = max((cell.reward_sources for cell in cells), key=len)
        return cls(
            sources=(name,),
            source_member=member,
            reward_sources=tuple(held[cell.name][0] for cell in stored),
            reward_counts=tuple(axes["count"]),
        )


def _of_action_size(dynamics: dict[str, Any], size: int) -> dict[str, Any]:
    """A dynamics model that reads actions of another size, padded or cut with zeros."""
    import jax.numpy as jnp

    import transfer

    kernel = dynamics["action_in"]["kernel"]
    target = {"kernel": jnp.zeros((size, kernel.shape[1]), kernel.dtype)}
    fit = transfer.pad if size >= len(kernel) else transfer.crop
    return dynamics | {"action_in": fit(target, {"kernel": kernel}, axis="input")}


METHOD = MetaModel
