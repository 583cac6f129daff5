"""Writes a session as one MCAP file in which each topic has one schema, as Foxglove and PlotJuggler expect it.

A message whose type does not fit its key, or whose schema is not the first one of its key, gets another topic:
`stray/KEY/TYPE`. Nothing else changes: payloads, times, sequences, attachments and metadata are those of the session.
"""

from collections.abc import Iterable
from copy import copy
from itertools import chain
from pathlib import Path

from msgspec import Struct, field

from fleet.recording.left_out import LeftOut, LeftOutCause
from fleet.recording.reading.mcap_copy import McapCopy
from fleet.recording.reading.mcap_reader import ChannelInfo, Extra, Row
from fleet.recording.reading.message_decoder import message_of
from fleet.recording.tools.table_export import numbered, own_type
from schemas import keys

_Schema = tuple[str | bytes, ...]
"""Encoding of the messages, then name, encoding and data of their schema if there is one."""


class TopicNames(Struct):
    """Names topics for Foxglove, so that each has one schema. Used for sessions and for a live fleet."""

    schemas: dict[str, _Schema] = field(default_factory=dict)
    """Schema by topic."""

    @property
    def fleet(self) -> str:
        """Return the name of the fleet."""
        return next((key.fleet for key in self._own_keys()), keys.DEFAULT_FLEET)

    @property
    def cars(self) -> list[str]:
        """Return the names of the fleet's cars that have a topic."""
        return sorted({key.car for key in self._own_keys() if key.fleet == self.fleet and not key.car.startswith("@")})

    def _own_keys(self) -> list[keys.Key]:
        return [parsed for topic in self.schemas if own_type(topic) and (parsed := keys.parse(topic)) is not None]

    def name(self, key: str, kind: str, encoding: str, *schema: str | bytes) -> str:
        """Return the topic of a message of a type: its key, or `stray/KEY/TYPE` if the key has another schema."""
        found = (encoding, *schema)
        own = own_type(key)
        strays = numbered(f"stray/{key}/{kind or encoding or 'unknown'}", "-")
        names = strays if own and kind != own else chain((key,), strays)
        return next(name for name in names if self.schemas.setdefault(name, found) == found)


class OneSchema(TopicNames):
    """Counts and topics of a written file."""

    messages: int = 0
    strays: LeftOut = field(default_factory=LeftOut)
    """Messages with a topic of their own, by key."""

    def topic_of(self, info: ChannelInfo) -> str:
        """Return the topic of a channel."""
        schema = () if (each := info.schema) is None else (each.name, each.encoding, each.data)
        return self.name(info.channel.topic, message_of(info), info.channel.message_encoding, *schema)


def write(rows: Iterable[Row], extras: Iterable[Extra], out: Path) -> OneSchema:
    """Write a new file. Raises OSError."""
    done = OneSchema()
    renamed: dict[int, tuple[ChannelInfo, ChannelInfo]] = {}
    with McapCopy(out) as file:
        file.add_extras(extras)
        for info, sequence, log_ns, publish_ns, payload in rows:
            # The stored channel keeps its id from being reused.
            if id(info) not in renamed:
                renamed[id(info)] = (info, _renamed(info, done.topic_of(info)))
            new = renamed[id(info)][1]
            if new is not info:
                done.strays.add(info.channel.topic, LeftOutCause.OTHER_TYPE)
            file.add((new, sequence, log_ns, publish_ns, payload))
        done.messages = file.messages
    return done


def _renamed(info: ChannelInfo, topic: str) -> ChannelInfo:
    if topic == info.channel.topic:
        return info
    channel = copy(info.channel)
    channel.topic = topic
    return info._replace(channel=channel)
