"""What the README and the generated pages show is what the code says."""

from pathlib import Path

import pytest

from tests.tools.readme import PAGES, STOP_EVIDENCE, generated, stop_evidence_page


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_the_generated_parts_are_up_to_date(page: Path) -> None:
    assert generated(page) == page.read_text(encoding="utf-8"), "run `make readme`"


def test_the_page_on_the_evidence_of_stops_is_up_to_date() -> None:
    assert STOP_EVIDENCE.read_text(encoding="utf-8") == stop_evidence_page(), "run `make readme`"
