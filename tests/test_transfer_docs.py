"""Every block of Python in the pages on the transfer library prints what is shown under it."""

import pytest

from test_docs import DOCS, run, sections

PAGES = sorted(page.name for page in DOCS.glob("transfer_*.md"))


@pytest.mark.parametrize("page", PAGES)
def test_the_page_prints_what_it_shows(page):
    """Its sections go on from one another."""
    names = {}
    for title in sections(page):
        run(page, title, names)


def test_there_is_a_page_for_each_group_of_operations():
    groups = ("selecting", "operations", "plans", "merging", "training", "files", "comparison")
    assert set(PAGES) == {f"transfer_{group}.md" for group in groups}
    assert all(page in (DOCS / "transfer.md").read_text() for page in PAGES)
