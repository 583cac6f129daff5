"""Finds the failed stops of a session. Pure.

A stop has failed if it did not reach the car, or if the car did not show it: its readings are no evidence that the stop
arrived. A gateway records such a stop twice: as the last event of each command that asked for it, and in its log. Both
have the same words, so they become one finding here. The likely cause is in the last states before the stop: a lost
link, a car that did not show an earlier stop, or a car whose reports cannot show a stop.
"""

from collections.abc import Iterator
from typing import Any, Final

from msgspec import Struct, field

from fleet.client.claims import claims_of
from fleet.recording.foreign_fields import text_of
from fleet.recording.stop_count import stops_cars
from schemas.keys import name_of
from schemas.local_time import clock
from schemas.words import UNKNOWN, LinkState, Phase, Reason, Shows

NOT_STOPPED_CODE: Final = "not_stopped"
NOT_SHOWN_CODE: Final = str(Reason.NOT_SHOWN)
WATCHED_TOPICS: Final = ("event/command", "event/log", "state/link", "state/health")
_SAME_STOP_NS: Final = 3_000_000_000
"""Maximum time between the records of one stop."""
_FAILED: Final = frozenset({Phase.FAILED, Phase.REJECTED, Phase.EXPIRED})
_OPEN: Final = frozenset({LinkState.ONLINE, LinkState.QUIET})


class UnshownStop(Struct):
    """One failed stop. Its code is `not_shown`, or `not_stopped` if the stop did not reach the car or was given up."""

    car: str
    at_ns: int
    """The time of its record, by the recorder's clock, ns since the epoch."""
    code: str
    asked: str
    """The verb and the sender, such as `stop by mia`. Empty if the gateway itself stopped the car."""
    words: str
    """The words of the gateway."""
    cause: str
    """The state of the car just before, in words."""

    def describe(self) -> str:
        """Return car, time and cause."""
        what = "was not shown" if self.code == NOT_SHOWN_CODE else "did not stop it"
        cause = f" Before that: {self.cause}." if self.cause else ""
        asked = self.asked or "a stop of its gateway"
        return f"{self.car} at {clock(self.at_ns / 1e9)}: {asked} {what}: {self.words}{cause}"

    def as_dict(self) -> dict[str, Any]:
        """Return the stop as JSON values."""
        return {
            "car": self.car,
            "at": clock(self.at_ns / 1e9),
            "at_ns": self.at_ns,
            "code": self.code,
            "asked": self.asked,
            "words": self.words,
            "cause": self.cause,
        }


class StopFindings(Struct):
    """The failed stops of one session, in the order of their messages."""

    stops: list[UnshownStop] = field(default_factory=list)
    _states: dict[str, dict[str, Any]] = field(default_factory=dict)
    """The newest states by car and topic."""

    def add(self, car: str, topic: str, message: Any, at_ns: int) -> None:
        """Add a message of `WATCHED_TOPICS`. `at_ns` is its time by the recorder's clock."""
        if topic.startswith("state/"):
            self._states.setdefault(car, {})[topic] = message
        elif not (code := failed_stop_code(topic, message)):
            return
        elif topic == "event/log":
            self._note(car, at_ns, code, "", message.message)
        else:
            self._note(car, at_ns, code, asked_by(message), message.words or message.reason)

    def of(self, code: str) -> list[UnshownStop]:
        """Return the stops with this code."""
        return [each for each in self.stops if each.code == code]

    def _note(self, car: str, at_ns: int, code: str, asked: str, words: str) -> None:
        core = _core(words, car)
        for other in reversed(self.stops):
            before = _core(other.words, car)
            is_same = other.car == car and abs(at_ns - other.at_ns) <= _SAME_STOP_NS
            if is_same and (core in before or before in core):
                other.code = NOT_STOPPED_CODE if NOT_STOPPED_CODE in (code, other.code) else code
                if asked and asked not in other.asked:
                    other.asked = f"{other.asked} and {asked}" if other.asked else asked
                if len(words) > len(other.words):
                    other.words = words
                return
        self.stops.append(UnshownStop(car, at_ns, code, asked, words, ", ".join(self._causes(car, words))))

    def _causes(self, car: str, words: str) -> Iterator[str]:
        states = self._states.get(car, {})
        link, health = claims_of(states).link, states.get("state/health")
        if link.what not in (*_OPEN, UNKNOWN):
            reason = f" ({link.why})" if link.why and link.why not in words else ""
            yield f"its link was {link.what}{reason}"
        if health is not None and (health.doubted or health.shows_stops in (Shows.NO, Shows.UNKNOWN)):
            yield health.shows_stops_words or f"whether it shows stops: {health.shows_stops}"


def failed_stop_code(topic: str, message: Any) -> str:
    """Return the code if a message of `event/command` or `event/log` reports a failed stop. Otherwise return ""."""
    if topic == "event/log":
        code = log_code(message)
        return code if code in (NOT_STOPPED_CODE, NOT_SHOWN_CODE) else ""
    if not stops_cars(message) or message.phase not in _FAILED:
        return ""
    return NOT_SHOWN_CODE if message.reason == NOT_SHOWN_CODE else NOT_STOPPED_CODE


def asked_by(event: Any) -> str:
    """Return verb and person of a fleet.v1.CommandEvent: `stop by mia`. The schema of its recording may lack both."""
    verb, sender = (text_of(event, name) for name in ("verb", "sender"))
    return f"{verb or 'a command'} by {name_of(sender) or 'somebody'}"


def log_code(record: Any) -> str:
    """Return the code of a log record. The record's name consists of the car's name and the code."""
    code: str = record.name.replace("/", " ").rpartition(" ")[2]
    return code


def _core(words: str, car: str) -> str:
    """Return the part of the gateway's words that its event and its log share."""
    text = words.removeprefix("NOT CONFIRMED: ").removeprefix("NOT STOPPED: ")
    text = text.removeprefix(f"{car} may still be moving: ").removeprefix(f"{car} ")
    return text.partition(". ")[0].rstrip(".")
