"""Every block of Python in docs/transfer.md runs and prints what the page shows under it."""

import contextlib
import io
import re
from pathlib import Path

import pytest

PAGE = Path(__file__).parent.parent / "docs" / "transfer.md"
BLOCK = re.compile(r"```python\n(.*?)```(?:\s*```text\n(.*?)```)?", re.DOTALL)


def sections():
    """Title -> its blocks: (code, what it prints)."""
    parts = re.split(r"^## (.*)$", PAGE.read_text(encoding="utf-8"), flags=re.MULTILINE)
    found = {
        title: BLOCK.findall(text) for title, text in zip(parts[1::2], parts[2::2], strict=True)
    }
    return {title: blocks for title, blocks in found.items() if blocks}


@pytest.mark.parametrize("title", sections())
def test_the_page_prints_what_it_shows(title):
    names = {}
    for code, shown in sections()[title]:
        printed = io.StringIO()
        with contextlib.redirect_stdout(printed):
            exec(compile(code, f"{PAGE.name}: {title}", "exec"), names)
        assert printed.getvalue() == shown


def test_the_page_shows_three_uses():
    uses = [title for title in sections() if title.startswith("Use ")]
    assert len(uses) == 3
    assert all("dreamer_jax" not in code for title in uses for code, _ in sections()[title])
