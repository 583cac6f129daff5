"""Finds what was known at one moment of a session: the newest message of each key, and the session's lanes.

The moment is by the recorder's clock, as `start_ns` and `end_ns` of `Session.messages`, because the clocks of gateways
may be wrong and differ. A message that the recorder had not received by then is not known yet. Of the messages that it
had received, the one that was published last counts, as in the tables: a backfilled message is received late, although
it is old.
"""

from collections.abc import Iterable, Iterator, Mapping
from contextlib import suppress
from typing import Any, Final

from google.protobuf.message import DecodeError
from msgspec import Struct

from fleet.recording.reading.mcap_reader import Row
from fleet.recording.reading.message_decoder import message_of
from fleet.recording.reading.session import Session
from fleet.recording.selection import Selection
from fleet.recording.tools.car_timeline import STATE_BEFORE_NS
from fleet.recording.tools.lanes import LANE_TOPICS, MARK_TOPIC, Lanes
from schemas import keys, messages
from schemas.topics import TOPICS


class Known(Struct, frozen=True):
    """A message that was known. Times: ns, by the recorder's and by the publisher's clock."""

    key: keys.Key
    message: Any
    log_ns: int
    publish_ns: int


def known_at(session: Session, at_ns: int, *, before_ns: int = STATE_BEFORE_NS) -> list[Known]:
    """Return, of the messages of each key that were recorded up to a moment, the one that was published last.

    They are sorted by the time at which they were recorded. Only the time `before_ns` before the moment is searched.
    Gateways repeat their states each second, so older states are no longer in force. Messages that are not of their
    key's type are left out.
    """
    newest = newest_rows(session.rows(Selection(None, at_ns - before_ns + 1, at_ns + 1)))
    return sorted(_decoded(newest.values()), key=lambda each: each.log_ns)


def newest_rows(rows: Iterable[Row]) -> Mapping[str, Row]:
    """Return the row of each key that was published last.

    If two were published at one time, the later one in the file counts. Pure.
    """
    newest: dict[str, Row] = {}
    for row in rows:
        topic = row[0].channel.topic
        before = newest.get(topic)
        if before is None or row[3] >= before[3]:
            newest[topic] = row
    return newest


def read_between(session: Session, expressions: tuple[str, ...], from_ns: int, to_ns: int) -> Iterator[Known]:
    """Yield the messages of some keys from `from_ns` to `to_ns`, both included, as they were recorded."""
    yield from _decoded(session.rows(Selection(expressions, from_ns, to_ns + 1)))


def thinned(session: Session, expressions: tuple[str, ...], from_ns: int, to_ns: int, step_ns: int) -> Iterator[Known]:
    """Yield messages as `read_between` does, but at most one of each key in each step of time."""
    yield from _decoded(one_a_step(session.rows(Selection(expressions, from_ns, to_ns + 1)), step_ns))


def one_a_step(rows: Iterable[Row], step_ns: int) -> Iterator[Row]:
    """Yield the first row of each key in each step of time. Pure."""
    taken: dict[str, int] = {}
    for row in rows:
        topic, step = row[0].channel.topic, row[2] // step_ns
        if taken.get(topic) != step:
            taken[topic] = step
            yield row


def newest_of(session: Session, expressions: tuple[str, ...], at_ns: int) -> list[Known]:
    """Return the newest message of some keys up to a moment, however old.

    Use it for keys that are seldom published.
    """
    return list(_decoded(newest_rows(session.rows(Selection(expressions, 0, at_ns + 1))).values()))


def lanes_of(session: Session) -> Lanes:
    """Return the lanes and marks of a whole session. `session.damage` then lists the parts that could not be read."""
    expressions = (*(f"*/*/{topic}" for topic in LANE_TOPICS), f"*/{MARK_TOPIC}")
    lanes = Lanes()
    for each in read_between(session, expressions, 0, _LATEST_NS):
        if each.key.topic in LANE_TOPICS:
            lanes.add(each.key.car, each.key.topic, each.message, each.log_ns)
        else:
            lanes.add("", MARK_TOPIC, each.message, each.log_ns)
    return lanes


_LATEST_NS: Final = 2**63 - 2
"""Later than any time of a real clock: the year 2262."""


def _decoded(rows: Iterable[Row]) -> Iterator[Known]:
    yield from (known for row in rows if (known := known_message(row)) is not None)


def known_message(row: Row) -> Known | None:
    """Return the message of a row, decoded with our own class, or None if it is not of its key's type.

    A message of an older version lacks fields, which then have their default values. That works because a schema only
    gains fields.
    """
    info, _, log_ns, publish_ns, data = row
    key = keys.parse(info.channel.topic)
    topic = None if key is None else TOPICS.get(key.topic) or TOPICS.get(f"{key.car}/{key.topic}")
    if key is None or topic is None or message_of(info) != topic.message:
        return None
    with suppress(DecodeError):
        return Known(key, messages.message_class(topic.message).FromString(data), log_ns, publish_ns)
    return None
