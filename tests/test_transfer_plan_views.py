"""Plans compared and drawn."""

import sys

import jax
import jax.numpy as jnp
import matplotlib
import pytest

import transfer
from transfer import Plan, Rule
from transfer.recipes import fractional_transfer

matplotlib.use("Agg")

TREE = {
    "body": {"in": {"w": jnp.ones(2)}, "mid": {"w": jnp.ones(2), "b": jnp.ones(2)}},
    "head": {"out": {"w": jnp.ones(2)}},
}
ONE = Plan(
    (Rule("body/**", "copy"), Rule("head/**", "fraction", {"omega": 0.2})), name="one <&> two"
)


def test_plans_differ_in_what_they_do_and_not_in_how_they_are_written():
    written = Plan(
        (
            Rule(("body/in/*", "body/mid/{name}"), "copy", note="features"),
            Rule("head/out/w", "fraction", {"omega": 0.2}),
        )
    )
    assert transfer.diff(ONE, written, TREE) == ()
    assert str(transfer.diff(ONE, written, TREE)) == "The plans do the same to every leaf."
    other = Plan(
        (
            Rule("body/in/*", "copy", frozen=True),
            Rule("body/mid/w", "copy", source="trunk/w"),
            Rule("head/**", "fraction", {"omega": 0.5}),
        ),
        default="copy",
    )
    found = transfer.diff(ONE, other, jax.eval_shape(lambda: TREE))
    assert [one.leaf for one in found] == ["body/in/w", "body/mid/w", "head/out/w"]
    assert str(found).splitlines() == [
        "body/in/w   copy()               ->  copy(), frozen",
        "body/mid/w  copy()               ->  copy(source=trunk/w)",
        "head/out/w  fraction(omega=0.2)  ->  fraction(omega=0.5)",
    ]


def test_rules_that_read_other_places_differ():
    here = Plan((Rule("body/{part}/*", "copy", source="a/{part}"),), default="keep")
    there = Plan((Rule("body/{layer}/*", "copy", source="a/{layer}"),), default="keep")
    assert len(transfer.diff(here, there, TREE)) == 3
    assert transfer.diff(here, here, TREE) == ()


def test_a_plan_is_drawn_with_a_box_for_each_layer():
    axes = transfer.draw(ONE, TREE)
    assert len(axes.patches) == 3
    texts = {text.get_text() for text in axes.texts}
    assert texts == {"body", "head", "in", "mid", "out"}
    assert [text.get_text() for text in axes.get_legend().get_texts()] == ["copy", "fraction"]
    again = transfer.draw(ONE, TREE, axes=axes.figure.add_subplot(), components=["head"])
    assert [text.get_text() for text in again.texts][0] == "head"
    with pytest.raises(ValueError, match="no component 'tail'; it has body, head"):
        transfer.draw(ONE, TREE, components=["tail"])
    matplotlib.pyplot.close("all")


def test_a_plan_as_html_names_every_leaf(monkeypatch):
    assert "fraction(omega=0.2)" in transfer.to_html(ONE, TREE)
    monkeypatch.setitem(sys.modules, "treescope", None)
    table = transfer.to_html(ONE, TREE)
    assert table.count("<tr>") == 4 and "one &lt;&amp;&gt; two" in table and "body/mid/b" in table


def test_the_outline_counts_leaves():
    assert transfer.outline(ONE, TREE, depth=1) == {
        "body": {"copy()": 3},
        "head": {"fraction(omega=0.2)": 1},
    }
    assert fractional_transfer(0.1) == fractional_transfer(0.1)
