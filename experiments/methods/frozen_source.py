"""A frozen source: its encoder, decoder and dynamics stay as they are, and heads are trained."""

from collections.abc import Collection
from dataclasses import dataclass
from typing import ClassVar

from experiments.methods.base import require
from experiments.methods.targets import OF_ACTIONS, CopiedTargets

_FROZEN = ("encoder/**", "decoder/**", "dynamics/**", "!dynamics/action_in/*")
_TRAINED = ("dynamics/action_in/*", "reward/**", "value/**", "actor/**")
_OPTIONAL = ("termination/**",)


@dataclass(frozen=True)
class FrozenSource(CopiedTargets):
    """One target per source and seed, of whose world model only the heads are trained.

    The kernel of the action trains, too: its size and meaning change with the task.
    """

    NAME: ClassVar[str] = "frozen-source"
    SUMMARY: ClassVar[str] = "everything copied where shapes fit, all but the heads frozen"
    COMPARED: ClassVar[bool] = True

    def check_settings(self) -> None:
        """Checks the sources; what is frozen is frozen in all agents of a run.

        Raises:
          ValueError: with the way out.
        """
        super().check_settings()
        require(
            not self.baseline,
            f"--method {self.NAME} freezes parts of all agents of its run, those from scratch too: "
            "leave out --baseline, and train them in a run of their own",
        )

    def plan(self, unfit: Collection[str] = OF_ACTIONS):
        """Copies all but what does not fit, and freezes what is no head.

        Args:
          unfit: patterns of the leaves that the sources have in another shape, or not at all.
        """
        from transfer import Plan, Rule

        others = tuple(f"!{path}" for path in unfit)
        rules = [
            Rule(_FROZEN, "copy", frozen=True, note="as in the source"),
            Rule((*_TRAINED, *others), "copy", note="trains on"),
        ]
        rules += [
            Rule((pattern, *others), "copy", optional=True, note="trains on")
            for pattern in _OPTIONAL
        ]
        if unfit:
            rules.append(Rule(tuple(unfit), "keep", note="random: another shape in the source"))
        return Plan(name=self.NAME, rules=tuple(rules))


METHOD = FrozenSource
