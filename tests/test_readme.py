"""What the README shows is what the code says."""

from tests.readme import README, generated


def test_the_generated_parts_are_up_to_date() -> None:
    text = README.read_text(encoding="utf-8")
    assert generated(text) == text, "run `make readme`"
