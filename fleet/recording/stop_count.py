"""Counts the commands of a session that stop cars, from the events of commands. Pure.

A stop of several cars is one command with one id, and each gateway publishes several events of it.
"""

from typing import Any, Final

from fleet.recording.foreign_fields import text_of
from schemas.commands import STOPPING_VERBS, Verb
from schemas.topics import TOPICS
from schemas.words import Phase, Reason

EVENTS: Final = TOPICS["event/command"]
MAX_RECENT_IDS: Final = 1000
"""Maximum number of remembered ids. So many are enough, because the events of one command are at most seconds apart."""


def stops_cars(event: Any) -> bool:
    """Return True for an event of a command that stops cars.

    A pause stops no car before its gateway has accepted it, because not everybody may pause a fleet. The message has
    the schema of its recording, which may lack a field, or have it with another type.
    """
    verb, phase, reason = (text_of(event, name) for name in ("verb", "phase", "reason"))
    if verb != Verb.PAUSE:
        return verb in STOPPING_VERBS
    return phase != Phase.ASKED and (phase != Phase.REJECTED or reason == Reason.LINK_DOWN)


class StopCount:
    """The number of commands that stop cars (`stop`, `estop`, `pause`), each counted once."""

    def __init__(self) -> None:
        self.count = 0
        self._recent: dict[str, None] = {}

    def add(self, event: Any) -> None:
        """Count a message of `EVENTS`. Messages of other types are ignored."""
        if event.DESCRIPTOR.full_name != EVENTS.message or not stops_cars(event):
            return
        command, phase = (text_of(event, name) for name in ("id", "phase"))
        if not command:  # without an id, the events of one command cannot be told from others: count each car
            self.count += phase == Phase.ASKED
        elif command not in self._recent:
            self.count += 1
            self._recent[command] = None
            if len(self._recent) > MAX_RECENT_IDS:
                del self._recent[next(iter(self._recent))]
