"""Finds gaps in the numbers that publishers gave to recorded messages. Pure."""

from collections.abc import Mapping

from google.protobuf.message import Message

from fleet.recording.foreign_fields import number_of, text_of
from fleet.recording.reading.mcap_reader import Row
from fleet.recording.reading.message_decoder import MessageDecoder
from fleet.recording.sequence_tracker import PublisherSequence


class NumberGaps:
    """The numbers of the messages of a session, by key and publisher.

    The number is that of the message itself (`seq`), which counts from the start of its publisher (`boot_id`), or else
    Zenoh's. A message without a number is in no gap.
    """

    def __init__(self) -> None:
        self._decoder = MessageDecoder()
        self.streams: dict[tuple[str, str], PublisherSequence] = {}
        """By key and publisher: its `boot_id` or `sender`, or an empty text."""

    def add(self, row: Row) -> None:
        """Add the next message in the order of the file."""
        self.add_decoded(row, self._decoder.message(row[0], row[4]))

    def add_decoded(self, row: Row, message: Message | None) -> tuple[str, bool]:
        """Add the next message, and return its publisher and whether it is the newest one.

        `message` is None if it cannot be decoded.
        """
        info, sequence, log_ns, publish_ns, _ = row
        boot = text_of(message, "boot_id")
        publisher = boot or text_of(message, "sender")
        own = number_of(message, "seq") if boot else 0
        if not (number := own or sequence):
            return publisher, True
        stream = self.streams.get((info.channel.topic, publisher))
        if stream is None:
            stream = self.streams[info.channel.topic, publisher] = PublisherSequence(restarts=not own)
        return publisher, stream.add(number, log_ns, publish_ns)

    def missing(self) -> Mapping[str, int]:
        """Return the number of missing messages by key, without keys that miss none."""
        found: dict[str, int] = {}
        for (key, _), stream in sorted(self.streams.items()):
            if stream.missing:
                found[key] = found.get(key, 0) + stream.missing
        return found
