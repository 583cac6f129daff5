"""Serves a fleet live to Foxglove: each message of the bus on a topic of its key, with its schema. It takes none.

The topics are those that `fleet sessions export --foxglove` writes, so one layout shows both. Three parties may be slow
or odd, and none may hold up the others. A client of Foxglove that does not read loses its oldest messages, which the
SDK drops, and no other client notices. If we are behind the bus, Zenoh's queue for us fills and the hub drops what is
for us. A program that publishes nonsense gets a topic of its own, or none: what is not protobuf of this version is
counted and named at the end, and the number of topics is bounded.
"""

import logging
import time
from collections.abc import Callable
from typing import Final

import foxglove
from foxglove.websocket import ChannelView, Client, ServerListener
from google.protobuf.message import DecodeError

from fleet.client.client import Fleet
from fleet.recording.left_out import LeftOut, LeftOutCause
from fleet.recording.tools.one_schema import TopicNames
from fleet.replay.foxglove_layout import layout_text
from fleet.replay.panels import ON_CHANGE_TOPICS
from schemas import keys, messages, topics
from schemas.bus import LARGEST_PAYLOAD, Sample, sample_of
from schemas.topics import Qos

DEFAULT_FOXGLOVE_PORT: Final = 8765
"""Foxglove offers this port by itself."""
BACKLOG_SIZE: Final = 1024
"""Maximum messages that wait for one client. Beyond it, its oldest are dropped."""
MAX_FOXGLOVE_TOPICS: Final = 8192
"""Maximum topics: 256 cars with all of theirs, and some thousand of strangers."""
MAX_NAMED_KEYS: Final = 1024
"""Maximum keys whose left-out messages are counted singly."""
OTHER_KEYS: Final = "other keys"
_QUEUE_SIZE: Final = 16_384
"""Maximum messages in the queue of one subscription: three seconds of 100 cars."""
_MAX_BATCH: Final = 4096
_LAST_TIMEOUT_S: Final = 3.0
"""Timeout for the last message of a topic that is published on change. If nobody answers, no time passes."""

# The SDK logs an error for each message to a client that has gone without a word.
logging.getLogger("foxglove").setLevel(logging.CRITICAL + 1)


class PortInUse(Exception):
    """The server cannot listen. The message says why."""


class FoxgloveServer:
    """Serves one fleet from its making to `close`. `step` passes on what has come since."""

    def __init__(self, client: Fleet, address: str, port: int, backlog: int = BACKLOG_SIZE) -> None:
        self._client = client
        self._context = foxglove.Context()
        self._channels: dict[str, foxglove.Channel] = {}
        self._last: dict[int, tuple[bytes, int]] = {}
        """Last message and its time by channel, of states and events."""
        self._names = TopicNames()
        self.left_out = LeftOut()
        """Messages that have no topic."""
        self._listener = _Listener(self._on_subscribe)
        try:
            self._server = foxglove.start_server(
                name=f"{keys.describe_fleet(client.name)} (live)",
                host=address,
                port=port,
                capabilities=[],  # nobody may publish, call or set anything here
                server_listener=self._listener,
                message_backlog_size=backlog,
                context=self._context,
            )
        except RuntimeError as error:  # the SDK's FoxgloveError
            raise PortInUse(str(error).partition(": ")[2] or str(error)) from None
        self._subscribers = [
            client.bus.subscribe_channel(expression, _QUEUE_SIZE) for expression in keys.recorded_keys(client.name)
        ]
        for topic in ON_CHANGE_TOPICS:
            for answer in client.bus.query(f"{client.name}/{topic}", timeout_s=_LAST_TIMEOUT_S):
                if isinstance(answer, Sample):
                    self._log(answer)

    @property
    def port(self) -> int:
        """Return the port that it listens on."""
        return self._server.port

    def step(self) -> int:
        """Pass on the messages that have come. Return their number."""
        count = 0
        for subscriber in self._subscribers:
            for _ in range(_MAX_BATCH):
                if (sample := subscriber.try_recv()) is None:
                    break
                count += 1
                self._log(sample_of(sample))
        return count

    def close(self) -> None:
        """End the connections of all clients."""
        for subscriber in self._subscribers:
            subscriber.undeclare()
        self._server.stop()

    def _log(self, sample: Sample) -> None:
        if sample.deleted:
            return
        channel = self._channel(sample)
        if isinstance(channel, LeftOutCause):
            known = len(self.left_out.counts) < MAX_NAMED_KEYS or (sample.key, channel) in self.left_out.counts
            self.left_out.add(sample.key if known else OTHER_KEYS, channel)
            return
        now_ns = time.time_ns()
        # A client learns of a topic by its first message, and subscribes when it has passed. Keep the message before it
        # goes out, so that who subscribes meanwhile gets it twice rather than not at all.
        if self._is_kept(sample):
            self._last[channel.id()] = sample.payload, now_ns
        channel.log(sample.payload, log_time=now_ns)

    @staticmethod
    def _is_kept(sample: Sample) -> bool:
        topic = topics.of_key(sample.key)
        return topic is not None and topic.qos is Qos.STATE and len(sample.payload) <= LARGEST_PAYLOAD

    def _channel(self, sample: Sample) -> "foxglove.Channel | LeftOutCause":
        """Return the channel of a message, or why it has none."""
        kind = messages.name_in(sample.encoding)
        if kind is None:
            return LeftOutCause.NOT_PROTOBUF
        try:
            messages.message_class(kind).FromString(sample.payload)
        except KeyError:
            return LeftOutCause.BAD_SCHEMA
        except DecodeError:
            return LeftOutCause.UNREADABLE
        schema = (kind, "protobuf", messages.descriptor_set(kind))
        if len(self._channels) >= MAX_FOXGLOVE_TOPICS and sample.key not in self._channels:
            return LeftOutCause.TOO_MANY_TOPICS
        topic = self._names.name(sample.key, kind, "protobuf", *schema)
        if topic not in self._channels:
            made = foxglove.Schema(name=kind, encoding="protobuf", data=schema[2])
            self._channels[topic] = foxglove.Channel(
                topic, schema=made, message_encoding="protobuf", context=self._context
            )
        return self._channels[topic]

    def _on_subscribe(self, client: Client, channel: ChannelView) -> None:
        """Give a new client the last message of a state or event. Runs on a thread of the SDK."""
        if (last := self._last.get(channel.id)) is None:
            return
        payload, at_ns = last
        self._channels[channel.topic].log(payload, log_time=at_ns, sink_id=client.id)


class _Listener(ServerListener):
    """Passes on who subscribes to what."""

    def __init__(self, on_subscribe: Callable[[Client, ChannelView], object]) -> None:
        self._on_subscribe = on_subscribe

    def on_subscribe(self, client: Client, channel: ChannelView) -> None:
        """Pass it on."""
        self._on_subscribe(client, channel)


def layout_now(client: Fleet) -> str:
    """Return a layout for the cars that are on the bus now."""
    return layout_text(client.cars(), client.name)
