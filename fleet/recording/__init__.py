"""Records, reads and converts sessions: directories with MCAP segments. Scripts use `open_session`.

Read `session_dir` first, then the packages `writing`, `reading` and `tools`.
"""

from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from fleet.recording.reading.session import Session

__all__ = ["open_session"]


def open_session(path: str | PathLike[str]) -> "Session":
    """Open a session directory or .mcap file for reading; raises fleet.recording.reading.session.NoSession.

    `session.messages(keys=..., start_ns=..., end_ns=...)` yields its messages. Afterwards `session.damage_words`
    describes what could not be read.
    """
    from fleet.recording.reading.session import Session

    return Session.open(Path(path))
