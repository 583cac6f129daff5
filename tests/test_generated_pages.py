"""Tests that the generated parts of docs/ are up to date with the code."""

from pathlib import Path

import pytest

from tests.tools.pages.build import ROOT, expected, stale_pages

EXPECTED = expected()


@pytest.mark.parametrize("page", EXPECTED, ids=lambda page: str(page.relative_to(ROOT)))
def test_generated_pages_are_up_to_date(page: Path) -> None:
    assert page.read_text(encoding="utf-8") == EXPECTED[page], "run `make pages`"


def test_no_page_of_a_command_that_is_gone() -> None:
    assert stale_pages() == [], "run `make pages`"
