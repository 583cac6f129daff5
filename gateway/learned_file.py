"""Saves what was learned about one car in a small JSON file, such as how often the car reports, and if it shows stops.

The file is for one platform and one link. If the car now has another platform or link, or if the file is damaged, the
gateway does not use it, and begins as if it knew nothing of the car.
"""

import json
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, Final, TypeVar

from schemas.atomic_file import DAMAGE, write_state

T = TypeVar("T")

MAX_BYTES: Final = 65536
"""Maximum size of the file. It usually has a few hundred bytes."""


class LearnedFile:
    """The file of one car. `link` is what `schemas.links.car_link` returns, `platform` the configured platform."""

    def __init__(self, directory: Path, fleet: str, car: str, *, link: str, platform: str) -> None:
        self.path = directory / f"{fleet}.{car}.learned.json"
        self._made_for = {"link": link, "platform": platform}
        self._saved = ""
        self.trouble = ""
        """A sentence on why an existing file was not used. Else empty."""

    def load(self, use: Callable[[Mapping[str, Any]], T]) -> T:
        """Call `use` with what was learned, or with an empty mapping. Return what it returns.

        If `use` raises ValueError, the content counts as damaged.
        """
        self.trouble = ""
        try:
            content = json.loads(self.path.read_text(encoding="utf-8")[:MAX_BYTES])
            if {key: content[key] for key in self._made_for} != self._made_for:
                self.trouble = f"{self.path} belongs to {content['platform']} at {content['link']}, so it is not used"
                return use({})
            return use(dict(content["learned"]))
        except FileNotFoundError:
            return use({})
        except (OSError, *DAMAGE) as error:
            self.trouble = f"{self.path} is damaged ({type(error).__name__}), so it is not used"
            return use({})

    def save(self, learned: Mapping[str, Any]) -> None:
        """Replace the file if anything has changed since the last save. Raises OSError."""
        text = json.dumps(self._made_for | {"learned": learned})
        if text == self._saved:
            return
        write_state(self.path, text)
        self._saved = text
