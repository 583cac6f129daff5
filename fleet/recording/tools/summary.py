"""What can be said of a session without reading its messages: from session.json and what stands at each file's end."""

import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from enum import StrEnum
from pathlib import Path
from typing import Any, Final

from fleet.recording import session_dir, time_spec
from fleet.recording.reading.message_decoder import MessageDecoder
from fleet.recording.reading.session import NoSession, Session
from fleet.recording.selection import Selection
from fleet.recording.tools.transform import lost_words
from schemas import keys

MARK: Final = "@recorder/mark"
WRITING_S: Final = 5.0
"""A session that is not closed, and whose files changed so lately, is being recorded still: a flush a second."""


LOOKED_S: Final = 2.5
"""A recorder writes each second, its own status at least: a session that does not grow for so long is not recorded."""
LOOK_EACH_S: Final = 0.1
STEP_NS: Final = 1_000_000_000
"""Times that go back further than this are a clock that went back."""


class SessionState(StrEnum):
    """How a session is."""

    WHOLE = "whole"
    RECORDING = "recording"
    CUT = "cut"  # the recorder did not close it
    DAMAGED = "damaged"  # files are missing, or are none
    RECOVERED = "recovered"  # whole by itself, made of one that lacked something
    UNREADABLE = "unreadable"  # nothing of it can be read, or it is of a newer version


@dataclass(slots=True)
class SessionSummary:
    """A line of the list."""

    name: str
    path: str
    state: SessionState
    words: str = ""
    """Why it is not whole."""
    started: str = ""
    """ISO 8601, UTC."""
    length_s: float = 0.0
    """What passed on the recorder's clock; what it went back is left out."""
    clock_back_s: float = 0.0
    """The furthest that the recorder's clock went back, at once."""
    bytes: int = 0
    messages: int = 0
    lost: int = 0
    """Messages dropped by the recorder, or missed on the bus, as far as it knew."""
    cars: Sequence[str] = ()
    marks: Sequence[Mapping[str, Any]] = ()
    kept: bool = False
    """Whether it is spared when room is made for others."""
    keys: Mapping[str, int] = field(default_factory=dict)
    """Messages by key."""
    start_ns: int = 0
    end_ns: int = 0

    def to_dict(self) -> dict[str, Any]:
        """For JSON."""
        return asdict(self)


def overviews(root: Path) -> Iterator[SessionSummary]:
    """Every session below a directory, the oldest first; raises OSError if it cannot be listed."""
    for path in sorted(root.iterdir()):
        if path.is_dir() and not path.name.startswith("."):
            described = (path / session_dir.DESCRIPTION).exists()
            if described or next(path.glob(session_dir.SEGMENTS), None) is not None:
                yield overview(path)
        elif path.suffix == ".mcap" and path.is_file():
            yield overview(path)


def overview(path: Path) -> SessionSummary:
    """One session; nothing that is wrong with it is an error."""
    try:
        session = Session.open(path)
    except NoSession as error:
        files = [*path.glob(session_dir.SEGMENTS)] if path.is_dir() else [path]
        return SessionSummary(path.name, str(path), SessionState.UNREADABLE, str(error), bytes=_size(files))
    return of_session(session)


def of_session(session: Session) -> SessionSummary:
    """As `overview`, of one that is open."""
    found = SessionSummary(session.name, str(session.path), SessionState.WHOLE)
    counts: dict[str, int] = {}
    cut: list[Path] = []
    span = _Span()
    for segment, index in session.indexes().items():
        if index is not None and index.statistics is not None:
            for key, count in index.counts.items():
                counts[key] = counts.get(key, 0) + count
            for place in index.places:
                span.add(place.first_ns, place.last_ns)
            continue
        cut.append(segment)
        for lane, _, log_ns, _, _ in Session(segment, (segment,), None).rows():
            counts[lane.channel.topic] = counts.get(lane.channel.topic, 0) + 1
            span.add(log_ns, log_ns)
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
    found.state, found.words = _state(session, cut)
    if found.state is SessionState.WHOLE and (words := session.lacking(found.messages)):
        found.state, found.words = SessionState.DAMAGED, f"{session_dir.DESCRIPTION} {words}"
    if found.state is SessionState.WHOLE and (words := lost_words(session)):
        found.state, found.words = SessionState.RECOVERED, words
    return found


class _Span:
    """From when to when messages are, chunk by chunk in the order of writing, on a clock that may go back."""

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
        if end_ns - first_ns <= STEP_NS:
            self._run = start_ns, max(end_ns, last_ns)
            return
        # The chunk in which the clock went back has times of before and after: its last is then one of before.
        within = last_ns >= end_ns
        end_ns = max(end_ns, last_ns)
        self.back_ns = max(self.back_ns, end_ns - first_ns)
        self._before_ns += end_ns - start_ns
        self._run = (first_ns, first_ns) if within else (first_ns, last_ns)

    @property
    def length_ns(self) -> int:
        """What passed."""
        return self._before_ns + (self._run[1] - self._run[0] if self._run is not None else 0)


def growing(session: Session) -> Callable[[], bool]:
    """Tells, asked later, whether a session that nobody closed has grown meanwhile; it looks for up to LOOKED_S."""
    began, before = time.monotonic(), _size(session.segments)

    def grew() -> bool:
        try:
            lately = max(segment.stat().st_mtime for segment in session.segments) > time.time() - WRITING_S
        except OSError:
            return False
        while lately and time.monotonic() - began < LOOKED_S and _size(session.segments) == before:
            time.sleep(LOOK_EACH_S)
        return _size(session.segments) != before

    return grew


def total(session: Session) -> int | None:
    """How many messages the indexes say that there are; None where one is missing."""
    count = 0
    for index in session.indexes().values():
        if index is None or index.statistics is None:
            return None
        count += index.statistics.message_count
    return count


def marks_of(session: Session, about: SessionSummary) -> list[Mapping[str, Any]]:
    """The marks of a session: as its description has them, else as they were recorded."""
    if about.marks:
        return list(about.marks)
    found: list[Mapping[str, Any]] = []
    decoder = MessageDecoder()
    marked = [key for key in about.keys if key.endswith(f"/{MARK}")]
    for lane, _, log_ns, _, data in session.rows(Selection.of(marked, None, None)) if marked else ():
        message: Any = decoder.message(lane, data)
        if message is not None:
            text, by = getattr(message, "message", ""), getattr(message, "name", "")
            found.append({"time": time_spec.iso(log_ns), "text": text, "by": by})
    return found


def _state(session: Session, cut: Sequence[Path]) -> tuple[SessionState, str]:
    description = session.description
    if session.damage:
        return SessionState.DAMAGED, session.damage_words
    if description is not None and not description.closed:
        lately = max(segment.stat().st_mtime for segment in session.segments) > time.time() - WRITING_S
        if lately and not description.ended:
            return SessionState.RECORDING, ""
        return (
            SessionState.CUT,
            description.error or "the recorder did not close it: `fleet sessions recover` makes it whole",
        )
    if cut:
        return SessionState.CUT, f"{cut[0].name} has no end that is whole: `fleet sessions recover` makes it whole"
    return SessionState.WHOLE, ""


def _size(paths: Sequence[Path]) -> int:
    total = 0
    for path in paths:
        try:
            total += path.stat().st_size if path.is_file() else 0
        except OSError:
            continue  # it went meanwhile
    return total
