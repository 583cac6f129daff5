"""Serves a fleet live to Foxglove. Each message of the bus appears on a topic named like its key, with its schema.

The server accepts no messages from Foxglove. The topics are the same as those that `fleet sessions export --foxglove`
writes, so one layout shows both. Nobody who is slow, or publishes nonsense, may delay the others. If a client of
Foxglove does not read, the SDK drops its oldest messages, and no other client notices. If we are slower than the bus,
Zenoh's queue for us fills, and the hub drops messages for us. If a program publishes messages that are not protobuf of
this version, they are counted, and named at the end. The number of topics is bounded.

The SDK (0.30) tells its clients of a new channel a moment before it knows the channel itself. A client that subscribes
at once is refused, and does not try again. So a channel that refused somebody is closed and opened under a new number.
"""

import logging
import re
import time
from collections import Counter, deque
from collections.abc import Callable, Container
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
"""The port that Foxglove suggests."""
BACKLOG_SIZE: Final = 1024
"""Maximum number of messages that wait for one client. Beyond it, the oldest are dropped."""
MAX_FOXGLOVE_TOPICS: Final = 8192
"""Maximum number of topics: all topics of 256 cars, and some thousand topics of other programs."""
MAX_NAMED_KEYS: Final = 1024
"""Maximum number of keys whose left-out messages are counted separately."""
OTHER_KEYS: Final = "other keys"
_QUEUE_SIZE: Final = 16_384
"""Maximum number of messages in the queue of one subscription: three seconds of 100 cars."""
_MAX_BATCH: Final = 4096
MAX_REOPENED: Final = 10
"""Maximum number of times that a topic gets a new channel. A bad client could cause refusals without end."""
_REFUSED: Final = re.compile(r"subscribe to unknown channel: (\d+)")
"""The SDK's log message about a client that it refused."""
_LAST_TIMEOUT_S: Final = 3.0
"""Timeout for the last message of a topic that is published only on change. If nobody can answer, the query ends at
once."""

# Do not print the SDK's log. It has an error for each message to a client that has gone without closing its connection.
_sdk_log = logging.getLogger("foxglove")
_sdk_log.propagate = False
_sdk_log.addHandler(logging.NullHandler())


class PortInUse(Exception):
    """The server cannot listen on its port. The message says why."""


class FoxgloveServer:
    """Serves one fleet from the constructor until `close`.

    `step` passes on the messages that have come since the last step.
    """

    def __init__(self, client: Fleet, address: str, port: int, backlog: int = BACKLOG_SIZE) -> None:
        self._client = client
        self._context = foxglove.Context()
        self._channels: dict[str, foxglove.Channel] = {}
        self._last: dict[str, tuple[bytes, int]] = {}
        """The last message of each topic of states or events, and its time."""
        self._names = TopicNames()
        self._topics: dict[int, str] = {}
        """The topic of each channel, by the channel's number."""
        self._reopened: Counter[str] = Counter()
        """How often each topic got a new channel."""
        self.left_out = LeftOut()
        """Messages that have no topic."""
        self._listener = _Listener(self._on_subscribe)
        try:
            self._server = foxglove.start_server(
                name=f"{keys.describe_fleet(client.name)} (live)",
                host=address,
                port=port,
                capabilities=[],  # clients may not publish, call or set anything
                server_listener=self._listener,
                message_backlog_size=backlog,
                context=self._context,
            )
        except RuntimeError as error:  # the SDK's FoxgloveError
            raise PortInUse(str(error).partition(": ")[2] or str(error)) from None
        self._refusals = _Refusals()
        self._subscribers = [
            client.bus.subscribe_channel(expression, _QUEUE_SIZE) for expression in keys.recorded_keys(client.name)
        ]
        for topic in ON_CHANGE_TOPICS:
            for answer in client.bus.query(f"{client.name}/{topic}", timeout_s=_LAST_TIMEOUT_S):
                if isinstance(answer, Sample):
                    self._log(answer)

    @property
    def port(self) -> int:
        """Return the port that the server listens on."""
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
        self._reopen_refusing()
        return count

    def close(self) -> None:
        """End the connections of all clients."""
        for subscriber in self._subscribers:
            subscriber.undeclare()
        self._server.stop()
        self._refusals.close()

    def _log(self, sample: Sample) -> None:
        if sample.deleted:
            return
        channel = self._channel(sample)
        if isinstance(channel, LeftOutCause):
            known = len(self.left_out.counts) < MAX_NAMED_KEYS or (sample.key, channel) in self.left_out.counts
            self.left_out.add(sample.key if known else OTHER_KEYS, channel)
            return
        now_ns = time.time_ns()
        # A client learns of a topic by its first message, so it subscribes only after this message was sent. Store the
        # message before it is sent: a client that subscribes in between then gets it twice rather than not at all.
        if self._is_kept(sample):
            self._last[channel.topic()] = sample.payload, now_ns
        channel.log(sample.payload, log_time=now_ns)

    @staticmethod
    def _is_kept(sample: Sample) -> bool:
        topic = topics.of_key(sample.key)
        return topic is not None and topic.qos is Qos.STATE and len(sample.payload) <= LARGEST_PAYLOAD

    def _channel(self, sample: Sample) -> "foxglove.Channel | LeftOutCause":
        """Return the channel of a message, or why the message has none."""
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
            self._channels[topic] = self._open(topic, foxglove.Schema(name=kind, encoding="protobuf", data=schema[2]))
        return self._channels[topic]

    def _open(self, topic: str, schema: foxglove.Schema | None) -> foxglove.Channel:
        opened = foxglove.Channel(topic, schema=schema, message_encoding="protobuf", context=self._context)
        self._topics[opened.id()] = topic
        return opened

    def _reopen_refusing(self) -> None:
        """Open a new channel for each topic whose channel refused a client. The SDK tells all clients of it."""
        for number in self._refusals.take(self._topics):
            topic = self._topics[number]
            if self._reopened[topic] == MAX_REOPENED:
                continue
            self._reopened[topic] += 1
            del self._topics[number]
            old = self._channels[topic]
            schema = old.schema()
            old.close()  # else the SDK would not create a new channel
            self._channels[topic] = self._open(topic, schema)
            self._repeat_last(topic)  # clients of the new channel may not have it yet

    def _on_subscribe(self, client: Client, channel: ChannelView) -> None:
        """Send the last message to a client that subscribes to states or events. Runs on a thread of the SDK."""
        self._repeat_last(channel.topic, client.id)

    def _repeat_last(self, topic: str, client: int | None = None) -> None:
        """Send the last message of a topic of states or events to one client, or to all that subscribe."""
        if (last := self._last.get(topic)) is not None:
            payload, at_ns = last
            self._channels[topic].log(payload, log_time=at_ns, sink_id=client)


class _Listener(ServerListener):
    """Tells the server which client subscribes to which channel."""

    def __init__(self, on_subscribe: Callable[[Client, ChannelView], object]) -> None:
        self._on_subscribe = on_subscribe

    def on_subscribe(self, client: Client, channel: ChannelView) -> None:
        """Call the function for subscriptions."""
        self._on_subscribe(client, channel)


class _Refusals(logging.Handler):
    """Collects from the SDK's log the channels that refused a client."""

    MAX_REFUSALS: Final = 1024

    def __init__(self) -> None:
        super().__init__()
        self._found: deque[int] = deque(maxlen=self.MAX_REFUSALS)
        _sdk_log.addHandler(self)

    def emit(self, record: logging.LogRecord) -> None:
        """Note the channel of a refusal. Runs on a thread of the SDK."""
        if found := _REFUSED.search(record.getMessage()):
            self._found.append(int(found[1]))

    def take(self, known: Container[int]) -> set[int]:
        """Return those of the `known` channels that refused a client.

        Keep the refusals of other channels, which may become known soon.
        """
        found = [self._found.popleft() for _ in range(len(self._found))]
        self._found.extend(each for each in found if each not in known)
        return {each for each in found if each in known}

    def close(self) -> None:
        """Stop collecting."""
        _sdk_log.removeHandler(self)
        super().close()


def layout_now(client: Fleet) -> str:
    """Return a layout for the cars that are on the bus now."""
    return layout_text(client.cars(), client.name)
