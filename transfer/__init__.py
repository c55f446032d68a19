"""Move knowledge between pytrees of parameters: select leaves, operate on them, say what happened.

Works on any pytree of arrays (Flax linen and NNX, Equinox, Haiku, Optax states, dataclasses, plain
containers), alone or stacked as a population, under `jit` and `vmap`.

Axis letters, used everywhere: P population member, N source, M feature, S sample.
"""

from transfer.execution import OPERATIONS, apply, source_leaves, stream
from transfer.files import load, open_file, save
from transfer.freeze import (
    combine,
    freeze,
    partition,
    scale_learning_rates,
    stop_gradient,
    unfreeze_gradually,
)
from transfer.mergekit import read_mergekit
from transfer.merging import average, karcher_mean, model_stock, slerp
from transfer.optimizer_state import apply_to_optimizer
from transfer.patterns import escape, match
from transfer.plan import Plan, Rule, claims, frozen
from transfer.plan_files import read_plan, write_plan
from transfer.plan_views import diff, draw, outline, to_html
from transfer.plasticity import dormancy, dormant_units, recycle, reset_periodically
from transfer.population import replicate, stack, unstack
from transfer.report import Report
from transfer.select import (
    complement,
    difference,
    flatten,
    intersection,
    paths,
    select,
    selected,
    unflatten,
    union,
)
from transfer.surgery import (
    copy,
    crop,
    fraction,
    interpolate,
    keep,
    pad,
    reinitialise,
    shrink_perturb,
    splice,
    take,
)
from transfer.task_vectors import breadcrumbs, dare, task_arithmetic, ties

__all__ = [
    "OPERATIONS",
    "Plan",
    "Report",
    "Rule",
    "apply",
    "apply_to_optimizer",
    "average",
    "breadcrumbs",
    "claims",
    "combine",
    "complement",
    "copy",
    "crop",
    "dare",
    "diff",
    "difference",
    "dormancy",
    "dormant_units",
    "draw",
    "escape",
    "flatten",
    "fraction",
    "freeze",
    "frozen",
    "interpolate",
    "intersection",
    "karcher_mean",
    "keep",
    "load",
    "match",
    "model_stock",
    "open_file",
    "outline",
    "pad",
    "partition",
    "paths",
    "read_mergekit",
    "read_plan",
    "recycle",
    "reinitialise",
    "replicate",
    "reset_periodically",
    "save",
    "scale_learning_rates",
    "select",
    "selected",
    "shrink_perturb",
    "slerp",
    "source_leaves",
    "splice",
    "stack",
    "stop_gradient",
    "stream",
    "take",
    "task_arithmetic",
    "ties",
    "to_html",
    "unflatten",
    "unfreeze_gradually",
    "union",
    "unstack",
    "write_plan",
]
