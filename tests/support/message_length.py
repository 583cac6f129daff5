"""How long a message to a person may be: two lines, unless it lists the faults of a file, cars, or what changed."""

import re
from typing import Final

LINE: Final = 160
"""Characters of a line."""
MAX_LINES: Final = 2
_PART_OF_A_LIST: Final = re.compile(
    r"\S+ is (?:added|removed|restarted)$|"
    r"\S+: (?:error|warning): |\S+:\d+(?::\d+)?: |(?:fleet: )?(?!fleet: )@?[a-z0-9][a-z0-9_-]*: |\d\d:\d\d:\d\d "
)
"""Changes of a fleet, faults of a file, outcomes of cars, and events: each is a message of its own."""


def count_lines(text: str) -> int:
    """Return how many lines a message takes."""
    return sum(max(1, -(-len(line) // LINE)) for line in text.strip().splitlines())


def too_long(printed: str) -> list[str]:
    """Return the messages in what a command printed on stderr that are too long."""
    lines = printed.splitlines()
    one = [line for line in lines if not _PART_OF_A_LIST.match(line)]
    every = [*(line for line in lines if _PART_OF_A_LIST.match(line)), "\n".join(one)]
    return [text for text in every if count_lines(text) > MAX_LINES]
