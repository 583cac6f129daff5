"""Lists what happened to one car around one time of a session: commands, log records, claims of its gateway, decisions.

Pure.
"""

from collections.abc import Mapping
from typing import Any, Final

from msgspec import Struct, field

from fleet.client.claims import link_claim, mode_claim, motors_claim
from fleet.recording.tools.stop_findings import StopFindings, UnshownStop, asked_by
from schemas import keys, messages
from schemas.local_time import clock

TIMELINE_BEFORE_NS: Final = 30_000_000_000
TIMELINE_AFTER_NS: Final = 30_000_000_000
"""Time before and after the requested one that the timeline covers, ns."""
STATE_BEFORE_NS: Final = 30_000_000_000
"""Time before the timeline that is searched for the states at its beginning. Gateways repeat states each second."""
DECISION_TOPIC: Final = f"{keys.COORDINATOR}/decision"
_CLAIMS: Final = {
    "state/link": ("link", link_claim),
    "state/mode": ("mode", mode_claim),
    "state/safety": ("motors", motors_claim),
}
TIMELINE_TOPICS: Final = (*_CLAIMS, "state/health", "event/command", "event/log")


class TimelineEntry(Struct, frozen=True):
    """One line of the timeline."""

    at_ns: int
    words: str

    def __str__(self) -> str:
        return f"{clock(self.at_ns / 1e9)}  {self.words}"


class CarTimeline(Struct):
    """The timeline of one car from `begin_ns` to `end_ns`, by the recorder's clock."""

    car: str
    begin_ns: int
    end_ns: int
    entries: list[TimelineEntry] = field(default_factory=list)
    stops: StopFindings = field(default_factory=StopFindings)
    _last: dict[str, str] = field(default_factory=dict)

    def add(self, topic: str, message: Any, at_ns: int) -> None:
        """Add a message of the car, or a decision of the plan. `at_ns` is its time by the recorder's clock."""
        if topic in TIMELINE_TOPICS:
            self.stops.add(self.car, topic, message, at_ns)
        if topic in _CLAIMS:
            name, claim_of = _CLAIMS[topic]
            claim = claim_of(message)
            self._changed(name, f"{name} {claim.with_basis}", claim.why, at_ns)
        elif topic == "event/command":
            words = f": {message.words or message.reason}" if message.words or message.reason else ""
            basis = f" ({message.basis})" if message.basis else ""
            self._changed(
                message.id,
                f"{asked_by(message)} {message.phase}{basis}{words}",
                "",
                at_ns,
            )
        elif topic == "event/log":
            self._add(message.message, at_ns)
        elif topic == DECISION_TOPIC and message.subject == self.car:
            self._changed("plan", f"plan: {message.decided}, because: {message.why}", "", at_ns)

    @property
    def nearest(self) -> list[UnshownStop]:
        """The failed stops within the timeline."""
        return [each for each in self.stops.stops if self.begin_ns <= each.at_ns < self.end_ns]

    def as_dict(self) -> Mapping[str, Any]:
        """Return the timeline as JSON values."""
        return {
            "car": self.car,
            "begin_ns": self.begin_ns,
            "end_ns": self.end_ns,
            "stops": [each.as_dict() for each in self.nearest],
            "entries": [
                {"at": clock(each.at_ns / 1e9), "at_ns": each.at_ns, "words": each.words} for each in self.entries
            ],
        }

    def _changed(self, what: str, words: str, why: str, at_ns: int) -> None:
        """Add a line, unless the last line about `what` was the same.

        The states before the timeline are its first lines.
        """
        if self._last.get(what) == words:
            return
        self._last[what] = words
        self._add(f"{words}{f': {why}' if why else ''}", at_ns, is_state=what in ("link", "mode", "motors"))

    def _add(self, words: str, at_ns: int, *, is_state: bool = False) -> None:
        if self.begin_ns <= at_ns < self.end_ns:
            self.entries.append(TimelineEntry(at_ns, words))
        elif is_state and at_ns < self.begin_ns:
            name = words.partition(" ")[0]
            kept = [
                each for each in self.entries if each.at_ns >= self.begin_ns or not each.words.startswith(f"{name} ")
            ]
            self.entries[:] = [*kept, TimelineEntry(at_ns, words)]


def message_time_ns(message: Any, at_ns: int) -> int:
    """Return the stamp of a message, or `at_ns` if it has none, or if another program's schema has something else."""
    stamp = getattr(message, "stamp", None) or getattr(message, "timestamp", None)
    return (messages.stamp_ns(stamp) if hasattr(stamp, "seconds") else 0) or at_ns
