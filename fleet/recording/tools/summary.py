"""Summarizes a session from session.json and the index of each file.

It reads messages only where these do not suffice: in a file without a complete index, and for stops and marks that
session.json lacks.
"""

import shlex
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from enum import StrEnum
from pathlib import Path
from typing import Any, Final

from msgspec import Struct, field, to_builtins

from fleet.recording import session_dir, time_spec
from fleet.recording.foreign_fields import text_of
from fleet.recording.reading.message_decoder import MessageDecoder
from fleet.recording.reading.session import NoSession, Session
from fleet.recording.selection import Selection
from fleet.recording.session_lookup import find_session
from fleet.recording.stop_count import EVENTS, StopCount
from fleet.recording.tools.merge_cut_recover import lost_words
from schemas import keys

MARK_TOPIC_NAME: Final = "@recorder/mark"
RECENT_WRITE_S: Final = 5.0
"""An unclosed session that was written within this time counts as being recorded. A recorder flushes every second."""
MAX_GROWTH_WAIT_S: Final = 2.5
"""Timeout for an unclosed session to grow. A recorder writes at least its own status every second."""
GROWTH_POLL_INTERVAL_S: Final = 0.1
MIN_CLOCK_STEP_NS: Final = 1_000_000_000
"""Minimum backward step of times that counts as a step of the clock."""


class SessionState(StrEnum):
    """State of a session."""

    WHOLE = "whole"
    RECORDING = "recording"
    CUT = "cut"  # the recorder did not close it, or a file has no end
    DAMAGED = "damaged"  # files, session.json or messages are missing, or a file is not an MCAP file
    THINNED = "thinned"  # whole, except for files that the quota removed
    RECOVERED = "recovered"  # whole, but made from an incomplete session
    GAPS = "gaps"  # all files are whole, but the recorder lost messages
    UNREADABLE = "unreadable"  # no file can be read, or the format is newer than ours


class SessionSummary(Struct):
    """One line of `fleet sessions list`."""

    name: str
    path: str
    state: SessionState
    words: str = ""
    """Why the session is not whole, in words."""
    started: str = ""
    """ISO 8601, UTC."""
    length_s: float = 0.0
    """Duration on the recorder's clock, without backward steps."""
    clock_back_s: float = 0.0
    """Largest backward step of the recorder's clock."""
    bytes: int = 0
    messages: int = 0
    lost: int = 0
    """Messages that the recorder dropped, or knew to have missed on the bus, and those that a tool could not read."""
    cars: Sequence[str] = ()
    stops: int | None = None
    """Commands that stop cars. A stop of several cars counts once. None if they were not counted."""
    marks: Sequence[Mapping[str, Any]] = ()
    kept: bool = False
    """True if the quota spares the session."""
    pins: Sequence[Mapping[str, Any]] = ()
    """Times that the quota removes last. The times around marks are not listed here."""
    gone: Sequence[Mapping[str, Any]] = ()
    """Files that the quota has removed."""
    keys: Mapping[str, int] = field(default_factory=dict)
    """Messages by key."""
    start_ns: int = 0
    end_ns: int = 0

    @property
    def typed(self) -> str:
        """Return what to type for the session."""
        return _typed(self.name, Path(self.path))

    def to_dict(self) -> dict[str, Any]:
        """Return the fields for JSON."""
        found: dict[str, Any] = to_builtins(self)
        return found


def overviews(root: Path) -> Iterator[SessionSummary]:
    """Yield a summary of each session in a directory, by name. Raises OSError if the directory cannot be listed."""
    yield from map(overview, filter(session_dir.is_session, sorted(root.iterdir())))


def overview(path: Path) -> SessionSummary:
    """Summarize one session. Damage is part of the summary and no error."""
    try:
        session = Session(path)
    except NoSession as error:
        files = [*path.glob(session_dir.SEGMENTS)] if path.is_dir() else [path]
        return SessionSummary(path.name, str(path), SessionState.UNREADABLE, str(error), bytes=_size(files))
    about = of_session(session)
    about.stops = stops_of(session, about)
    return about


def of_session(session: Session) -> SessionSummary:
    """Summarize an open session."""
    found = SessionSummary(session.name, str(session.path), SessionState.WHOLE)
    counts: dict[str, int] = {}
    read = session.part(())
    span = _Span()
    for segment, index in session.indexes().items():
        if index is not None and index.counts_all_messages:
            for key, count in index.counts.items():
                counts[key] = counts.get(key, 0) + count
            for chunk in index.chunks:
                span.add(chunk.first_ns, chunk.last_ns)
            continue
        part = session.part((segment,))
        for info, _, log_ns, _, _ in part.rows():
            counts[info.channel.topic] = counts.get(info.channel.topic, 0) + 1
            span.add(log_ns, log_ns)
        read.damage |= part.damage
        read.unended |= part.unended
    found.keys = dict(sorted(counts.items()))
    found.messages = sum(counts.values())
    parsed = (keys.parse(key) for key in counts)
    found.cars = sorted({one.car for one in parsed if one is not None and not one.car.startswith("@")})
    found.bytes = _size(session.segments)
    if found.messages:
        found.start_ns, found.end_ns = span.first_ns, span.last_ns
        found.started = time_spec.iso(found.start_ns)
        found.length_s, found.clock_back_s = span.length_ns / 1e9, span.back_ns / 1e9
    description = session.description
    if description is not None:
        found.started = description.started or found.started
        missing = description.origin.get("missing")
        found.lost = sum(description.drops.values()) + sum(description.missed.values())
        found.lost += missing if isinstance(missing, int) else 0
        found.marks = list(description.marks)
        found.kept = description.kept
        found.pins, found.gone = list(description.pins), session_dir.gone_of(description)
        found.stops = description.stops if description.closed else None  # an open session may lack its last stops
    found.state, found.words = _state(session, read, found.messages)
    if found.state is SessionState.WHOLE and (words := session.undescribed or session.lacking(found.messages)):
        found.state, found.words = SessionState.DAMAGED, f"{session_dir.SESSION_FILE} {words}"
    if found.state is SessionState.WHOLE and found.gone:
        found.state = SessionState.THINNED
    if found.state is SessionState.WHOLE and (words := lost_words(session)):
        found.state, found.words = SessionState.RECOVERED, words
    if found.state is SessionState.WHOLE and found.lost:
        found.state = SessionState.GAPS
        found.words = f"{found.lost} messages were lost: `fleet sessions verify {typed_name(session)}` lists them"
    return found


class _Span:
    """Time span of chunks in the order of the file, on a clock that may step back."""

    def __init__(self) -> None:
        self.first_ns = self.last_ns = self.back_ns = 0
        self._before_ns = 0
        self._run: tuple[int, int] | None = None

    def add(self, first_ns: int, last_ns: int) -> None:
        if self._run is None:
            self.first_ns, self.last_ns, self._run = first_ns, last_ns, (first_ns, last_ns)
            return
        self.first_ns, self.last_ns = min(self.first_ns, first_ns), max(self.last_ns, last_ns)
        start_ns, end_ns = self._run
        if end_ns - first_ns <= MIN_CLOCK_STEP_NS:
            self._run = start_ns, max(end_ns, last_ns)
            return
        # The chunk in which the clock stepped back has times from before and after the step. Its last time is from
        # before.
        within = last_ns >= end_ns
        end_ns = max(end_ns, last_ns)
        self.back_ns = max(self.back_ns, end_ns - first_ns)
        self._before_ns += end_ns - start_ns
        self._run = (first_ns, first_ns) if within else (first_ns, last_ns)

    @property
    def length_ns(self) -> int:
        """Return the duration without backward steps."""
        return self._before_ns + (self._run[1] - self._run[0] if self._run is not None else 0)


def growth_check(session: Session) -> Callable[[], bool]:
    """Return a function that tells if a session has grown since this call. It waits up to MAX_GROWTH_WAIT_S."""
    began, before = time.monotonic(), _size(session.segments)

    def has_grown() -> bool:
        lately = _is_written_lately(session)
        while lately and time.monotonic() - began < MAX_GROWTH_WAIT_S and _size(session.segments) == before:
            time.sleep(GROWTH_POLL_INTERVAL_S)
        return lately and _size(session.segments) != before

    return has_grown


def total(session: Session) -> int | None:
    """Return the number of messages from the indexes, or None if one is missing."""
    count = 0
    for index in session.indexes().values():
        if index is None or index.statistics is None:
            return None
        count += index.statistics.message_count
    return count


def marks_of(session: Session, about: SessionSummary) -> list[Mapping[str, Any]]:
    """Return the marks of a session, from session.json or else from its messages.

    Marks that were added later always count.
    """
    if any("added" not in mark for mark in about.marks):
        return list(about.marks)
    found: list[Mapping[str, Any]] = list(about.marks)
    for log_ns, message in _messages(session, about, MARK_TOPIC_NAME):
        text, by = (text_of(message, name) for name in ("message", "name"))
        found.append({"time": time_spec.iso(log_ns), "text": text, "by": by})
    return found


def stops_of(session: Session, about: SessionSummary) -> int:
    """Return the number of stops of a session, from session.json or else from the events of commands."""
    if about.stops is not None:
        return about.stops
    found = StopCount()
    # Read a copy of the session, so that its damage is not reported twice.
    for _, event in _messages(session.part(session.segments), about, EVENTS.name):
        found.add(event)
    return found.count


def _messages(session: Session, about: SessionSummary, topic: str) -> Iterator[tuple[int, Any]]:
    """Yield the messages of a topic, each with its time in ns. Read only chunks that may contain one, if indexed."""
    decoder = MessageDecoder()
    selected = tuple(key for key in about.keys if key.endswith(f"/{topic}"))
    for info, _, log_ns, _, data in session.rows(Selection(selected)) if selected else ():
        if (message := decoder.message(info, data)) is not None:
            yield log_ns, message


def _state(session: Session, read: Session, messages: int) -> tuple[SessionState, str]:
    """Return the state, and its reason. `read` has the damage of the files that were read for lack of an index."""
    repair = f": `{_recover(session)}` repairs it" if messages else ", and no message is in it"
    description = session.description
    if session.damage:
        return SessionState.DAMAGED, session.damage_words
    if description is not None and not description.closed:
        if _is_written_lately(session) and not description.ended:
            return SessionState.RECORDING, description.error
        if description.ended and description.error:  # the recorder failed, and has counted its losses
            return SessionState.CUT, description.error
        why = f" ({description.error.rstrip('.')})" if description.error else ""
        return SessionState.CUT, f"the recorder did not close it{why}{repair}"
    if damaged := sorted(read.damage.keys() - read.unended):
        return SessionState.DAMAGED, f"{damaged[0].name} {read.damage[damaged[0]]}"
    if read.unended and (messages or description is None or not description.drops):
        return SessionState.CUT, f"{min(read.unended).name} has no intact end{repair}"
    return SessionState.WHOLE, ""


def _recover(session: Session) -> str:
    """Return the command that repairs this session. It names the session, because the default is the newest one."""
    return f"fleet sessions recover {typed_name(session)}"


def typed_name(session: Session) -> str:
    """Return what to type for a session: its name, or its path if the name alone does not find it."""
    return _typed(session.name, session.path)


def _typed(name: str, path: Path) -> str:
    """Return what to type for a session with this name and path, in quotes where a shell needs them."""
    found = find_session(name)
    is_named = found.exists() and found.samefile(path) and not name.startswith("-")
    text = name if is_named else str(path)
    return shlex.quote(f"./{text}" if text.startswith("-") else text)


def _is_written_lately(session: Session) -> bool:
    try:
        return max(segment.stat().st_mtime for segment in session.segments) > time.time() - RECENT_WRITE_S
    except OSError:
        return False  # removed meanwhile


def _size(paths: Sequence[Path]) -> int:
    total = 0
    for path in paths:
        try:
            total += path.stat().st_size if path.is_file() else 0
        except OSError:
            continue  # removed meanwhile
    return total
