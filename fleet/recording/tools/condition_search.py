"""Finds when a condition of a plan held in a session. `ConditionRun` is pure; `find_in` reads the messages.

`CarCondition` evaluates the condition, as it does for the pins of recordings. A value that was not measured is unknown,
and so is a stale one. A hit lasts from the first reading to the last one that shows it. The time between two readings
counts as true, unless a value that the condition needs became stale in between. So a hit never spans such a gap.
"""

from collections.abc import Collection, Iterator
from typing import Any, Final

from msgspec import Struct

from fleet.conditions import Expression
from fleet.conditions.holding import HeldSpan
from fleet.policy.car_condition import CarCondition
from fleet.policy.snapshot import is_in, topic_of
from fleet.recording.foreign_fields import number_of, text_of
from fleet.recording.left_out import LeftOut, LeftOutCause
from fleet.recording.reading.mcap_reader import ChannelInfo
from fleet.recording.reading.message_decoder import MessageDecoder, why_not_decoded
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


class Hit(Struct, frozen=True):
    """A time during which a condition held for one car.

    Times: of the first and last reading, by the recorder's clock, ns since the epoch.
    """

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
    """Finds the hits of one car. It gets the car's messages in the order of publishing, each with its topic."""

    def __init__(self, expression: Expression, car: str, for_s: float = 0.0) -> None:
        self._condition = CarCondition(expression)
        self._car = car
        self._for_s = for_s
        """Minimum length of a hit, s."""
        self._mode = ""
        self._command = ""
        self._at_begin = "", ""
        """Mode and command when the current hit began."""
        self._ahead_ns = 0
        self.hits: list[Hit] = []
        self.longest_s = -1.0
        """The longest time (s) for which the condition held. Negative if it never did."""

    def add(self, topic: str, message: Any, at_ns: int, ahead_ns: int = 0) -> None:
        """Use a message. `at_ns` is its stamp. The recorder's clock was ahead of that stamp by `ahead_ns`."""
        # The message has the schema of the recording, which may lack a field.
        if topic == COMMANDS.name and text_of(message, "phase") == Phase.SENT:
            self._command = asked_by(message)
        if topic == MODE.name:
            self._mode = text_of(message, "asked")
        if topic not in self._condition.topics or (step := self._condition.add(topic, message, at_ns)) is None:
            return
        self._keep(step.ended)
        self._ahead_ns = ahead_ns
        if step.has_begun:
            self._at_begin = self._mode, self._command

    def close(self) -> list[Hit]:
        """Return all hits. The last one ends with the last reading."""
        self._keep(self._condition.end())
        return self.hits

    def _keep(self, span: HeldSpan | None) -> None:
        if span is None:
            return
        self.longest_s = max(self.longest_s, span.length_s)
        if span.length_s >= self._for_s:
            begin_ns, end_ns = span.begin_ns + self._ahead_ns, span.end_ns + self._ahead_ns
            self.hits.append(Hit(self._car, begin_ns, end_ns, *self._at_begin))


class Found(Struct):
    """The hits of one session, and what was left out."""

    hits: list[Hit]
    """Sorted by time."""
    longest_s: float
    """The longest time (s) for which the condition held, regardless of `for_s`. Negative if it never did."""
    left_out: LeftOut
    """Messages under the keys of the condition that contain none of its values."""


def find_in(
    session: Session, expression: Expression, cars: Collection[str], for_s: float = 0.0, since_ns: int = 0
) -> Found:
    """Return the hits of these cars in a session. `session.damage` then has what could not be read.

    Times are those of the recorder's clock, as in every tool that opens a session. since_ns: ns since the epoch.
    """
    topics = sorted({MODE.name, COMMANDS.name, *map(topic_of, expression.names)})
    selection = Selection(tuple(f"*/{car}/{topic}" for car in cars for topic in topics))
    messages: dict[str, list[RecordedMessage[tuple[str, Any]]]] = {car: [] for car in cars}
    left_out = LeftOut()
    for car, message in _messages(session, selection, expression, left_out):
        messages[car].append(message)
    hits: list[Hit] = []
    longest_s = -1.0
    for car, every in messages.items():
        run = ConditionRun(expression, car, for_s)
        for ahead_ns, each in as_published(every):
            topic, message = each.item
            if each.at_ns + ahead_ns >= since_ns or topic in (MODE.name, COMMANDS.name):
                run.add(topic, message, each.at_ns, ahead_ns)
        hits += run.close()
        longest_s = max(longest_s, run.longest_s)
    return Found(sorted(hits, key=lambda hit: (hit.begin_ns, hit.car)), longest_s, left_out)


def _messages(
    session: Session, selection: Selection, expression: Expression, left_out: LeftOut
) -> Iterator[tuple[str, RecordedMessage[tuple[str, Any]]]]:
    """Yield each message with its car. Leave out messages of the condition's topics that have none of its values."""
    names: dict[str, list[str]] = {}
    for name in expression.names:
        names.setdefault(topic_of(name), []).append(name)
    decoder = MessageDecoder()
    for info, _, log_ns, publish_ns, data in session.rows(selection):
        key, message = keys.parse(info.channel.topic), decoder.message(info, data)
        if key is None:
            continue
        cause = _why_left_out(info, decoder, message, key.topic, names.get(key.topic, ()))
        if cause is not None:
            if key.topic in names:
                left_out.add(info.channel.topic, cause)
            continue
        stream = info.channel.topic, text_of(message, "boot_id")
        at_ns = message_time_ns(message, publish_ns)
        yield key.car, RecordedMessage(log_ns, at_ns, stream, number_of(message, "seq"), (key.topic, message))


def _why_left_out(
    info: ChannelInfo, decoder: MessageDecoder, message: Any, topic: str, names: Collection[str]
) -> LeftOutCause | None:
    """Return why a message has no value of these names. None if it has one, or if its topic has none of the names."""
    if message is None:
        return why_not_decoded(decoder, info)
    if message.DESCRIPTOR.full_name != TOPICS[topic].message:
        return LeftOutCause.OTHER_TYPE
    return None if not names or any(is_in(name, message) for name in names) else LeftOutCause.OTHER_FIELD
