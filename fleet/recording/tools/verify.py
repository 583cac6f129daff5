"""Is a session whole, and if not, what is missing: files, checksums, numbers, schemas, clocks. Nothing is mended."""

from collections.abc import Callable, Iterable
from dataclasses import asdict, dataclass, field
from typing import Any, Final

from google.protobuf.message import Message

from fleet.recording import session_dir, time_spec
from fleet.recording.reading.mcap_reader import ChannelInfo, Row
from fleet.recording.reading.message_decoder import SAME, MessageDecoder, compared
from fleet.recording.reading.session import Session, message_of
from fleet.recording.tools.sequence_check import Stream
from fleet.recording.tools.transform import lost_words
from schemas import keys

OFFSET_S: Final = 0.5
"""A publisher's clock that is further from the recorder's is said."""
MOST_WORDS: Final = 20
"""Gaps that are told one by one; --json has them all."""


@dataclass(slots=True)
class Clock:
    """How the clock of a car's gateway (or a service) stood to the recorder's, as far as messages tell."""

    least_s: float
    """The least that a message took, recorder's time minus publisher's: negative if the publisher's is ahead."""
    most_s: float
    backwards: int = 0
    """How often a publisher's time was before that of the message before it."""
    step_s: float = 0.0
    """The largest of these steps."""


@dataclass(slots=True)
class SessionVerdict:
    """What was found."""

    session: str
    messages: int = 0
    first_ns: int = 0
    last_ns: int = 0
    damage: dict[str, str] = field(default_factory=dict)
    """By file: what is wrong with it."""
    closed: bool = True
    ended: str = ""
    """What its end says that it should not; empty if the recorder closed it."""
    lost: str = ""
    """What the session that this one was made of lacked already."""
    recording: bool = False
    """Whether it grew while it was looked at: its end is still to come."""
    missing: list[dict[str, Any]] = field(default_factory=list)
    """Per key and publisher: which numbers are not there, and when they would have come."""
    twice: list[dict[str, Any]] = field(default_factory=list)
    dropped: dict[str, int] = field(default_factory=dict)
    """By key, by the recorder itself: it had no room."""
    missed: dict[str, int] = field(default_factory=dict)
    """By key, by the recorder itself: lost before it had them."""
    undecoded: dict[str, int] = field(default_factory=dict)
    """By key: messages that their schema does not fit."""
    schemas: dict[str, str] = field(default_factory=dict)
    """By name: `same` as today's, or how it differs."""
    clocks: dict[str, Clock] = field(default_factory=dict)
    """By car or service."""
    backwards: list[dict[str, Any]] = field(default_factory=list)
    """When the recorder's own clock went back, and how far."""

    @property
    def whole(self) -> bool:
        """Whether nothing is missing and nothing is there twice."""
        return (self.closed or self.recording) and not any(
            (self.damage, self.lost, self.missing, self.twice, self.dropped, self.missed, self.undecoded)
        )

    @property
    def missing_count(self) -> int:
        """How many messages the numbers say are not there."""
        return sum(one["count"] for one in self.missing)

    def to_dict(self) -> dict[str, Any]:
        """For JSON."""
        return {"whole": self.whole, "missing_count": self.missing_count, **asdict(self)}

    def words(self) -> Iterable[str]:
        """What there is to say, a line each; the first is the verdict."""
        length = time_spec.words(max(self.last_ns - self.first_ns, 0) / 1e9)
        span = f", {time_spec.iso(self.first_ns)} to {time_spec.iso(self.last_ns)} ({length})" if self.messages else ""
        state = "whole" if self.whole else "NOT whole"
        if self.recording:
            state = f"is being recorded, {'nothing is missing until now' if self.whole else state}"
        yield f"{self.session}: {state}, {self.messages} messages{span}"
        for name, words in self.damage.items():
            yield f"  damage: {name} {words}"
        if self.lost:
            yield f"  lost: {self.lost}"
        if self.ended:
            yield f"  end: {self.ended}"
        for one in self.missing[:MOST_WORDS]:
            yield f"  missing: {_missing_words(one)}"
        if len(self.missing) > MOST_WORDS:
            more = len(self.missing) - MOST_WORDS
            yield f"  missing: {more} more gaps (--json has all); {self.missing_count} messages altogether"
        for one in self.twice[:MOST_WORDS]:
            yield f"  twice: {one['key']} has {one['count']} messages of {_by(one)} more than once"
        for what, counts in (
            ("dropped", self.dropped),
            ("missed on the bus", self.missed),
            ("do not fit their schema", self.undecoded),
        ):
            if counts:
                worst = max(counts, key=lambda key: counts[key])
                yield f"  {what}: {sum(counts.values())} messages, most of {worst} ({counts[worst]})"
        for name, words in self.schemas.items():
            if words != SAME:
                yield f"  schema: {name} {words}"
        for one in self.backwards[:MOST_WORDS]:
            yield f"  clock: the recorder's went back by {one['step_s']:.3f} s at {time_spec.iso(one['at_ns'])}"
        for name, clock in self.clocks.items():
            if clock.backwards:
                yield f"  clock: {name}'s went back {clock.backwards} times, by {clock.step_s:.3f} s at most"
            if clock.least_s < -OFFSET_S or clock.least_s > OFFSET_S:
                ahead = "ahead of" if clock.least_s < 0 else "behind"
                yield f"  clock: {name}'s is {abs(clock.least_s):.3f} s {ahead} the recorder's"


def _by(one: dict[str, Any]) -> str:
    return f"publisher {one['publisher']}" if one["publisher"] else "a publisher"


def _missing_words(one: dict[str, Any]) -> str:
    numbers = f"number {one['first']}" if one["count"] == 1 else f"numbers {one['first']} to {one['last']}"
    when = f"between {time_spec.iso(one['after_ns'])} and {time_spec.iso(one['before_ns'])}"
    return f"{one['key']} lacks {one['count']} of {_by(one)}: {numbers}, {when}"


class _Audit:
    """Looks at every message once."""

    def __init__(self, verdict: SessionVerdict) -> None:
        self._verdict = verdict
        self._decoder = MessageDecoder()
        self._streams: dict[tuple[str, str], Stream] = {}
        self._times: dict[tuple[str, str], int] = {}
        self._lanes: dict[int, tuple[ChannelInfo, type[Message] | None, str]] = {}
        self._last_ns: int | None = None

    def add(self, row: Row) -> None:
        lane, sequence, log_ns, publish_ns, data = row
        verdict = self._verdict
        known = self._lanes.get(id(lane))
        if known is None:
            known = self._lanes[id(lane)] = (lane, self._met(lane), _owner(lane.channel.topic))
        _, made, owner = known
        key = lane.channel.topic
        verdict.messages += 1
        self._recorder_clock(log_ns)
        number, publisher, own = sequence, "", False
        if made is not None:
            message: Any = self._decoder.message(lane, data)
            if message is None:
                verdict.undecoded[key] = verdict.undecoded.get(key, 0) + 1
            else:
                publisher = str(getattr(message, "boot_id", "") or getattr(message, "sender", ""))
                if getattr(message, "boot_id", "") and getattr(message, "seq", 0):
                    number, own = int(message.seq), True
        newest = True
        if number:
            stream = self._streams.get((key, publisher))
            if stream is None:
                stream = self._streams[key, publisher] = Stream(numbered=own)
            newest = stream.add(number, log_ns)
        self._publisher_clock(owner, (key, publisher), log_ns, publish_ns, newest=newest)

    def _met(self, lane: ChannelInfo) -> type[Message] | None:
        made = self._decoder.class_of(lane)
        name = message_of(lane)
        if made is not None:
            self._verdict.schemas[name] = compared(made)
        elif name:
            self._verdict.schemas[name] = "cannot be understood: its messages are kept as bytes"
        return made

    def _recorder_clock(self, log_ns: int) -> None:
        verdict = self._verdict
        if self._last_ns is None:
            verdict.first_ns = verdict.last_ns = log_ns
        elif log_ns < self._last_ns:
            verdict.backwards.append({"at_ns": log_ns, "step_s": (self._last_ns - log_ns) / 1e9})
        verdict.first_ns, verdict.last_ns = min(verdict.first_ns, log_ns), max(verdict.last_ns, log_ns)
        self._last_ns = log_ns

    def _publisher_clock(
        self, owner: str, stream: tuple[str, str], log_ns: int, publish_ns: int, *, newest: bool
    ) -> None:
        took = (log_ns - publish_ns) / 1e9
        clock = self._verdict.clocks.get(owner)
        if clock is None:
            clock = self._verdict.clocks[owner] = Clock(took, took)
        clock.least_s, clock.most_s = min(clock.least_s, took), max(clock.most_s, took)
        if newest:
            before = self._times.get(stream)
            if before is not None and publish_ns < before:
                clock.backwards += 1
                clock.step_s = max(clock.step_s, (before - publish_ns) / 1e9)
            self._times[stream] = publish_ns

    def end(self) -> None:
        for (key, publisher), stream in sorted(self._streams.items()):
            about = {"key": key, "publisher": publisher}
            self._verdict.missing += [{**about, "count": gap.count, **asdict(gap)} for gap in stream.gaps]
            if stream.further:
                at = stream.gaps[-1].before_ns
                further = {"count": stream.further, "first": stream.gaps[-1].last + 1, "last": stream.last}
                self._verdict.missing.append({**about, **further, "after_ns": at, "before_ns": self._verdict.last_ns})
            if stream.twice:
                self._verdict.twice.append({**about, "count": stream.twice})


def _owner(key: str) -> str:
    parsed = keys.parse(key)
    return parsed.car if parsed is not None else key


def verify(
    session: Session,
    watched: Callable[[Iterable[Row]], Iterable[Row]] = iter,
    recording: Callable[[], bool] = lambda: False,
) -> SessionVerdict:
    """Look at every byte and every message; `watched` may look on as they pass, `recording` is asked at the end."""
    verdict = SessionVerdict(str(session.path))
    audit = _Audit(verdict)
    for row in watched(session.rows()):
        audit.add(row)
    audit.end()
    read = dict(session.damage)
    session.check()
    # What reading says is lost comes before what only a checksum tells.
    verdict.damage = {path.name: words for path, words in sorted((session.damage | read).items())}
    description = session.description
    if session.path.is_dir() and description is None:
        verdict.damage[session_dir.DESCRIPTION] = (
            "is missing, or cannot be understood: who recorded what, and the marks"
        )
    if words := session.lacking(verdict.messages):
        verdict.damage[session_dir.DESCRIPTION] = words
    verdict.lost = lost_words(session)
    if description is not None:
        verdict.closed = description.closed
        verdict.dropped, verdict.missed = dict(description.drops), dict(description.missed)
        verdict.recording = not description.closed and recording()
        if verdict.recording and session.segments[-1] in session.unended:
            verdict.damage.pop(session.segments[-1].name, None)
        elif not description.closed:
            until = (
                f"everything until {time_spec.iso(verdict.last_ns)} is here" if verdict.messages else "nothing is here"
            )
            why = description.error or "it was killed, or is still recording"
            verdict.ended = f"the recorder did not close it ({why}); {until}, what came after is not"
    return verdict
