"""The thesis's transfer methods as plans: pattern -> operation, to be read beside Figure 8.

The paths are those of a Dreamer agent whose parameters are one dictionary:

    encoder/...  decoder/...  dynamics/{stoch_in, action_in, gru, prior, posterior}/...
    reward/{hidden_i, out}  value/{hidden_i, out}  actor/{hidden_i, out}
    termination/{hidden_i, out}                                            (where there is one)

This module knows these names and nothing else of the agent. The target of every recipe is a
freshly initialised tree, so that ``keep`` is random initialisation. Optimiser state is fresh.
"""

from transfer.plan import Plan, Rule


def fractional_transfer(omega: float | None = None) -> Plan:
    """Fractional transfer learning to Dreamer (thesis §3.2.3, Figure 8).

    Fully transferred: encoder, decoder, dynamics and the hidden layers of all heads. Randomly
    initialised: what handles actions, for its size and meaning change with the task. In between:
    the last layers of the reward and value models, W_T + ω·W_S (equation 19), kernel and bias.
    All stay trainable. Source and target may differ in action size.

    The thesis has no termination head. Its last layer is treated as the reward's: a function of the
    same features that differs between tasks (Hopper falls, HalfCheetah cannot), of one size
    everywhere, so neither must it be drawn anew nor should it be taken over whole.

    Args:
        omega: ω in [0, 1], a scalar; or [P] for a stacked population. ``None`` leaves it open, to
            be given as ``apply(plan, target, source, omega=...)``, where it may be traced.
    """
    parameters = {} if omega is None else {"omega": omega}
    return Plan(
        name="fractional transfer learning",
        rules=(
            Rule("encoder/**", "copy", note="representation: visually alike domains"),
            Rule("decoder/**", "copy", note="representation: visually alike domains"),
            Rule(("dynamics/**", "!dynamics/action_in/**"), "copy", note="the same physics"),
            Rule("dynamics/action_in/**", "keep", note="random: actions differ"),
            Rule("reward/hidden_*/**", "copy", note="feature extraction"),
            Rule("reward/out/*", "fraction", parameters, note="equation 19"),
            Rule("value/hidden_*/**", "copy", note="feature extraction"),
            Rule("value/out/*", "fraction", parameters, note="equation 19"),
            Rule("actor/hidden_*/**", "copy", note="feature extraction"),
            Rule("actor/out/*", "keep", note="random: actions differ"),
            Rule("termination/hidden_*/**", "copy", optional=True, note="feature extraction"),
            Rule("termination/out/*", "fraction", parameters, optional=True, note="as the reward"),
        ),
    )
