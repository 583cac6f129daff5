"""What can be said of a session without reading its messages: from session.json and what stands at each file's end."""

import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from enum import StrEnum
from pathlib import Path
from typing import Any, Final

from fleet.recording import directory, times
from fleet.recording.decoding import Decoder
from fleet.recording.selection import Selection
from fleet.recording.session import NoSession, Session
from schemas import keys

MARK: Final = "@recorder/mark"
WRITING_S: Final = 5.0
"""A session that is not closed, and whose files changed so lately, is being recorded still: a flush a second."""


class State(StrEnum):
    """How a session is."""

    WHOLE = "whole"
    RECORDING = "recording"
    CUT = "cut"  # the recorder did not close it
    DAMAGED = "damaged"  # files are missing, or are none
    UNREADABLE = "unreadable"  # nothing of it can be read, or it is of a newer version


@dataclass(slots=True)
class Overview:
    """A line of the list."""

    name: str
    path: str
    state: State
    words: str = ""
    """Why it is not whole."""
    started: str = ""
    """ISO 8601, UTC."""
    length_s: float = 0.0
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


def overviews(root: Path) -> Iterator[Overview]:
    """Every session below a directory, the oldest first; raises OSError if it cannot be listed."""
    for path in sorted(root.iterdir()):
        if path.is_dir() and not path.name.startswith("."):
            described = (path / directory.DESCRIPTION).exists()
            if described or next(path.glob(directory.SEGMENTS), None) is not None:
                yield overview(path)
        elif path.suffix == ".mcap" and path.is_file():
            yield overview(path)


def overview(path: Path) -> Overview:
    """One session; nothing that is wrong with it is an error."""
    try:
        session = Session.open(path)
    except NoSession as error:
        files = [*path.glob(directory.SEGMENTS)] if path.is_dir() else [path]
        return Overview(path.name, str(path), State.UNREADABLE, str(error), bytes=_size(files))
    return of_session(session)


def of_session(session: Session) -> Overview:
    """As `overview`, of one that is open."""
    found = Overview(session.name, str(session.path), State.WHOLE)
    counts: dict[str, int] = {}
    cut: list[Path] = []
    firsts: list[int] = []
    lasts: list[int] = []
    for segment, index in session.indexes().items():
        if index is not None and index.statistics is not None:
            for key, count in index.counts.items():
                counts[key] = counts.get(key, 0) + count
            firsts.append(index.statistics.message_start_time)
            lasts.append(index.statistics.message_end_time)
            continue
        cut.append(segment)
        for lane, _, log_ns, _, _ in Session(segment, (segment,), None).rows():
            counts[lane.channel.topic] = counts.get(lane.channel.topic, 0) + 1
            firsts, lasts = [min([*firsts, log_ns])], [max([*lasts, log_ns])]
    found.keys = dict(sorted(counts.items()))
    found.messages = sum(counts.values())
    parsed = (keys.parse(key) for key in counts)
    found.cars = sorted({one.car for one in parsed if one is not None and not one.car.startswith("@")})
    found.bytes = _size(session.segments)
    if firsts and found.messages:
        found.start_ns, found.end_ns = min(firsts), max(lasts)
        found.started = times.iso(found.start_ns)
        found.length_s = (found.end_ns - found.start_ns) / 1e9
    description = session.description
    if description is not None:
        found.started = description.started or found.started
        found.lost = sum(description.drops.values()) + sum(description.missed.values())
        found.marks = list(description.marks)
        found.kept = description.kept
    found.state, found.words = _state(session, cut)
    if found.state is State.WHOLE and (words := session.lacking(found.messages)):
        found.state, found.words = State.DAMAGED, f"{directory.DESCRIPTION} {words}"
    return found


def total(session: Session) -> int | None:
    """How many messages the indexes say that there are; None where one is missing."""
    count = 0
    for index in session.indexes().values():
        if index is None or index.statistics is None:
            return None
        count += index.statistics.message_count
    return count


def marks_of(session: Session, about: Overview) -> list[Mapping[str, Any]]:
    """The marks of a session: as its description has them, else as they were recorded."""
    if about.marks:
        return list(about.marks)
    found: list[Mapping[str, Any]] = []
    decoder = Decoder()
    marked = [key for key in about.keys if key.endswith(f"/{MARK}")]
    for lane, _, log_ns, _, data in session.rows(Selection.of(marked, None, None)) if marked else ():
        message: Any = decoder.message(lane, data)
        if message is not None:
            text, by = getattr(message, "message", ""), getattr(message, "name", "")
            found.append({"time": times.iso(log_ns), "text": text, "by": by})
    return found


def _state(session: Session, cut: Sequence[Path]) -> tuple[State, str]:
    description = session.description
    if session.damage:
        return State.DAMAGED, session.damage_words
    if description is not None and not description.closed:
        lately = max(segment.stat().st_mtime for segment in session.segments) > time.time() - WRITING_S
        if lately and not description.ended:
            return State.RECORDING, ""
        return State.CUT, description.error or "the recorder did not close it: `fleet sessions recover` makes it whole"
    if cut:
        return State.CUT, f"{cut[0].name} has no end that is whole: `fleet sessions recover` makes it whole"
    return State.WHOLE, ""


def _size(paths: Sequence[Path]) -> int:
    total = 0
    for path in paths:
        try:
            total += path.stat().st_size if path.is_file() else 0
        except OSError:
            continue  # it went meanwhile
    return total
