"""A session on the bus again, as a fleet of another name: payloads, encodings and numbers as they came.

It looks like a fleet to whoever reads: cars have tokens, and the latest values are there to be asked for. Nothing
takes a command: every one is refused, in words. What was recorded under `@cmd` is not published, so that no gateway,
now or later, can ever obey a recording.
"""

import contextlib
import queue
import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from typing import Any, Final

import zenoh

from fleet.recording.reading.session import Recorded
from fleet.replay.player.schedule import Schedule
from schemas import keys, messages, topics
from schemas.bus import Bus, BusError, ensure_hub, reply, reply_value
from schemas.gen import fleet_v1_pb2 as pb
from schemas.topics import Qos, Topic

PAUSE_NS: Final = 1_000_000_000
"""Between two rounds of a loop."""
LATE_S: Final = 0.25
_LOOK_S: Final = 0.1
_ALONE_S: Final = 0.5
_TOLD: Final = 4
_QUESTIONS: Final = 256
"""Queries that may wait."""
_SPARED: Final = frozenset(" /*$#?")


class NameTaken(Exception):
    """The fleet's name is in use; the text says by whom."""


@dataclass(slots=True)
class Player:
    """Publishes messages under another fleet's name. `refuse`: why a command is not accepted."""

    bus: Bus
    name: str
    refuse: str
    cars_only: bool = False
    """Whether the fleet may have a living coordinator and recorder, because those of the recording are silent."""
    published: int = 0
    late: int = 0
    """Messages that were published over LATE_S too late: this machine, or the bus, was too slow for the rate."""
    _cars: list[str] = field(default_factory=list)
    _looked_s: float = 0.0
    _alone_since_s: float | None = None
    _latest: dict[tuple[str, str], tuple[bytes, str]] = field(default_factory=dict)
    """By key, and of decisions by subject."""
    _inbox: "queue.Queue[zenoh.Query]" = field(default_factory=lambda: queue.Queue(_QUESTIONS))

    def begin(self, session: str, cars: Iterable[str]) -> None:
        """Be there, with these cars; raises NameTaken."""
        another = "give this one another name with --as"
        if playing := self.bus.tokens(f"{self.name}/{keys.REPLAY}/*"):
            raise NameTaken(f"fleet {self.name} is a replay of {playing[0].rpartition('/')[2]} already: {another}")
        if taken := sorted(token.partition("/")[2] for token in self._alive()):
            more = f" and {len(taken) - _TOLD} more" if len(taken) > _TOLD else ""
            raise NameTaken(
                f"fleet {self.name} is alive ({', '.join(taken[:_TOLD])}{more}): {another}{self._or_cars_only(taken)}"
            )
        for expression in ("*/*/*", "*/@cmd/*", "@coordinator/*", "@recorder/*", "@supervisor/*", "@sim/*"):
            self.bus.queryable(f"{self.name}/{expression}", self._ask)
        self.bus.token(f"{self.name}/{keys.REPLAY}/{''.join('_' if each in _SPARED else each for each in session)}")
        self._cars = sorted(cars)
        for car in self._cars:
            self.bus.token(keys.car_token(self.name, car))

    def _alive(self) -> list[str]:
        """Tokens of who says already what we are to say: `*` means no chunk that begins with @."""
        services = (keys.SUPERVISOR,) if self.cars_only else (keys.SUPERVISOR, keys.COORDINATOR, keys.RECORDER)
        of_services = (token for each in services for token in self.bus.tokens(f"{self.name}/{each}/**"))
        return [*self.bus.tokens(f"{self.name}/*"), *of_services]

    @staticmethod
    def _or_cars_only(taken: list[str]) -> str:
        tried = all(each.startswith((keys.COORDINATOR, keys.RECORDER)) for each in taken)
        return ", or only what cars said with --cars-only" if tried else ""

    def remember(self, recorded: Iterable[Recorded]) -> None:
        """What was said before the beginning is there to be asked for, as it was then."""
        for one in recorded:
            if (key := self._key_of(one)) is not None:
                self._keep(key, one, _encoding(one))

    def play(
        self,
        recorded: Iterable[Recorded],
        schedule: Schedule,
        origin_s: float,
        ended: Callable[[], bool],
        progress: Callable[[Recorded], object],
    ) -> None:
        """Publish each when it is due, counted from `origin_s` of the monotonic clock, until `ended` says so."""
        for one in recorded:
            at_s = origin_s + schedule.due_s(one.recorded_ns)
            self.wait(at_s, ended)
            if ended():
                return
            if time.monotonic() - at_s > LATE_S:
                self.late += 1
            self._publish(one)
            progress(one)

    def wait(self, until_s: float, ended: Callable[[], bool]) -> None:
        """Answer queries until then; sees that there is a hub."""
        while not ended():
            now_s = time.monotonic()
            if now_s - self._looked_s > _LOOK_S:
                self._looked_s = now_s
                self._see_hub(now_s)
            left_s = until_s - now_s
            try:
                query = self._inbox.get(timeout=min(left_s, _LOOK_S)) if left_s > 0 else self._inbox.get_nowait()
            except queue.Empty:
                if left_s <= _LOOK_S:
                    return
            else:
                self._answer(query)

    def _see_hub(self, now_s: float) -> None:
        """Start one in the place of one that went."""
        if self.bus.connected:
            self._alone_since_s = None
        elif self._alone_since_s is None:
            self._alone_since_s = now_s
        elif now_s - self._alone_since_s > _ALONE_S:
            self._alone_since_s = now_s
            with contextlib.suppress(BusError):  # of another machine: it comes back by itself, or Ctrl-C
                ensure_hub(self.bus.endpoint)

    def _key_of(self, one: Recorded) -> str | None:
        key = keys.parse(one.key)
        if key is None or key.topic.startswith("@cmd/") or not key.topic:
            return None
        return f"{self.name}/{key.car}/{key.topic}"

    def _publish(self, one: Recorded) -> None:
        written = self._key_of(one)
        if written is None:
            return
        encoding = _encoding(one)
        topic = topics.of_key(written)
        self.bus.put_again(written, one.payload, encoding, one.sequence, Qos.READING if topic is None else topic.qos)
        self.published += 1
        self._keep(written, one, encoding)

    def _keep(self, key: str, one: Recorded, encoding: str) -> None:
        topic = topics.of_key(key)
        if topic is not None and topic.message == one.message and topic.family not in ("frame", "event", "sim"):
            self._latest[key, _subject(topic, one.payload)] = one.payload, encoding

    # ------------------------------------------------------------------ queries

    def _ask(self, query: zenoh.Query) -> bool:
        """On a Zenoh thread; False if too many wait."""
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
            result = pb.Result(id=identity, car=car, status="rejected", reason="unsupported", words=self.refuse)
            if query.parameters.get("format") == "json" or not encoding.startswith(topics.PROTOBUF):
                reply(query, key, messages.to_json(result).encode(), messages.JSON)
            else:
                reply(query, key, result.SerializeToString(), messages.encoding_of(topics.RESULT))


def _encoding(one: Recorded) -> str:
    if one.message:
        return f"{topics.PROTOBUF};{one.message}"
    return messages.JSON if one.encoding == "json" else one.encoding


def _subject(topic: Topic, payload: bytes) -> str:
    """A coordinator has a latest decision of each subject."""
    if topic.message != "fleet.v1.Decision":
        return ""
    try:
        decision: Any = messages.parse(topic.message, payload, topic.encoding)
    except messages.BadPayload:
        return ""
    return str(decision.subject)


def _identity(verb: str, query: zenoh.Query, encoding: str) -> str:
    """The id that a command was given by who asked."""
    if verb not in topics.COMMANDS or query.payload is None:
        return ""
    try:
        command: Any = messages.parse(topics.COMMANDS[verb], query.payload.to_bytes(), encoding)
    except messages.BadPayload:
        return ""
    return str(command.id)
