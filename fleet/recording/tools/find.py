"""Finds when a condition of a plan held in a session. `ConditionRun` is pure; `find_in` reads the messages.

`CarCondition` gives the condition its meaning, here as for the pins of a recording. A value that was not measured is
unknown, and so is a stale one. A hit lasts from the first reading to the last one that shows it: what nobody measured
between two readings counts, unless a value got stale there. So a gap is never true.
"""

from collections.abc import Collection, Iterator
from dataclasses import dataclass
from typing import Any, Final

from fleet.conditions import Expression
from fleet.conditions.holding import HeldSpan
from fleet.policy.car_condition import CarCondition
from fleet.policy.snapshot import topic_of
from fleet.recording.reading.message_decoder import MessageDecoder
from fleet.recording.reading.session import Session
from fleet.recording.selection import Selection
from fleet.recording.tools.car_timeline import message_time_ns
from fleet.recording.tools.publish_order import RecordedMessage, as_published
from fleet.recording.tools.stop_findings import asked_by
from schemas import keys
from schemas.topics import TOPICS
from schemas.words import Phase

MODE: Final = TOPICS["state/mode"]
COMMANDS: Final = TOPICS["event/command"]


@dataclass(frozen=True, slots=True)
class Hit:
    """A time during which a condition held for one car. Times: ns since the epoch, of the first and last reading."""

    car: str
    begin_ns: int
    end_ns: int
    mode: str = ""
    """The mode as commanded when it began. Empty if not known."""
    command: str = ""
    """The last command that had been sent to the car when it began, and by whom. Empty if there was none."""

    @property
    def length_s(self) -> float:
        """Return the time from the first reading to the last one, s."""
        return (self.end_ns - self.begin_ns) / 1e9


class ConditionRun:
    """The hits of one car, from its messages in the order in which they were published, by topic."""

    def __init__(self, expression: Expression, car: str, for_s: float = 0.0) -> None:
        self._condition = CarCondition(expression)
        self._car = car
        self._for_s = for_s
        """Minimum length of a hit, s."""
        self._mode = ""
        self._command = ""
        self._at_begin = "", ""
        """Mode and command when the current hit began."""
        self.hits: list[Hit] = []

    def add(self, topic: str, message: Any, at_ns: int) -> None:
        """Take in a message."""
        # The schema is that of the recording, and may lack a field.
        if topic == COMMANDS.name and getattr(message, "phase", "") == Phase.SENT:
            self._command = asked_by(message)
        if topic == MODE.name:
            self._mode = getattr(message, "asked", "")
        if topic not in self._condition.topics or (step := self._condition.add(topic, message, at_ns)) is None:
            return
        self._keep(step.ended)
        if step.has_begun:
            self._at_begin = self._mode, self._command

    def close(self) -> list[Hit]:
        """Return all hits. The last one ends with the last reading."""
        self._keep(self._condition.end())
        return self.hits

    def _keep(self, span: HeldSpan | None) -> None:
        if span is not None and span.length_s >= self._for_s:
            self.hits.append(Hit(self._car, *span, *self._at_begin))


def find_in(
    session: Session, expression: Expression, cars: Collection[str], for_s: float = 0.0, since_ns: int = 0
) -> list[Hit]:
    """Return the hits of these cars in a session, sorted by time. `session.damage` then has what could not be read."""
    topics = sorted({MODE.name, COMMANDS.name, *map(topic_of, expression.names)})
    selection = Selection(tuple(f"*/{car}/{topic}" for car in cars for topic in topics))
    runs = {car: ConditionRun(expression, car, for_s) for car in cars}
    for each in as_published(_messages(session, selection)):
        car, topic, message = each.item
        if each.at_ns >= since_ns or topic in (MODE.name, COMMANDS.name):
            runs[car].add(topic, message, each.at_ns)
    return sorted((hit for run in runs.values() for hit in run.close()), key=lambda hit: (hit.begin_ns, hit.car))


def _messages(session: Session, selection: Selection) -> Iterator[RecordedMessage[tuple[str, str, Any]]]:
    decoder = MessageDecoder()
    for info, _, log_ns, publish_ns, data in session.rows(selection):
        key, message = keys.parse(info.channel.topic), decoder.message(info, data)
        if key is None or message is None or message.DESCRIPTOR.full_name != TOPICS[key.topic].message:
            continue  # a message of another type has no fields of the condition
        stream = info.channel.topic, getattr(message, "boot_id", "")
        at_ns = message_time_ns(message, publish_ns)
        yield RecordedMessage(log_ns, at_ns, stream, getattr(message, "seq", 0), (key.car, key.topic, message))
