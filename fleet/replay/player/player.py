"""Replays a session on the bus under another fleet name, with its payloads, encodings and sequence numbers unchanged.

Readers see a normal fleet: cars have tokens, and queries return the latest values. The player rejects every command,
and never publishes messages recorded under `@cmd`, so that no gateway can obey a recording.
"""

import queue
import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from typing import Any, Final

import zenoh

from fleet.recording.left_out import LeftOut, LeftOutCause
from fleet.recording.reading.session import Recorded
from fleet.replay.player.schedule import Schedule
from schemas import keys, messages, topics
from schemas.bus import Bus, HubKeeper, is_json_wanted, reply_message, reply_value
from schemas.commands import COMMANDS
from schemas.gen import fleet_v1_pb2 as pb
from schemas.topics import Qos, Topic
from schemas.words import Phase, Reason

LOOP_PAUSE_NS: Final = 1_000_000_000
"""Pause between two rounds of a loop."""
MAX_LATENESS_S: Final = 0.25
_HUB_POLL_INTERVAL_S: Final = 0.1
_MAX_LISTED_TOKENS: Final = 4
_MAX_PLAYER_QUERIES: Final = 256
"""Maximum number of queries in the queue."""
MAX_KEY_BYTES: Final = 65_535
MAX_ENCODING_BYTES: Final = 255
"""Limits of Zenoh's library, which panics beyond them."""
_NOT_IN_KEYS: Final = frozenset("*$#?")
_RESERVED_CHARACTERS: Final = frozenset(" /*$#?")


class NameTaken(Exception):
    """The fleet name is in use. The message says by whom."""


@dataclass(slots=True)
class Player:
    """Publishes messages under another fleet name. `refuse` is the reason in the answer to commands."""

    bus: Bus
    name: str
    refuse: str
    cars_only: bool = False
    """True if only cars are replayed. Then the fleet may have a live coordinator and recorder."""
    published: int = 0
    late: int = 0
    """Messages published over MAX_LATENESS_S late: this machine or the bus was too slow for the rate."""
    left_out: LeftOut = field(default_factory=LeftOut)
    """Messages that were due, but could not be published."""
    _cars: list[str] = field(default_factory=list)
    _polled_s: float = 0.0
    _hub_keeper: HubKeeper = field(init=False)
    _latest: dict[tuple[str, str], tuple[bytes, str]] = field(default_factory=dict)
    """Latest value of each key. Of decisions, the latest one of each key and subject."""
    _inbox: "queue.Queue[zenoh.Query]" = field(default_factory=lambda: queue.Queue(_MAX_PLAYER_QUERIES))

    def __post_init__(self) -> None:
        self._hub_keeper = HubKeeper(self.bus.endpoint)

    def begin(self, session: str, cars: Iterable[str]) -> None:
        """Declare the tokens of these cars, and answer queries.

        Raises NameTaken if a fleet of this name exists already.
        """
        hint = "give this replay another name with --as"
        if playing := self.bus.tokens(keys.replay_token(self.name)):
            raise NameTaken(f"fleet {self.name} is a replay of {playing[0].rpartition('/')[2]} already: {hint}")
        if taken := sorted(token.partition("/")[2] for token in self._alive()):
            listed = ", ".join(taken[:_MAX_LISTED_TOKENS])
            more = f" and {len(taken) - _MAX_LISTED_TOKENS} more" if len(taken) > _MAX_LISTED_TOKENS else ""
            raise NameTaken(f"fleet {self.name} is alive ({listed}{more}): {hint}{self._or_cars_only(taken)}")
        for expression in ("*/*/*", "*/@cmd/*", "@coordinator/*", "@recorder/*", "@supervisor/*", "@sim/*"):
            self.bus.queryable(f"{self.name}/{expression}", self._on_query)
        title = "".join("_" if each in _RESERVED_CHARACTERS else each for each in session)
        self.bus.token(keys.replay_token(self.name, title))
        self._cars = sorted(car for car in cars if is_carried(keys.car_token(self.name, car)))
        for car in self._cars:
            self.bus.token(keys.car_token(self.name, car))

    def _alive(self) -> list[str]:
        """Return the tokens of live processes that publish what we would replay."""
        # `*` matches no part of a key that begins with @, so services are queried one by one.
        services = (keys.SUPERVISOR,) if self.cars_only else (keys.SUPERVISOR, keys.COORDINATOR, keys.RECORDER)
        of_services = (token for each in services for token in self.bus.tokens(f"{self.name}/{each}/**"))
        return [*self.bus.tokens(f"{self.name}/*"), *of_services]

    @staticmethod
    def _or_cars_only(taken: list[str]) -> str:
        tried = all(each.startswith((keys.COORDINATOR, keys.RECORDER)) for each in taken)
        return ", or play only the cars with --cars-only" if tried else ""

    def remember(self, recorded: Iterable[Recorded]) -> None:
        """Keep messages from before the start as the latest values, for answers to queries."""
        for message in recorded:
            key = self._key_of(message)
            if not isinstance(key, LeftOutCause):
                self._keep(key, message, _encoding(message))

    def play(
        self,
        recorded: Iterable[Recorded],
        schedule: Schedule,
        origin_s: float,
        ended: Callable[[], bool],
        progress: Callable[[Recorded], object],
    ) -> None:
        """Publish each message when it is due, until `ended()` is True.

        `origin_s` is when the schedule starts (monotonic clock).
        """
        for message in recorded:
            at_s = origin_s + schedule.due_s(message.recorded_ns)
            self.wait(at_s, ended)
            if ended():
                return
            if time.monotonic() - at_s > MAX_LATENESS_S:
                self.late += 1
            self._publish(message)
            progress(message)

    def wait(self, until_s: float, ended: Callable[[], bool]) -> None:
        """Answer queries until a time of the monotonic clock, and restart a crashed hub."""
        while not ended():
            now_s = time.monotonic()
            if now_s - self._polled_s > _HUB_POLL_INTERVAL_S:
                self._polled_s = now_s
                self._hub_keeper.check(connected=self.bus.connected)
            left_s = until_s - now_s
            try:
                query = (
                    self._inbox.get(timeout=min(left_s, _HUB_POLL_INTERVAL_S))
                    if left_s > 0
                    else self._inbox.get_nowait()
                )
            except queue.Empty:
                if left_s <= _HUB_POLL_INTERVAL_S:
                    return
            else:
                self._answer(query)

    def _key_of(self, message: Recorded) -> str | LeftOutCause:
        """Return the key under which a message is published, or why it is not."""
        key = keys.parse(message.key)
        if key is None or not key.topic:
            return LeftOutCause.NO_FLEET
        if key.topic.startswith("@cmd/"):
            return LeftOutCause.COMMAND
        written = f"{self.name}/{key.car}/{key.topic}"
        if not is_carried(written):
            return LeftOutCause.BAD_KEY
        # Zenoh's library panics if an encoding is longer.
        return LeftOutCause.LONG_ENCODING if len(_encoding(message).encode()) > MAX_ENCODING_BYTES else written

    def _publish(self, message: Recorded) -> None:
        written = self._key_of(message)
        if isinstance(written, LeftOutCause):
            self.left_out.add(message.key, written)
            return
        encoding = _encoding(message)
        topic = topics.of_key(written)
        self.bus.put_again(
            written, message.payload, encoding, message.sequence, Qos.READING if topic is None else topic.qos
        )
        self.published += 1
        self._keep(written, message, encoding)

    def _keep(self, key: str, message: Recorded, encoding: str) -> None:
        topic = topics.of_key(key)
        if topic is not None and topic.message == message.message and topic.family not in ("frame", "event", "sim"):
            self._latest[key, _subject(topic, message.payload)] = message.payload, encoding

    # ------------------------------------------------------------------ queries

    def _on_query(self, query: zenoh.Query) -> bool:
        """Queue a query, on a Zenoh thread. Return False if too many are pending."""
        try:
            self._inbox.put_nowait(query)
        except queue.Full:
            return False
        return True

    def _answer(self, query: zenoh.Query) -> None:
        with query:
            expression = str(query.key_expr)
            if "/@cmd/" in expression:
                self._refuse(query, expression.rpartition("/")[2])
                return
            for (key, _), (payload, _) in [*self._latest.items()]:
                topic = topics.of_key(key)
                if topic is not None and query.key_expr.intersects(key):
                    reply_value(query, key, payload, topic, express=False)

    def _refuse(self, query: zenoh.Query, verb: str) -> None:
        encoding = str(query.encoding) if query.encoding is not None else ""
        identity = _identity(verb, query, encoding)
        for car in (*self._cars, keys.COORDINATOR):
            key = keys.command_key(self.name, car, verb)
            if "*" in verb or not query.key_expr.intersects(key):
                continue
            result = pb.Result(
                id=identity, car=car, status=Phase.REJECTED, reason=Reason.UNSUPPORTED, words=self.refuse
            )
            reply_message(query, key, result, as_json=is_json_wanted(query))


def is_carried(key: str) -> bool:
    """Return True if Zenoh can publish on a key: no wildcards, no empty parts, none of # ? $, at most 65,535 bytes."""
    return len(key.encode()) <= MAX_KEY_BYTES and all(key.split("/")) and not set(key) & _NOT_IN_KEYS


def _encoding(message: Recorded) -> str:
    if message.message:
        return f"{topics.PROTOBUF};{message.message}"
    return messages.JSON if message.encoding == "json" else message.encoding


def _subject(topic: Topic, payload: bytes) -> str:
    """Return the subject of a decision, because each subject has its own latest value.

    Return an empty text for any other message.
    """
    if topic.message != "fleet.v1.Decision":
        return ""
    try:
        decision: Any = messages.parse(topic.message, payload, topic.encoding)
    except messages.BadPayload:
        return ""
    return str(decision.subject)


def _identity(verb: str, query: zenoh.Query, encoding: str) -> str:
    """Return the id that the sender gave a command, or an empty text if the command cannot be read."""
    if verb not in COMMANDS or query.payload is None:
        return ""
    try:
        command: Any = messages.parse(COMMANDS[verb].message, query.payload.to_bytes(), encoding)
    except messages.BadPayload:
        return ""
    return str(command.id)
