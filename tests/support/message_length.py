"""The maximum length of a message to a person: two lines. Each fault of a file, car or change is a message."""

import tempfile
from typing import Final

LINE: Final = 160
"""Number of characters of a line."""
MAX_LINES: Final = 2


def count_lines(text: str) -> int:
    """Return how many lines a message takes."""
    return sum(max(1, -(-len(line) // LINE)) for line in text.strip().splitlines())


def too_long(printed: str) -> list[str]:
    """Return the lines of a command's stderr that are too long.

    The temporary directory counts as `/tmp`: a test may not depend on the place of its clone.
    """
    return [
        line for line in printed.replace(tempfile.gettempdir(), "/tmp").splitlines() if count_lines(line) > MAX_LINES
    ]
