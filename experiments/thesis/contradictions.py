"""Where the thesis contradicts itself, or leaves something open, and what is done here."""

from dataclasses import dataclass


@dataclass(frozen=True)
class Contradiction:
    """One of them.

    Attributes:
      what: the statements that do not agree.
      where: the places that they stand in.
      choice: what is done here.
    """

    what: str
    where: str
    choice: str


CONTRADICTIONS = (
    Contradiction(
        "The fourth source task of Ant is InvertedDoublePendulum in the caption of the figure, and "
        "InvertedPendulum in the list of agents.",
        "Figure 29; section 4.2.1",
        "InvertedPendulum, as in section 4.2.1.",
    ),
    Contradiction(
        "The third source of InvertedPendulum's meta-model is Walker2D in the caption of the "
        "figure, and Hopper in the list of agents, which section 4.4.1 says is used.",
        "Figure 33; sections 4.2.1 and 4.4.1",
        "Hopper, as in section 4.2.1.",
    ),
    Contradiction(
        "The baseline of Ant is 1636 ± 895 overall and 2619 ± 261 final in the tables of "
        "fractional transfer, 1589 ± 771 and 2463 ± 208 in those of meta-models. The baselines of "
        "the five other tasks are the same in both.",
        "Tables 11 and 12; tables 16 and 17",
        "One baseline is trained for each task; beside it stands the number of the table shown.",
    ),
    Contradiction(
        "The caption names the novel tasks Hopper and Walker2D, which are those of Table 14; the "
        "columns and the text name Ant and InvertedPendulum.",
        "Caption of Table 15; sections 4.3.1 and 5.2",
        "Ant and InvertedPendulum are the novel tasks.",
    ),
    Contradiction(
        "The thresholds ξ are 0.5, 0.7 and 0.9 in the description, and 50, 70 and 90 in the "
        "tables and the discussion.",
        "Section 4.3.2; tables 13 to 15 and section 6.1",
        "50, 70 and 90, for M = 230 latent features; scaled by M / 230 at other sizes.",
    ),
    Contradiction(
        "Exploration is Gaussian noise on the action in one sentence, and ε-greedy with ε from 0.4 "
        "to 0.1 over 200,000 updates in the next.",
        "Section 3.1",
        "Gaussian noise of deviation 0.3, as in the author's runs; ε-greedy is an option, and "
        "the one used for discrete actions.",
    ),
    Contradiction(
        "Reward, value and action models have three fully-connected layers each; Dreamer, whose "
        "hyperparameters are said to be kept, has 2, 3 and 4 hidden ones and an output layer.",
        "Section 3.1; section 4",
        "2, 3 and 4 hidden layers and an output layer, as in Dreamer.",
    ),
    Contradiction(
        "The deviations in the columns of 2 tasks for final returns are those of the overall "
        "returns, digit by digit, though the means differ.",
        "Tables 4, 6, 8 and 12; tables 3, 5, 7 and 11",
        "They are shown as printed, marked as copies, and nothing is concluded from them.",
    ),
    Contradiction(
        "ω = 1 is said to be a full transfer of the weights; the equation gives the sum of the "
        "fresh weights and all of the source's.",
        "Equation 19; section 3.2.2",
        "The equation.",
    ),
    Contradiction(
        "The sense of ± is not said; shaded areas are the deviation of three runs.",
        "Tables 1 to 12, 16 and 17; section 5.1",
        "The deviation of all evaluation returns of all seeds together, which the numbers "
        "call for; figures shade the deviation of the seeds at each evaluation.",
    ),
    Contradiction(
        "An agent of several tasks trains for 100 updates a round of one episode of each task, by "
        "the text; the author's code makes 100 updates for each task.",
        "Section 3.2.1",
        "100 updates for each task, so that every episode is learned from as much as in a run "
        "of one task; the schedule is a setting.",
    ),
    Contradiction(
        "The latent states to classify are said to come from the encoder alone, and to have 230 "
        "features; the encoder has 1024, and the 230 are those of the dynamics model behind it.",
        "Section 4.3.1; section 3.3.3",
        "The 230 features of the dynamics model's posterior.",
    ),
    Contradiction(
        "The share taken for the right known task changes with ξ where every sample is taken for "
        "known (Walker2D of Table 15: 0.65, 1.00, 0.85), though the neighbours' votes do not "
        "depend on ξ. Each row must have been made from samples of its own.",
        "Tables 13 to 15; equation 22",
        "All rows of a table judge the same samples, so this share is the same in all.",
    ),
    Contradiction(
        "Hopper and Ant are shown as novel tasks, and their images trained the encoder whose "
        "states are classified.",
        "Tables 14 and 15; section 4.3.1",
        "As in the thesis: they are novel to the classifier, not to the encoder.",
    ),
    Contradiction(
        "The frozen encoder is said to give one feature space to all agents, and stored reward "
        "models read it; they read the features of the dynamics model, which the agents train "
        "each for itself.",
        "Sections 3.3.1 and 3.3.2; tables 16 and 17",
        "The dynamics are drawn anew, as in the author's runs, so a stored reward model reads "
        "features of another dynamics model than its own; copied and frozen dynamics are options.",
    ),
    Contradiction(
        "The number of misclassifications is said never to be less than half of the samples; by "
        "the tables it is never more than half (known tasks; the least share that is right is "
        "0.60).",
        "Section 6.1; tables 13 to 15",
        "The tables.",
    ),
)
"""All that are known."""
