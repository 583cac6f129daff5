"""The reference says what the code says."""

from tests.tools.reference import PATH, reference


def test_it_is_up_to_date() -> None:
    assert PATH.read_text(encoding="utf-8") == reference(), "run `make readme`"
