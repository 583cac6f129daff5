"""Makes new sessions from old ones: recovers, cuts and merges them. Never changes the old sessions.

A new session is written to a temporary directory and renamed at the end, so an interruption leaves no partial session.
"""

import heapq
import json
import shutil
import tempfile
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Final

from msgspec.structs import replace

from fleet.recording import session_dir, time_spec
from fleet.recording.message_identity import identity
from fleet.recording.reading.mcap_copy import McapCopy
from fleet.recording.reading.mcap_reader import Extra, Row
from fleet.recording.reading.message_decoder import message_of
from fleet.recording.reading.session import NoSession, Session
from fleet.recording.selection import EVERYTHING, Selection
from fleet.recording.tools.merged_losses import MergedLosses
from fleet.recording.tools.number_gaps import NumberGaps
from fleet.recording.tools.tables import car_of

COPIED: Final = ("fleet.yaml", "plan.yaml")
MAX_SEGMENT_PAYLOAD_BYTES: Final = 256 << 20
"""Size of the payloads in one segment. The message that reaches it is the last one."""


class Exists(Exception):
    """The new directory already exists. The message says what to do."""


@contextmanager
def atomic_directory(out: Path) -> Iterator[Path]:
    """Yield a temporary directory, and rename it to `out` if no error occurs. Raises Exists if `out` is not empty."""
    if out.exists() and not (out.is_dir() and not any(out.iterdir())):
        raise Exists(f"{out} already exists: name a new directory")
    out.parent.mkdir(parents=True, exist_ok=True)
    scratch = Path(tempfile.mkdtemp(prefix=f".{out.name}.", suffix=".new", dir=out.parent))
    try:
        new = scratch / out.name
        new.mkdir()  # this one has default permissions: mkdtemp grants access only to us
        yield new
        if out.exists():
            out.rmdir()
        new.replace(out)
    finally:
        shutil.rmtree(scratch, ignore_errors=True)


Progress = Callable[[Iterable[Row]], Iterable[Row]]
"""Passes messages through and shows the progress."""


def recover(session: Session, out: Path, with_progress: Progress = iter) -> tuple[int, str]:
    """Write every intact message, attachment and metadata record to a new session.

    Return the number of messages, and the losses in words. Raises Exists, OSError, and NoSession if none is intact.
    """
    with atomic_directory(out) as new:
        count = _copy(with_progress(session.rows()), new, session)
        # Get the damage only now: reading finds it, and can say which times were lost. A check of all CRCs would add
        # nothing.
        words = "; ".join(filter(None, (session.damage_words, session.lost_extras)))
        if not count:
            raise NoSession(f"{session.path} has no intact message: {words or 'it is empty'}")
        if session.lacking(count) or (session.description is not None and not session.description.closed):
            words = "; ".join(filter(None, (words, session.lacking(count) or "its recorder did not close it")))
        origin = {"by": "recover", "lost": words, "missing": _missing(session, count, words)}
        _described(session, new, count, origin).write(new)
        _copy_others(session, new)
    return count, words


def _missing(session: Session, count: int, words: str) -> int | None:
    """Return the number of messages that could not be read, or None if unknown."""
    description = session.description
    if not words:
        return 0
    if description is not None and description.closed and description.messages:
        gone = session_dir.gone_messages(description)
        return None if gone is None else max(description.messages - gone - count, 0)
    if description is not None and not description.closed:
        return None
    expected = _sum(session.expected().values())
    return None if expected is None else max(expected - count, 0)


def _sum(counts: Iterable[object]) -> int | None:
    """Return the sum, or None if one count is unknown."""
    total = 0
    for each in counts:
        if not isinstance(each, int):
            return None
        total += each
    return total


def cut(
    session: Session, out: Path, selection: Selection, cars: Iterable[str] = (), with_progress: Progress = iter
) -> int:
    """Write a part to a new session, and return its number of messages.

    With `cars`, write only messages of these cars and of services. Raises Exists, OSError, and NoSession for an empty
    part.
    """
    names = frozenset(cars)

    def is_chosen(key: str) -> bool:
        car = car_of(key)
        return not names or car in names or car.startswith("@")

    numbers = NumberGaps()
    is_whole_time = selection.start_ns is None and selection.end_ns is None

    def part() -> Iterator[Row]:
        for row in session.rows(selection):
            if is_chosen(row[0].channel.topic):
                if not is_whole_time:
                    numbers.add(row)
                yield row

    with atomic_directory(out) as new:
        count = _copy(with_progress(part()), new, session)
        lost = "; ".join(filter(None, (session.damage_words, session.lost_extras)))
        if not count:
            raise NoSession(f"{session.path} has no messages there")
        bounds = [None if ns is None else time_spec.iso(ns) for ns in (selection.start_ns, selection.end_ns)]
        about = {"by": "cut", "from": bounds[0], "to": bounds[1], "cars": sorted(names), "lost": lost}
        made = _described(session, new, count, about, selection)
        # The recorder has counted its losses for the whole session. In a part of that time, the numbers of the messages
        # show how many are missing inside: lost ones, and those that a backfill brought only after this part.
        made.drops, made.missed, made.recovered = (
            {key: lost for key, lost in each.items() if is_whole_time and is_chosen(key) and selection.has_key(key)}
            for each in (made.drops, made.missed, made.recovered)
        )
        if not is_whole_time:
            made.missed = numbers.missing()
        made.write(new)
        _copy_others(session, new)
    return count


def merge(sessions: Sequence[Session], out: Path, with_progress: Progress = iter) -> tuple[int, int, str]:
    """Write the messages of several sessions of one fleet, in the order of their recorders' clocks.

    A message that several recorders received is written once. It is recognized by its key, number and payload, and
    messages of other programs also by their publish time. A message without a number is written each time. Return the
    number of messages, the number of duplicates, and the losses in words. Raises Exists, OSError, and NoSession if the
    sessions are of several fleets, or none has an intact message.
    """
    fleets = {each.description.fleet for each in sessions if each.description is not None}
    if len(fleets) > 1:
        raise NoSession(f"these are sessions of several fleets: {', '.join(sorted(fleets))}")
    twice, counts = 0, [0] * len(sessions)
    before = {each.description.continues for each in sessions if each.description is not None}
    continued = [number for number, each in enumerate(sessions) if each.name in before]
    losses = MergedLosses([each.description for each in sessions], continued)

    def counted(number: int) -> Iterator[Row]:
        for row in sessions[number].rows():
            counts[number] += 1
            losses.on_read(number, row[0].channel.topic)
            yield row

    def once() -> Iterator[Row]:
        nonlocal twice
        # Hashes of 64 bits: with ten million messages, two are equal by chance once in 400,000 merges.
        seen: set[int] = set()
        for row in heapq.merge(*map(counted, range(len(sessions))), key=lambda row: row[2]):
            info, sequence, _, publish_ns, payload = row
            told = hash((info.channel.topic, sequence, identity(message_of(info), payload, publish_ns)))
            if sequence and told in seen:
                twice += 1
                continue
            seen.add(told)
            losses.on_written(row)
            yield row

    with atomic_directory(out) as new:
        extras = [extra for each in sessions for extra in each.extras()]
        count = _copy(with_progress(once()), new, sessions[0], extras)
        named = zip(sessions, counts, strict=True)
        lost = "; ".join(f"{each.name}: {words}" for each, own in named if (words := _losses(each, own)))
        if not count:
            names = ", ".join(each.name for each in sessions)
            raise NoSession(f"nothing in {names} is intact: {lost or 'all are empty'}")
        described = [each.description for each in sessions if each.description is not None]
        marks = sorted((mark for each in described for mark in each.marks), key=lambda mark: str(mark.get("time")))
        pins = [pin for each in described for pin in each.pins]
        about = {"by": "merge", "of": ", ".join(each.name for each in sessions), "lost": lost}
        made = _described(sessions[0], new, count, about)
        started = min((each.started for each in described), default=made.started)
        origin = {**made.origin, "of": about["of"], "lost": lost, "missing": None if lost else 0}
        kept = any(each.kept for each in described)
        drops, missed = losses.remaining()
        recovered = dict(sum((Counter(each.recovered) for each in described), Counter[str]()))
        made = replace(made, marks=marks, pins=pins, kept=kept, started=started, origin=origin)
        made.drops, made.missed, made.recovered = drops, missed, recovered
        made.write(new)
        _copy_others(sessions[0], new)
    return count, twice, lost


def _losses(session: Session, count: int) -> str:
    """Return the losses of a session in words: unreadable parts and earlier losses. `count` messages were read."""
    found = (session.damage_words, session.lost_extras, session.lacking(count), lost_words(session))
    return "; ".join(filter(None, found))


def _copy(rows: Iterable[Row], new: Path, session: Session, extras: Sequence[Extra] | None = None) -> int:
    """Write the segments, and return the number of messages. Attachments and metadata are in the first one."""
    description = session.description
    about = {"made_from": session.name}
    extras = session.extras() if extras is None else extras
    if description is not None:
        about |= {"fleet": description.fleet, "started": description.started, "host": description.host}
    remaining = iter(rows)
    number, count = 0, 0
    row = next(remaining, None)
    while row is not None:
        number += 1
        size = 0
        with McapCopy(session_dir.segment(new, number), {**about, "format": str(session_dir.FORMAT_VERSION)}) as copy:
            copy.add_extras(extras if number == 1 else ())
            while row is not None and size < MAX_SEGMENT_PAYLOAD_BYTES:
                copy.add(row)
                size += len(row[4])
                row = next(remaining, None)
        count += copy.messages
    return count


def _described(
    session: Session, new: Path, count: int, origin: Mapping[str, object], selection: Selection = EVERYTHING
) -> session_dir.SessionInfo:
    """Return the description of the new session. Its segments must already be in `new`."""
    first = last = None
    fleet = ""
    for index in Session(new).indexes().values():
        if index is not None and index.statistics is not None:
            first = index.statistics.message_start_time if first is None else first
            last = index.statistics.message_end_time
            fleet = fleet or next((key.partition("/")[0] for key in index.counts), "")
    assert first is not None
    assert last is not None
    old = session.description
    before = origin_of(session)
    if lost := before.get("lost"):  # the old session was incomplete already
        origin = {**origin, "lost": "; ".join(str(each) for each in (origin["lost"], lost) if each)}
        origin["missing"] = _sum((origin.get("missing"), before.get("missing")))
    if not origin.get("cars") and before.get("cars"):
        origin = {**origin, "cars": before["cars"]}
    gone = [each for each in session_dir.gone_of(old) if _has(selection, each["from"], each["to"])] if old else []
    if old is not None and gone:
        words = f"the quota had removed {len(gone)} {'files' if len(gone) > 1 else 'file'}"
        origin = {**origin, "lost": "; ".join(str(each) for each in (origin.get("lost"), words) if each)}
        origin["missing"] = _sum((origin.get("missing"), session_dir.gone_messages(old)))
    base = old if old is not None else session_dir.SessionInfo(fleet, time_spec.iso(first), "", {})
    origin = {"by": origin["by"], "of": session.name, **origin}
    marks = [mark for mark in base.marks if _has(selection, mark.get("time"), mark.get("time"))]
    pins = [pin for pin in base.pins if _has(selection, pin.get("from"), pin.get("to"))]
    return replace(
        base,
        marks=marks,
        kept=base.kept and (bool(marks) or not base.marks),
        pins=pins,
        gone=(),
        started=time_spec.iso(first) if origin["by"] == "cut" else base.started,
        ended=time_spec.iso(last),
        closed=True,
        messages=count,
        error="",
        stops=None,  # the count is that of the old session
        format=session_dir.FORMAT_VERSION,
        origin=origin,
    )


def _copy_others(session: Session, new: Path) -> None:
    """Copy the fleet file and the plan of the old session, if it has them."""
    if session.path.is_dir():
        for name in COPIED:
            if (session.path / name).is_file():
                shutil.copyfile(session.path / name, new / name)


def _has(selection: Selection, begin: object, end: object) -> bool:
    """Return True if a stored span of time overlaps the selection, or if it is invalid, as after an edit by hand."""
    try:
        return selection.overlaps(time_spec.iso_ns(str(begin)), time_spec.iso_ns(str(end)))
    except (ValueError, OverflowError):
        return True


def origin_of(session: Session) -> Mapping[str, Any]:
    """Return the origin of a session that was made from another. Empty if it was recorded."""
    return session.description.origin if session.description is not None else {}


def lost_words(session: Session) -> str:
    """Return the losses of the session from which this one was made, or an empty text if there are none."""
    origin = origin_of(session)
    if not origin.get("lost") or origin.get("missing") == 0:
        return ""
    missing = origin.get("missing")
    many = f"{missing} messages" if isinstance(missing, int) else "an unknown number of messages"
    return f"made of {origin.get('of')} by {origin.get('by')}: {many} are missing ({origin['lost']})"


def origin_words(origin: object) -> str:
    """Return the origin of a session on one line, or an empty text if it was recorded."""
    if not isinstance(origin, dict) or not origin:
        return ""
    parts = [f"{name} {json.dumps(value)}" for name, value in origin.items() if value and name not in ("by", "of")]
    return f"{origin.get('by')} of {origin.get('of')}" + (f": {', '.join(parts)}" if parts else "")
