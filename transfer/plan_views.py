"""Plans compared and drawn: what differs, leaf by leaf, and what becomes of each part of a tree."""

import html
from collections import Counter
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

from transfer.plan import Plan, Rule, claims
from transfer.select import PyTree


class Difference(NamedTuple):
    """A leaf that two plans treat differently.

    Attributes:
      leaf: its path.
      first: what the first plan does with it, as in `fraction(omega=0.2)`.
      second: what the second does.
    """

    leaf: str
    first: str
    second: str


class PlanDifference(tuple):
    """The differences between two plans, leaf by leaf; prints as a table."""

    def __str__(self) -> str:
        if not self:
            return "The plans do the same to every leaf."
        rows = [(one.leaf, one.first, one.second) for one in self]
        widths = [max(len(row[column]) for row in rows) for column in (0, 1)]
        return "\n".join(f"{a:{widths[0]}}  {b:{widths[1]}}  ->  {c}" for a, b, c in rows)


def diff(first: Plan, second: Plan, target: PyTree) -> PlanDifference:
    """What two plans would do differently to a target.

    Rules are compared by what they do, not by how they are written: other patterns that select the
    same leaves, or other notes, make no difference.

    Args:
      first: a plan.
      second: another.
      target: a tree whose leaves both claim; only its paths are read, so shapes are enough.

    Returns:
      A tuple of `Difference`, in tree order; empty where the plans do the same.

    Raises:
      ValueError: as `transfer.claims`, of either plan.

    >>> tree = {"body": {"w": jnp.ones(2)}, "head": {"w": jnp.ones(2)}}
    >>> one = Plan((Rule("head/*", "fraction", {"omega": 0.2}),), default="copy")
    >>> print(diff(one, Plan((Rule("head/*", "keep"),), default="copy"), tree))
    head/w  fraction(omega=0.2)  ->  keep()
    """
    befores, afters = claims(first, target), claims(second, target)
    return PlanDifference(
        Difference(path, befores[path].describe(), afters[path].describe())
        for path in befores
        if _does(befores[path], path) != _does(afters[path], path)
    )


def _does(rule: Rule, path: str) -> tuple[Any, ...]:
    """What a rule does to a leaf, apart from how it is written."""
    captured = rule.captured(path)
    used = tuple(sorted(captured.items())) if rule.source or rule.layout else ()
    return (rule.operation, rule.parameters, rule.source, rule.layout, rule.frozen, used)


def outline(plan: Plan, target: PyTree, *, depth: int = 2) -> dict[str, dict[str, int]]:
    """What becomes of each branch: `{branch: {operation: number of leaves}}`.

    Args:
      plan: a plan.
      target: a tree that it claims.
      depth: how many parts of a path make a branch.

    >>> tree = {"body": {"w": jnp.ones(2), "b": jnp.ones(2)}, "head": jnp.ones(2)}
    >>> outline(Plan((Rule("head", "keep"),), default="copy"), tree)
    {'body/b': {'copy()': 1}, 'body/w': {'copy()': 1}, 'head': {'keep()': 1}}
    """
    found: dict[str, Counter] = {}
    for path, rule in claims(plan, target).items():
        branch = "/".join(path.split("/")[:depth])
        found.setdefault(branch, Counter())[rule.describe()] += 1
    return {branch: dict(counts) for branch, counts in found.items()}


def to_html(plan: Plan, target: PyTree) -> str:
    """A plan over a target as HTML: the tree, with what happens to each leaf in its place.

    Where Treescope is installed (Flax brings it) the tree folds and unfolds; else it is a table.

    Raises:
      ValueError: as `transfer.claims`.
    """
    texts = {path: rule.describe() for path, rule in claims(plan, target).items()}
    try:
        import treescope
    except ImportError:
        rows = "".join(
            f"<tr><td>{html.escape(path)}</td><td>{html.escape(text)}</td></tr>"
            for path, text in texts.items()
        )
        return f"<table><caption>{html.escape(plan.name)}</caption>{rows}</table>"
    return treescope.render_to_html(_nested(texts), compressed=False)


def _nested(texts: Mapping[str, str]) -> dict[str, Any]:
    tree: dict[str, Any] = {}
    for path, text in texts.items():
        *branches, last = path.split("/")
        node = tree
        for branch in branches:
            node = node.setdefault(branch, {})
        node[last] = text
    return tree


# Of each operation: the colour of its box. Others are white.
_COLOURS = {
    "copy": "#9ecae1",
    "fraction": "#fdd0a2",
    "keep": "#e5e5e5",
    "reinitialise": "#e5e5e5",
    "average": "#c7e9c0",
}


def draw(plan: Plan, target: PyTree, *, axes: Any = None, components: Sequence[str] = ()) -> Any:
    """A picture of a plan, one column for each component and one box for each of its layers.

    For the recipes this is the thesis's Figure 8. Needs Matplotlib
    (`pip install 'dreamer-transfer[pictures]'`).

    Args:
      plan: a plan.
      target: a tree that it claims; its first parts are the components, its second the layers.
      axes: of Matplotlib, to draw on; by default of a new figure.
      components: the order of columns; by default that of the tree.

    Returns:
      The axes.

    Raises:
      ValueError: as `transfer.claims`, or a component that the tree has not.
    """
    import matplotlib.pyplot as plt
    from matplotlib.patches import FancyBboxPatch, Patch

    boxes: dict[str, list[tuple[str, list[str]]]] = {}
    for branch, counts in outline(plan, target).items():
        component, _, layer = branch.partition("/")
        boxes.setdefault(component, []).append((layer, list(counts)))
    if unknown := sorted(set(components) - set(boxes)):
        raise ValueError(f"The tree has no component {unknown[0]!r}; it has {', '.join(boxes)}.")
    columns = {name: boxes[name] for name in (*components, *boxes)}
    if axes is None:
        height = 1 + 0.55 * max(map(len, columns.values()))
        _, axes = plt.subplots(figsize=(1.9 * len(columns), height), layout="constrained")
    seen: dict[str, str] = {}
    for column, (component, layers) in enumerate(columns.items()):
        axes.text(column, 0.9, component, ha="center", va="bottom", weight="bold")
        for row, (layer, descriptions) in enumerate(layers):
            names = [text.partition("(")[0] for text in descriptions]
            colour = _COLOURS.get(names[0], "white") if len(set(names)) == 1 else "#fff7bc"
            seen.setdefault(" / ".join(dict.fromkeys(names)), colour)
            axes.add_patch(
                FancyBboxPatch(
                    (column - 0.42, -row), 0.84, 0.6, "round,pad=0.03", fc=colour, ec="0.3"
                )
            )
            axes.text(column, 0.3 - row, layer or component, ha="center", va="center", fontsize=8)
    axes.legend(
        handles=[
            Patch(facecolor=colour, edgecolor="0.3", label=name) for name, colour in seen.items()
        ],
        loc="upper center",
        bbox_to_anchor=(0.5, 0),
        ncols=len(seen),
        frameon=False,
    )
    axes.set_xlim(-0.6, len(columns) - 0.4)
    axes.set_ylim(-max(map(len, columns.values())) + 0.7, 1.4)
    axes.set_axis_off()
    if plan.name:
        axes.set_title(plan.name)
    return axes
