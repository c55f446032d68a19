"""The thesis's transfer methods as plans: pattern -> operation, to be read beside Figure 8.

The paths are those of a Dreamer agent whose parameters are one dictionary:

    encoder/...  decoder/...  dynamics/{stoch_in, action_in, gru, prior, posterior}/...
    reward/{hidden_i, out}  value/{hidden_i, out}  actor/{hidden_i, out}
    termination/{hidden_i, out}                                        (where there is one)
    {reward, value, dynamics}/stored/{params/..., present}             (where it is a meta-model)

This module knows these names and nothing else of the agent. The target of every recipe is a
freshly initialised tree, so that `keep` is random initialisation. Optimiser state is fresh.
"""

from collections.abc import Sequence
from typing import Any, Literal

from transfer.plan import Plan, Rule

Dynamics = Literal["fresh", "copied", "frozen"]

# The last layer of each component that may be fractionally transferred.
_LAST_LAYERS = {
    "reward": "reward/out/*",
    "value": "value/out/*",
    "termination": "termination/out/*",
    "actor": "actor/out/*",
    "dynamics": "dynamics/*/out/*",
}
_OPTIONAL = ("termination",)


def fractional_transfer(
    omega: Any = None, *, fractions: Sequence[str] = ("reward", "value", "termination")
) -> Plan:
    """Fractional transfer learning to Dreamer (thesis §3.2.3, Figure 8).

    Fully transferred: encoder, decoder, dynamics and the hidden layers of all heads. Randomly
    initialised: what handles actions, for its size and meaning change with the task. In between:
    the last layers of the reward and value models, W_T + ω·W_S (equation 19), kernel and bias.
    All stay trainable. Source and target may differ in action size.

    The thesis has no termination head. Its last layer is treated as the reward's: a function of the
    same features that differs between tasks (Hopper falls, HalfCheetah cannot), of one size
    everywhere, so neither must it be drawn anew nor should it be taken over whole.

    Args:
      omega: ω in [0, 1], a scalar; or [P] for a stacked population. `None` leaves it open, to
        be given as `apply(plan, target, source, omega=...)`, where it may be traced.
      fractions: the components whose last layer is fractionally transferred. Beyond the
        thesis: without "reward" or "value" that last layer is drawn anew; "dynamics" adds the
        last layers of prior and posterior; "actor" the actor's, where the action sizes of
        source and target are the same.

    Raises:
      ValueError: an unknown component in `fractions`.
    """
    for component in fractions:
        if component not in _LAST_LAYERS:
            raise ValueError(
                f"There is no fraction for {component!r}; choose from {', '.join(_LAST_LAYERS)}."
            )
    parameters = {} if omega is None else {"omega": omega}

    def last_layer(component: str) -> Rule:
        optional = component in _OPTIONAL
        if component in fractions:
            note = "equation 19" if component in ("reward", "value") else "equation 19, added"
            return Rule(
                _LAST_LAYERS[component], "fraction", parameters, optional=optional, note=note
            )
        note = "random: actions differ" if component == "actor" else "random"
        return Rule(_LAST_LAYERS[component], "keep", optional=optional, note=note)

    def head(component: str) -> tuple[Rule, Rule]:
        hidden = Rule(
            f"{component}/hidden_*/*",
            "copy",
            optional=component in _OPTIONAL,
            note="feature extraction",
        )
        return hidden, last_layer(component)

    dynamics = ["dynamics/**", "!dynamics/action_in/*"]
    if "dynamics" in fractions:
        dynamics.append("!" + _LAST_LAYERS["dynamics"])
    return Plan(
        name="fractional transfer learning",
        rules=(
            Rule("encoder/**", "copy", note="visually similar domains"),
            Rule("decoder/**", "copy", note="visually similar domains"),
            Rule(tuple(dynamics), "copy", note="the same physics"),
            *((last_layer("dynamics"),) if "dynamics" in fractions else ()),
            Rule("dynamics/action_in/*", "keep", note="random: actions differ"),
            *head("reward"),
            *head("value"),
            *head("actor"),
            *head("termination"),
        ),
    )


def universal_autoencoder(dynamics: Dynamics = "fresh") -> Plan:
    """A target on the autoencoder of an agent trained on several tasks (thesis §3.3.1, Figure 9).

    Encoder and decoder are copied; the encoder is frozen (see `transfer.frozen`), so that all
    agents made by this recipe share one feature space; the decoder trains on. Heads are fresh. The
    agents whose models are stored, the target of a meta-model, and those that latent task
    classification samples are all made by it.

    Args:
      dynamics: `"fresh"` as in the author's runs: only the encoder's embedding is universal,
        while the latent state that heads read is each agent's own. `"copied"`: each agent
        starts from the source's dynamics. `"frozen"`: and keeps them, but for the kernel of
        the action, which is always fresh and trains.

    Raises:
      ValueError: another value of `dynamics`.
    """
    heads = (
        Rule("reward/**", "keep", note="random"),
        Rule("value/**", "keep", note="random"),
    )
    return Plan(
        name=f"universal autoencoder, {dynamics} dynamics",
        rules=_on_autoencoder(dynamics, heads),
    )


def meta_model(
    dynamics: Dynamics = "fresh",
    *,
    components: Sequence[str] = ("reward",),
    switching: bool = False,
) -> Plan:
    """A target whose models read what stored models predict (thesis §3.3.2, equation 20, Figure 9).

    As `universal_autoencoder`, and each of the components is a meta-model: it has the frozen
    models of N source tasks among its own parameters, under `stored`, and all others fresh. Two
    sources are given by name: `apply(plan, target, {"autoencoder": ..., "stored": ...})`, the
    second with the leaves `reward/stored/params/...` [N, ...] and `reward/stored/present` [N]
    (see `transfer.meta_model.store`).

    Args:
      dynamics: as for `universal_autoencoder`.
      components: which models are meta-models: `"reward"`, and beyond the thesis `"value"`
        and `"dynamics"`, whose kernel on the predictions is `dynamics/stored_in`.
      switching: whether the reward model also holds a classifier of tasks, under
        `reward/classifier`, by which it leaves known tasks to their stored models.

    Raises:
      ValueError: another value of `dynamics`, an unknown component, or switching without a
        meta-model of the reward.
    """
    if unknown := sorted(set(components) - {"reward", "value", "dynamics"}):
        raise ValueError(f"There is no meta-model for {unknown}; choose reward, value, dynamics.")
    if not components:
        raise ValueError("A meta-model needs a component: choose from reward, value, dynamics.")
    if switching and "reward" not in components:
        raise ValueError("Switching is between reward models: add 'reward' to the components.")

    def stored(component: str) -> Rule:
        return Rule(
            f"{component}/stored/**", "copy", source="stored", frozen=True, note="equation 20"
        )

    def head(component: str) -> tuple[Rule, ...]:
        if component not in components:
            return (Rule(f"{component}/**", "keep", note="random"),)
        held = [f"{component}/stored/**"]
        rules = [stored(component)]
        if switching and component == "reward":
            held.append("reward/classifier/*")
            rules.append(Rule(held[-1], "copy", source="stored", frozen=True, note="equation 22"))
        others = (f"{component}/**", *(f"!{pattern}" for pattern in held))
        return (*rules, Rule(others, "keep", note="random: the meta-model"))

    rules = (*head("reward"), *head("value"))
    if "dynamics" in components:
        rules = (stored("dynamics"), *rules)
    return Plan(
        name=f"meta-model of {', '.join(components)}, {dynamics} dynamics",
        rules=_on_autoencoder(
            dynamics, rules, source="autoencoder", meta_dynamics="dynamics" in components
        ),
    )


def _on_autoencoder(
    dynamics: str,
    heads: Sequence[Rule],
    *,
    source: str | None = None,
    meta_dynamics: bool = False,
) -> tuple[Rule, ...]:
    """The rules of an agent on a universal autoencoder, with those given for reward and value."""
    if dynamics not in ("fresh", "copied", "frozen"):
        raise ValueError(f"dynamics is 'fresh', 'copied' or 'frozen'; got {dynamics!r}.")
    others = ("!dynamics/stored/**",) if meta_dynamics else ()
    if dynamics == "fresh":
        rules = [Rule(("dynamics/**", *others), "keep", note="random")]
    else:
        inputs = ("dynamics/action_in/*", *(("dynamics/stored_in/*",) if meta_dynamics else ()))
        rules = [
            Rule(
                ("dynamics/**", *others, *(f"!{pattern}" for pattern in inputs)),
                "copy",
                source=source,
                frozen=dynamics == "frozen",
                note="the same physics",
            ),
            Rule(inputs, "keep", note="random: actions differ"),
        ]
    return (
        Rule("encoder/**", "copy", source=source, frozen=True, note="the universal features"),
        Rule("decoder/**", "copy", source=source, note="trains on"),
        *rules,
        *heads,
        Rule("actor/**", "keep", note="random"),
        Rule("termination/**", "keep", optional=True, note="random"),
    )


LATENT_TASK_THRESHOLDS = (50.0, 70.0, 90.0)
"""ξ of the thesis's tables for M = 230 features (§4.3.2 prints 0.5, 0.7 and 0.9)."""


def latent_task_thresholds(features: int) -> tuple[float, ...]:
    """The thesis's ξ for M = `features`: a Manhattan distance grows with the size, ξ·M/230.

    >>> latent_task_thresholds(115)
    (25.0, 35.0, 45.0)
    """
    return tuple(threshold * features / 230 for threshold in LATENT_TASK_THRESHOLDS)
