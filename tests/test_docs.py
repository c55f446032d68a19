"""The pages of docs/: their Python runs and prints what they show; what they name is there."""

import ast
import contextlib
import importlib.util
import io
import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
DOCS = ROOT / "docs"
PAGES = ("README.md", "CONTRIBUTING.md", *(f"docs/{path.name}" for path in DOCS.glob("*.md")))
BLOCK = re.compile(r"```python\n(.*?)```(?:\s*```text\n(.*?)```)?", re.DOTALL)


def sections(page):
    """Title -> its blocks: (code, what it prints)."""
    text = (DOCS / page).read_text(encoding="utf-8")
    parts = re.split(r"^## (.*)$", text, flags=re.MULTILINE)
    found = {
        title: BLOCK.findall(text) for title, text in zip(parts[1::2], parts[2::2], strict=True)
    }
    return {title: blocks for title, blocks in found.items() if blocks}


def run(page, title, names):
    for code, shown in sections(page)[title]:
        printed = io.StringIO()
        with contextlib.redirect_stdout(printed):
            exec(compile(code, f"{page}: {title}", "exec"), names)
        assert printed.getvalue() == shown


@pytest.mark.parametrize("title", sections("transfer.md"))
def test_the_page_on_transfer_prints_what_it_shows(title):
    run("transfer.md", title, {})


def test_the_page_on_the_renderer_prints_what_it_shows():
    """Its sections go on from one another."""
    pytest.importorskip("mujoco")
    names = {}
    for title in sections("renderer.md"):
        run("renderer.md", title, names)
    assert len(sections("renderer.md")) == 2


def test_the_page_shows_three_uses():
    uses = [title for title in sections("transfer.md") if title.startswith("Use ")]
    assert len(uses) == 3
    assert all(
        "dreamer_jax" not in code for title in uses for code, _ in sections("transfer.md")[title]
    )


def test_the_page_on_environments_makes_one():
    pytest.importorskip("pybullet")
    (code,) = BLOCK.findall((DOCS / "environments.md").read_text(encoding="utf-8"))
    names = {}
    exec(code[0], names)
    assert names["image"].shape == (64, 64, 3)


@pytest.mark.parametrize("page", PAGES)
def test_links_and_files_that_a_page_names_are_there(page):
    text = (ROOT / page).read_text(encoding="utf-8")
    links = re.findall(r"\]\(([^)#]+)(?:#[^)]*)?\)", text)
    named = re.findall(
        r"\b(?:benchmarks|docs|dreamer_jax|envs|experiments|tests|transfer)/[\w/.-]+\.\w+\b", text
    )
    local = {(ROOT / page).parent / link for link in links if not link.startswith("https://")}
    assert [
        str(path) for path in local | {ROOT / name for name in named} if not path.exists()
    ] == []


def test_the_readme_is_short():
    assert len((ROOT / "README.md").read_text(encoding="utf-8").splitlines()) <= 150


def docstrings(path):
    """The docstrings of what is public in a file: (name, text)."""
    nodes = [ast.parse(path.read_text(encoding="utf-8"))]
    while nodes:
        node = nodes.pop()
        name = getattr(node, "name", "__init__")
        if name.startswith("_") and name != "__init__":
            continue
        yield name, ast.get_docstring(node) or ""
        kinds = (ast.ClassDef, ast.FunctionDef, ast.AsyncFunctionDef)
        nodes += [inner for inner in node.body if isinstance(inner, kinds)]


@pytest.mark.parametrize("package", ["transfer", "dreamer_jax", "envs", "experiments"])
def test_sections_of_docstrings_are_indented_by_two_spaces(package):
    section = re.compile(r"^(?:Args|Attributes|Raises|Returns):\n( *)", re.MULTILINE)
    found = [
        (path.name, name, len(indent))
        for path in (ROOT / package).rglob("*.py")
        for name, text in docstrings(path)
        for indent in section.findall(text)
    ]
    assert [place for place in found if place[2] != 2] == []
    assert len(found) > 20


def test_what_an_update_takes_on_paper_is_what_the_program_for_it_prints():
    spec = importlib.util.spec_from_file_location("arithmetic", DOCS / "arithmetic.py")
    arithmetic = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(arithmetic)
    page = (DOCS / "scaling.md").read_text(encoding="utf-8")
    lines = list(arithmetic.of_one_member())
    assert len(lines) > 5 and "\n".join(lines) in page
    assert f"**{arithmetic.SHARE:.0%}".replace("%", " %") in page
    # The tables of one agent; those of many take longer to count.
    (entry,) = [table for name, table in arithmetic.TABLES.items() if name == "table-13"]
    assert f"| 13 to 15 {arithmetic.row(arithmetic.shown(entry))}\n" in page
