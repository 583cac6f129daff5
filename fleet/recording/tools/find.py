"""Finds when a condition of a plan held in a session. `ConditionRun` is pure; `find_in` reads the messages.

The meaning is that of plans and of `fleet wait --for`: `Holding` evaluates both. Names are those of plans. A value that
was not measured is unknown, and so is a stale one. A hit lasts from the first reading to the last one that shows it:
what nobody measured between two readings counts, unless a value got stale there. So a gap is never true.
"""

from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any, Final

from fleet.conditions import Expression, value_in
from fleet.conditions.expression import KINDS
from fleet.conditions.holding import HeldSpan, Holding
from fleet.policy.car_condition import holding_of
from fleet.policy.snapshot import NAMES, topic_of
from fleet.recording.reading.message_decoder import MessageDecoder
from fleet.recording.reading.session import Session
from fleet.recording.selection import Selection
from fleet.recording.tools.car_timeline import message_time_ns
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


@dataclass(slots=True)
class ConditionRun:
    """The hits of one car, from its messages in the order of their times."""

    expression: Expression
    car: str
    for_s: float = 0.0
    """Minimum length of a hit, s."""
    hits: list[Hit] = field(default_factory=list)
    _holding: Holding = field(init=False)
    _mode: str = ""
    _command: str = ""
    _at_begin: tuple[str, str] = ("", "")
    """Mode and command when the current hit began."""

    def __post_init__(self) -> None:
        self._holding = holding_of(self.expression)

    def command(self, words: str) -> None:
        """Note the last command."""
        self._command = words

    def mode(self, word: str) -> None:
        """Note the commanded mode."""
        self._mode = word

    def add(self, topic: str, fields: Mapping[str, object], at_ns: int) -> None:
        """Take in the values of one reading. `topic`: one that the condition uses."""
        before = self._holding.span
        self._keep(self._holding.add(topic, fields.get, at_ns).ended)
        span = self._holding.span
        if span is not None and (before is None or span.begin_ns != before.begin_ns):
            self._at_begin = self._mode, self._command

    def close(self) -> list[Hit]:
        """Return all hits. The last one ends with the last reading."""
        self._keep(self._holding.end())
        return self.hits

    def _keep(self, span: HeldSpan | None) -> None:
        if span is not None and span.length_s >= self.for_s:
            self.hits.append(Hit(self.car, *span, *self._at_begin))


def find_in(
    session: Session, expression: Expression, cars: Collection[str], for_s: float = 0.0, since_ns: int = 0
) -> list[Hit]:
    """Return the hits of these cars in a session, sorted by time. `session.damage` then has what could not be read."""
    topics = {topic_of(name) for name in expression.names}
    members = {topic: [name for name in expression.names if topic_of(name) == topic] for topic in topics}
    wanted = sorted({*topics, MODE.name, COMMANDS.name})
    selection = Selection(tuple(f"*/{car}/{topic}" for car in cars for topic in wanted))
    runs: dict[str, ConditionRun] = {}
    # Backfilled messages are late in the file, so all are sorted by their times.
    for at_ns, car, topic, message in sorted(_messages(session, selection), key=lambda each: each[0]):
        run = runs.setdefault(car, ConditionRun(expression, car, for_s))
        # The schema is that of the recording, and may lack a field.
        if topic == COMMANDS.name and getattr(message, "phase", "") == Phase.SENT:
            run.command(asked_by(message))
        if topic == MODE.name:
            run.mode(getattr(message, "asked", ""))
        if topic in topics and at_ns >= since_ns:
            run.add(topic, _fields(message, members[topic]), at_ns)
    return sorted((hit for run in runs.values() for hit in run.close()), key=lambda hit: (hit.begin_ns, hit.car))


def _messages(session: Session, selection: Selection) -> Iterator[tuple[int, str, str, Any]]:
    decoder = MessageDecoder()
    for info, _, _, publish_ns, data in session.rows(selection):
        key, message = keys.parse(info.channel.topic), decoder.message(info, data)
        if key is None or message is None or message.DESCRIPTOR.full_name != TOPICS[key.topic].message:
            continue  # a message of another type has no fields of the condition
        yield message_time_ns(message, publish_ns), key.car, key.topic, message


def _fields(message: Any, names: Collection[str]) -> dict[str, object]:
    """Return the measured values by name. A field that the schema of the recording has not is not measured."""
    found: dict[str, object] = {}
    for name in names:
        member = name.partition(".")[2]
        value = value_in(message)(member) if member in message.DESCRIPTOR.fields_by_name else None
        if value is not None and KINDS.get(type(value)) is KINDS[NAMES[name]]:
            found[name] = value
    return found
