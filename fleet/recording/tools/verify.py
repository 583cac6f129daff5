"""Verifies a session: its files, CRCs, sequence numbers, schemas and clocks. Repairs nothing."""

from collections.abc import Callable, Iterable
from typing import Any, Final

from google.protobuf.message import Message
from msgspec import Struct, field, to_builtins

from fleet.recording import session_dir, time_spec
from fleet.recording.reading.mcap_reader import ChannelInfo, Row
from fleet.recording.reading.message_decoder import SAME_SCHEMA, MessageDecoder, compare_schema, message_of
from fleet.recording.reading.session import Session
from fleet.recording.tools.merge_cut_recover import lost_words
from fleet.recording.tools.number_gaps import NumberGaps
from schemas import keys
from schemas.local_time import exact
from schemas.printable import printable

MAX_CLOCK_OFFSET_S: Final = 0.5
"""A larger offset of a publisher's clock from the recorder's clock is reported."""
MAX_DISORDER_NS: Final = 1_000_000_000
"""Maximum time by which a message may have been received before the message that stands before it in the file. While
backfilled messages are written, others arrive and wait. A larger step is one of the recorder's clock."""
MAX_LISTED_LINES: Final = 20
"""Maximum number of gaps to print, and of duplicates and of clock steps. --json lists all."""


class Clock(Struct):
    """Offset of the clock of a gateway or service from the recorder's, estimated from message times."""

    least_s: float
    """Minimum of receive time minus publish time: negative if the publisher's clock is ahead."""
    most_s: float
    """Maximum of receive time minus publish time."""
    backwards: int = 0
    """Number of backward steps of the publisher's clock."""
    step_s: float = 0.0
    """Largest backward step."""


class SessionVerdict(Struct):
    """Result of the verification."""

    session: str
    messages: int = 0
    first_ns: int = 0
    last_ns: int = 0
    damage: dict[str, str] = field(default_factory=dict)
    """Damage by file."""
    closed: bool = True
    ended: str = ""
    """Why the recorder did not close the session, or an empty text if it did."""
    lost: str = ""
    """Losses of the session from which this one was made."""
    gone: list[dict[str, Any]] = field(default_factory=list)
    """Files that the quota has removed. The gaps that this makes are not listed in `missing`."""
    recording: bool = False
    """True if the session grew during the verification, so that it has no end yet."""
    missing: list[dict[str, Any]] = field(default_factory=list)
    """Gaps by key and publisher: sequence numbers, and the times between which these messages should have come."""
    twice: list[dict[str, Any]] = field(default_factory=list)
    """Duplicates by key and publisher."""
    dropped: dict[str, int] = field(default_factory=dict)
    """Messages by key that the recorder dropped for lack of space."""
    missed: dict[str, int] = field(default_factory=dict)
    """Messages by key that never reached the recorder, by its own count."""
    undecoded: dict[str, int] = field(default_factory=dict)
    """Messages by key that do not match their schema."""
    schemas: dict[str, str] = field(default_factory=dict)
    """Comparison of each schema with ours: `same`, or the difference."""
    clocks: dict[str, Clock] = field(default_factory=dict)
    """Clocks by car or service."""
    backwards: list[dict[str, Any]] = field(default_factory=list)
    """Backward steps of the recorder's own clock."""

    @property
    def whole(self) -> bool:
        """True if no message is missing, duplicated or undecodable, no file is damaged or removed, and it was closed.

        A session that is being recorded need not be closed.
        """
        return (self.closed or self.recording) and not any(
            (self.damage, self.lost, self.gone, self.missing, self.twice, self.dropped, self.missed, self.undecoded)
        )

    @property
    def missing_count(self) -> int:
        """Return the number of messages missing by sequence number."""
        return sum(one["count"] for one in self.missing)

    def to_dict(self) -> dict[str, Any]:
        """Return the fields for JSON."""
        return {"whole": self.whole, "missing_count": self.missing_count, **to_builtins(self)}

    def words(self) -> Iterable[str]:
        """Yield the lines of the report. The first one is the verdict."""
        length = time_spec.words(max(self.last_ns - self.first_ns, 0) / 1e9)
        span = f", {exact(self.first_ns)} to {exact(self.last_ns)} ({length})" if self.messages else ""
        state = "whole" if self.whole else "NOT whole"
        if self.recording:
            state = f"is being recorded, {'nothing is missing so far' if self.whole else state}"
        yield f"{self.session}: {state}, {self.messages} messages{span}"
        for name, words in self.damage.items():
            yield f"  damage: {name} {words}"
        if self.lost:
            yield f"  lost: {self.lost}"
        if self.ended:
            yield f"  end: {self.ended}"
        for one in self.gone:
            yield f"  removed by the quota: {one['file']}, {one['from']} to {one['to']}"
        for one in self.missing[:MAX_LISTED_LINES]:
            yield f"  missing: {_missing_words(one)}"
        if len(self.missing) > MAX_LISTED_LINES:
            more = len(self.missing) - MAX_LISTED_LINES
            yield f"  missing: {more} more gaps (--json has all); {self.missing_count} messages altogether"
        for one in self.twice[:MAX_LISTED_LINES]:
            what = f"{one['count']} messages of {_publisher_words(one)}"
            yield f"  twice: {printable(one['key'])} has {what} more than once"
        for what, counts in (
            ("dropped", self.dropped),
            ("missed on the bus", self.missed),
            ("do not fit their schema", self.undecoded),
        ):
            if counts:
                worst = max(counts, key=lambda key: counts[key])
                yield f"  {what}: {sum(counts.values())} messages, most of {printable(worst)} ({counts[worst]})"
        for name, words in self.schemas.items():
            if words != SAME_SCHEMA:
                yield f"  schema: {printable(name)} {words}"
        for one in self.backwards[:MAX_LISTED_LINES]:
            yield f"  clock: the recorder's went back by {one['step_s']:.3f} s at {exact(one['at_ns'])}"
        for name, clock in self.clocks.items():
            if clock.backwards:
                yield f"  clock: {printable(name)}'s went back {clock.backwards} times, by {clock.step_s:.3f} s at most"
            if clock.least_s < -MAX_CLOCK_OFFSET_S or clock.least_s > MAX_CLOCK_OFFSET_S:
                ahead = "ahead of" if clock.least_s < 0 else "behind"
                yield f"  clock: {printable(name)}'s is {abs(clock.least_s):.3f} s {ahead} the recorder's"


def _publisher_words(one: dict[str, Any]) -> str:
    return f"publisher {printable(one['publisher'])}" if one["publisher"] else "a publisher"


def _missing_words(one: dict[str, Any]) -> str:
    numbers = f"number {one['first']}" if one["count"] == 1 else f"numbers {one['first']} to {one['last']}"
    when = f"between {exact(one['after_ns'])} and {exact(one['before_ns'])}"
    return f"{printable(one['key'])} lacks {one['count']} of {_publisher_words(one)}: {numbers}, {when}"


class _Verifier:
    """Collects the verdict from every message."""

    def __init__(self, verdict: SessionVerdict) -> None:
        self._verdict = verdict
        self._decoder = MessageDecoder()
        self._numbers = NumberGaps()
        self._times: dict[tuple[str, str], int] = {}
        self._channels: dict[int, tuple[ChannelInfo, type[Message] | None, str]] = {}
        self._last_ns: int | None = None

    def add(self, row: Row) -> None:
        info, _, log_ns, publish_ns, data = row
        verdict = self._verdict
        known = self._channels.get(id(info))
        if known is None:
            known = self._channels[id(info)] = (info, self._check_schema(info), _owner(info.channel.topic))
        _, message_class, owner = known
        key = info.channel.topic
        verdict.messages += 1
        self._recorder_clock(log_ns)
        message = self._decoder.message(info, data) if message_class is not None else None
        if message_class is not None and message is None:
            verdict.undecoded[key] = verdict.undecoded.get(key, 0) + 1
        publisher, newest = self._numbers.add_decoded(row, message)
        self._publisher_clock(owner, (key, publisher), log_ns, publish_ns, newest=newest)

    def _check_schema(self, info: ChannelInfo) -> type[Message] | None:
        message_class = self._decoder.class_of(info)
        name = message_of(info)
        if message_class is not None:
            self._verdict.schemas[name] = compare_schema(message_class)
        elif name:
            self._verdict.schemas[name] = "is unreadable: its messages stay bytes"
        return message_class

    def _recorder_clock(self, log_ns: int) -> None:
        verdict = self._verdict
        if self._last_ns is None:
            verdict.first_ns = verdict.last_ns = log_ns
        elif log_ns < self._last_ns - MAX_DISORDER_NS:
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
        for (key, publisher), stream in sorted(self._numbers.streams.items()):
            about = {"key": key, "publisher": publisher}
            self._verdict.missing += [{**about, "count": gap.count, **to_builtins(gap)} for gap in stream.gaps]
            if stream.unlisted:
                at = stream.gaps[-1].before_ns
                further = {"count": stream.unlisted, "first": stream.gaps[-1].last + 1, "last": stream.last}
                self._verdict.missing.append({**about, **further, "after_ns": at, "before_ns": self._verdict.last_ns})
            if stream.duplicates:
                self._verdict.twice.append({**about, "count": stream.duplicates})


def _owner(key: str) -> str:
    parsed = keys.parse(key)
    return parsed.car if parsed is not None else key


def verify(
    session: Session,
    with_progress: Callable[[Iterable[Row]], Iterable[Row]] = iter,
    recording: Callable[[], bool] = lambda: False,
) -> SessionVerdict:
    """Read every message and check the CRCs. `with_progress` shows the progress; `recording` is called at the end."""
    verdict = SessionVerdict(str(session.path))
    verifier = _Verifier(verdict)
    for row in with_progress(session.rows()):
        verifier.add(row)
    verifier.end()
    read = dict(session.damage)
    session.check()
    # Damage that reading finds names the lost messages, so it replaces damage that the CRC check finds.
    verdict.damage = {path.name: words for path, words in sorted((session.damage | read).items())}
    description = session.description
    if description is not None and (gone := session_dir.gone_of(description)):
        verdict.gone = [dict(each) for each in gone]
        verdict.missing = [
            one
            for one in verdict.missing
            if not any(
                iso_end >= time_spec.iso(one["after_ns"]) and begin <= time_spec.iso(one["before_ns"])
                for begin, iso_end in ((each["from"], each["to"]) for each in gone)
            )
        ]
    if words := session.undescribed or session.lacking(verdict.messages):
        verdict.damage[session_dir.SESSION_FILE] = words
    verdict.lost = lost_words(session)
    if description is not None:
        verdict.closed = description.closed
        verdict.dropped, verdict.missed = dict(description.drops), dict(description.missed)
        verdict.recording = not description.closed and recording()
        if verdict.recording and session.segments[-1] in session.unended:
            verdict.damage.pop(session.segments[-1].name, None)
        elif not description.closed:
            until = f"everything until {exact(verdict.last_ns)} is here" if verdict.messages else "nothing is here"
            why = description.error or "it crashed, or is still recording"
            verdict.ended = f"the recorder did not close it ({why}); {until}, later messages are lost"
    return verdict
