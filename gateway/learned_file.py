"""Keeps what was learned of one car in a small JSON file: its rhythm, its delays, and whether it can show a stop.

It belongs to the car of one platform at one link. If either changes, the file counts as that of another car. A damaged
file is no more than a car of which nothing is known yet.
"""

import json
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, Final, TypeVar

from schemas.atomic_file import DAMAGE, write_state

T = TypeVar("T")

MAX_BYTES: Final = 65536
"""Maximum size of the file. It has some hundred bytes."""


class LearnedFile:
    """The file of one car. `link` is the text of `schemas.links.car_link`; `platform`: as configured."""

    def __init__(self, directory: Path, fleet: str, car: str, *, link: str, platform: str) -> None:
        self.path = directory / f"{fleet}.{car}.learned.json"
        self._owner = {"link": link, "platform": platform}
        self._saved = ""
        self.trouble = ""
        """Why nothing was taken from a file that exists, for a person. Empty if all is well."""

    def load(self, use: Callable[[Mapping[str, Any]], T]) -> T:
        """Return what `use` makes of what was learned, or of nothing. `use` raises ValueError for damage."""
        self.trouble = ""
        try:
            content = json.loads(self.path.read_text(encoding="utf-8")[:MAX_BYTES])
            if {key: content[key] for key in self._owner} != self._owner:
                self.trouble = f"{self.path} is of {content['platform']} at {content['link']}, so it does not count"
                return use({})
            return use(dict(content["learned"]))
        except FileNotFoundError:
            return use({})
        except (OSError, *DAMAGE) as error:
            self.trouble = f"{self.path} is damaged ({type(error).__name__}), so it does not count"
            return use({})

    def save(self, learned: Mapping[str, Any]) -> None:
        """Replace the file if anything has changed. Raises OSError."""
        text = json.dumps(self._owner | {"learned": learned})
        if text == self._saved:
            return
        write_state(self.path, text)
        self._saved = text
