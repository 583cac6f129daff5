"""Publications and replies as values, and size limits of queries."""

import time
from contextlib import suppress
from typing import TYPE_CHECKING, Any, Final, NamedTuple

import zenoh

from schemas import topics

if TYPE_CHECKING:  # a gateway joins the bus before it imports protobuf
    from collections.abc import Iterable, Iterator

    from google.protobuf.message import Message


# Parsing 5 MB of JSON stalls a process for a second.
LARGEST_PAYLOAD: Final = 1 << 16
"""Maximum size of a command's payload in bytes. Larger ones are rejected without parsing."""

LONGEST_SELECTOR: Final = 4096
"""Maximum length of a query's selector (key and parameters), and of its encoding."""


class Sample(NamedTuple):
    """One publication or reply, with the payload's bytes."""

    key: str
    payload: bytes
    encoding: str
    time_ns: int
    """Zenoh timestamp of the publisher's session, ns since the epoch. The time of receipt if there is none."""
    sequence: int
    """The publisher's sequence number for the key, modulo 2^32. 0 if there is none."""
    deleted: bool = False
    why_unread: str = ""
    """The reason if the payload was not read because it is too large. Empty if it was read."""

    def message(self) -> "Message":
        """Parse the payload as the message that the encoding names. Raises messages.BadPayload or KeyError."""
        from schemas import messages

        name = messages.name_in(self.encoding)
        if name is None:
            raise messages.BadPayload(f"{self.key}: encoding {self.encoding!r} names no message")
        # Anybody may publish any message under any key, but readers use the fields of the topic's message. So parse the
        # payload as the topic's message.
        topic = topics.of_key(self.key)
        return messages.parse(name if topic is None else topic.message, self.payload, self.encoding)


class Failure(NamedTuple):
    """An error reply, or the end of a query that nobody has answered in time."""

    words: str

    @property
    def is_timeout(self) -> bool:
        """True if nobody has answered in time."""
        return self.words == "Timeout"  # Zenoh's word


def messages_of(answers: "Iterable[Sample | Failure]") -> "Iterator[Any]":
    """Yield the messages of answers. Skip error replies, and replies of foreign programs."""
    for answer in answers:
        if isinstance(answer, Sample):
            with suppress(ValueError, KeyError):  # messages.BadPayload is a ValueError
                yield answer.message()


def sequence_of(info: zenoh.SourceInfo) -> int:
    """Return a publisher's sequence number for a key, from 1, modulo 2^32. Zenoh counts from 0."""
    return (int(info.source_sn) + 1) & 0xFFFFFFFF


def session_of(sample: zenoh.Sample) -> str:
    """Return the id of the Zenoh session that published a sample. Return an empty text if the sample does not say."""
    info = sample.source_info
    return "" if info is None else str(info.source_id.zid)


def sample_of(sample: zenoh.Sample, largest: int | None = None) -> Sample:
    """Convert a Zenoh sample. `largest` is the maximum size of the payload in bytes."""
    stamp = sample.timestamp
    info = sample.source_info
    why_unread = "" if largest is None else _too_many_bytes(len(sample.payload), largest)
    return Sample(
        key=str(sample.key_expr),
        payload=b"" if why_unread else sample.payload.to_bytes(),
        encoding=str(sample.encoding),
        time_ns=stamp.get_time_as_ntp64().as_nanos() if stamp is not None else time.time_ns(),
        sequence=sequence_of(info) if info is not None else 0,
        deleted=sample.kind == zenoh.SampleKind.DELETE,
        why_unread=why_unread,
    )


def _too_many_bytes(size: int, largest: int) -> str:
    if size <= largest:
        return ""
    return f"a payload of {size} bytes is too large and was not read: the limit is {largest} bytes"


def why_unread(query: zenoh.Query) -> str:
    """Return why a query is not read: some part of it is too large. Return an empty string if all parts fit."""
    payload = query.payload
    if payload is not None and (words := _too_many_bytes(len(payload), LARGEST_PAYLOAD)):
        return words
    longest = max(len(str(query.selector)), len(str(query.encoding)) if query.encoding is not None else 0)
    if longest > LONGEST_SELECTOR:
        return f"a key, parameters or an encoding of {longest} characters is too long: the limit is {LONGEST_SELECTOR}"
    return ""
