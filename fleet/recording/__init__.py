"""Sessions on disk: MCAP segments and what belongs to them. `open_session` is for scripts."""

from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from fleet.recording.reading.session import Session

__all__ = ["open_session"]


def open_session(path: str | PathLike[str]) -> "Session":
    """Open a recorded session, a directory or an .mcap, to read it; raises fleet.recording.reading.session.NoSession.

    `session.messages(keys=..., start_ns=..., end_ns=...)` yields its messages, `session.damage_words` says afterwards
    what could not be read.
    """
    from fleet.recording.reading.session import Session

    return Session.open(Path(path))
