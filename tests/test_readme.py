"""What the README shows is what the code says."""

from tests.tools.readme import README, STOP_EVIDENCE, generated, stop_evidence_page


def test_the_generated_parts_are_up_to_date() -> None:
    text = README.read_text(encoding="utf-8")
    assert generated(text) == text, "run `make readme`"


def test_the_page_on_the_evidence_of_stops_is_up_to_date() -> None:
    assert STOP_EVIDENCE.read_text(encoding="utf-8") == stop_evidence_page(), "run `make readme`"
