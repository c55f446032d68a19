"""Fine-tuning: everything copied where shapes fit, and trained on. The plainest transfer."""

from collections.abc import Collection
from dataclasses import dataclass
from typing import ClassVar

from experiments.methods.targets import OF_ACTIONS, CopiedTargets


@dataclass(frozen=True)
class FineTuning(CopiedTargets):
    """One target per source and seed, which begins as its source."""

    NAME: ClassVar[str] = "fine-tuning"
    SUMMARY: ClassVar[str] = "everything copied where shapes fit, and trained on"
    COMPARED: ClassVar[bool] = True

    def plan(self, unfit: Collection[str] = OF_ACTIONS):
        """Copies all but what does not fit.

        Args:
          unfit: patterns of the leaves that the sources have in another shape, or not at all.
        """
        from transfer import Plan, Rule

        others = tuple(f"!{path}" for path in unfit)
        rules = [Rule(("**", *others), "copy", note="as in the source")]
        if unfit:
            rules.append(Rule(tuple(unfit), "keep", note="random: another shape in the source"))
        return Plan(name=self.NAME, rules=tuple(rules))


METHOD = FineTuning
