"""How much a recorder keeps: one value, passed from a fleet file through `fleet up` to `fleet record run`. Pure.

To add a limit, add a field here with the methods that apply it, a key in the model of the fleet file, and
an option.
"""

import re
from typing import Final

from msgspec import Struct

SESSIONS_PER_QUOTA: Final = 10
"""Number of sessions that fit into a quota, if no size of a session is set. Nothing of the session that is being
written may be removed, so each session is at most a tenth of the quota."""
QUOTA_SEGMENT_S: Final = 60.0
"""Length of a segment, s, if there is a quota. Whole segments are removed for the quota, and a pin keeps whole
minutes."""
MAX_SEGMENTS: Final = 9990
"""Maximum number of segments of a session, because their names have four digits."""
_SIZE_UNITS: Final = {"TB": 10**12, "GB": 10**9, "MB": 10**6, "KB": 10**3, "B": 1, "": 1}


def parse_size(text: str) -> int | None:
    """Return the number of bytes of `512MB`, `1.5GB`, or a number of bytes. None if the text is no size."""
    match = re.fullmatch(r"([0-9]+(?:\.[0-9]+)?)\s*([KMGT]?B|)", text.upper())
    return int(float(match[1]) * _SIZE_UNITS[match[2]]) if match else None


def format_size(size: int) -> str:
    """Return a number of bytes with its largest whole unit."""
    unit, factor = next((unit, factor) for unit, factor in _SIZE_UNITS.items() if size % factor == 0)
    return f"{size // factor}{unit}"


class Quota(Struct, frozen=True):
    """Maximum size of all sessions together, and of one, in bytes. 0 means no limit."""

    total: int = 0
    """While pinned segments fit into half of it, the oldest unpinned ones of unmarked sessions are removed first."""
    session: int = 0
    """Size at which a session is closed and the next one begins. 0 means a tenth of `total`."""

    @property
    def session_limit(self) -> int:
        """Return the maximum size of one session in bytes. 0 means no limit."""
        return self.session or self.total // SESSIONS_PER_QUOTA

    @property
    def refusal(self) -> str:
        """Return why the two sizes contradict each other, or an empty text if they do not."""
        if not self.session or not self.total or self.session <= self.total // 2:
            return ""
        return (
            f"--session-size: {self.session / 10**6:g} MB is more than half of --quota: at most "
            f"{self.total / 2 / 10**6:g} MB are allowed, because nothing of the session "
            "that is being written is ever removed"
        )

    @property
    def arguments(self) -> tuple[str, ...]:
        """Return the options of `fleet record run` for this quota."""
        options = {"--quota": self.total, "--session-size": self.session}
        return tuple(word for option, size in options.items() if size for word in (option, format_size(size)))

    def segment_s(self, otherwise_s: float) -> float:
        """Return the length of a segment for these limits, s. otherwise_s: the length if there is no quota."""
        return QUOTA_SEGMENT_S if self.total else otherwise_s

    def is_session_over(self, size: int, segments: int) -> bool:
        """Return True if a session of this size is complete, so that the next one begins."""
        return 0 < self.session_limit <= size or segments >= MAX_SEGMENTS

    def excess(self, size: int) -> int:
        """Return the number of bytes by which all sessions together exceed the quota, or 0 if they do not."""
        return max(0, size - self.total) if self.total else 0
