"""Writes one session: assigns messages to segments, tracks gaps, rolls files over and buffers while the disk is full.

All methods are called from one thread. The module does not use the bus and starts no thread.
"""

import contextlib
import errno
import os
import shutil
from collections.abc import Hashable, Mapping, Sequence
from datetime import UTC, datetime
from enum import StrEnum
from pathlib import Path
from types import MappingProxyType
from typing import Any, Final

import zenoh
from msgspec import Struct, field

from fleet.quota import Quota
from fleet.recording import session_dir
from fleet.recording.message_identity import identity
from fleet.recording.pins import Pin, PinList
from fleet.recording.sequence_tracker import SequenceTracker, TrackedSender
from fleet.recording.stop_count import StopCount
from fleet.recording.time_spec import format_utc
from fleet.recording.writing import resume
from fleet.recording.writing.backfill_plan import QUERY_AFTER_START_S, source_of
from fleet.recording.writing.disk_space import MB, MIN_CLOSE_BYTES, MIN_START_BYTES, Reserve, free_bytes, shortage
from fleet.recording.writing.quota_removal import enforce
from fleet.recording.writing.segment_counts import KeyState, Row, SegmentCounts
from fleet.recording.writing.segment_writer import Segment
from schemas import messages
from schemas.bus import sequence_of

MAX_BUFFERED_MESSAGES: Final = 100_000
MAX_BUFFERED_BYTES: Final = 64 * MB
"""Maximum size of the buffer while the disk is full. Further messages are dropped and counted."""
OVERFLOW_BATCH_BYTES: Final = 100_000
"""Buffered bytes to write and flush before the free space is checked again."""
NEWCOMER_AFTER_NS: Final = int(QUERY_AFTER_START_S[-1] * 1e9)
"""The query after the start is for all that is published until then."""


class Sync(StrEnum):
    """When to wait for the disk.

    Flushed data survives a crash of the recorder. It is lost only if the operating system crashes.
    """

    NEVER = "never"
    SEGMENT = "segment"
    SECOND = "second"


class Options(Struct, frozen=True):
    """Limits and files of the sessions to write. 0 means no limit."""

    segment_bytes: int = 512 * MB
    """Size at which a segment is rolled over."""
    segment_s: float = 600.0
    """Age at which a segment is rolled over. It is limited because the index of an open file grows in memory, by 0.1
    MB/s for 100 cars."""
    sync: Sync = Sync.SEGMENT
    quota: Quota = field(default_factory=Quota)
    reserve: Reserve = field(default_factory=Reserve)
    copied: Mapping[str, Path] = field(default_factory=lambda: MappingProxyType({}))
    """Files to copy into each session, by their names there."""


class SessionWriter:
    """Writes one new session. Raises OSError if the session cannot be created or written.

    A full disk is not an error: `full` names it, new messages are buffered, and writing resumes when there is space.
    If the disk is full to the last byte from the start, `path` is the future directory of the session.

    `after` is the session that this one follows without a pause, if there is one.
    """

    def __init__(
        self, root: Path, fleet: str, options: Options, now_ns: int, *, after: "SessionWriter | None" = None
    ) -> None:
        self._root = root
        self._options = options
        self.path, self.description = session_dir.plan(root, fleet, _utc(now_ns))
        self._made = False
        resume_point = resume.find_interrupted(root, fleet, now_ns) if after is None else after._end_point()
        self.description.continues = resume_point.name
        self.resume_since_ns = resume_point.since_ns
        """Time, by the recorder's clock, from which messages are accepted, also if they come later."""
        self._recorded, self._clocks = resume_point.known, resume_point.clocks
        self._metadata = {"fleet": fleet, "started": self.description.started, "host": self.description.host}
        self._metadata |= {**self.description.versions, "format": str(session_dir.FORMAT_VERSION)}
        self.uncopied: list[str] = []
        """Files that could not be copied. The recorder reports and clears them."""
        self._trackers: dict[str, SequenceTracker] = {}
        """The numbers of each key that this session and those before it have received."""
        self._irregular_keys: set[str] = set()
        """Keys whose sequence numbers were not always consecutive."""
        self.gaps: dict[str, int] = {}
        """Keys with new gaps, each with the time of the sender's last message before the gap (0 if there was none). The
        recorder requests a backfill for them and clears them."""
        self.newcomers: dict[str, str] = {}
        """Keys of senders whose first messages were not heard, perhaps because they had no link, each with the source
        to ask. The recorder requests a backfill for them and clears them."""
        self._asked: set[Hashable] = set()
        """Zenoh sessions that have answered when they were asked for everything since the begin."""
        if after is not None:
            self._trackers = {key: tracker.following() for key, tracker in after._trackers.items()}
            self.gaps, self.newcomers = after.gaps, after.newcomers
            self._asked = after._asked
        self._drops: dict[str, int] = {}
        """Lost messages by key: those that did not fit on the disk, and those without a number that did not fit into
        the queue."""
        self._overflows: dict[str, int] = {}
        """Numbered messages by key that did not fit into the recorder's queue. A backfill may still fetch them."""
        self.recovered: dict[str, int] = {}
        """Messages by key that a backfill restored."""
        self.full = ""
        """Why writing pauses. Empty if it does not."""
        self.cost = ""
        """Losses at the end of the session because the disk was full."""
        self.warning = ""
        self.quota_news: list[str] = []
        """News about the quota for a person. The recorder reports and clears them."""
        self._pins = PinList()
        self._pins_unwritten = False
        self._index: list[dict[str, Any]] = []
        self._written = self._closed_bytes = self._buffered_bytes = 0
        self._stops = StopCount()
        self._unended = 0
        """Number of rows at the beginning of the buffer that are already in the segment. The end of this segment did
        not fit on the full disk."""
        self._unflushed: list[Row] = []
        self._reset_segment(now_ns)
        if not self._open(now_ns, self._options.reserve.to_begin):
            self._begin_without_room(now_ns)

    # ------------------------------------------------------------------ messages

    def add(
        self,
        key: str,
        payload: bytes,
        encoding: zenoh.Encoding,
        stamp: zenoh.Timestamp | None,
        source: zenoh.SourceInfo | None,
        received_ns: int,
    ) -> None:
        """Write one publication unchanged, unless a backfill brought it before."""
        # Every message takes this path, and each call costs time. So the usual case, a consecutive number, is checked
        # here.
        state = self._states.get(key)
        if state is None or state.encoding != encoding:
            state = self._key_state(key, encoding)
        published_ns = stamp.get_time_as_ntp64().as_nanos() if stamp is not None else received_ns
        sequence = 0
        if source is not None:
            sequence = (source.source_sn + 1) & 0xFFFFFFFF  # inlined schemas.bus.sequence_of
            entity = source.source_id
            sender = (entity.zid, entity.eid)  # an EntityGlobalId itself compares by identity
            known = state.tracker.senders.get(sender)
            if known is not None and known.last == sequence - 1:
                known.last = sequence
            else:
                # A late message may reach this recorder after the one before it has fetched a copy and was killed.
                if known is None and self._is_recorded(key, sequence, str(encoding), payload, published_ns):
                    return
                if not state.tracker.add_live(sender, sequence, hash(payload)):
                    return
                if known is None:
                    self._note_newcomer(key, sender, sequence, received_ns)
                known = state.tracker.senders[sender]
                self._clocks.add(key, published_ns, received_ns)
                self._irregular_keys.add(key)
                self._request(key, known)
            known.heard_ns = received_ns
        self._unflushed.append((state, received_ns, payload, published_ns, sequence))
        if self.full:
            self._limit_buffer()
        else:
            self._put(state.channel, received_ns, payload, published_ns, sequence)

    def add_backfilled(self, sample: zenoh.Sample, received_ns: int, *, is_of_all: bool = False) -> bool:
        """Write a backfilled publication.

        `is_of_all`: its sender was asked for everything since the begin of the recording.
        Return False if it is recorded already, is older than the session, or has no number or no time.
        """
        source, stamp = sample.source_info, sample.timestamp
        if source is None or stamp is None:
            return False
        published_ns = stamp.get_time_as_ntp64().as_nanos()
        key, sequence = str(sample.key_expr), sequence_of(source)
        sender = (source.source_id.zid, source.source_id.eid)
        tracker = self._trackers.get(key)
        was_missing = tracker is not None and tracker.is_missing(sender, sequence)
        # A message in a gap belongs to this session, whatever the clocks say.
        live_ns = self._clocks.received_ns(key, published_ns)
        if live_ns < self.resume_since_ns and not was_missing:
            return False  # or its clock is slow, and nothing has shown that yet
        if is_of_all:
            self._asked.add(sender[0])
        state = self._states.get(key)
        if state is None or state.encoding != sample.encoding:
            state = self._key_state(key, sample.encoding)
        payload = sample.payload.to_bytes()
        before = state.tracker.senders.get(sender)
        gaps_before = 0 if before is None else len(before.gaps)
        if not state.tracker.add_backfilled(sender, sequence, hash(payload)):
            return False
        known = state.tracker.senders[sender]
        # A gap behind an answer that broke off begins at its last message, not when it was received. The clock of the
        # publisher may be ahead.
        known.heard_ns = known.heard_ns or min(live_ns, received_ns)
        if len(known.gaps) > gaps_before and not was_missing:  # the answer did not go back far enough
            self._request(key, known)
        if self._is_recorded(key, sequence, str(sample.encoding), payload, published_ns):
            return False
        self._irregular_keys.add(key)
        if was_missing:
            self.recovered[key] = self.recovered.get(key, 0) + 1
        if before is None:
            self._note_newcomer(key, sender, sequence, live_ns)
        self._write((state, received_ns, payload, published_ns, sequence))
        return True

    def _note_newcomer(self, key: str, sender: tuple[Hashable, int], sequence: int, heard_ns: int) -> None:
        """Note a new sender, unless all that it has published since the session's begin was or will be asked for."""
        # If more senders publish on one key than are remembered, each of them seems to be new again and again.
        if self._trackers[key].has_forgotten(sender):
            return
        if sequence > 1 and heard_ns > self.resume_since_ns + NEWCOMER_AFTER_NS:
            self.newcomers[key] = key if sender[0] in self._asked else source_of(key)

    def _is_recorded(self, key: str, sequence: int, encoding: str, payload: bytes, published_ns: int) -> bool:
        """Return True if the interrupted session has this message."""
        if not self._recorded:
            return False
        told = identity(messages.name_in(encoding) or "", payload, published_ns)
        return (key, sequence, told) in self._recorded

    def _end_point(self) -> resume.ResumePoint:
        """Return where the session begins that follows this one."""
        name = self.path.name if self._made else ""
        return resume.ResumePoint(name, self.resume_since_ns, self._recorded, self._clocks)

    def _write(self, row: Row) -> None:
        self._unflushed.append(row)
        if self.full:
            self._limit_buffer()
        else:
            self._put(row[0].channel, *row[1:])

    def _key_state(self, key: str, encoding: zenoh.Encoding) -> KeyState:
        """Return the state of a key and an encoding. A key has a second state only if its encoding changes."""
        state = self._counts.find(key, encoding)
        if state is None:
            channel = -1 if self.full or self._segment is None else self._segment.channel(key, str(encoding))
            state = KeyState(key, encoding, self._trackers.setdefault(key, SequenceTracker()), channel)
            self._counts.add(state)
        return state

    # ------------------------------------------------------------------ status

    @property
    def messages(self) -> int:
        """Return the number of messages, written or buffered."""
        return self._written + len(self._unflushed)

    @property
    def bytes(self) -> int:
        """Return the flushed size of all segments."""
        return self._closed_bytes + (0 if self._segment is None else self._segment.bytes)

    @property
    def segments(self) -> int:
        """Return the number of segments."""
        return len(self._index) + (self._segment is not None)

    @property
    def waiting(self) -> int:
        """Return the number of messages buffered because the disk is full."""
        return len(self._unflushed) if self.full else 0

    @property
    def free_bytes(self) -> int:
        """Return the free space on the disk in bytes. Raises OSError if it cannot be determined."""
        return shutil.disk_usage(self.path).free if self._made else free_bytes(self._root)

    @property
    def drops(self) -> dict[str, int]:
        """Return the number of messages that a full disk or queue has cost, by key. Backfilled ones do not count."""
        counts = {key: self._drops.get(key, 0) + self._unrestored(key) for key in (*self._drops, *self._overflows)}
        return {key: count for key, count in counts.items() if count}

    def _unrestored(self, key: str) -> int:
        """Return how many of the messages that did not fit into the queue are still missing."""
        overflows = self._overflows.get(key, 0)
        return min(overflows, self._trackers[key].missing) if overflows else 0

    @property
    def missed(self) -> dict[str, int]:
        """Return the number of publications by key that never came, from gaps in the sequence numbers."""
        counts = {key: self._trackers[key].missing - self._unrestored(key) for key in sorted(self._irregular_keys)}
        return {key: count for key, count in counts.items() if count}

    @property
    def over(self) -> bool:
        """True if the session has reached its limit of bytes or segments."""
        return self._options.quota.is_session_over(self.bytes, self.segments)

    # ------------------------------------------------------------------ every second, and the end

    def tick(self, now_ns: int) -> None:
        """Flush, roll over to the next segment if it is due, and check the disk."""
        self._check_segment()
        self._write_pins()  # write pins before messages, so that after a crash no recorded message lacks its pin
        if self.full:
            self._touch()
            self._resume(now_ns)
            return
        assert self._segment is not None
        try:
            self._flush(sync=self._options.sync is Sync.SECOND)
            segment_s = self._options.segment_s
            late = bool(segment_s) and now_ns - self._segment_started_ns >= segment_s * 1e9
            if (late or 0 < self._options.segment_bytes <= self._segment.bytes) and not self.over:
                self._finish_segment()
                if not self.over:  # the index of the finished segment may have filled the session
                    self._begin_segment(now_ns)
        except OSError as error:
            self._on_write_error(error)
        if not self.full:
            self._check_disk()

    def mark(self, text: str, by: str, now_ns: int) -> None:
        """Add a mark and exempt the session from the quota. Raises OSError if the mark cannot be written."""
        marks = [*self.description.marks, {"time": format_utc(_utc(now_ns)), "text": text, "by": by}]
        self.description.marks, self.description.kept = marks, True
        if self._made:
            self.description.write(self.path)

    def pin(self, pin: Pin) -> None:
        """Pin a time. The pin is in session.json after the next tick."""
        self._pins_unwritten = self._pins.add(pin) or self._pins_unwritten

    def _write_pins(self) -> None:
        if self._pins_unwritten and self._made:
            self._describe_pins()
            with contextlib.suppress(OSError):  # the disk is full or has failed; the status says so
                self.description.write(self.path)
                self._pins_unwritten = False

    def _describe_pins(self) -> None:
        self.description.pins = [pin.to_dict() for pin in self._pins.pins]

    def close(self, now_ns: int) -> None:
        """Write the buffer and end the session, even if this uses up the reserve of the disk.

        Count messages that still do not fit as dropped, and describe them in `cost`.
        """
        self._check_segment()
        self._try_to_finish()
        dropped = 0
        if self._segment is None and self._unflushed and self._open(now_ns, MIN_CLOSE_BYTES):
            dropped = self._drop_all(self._write_buffered(MIN_CLOSE_BYTES))
            self._try_to_finish()
        if self._segment is not None:
            self._segment.cut()
            if self._index and self._counts.is_empty:
                self._segment.path.unlink(missing_ok=True)  # the segment is empty
            else:
                self._add_to_index()
            self.cost = "The disk is full: the last file has no end, but all its messages"
        if dropped := dropped + self._drop_buffered():
            self.cost = f"The disk stayed full: {dropped} waiting messages are lost"
        if self.cost:
            self.description.error = self.cost = f"{self._root}: {self.cost}"
        if self._made:
            try:
                self._write_info(now_ns, closed=True)
            except OSError as error:
                if not session_dir.is_full(error):
                    raise
                self.cost = f"{self.cost or self._root}; the disk is too full to note it in session.json"
            session_dir.release(self.path)

    def abandon(self, why: str, now_ns: int) -> str:
        """End a session after a write error, and return a description. Flushed data stays unchanged."""
        vanished = self._vanished()
        if self._segment is not None:
            self._segment.cut()
        self._drop_buffered()
        dropped = sum(self._drops.values())
        words = f"{why}. The {self._written - vanished} messages before are intact; {dropped} are lost"
        if vanished:
            words += f"; {vanished} were in files that somebody has moved or removed"
        self.description.error = words
        with contextlib.suppress(OSError):  # the disk has failed, as `words` already says
            self._write_info(now_ns, closed=False)
            session_dir.release(self.path)
        return words

    def _check_segment(self) -> None:
        """Raise FileNotFoundError if somebody has moved or removed the file that is being written."""
        if self._segment is not None and not self._segment.is_there:
            raise FileNotFoundError(errno.ENOENT, os.strerror(errno.ENOENT), str(self._segment.path))

    def _touch(self) -> None:
        """Set the time of the newest file to now, although nothing can be written to it.

        By this time, others know that the session is in use: `fleet sessions`, the quota of another recorder, and the
        next recorder, if this one is killed.
        """
        if self._made:
            newest = session_dir.segment(self.path, self.segments)
            with contextlib.suppress(OSError):  # it was removed, or the disk has failed: the next write says so
                os.utime(newest)

    def _vanished(self) -> int:
        """Return how many of the written messages were in files that are no longer there."""
        counts: dict[str, int] = {each["file"]: each["messages"] for each in self._index}
        ended = sum(counts.values())
        lost = sum(count for file, count in counts.items() if not (self.path / file).exists())
        return lost + (0 if self._segment is None or self._segment.is_there else self._written - ended)

    # ------------------------------------------------------------------ segments

    def _open(self, now_ns: int, room_bytes: int) -> bool:
        """Begin a segment. Before the first one, begin the session. If space is short, pause and return False."""
        free = self.free_bytes
        if self._unflushed:  # without room for a large first message, each attempt would begin another empty file
            room_bytes += len(self._unflushed[0][2])
        if why := shortage(free, room_bytes):
            self._pause(why)
            return False
        made = self._made
        try:
            if not made:
                self.path = session_dir.create(self.path, self.description)
                self._made = True
            self._begin_segment(now_ns)
        except OSError as error:
            if self._made and not made:  # remove the new session, because it has no segment
                shutil.rmtree(self.path, ignore_errors=True)
                self._made = False
            self._on_write_error(error)
            return False
        if not made:
            self._copy_files()
        with contextlib.suppress(OSError):
            session_dir.reserve(self.path)
        self._on_room()
        return True

    def _begin_without_room(self, now_ns: int) -> None:
        """Make a session that has to wait for room, with an empty file that can be opened.

        If the recorder is killed while it waits, the session says that messages are lost, and why, and the next
        recorder continues it. It uses some of the reserve. If the disk is full to the last byte, nothing is made.
        """
        if shortage(self.free_bytes, MIN_START_BYTES):
            return
        try:
            self.path = session_dir.create(self.path, self.description)
            self._made = True
            self._begin_segment(now_ns)
            self._finish_segment()
        except OSError as error:
            if not session_dir.is_full(error):
                raise
            shutil.rmtree(self.path, ignore_errors=True)
            self._made = False
            self._reset_segment(now_ns)
        else:
            self._copy_files()

    def _reset_segment(self, now_ns: int) -> None:
        self._counts = SegmentCounts()
        self._states = self._counts.states
        self._segment_started_ns = now_ns
        self._segment: Segment | None = None

    def _begin_segment(self, now_ns: int) -> None:
        self._reset_segment(now_ns)
        path = session_dir.segment(self.path, len(self._index) + 1)
        try:
            self._segment = Segment(path, self._metadata)
        except OSError:
            path.unlink(missing_ok=True)
            raise
        self._put = self._segment.add

    def _flush(self, *, sync: bool = False) -> None:
        """Flush the segment, and count its messages."""
        if self._segment is not None:
            self._segment.flush(sync=sync)
            self._on_flushed()

    def _on_flushed(self) -> None:
        """Add the flushed messages to the counters of the index."""
        in_segment = self._unended if self.full else len(self._unflushed)
        rows, self._unflushed = self._unflushed[:in_segment], self._unflushed[in_segment:]
        self._unended = 0
        if not rows:
            return
        self._counts.count(rows, self._stops)
        self._written += len(rows)

    def _try_to_finish(self) -> None:
        """Flush and finish the segment, if there is one and the disk has room for its end."""
        try:
            if self._segment is not None:
                self._flush()
                self._finish_segment()
        except OSError as error:
            self._on_write_error(error)

    def _finish_segment(self) -> None:
        assert self._segment is not None
        lost = {"drops": self.drops, "missed": self.missed, "recovered": self.recovered}
        self._segment.finish({"messages": self._written, **lost}, sync=self._options.sync is not Sync.NEVER)
        self._add_to_index()

    def _add_to_index(self) -> None:
        """Add the closed segment to index.json."""
        assert self._segment is not None
        self._index.append(self._counts.entry(self._segment.path.name, self._segment.bytes))
        self._closed_bytes += self._segment.bytes
        self._segment = None
        with contextlib.suppress(OSError):  # index.json is only a cache, and session.json is written again at the end
            session_dir.replace(self.path / session_dir.INDEX_FILE, {"segments": self._index})
            self._write_info(None, closed=False)

    # ------------------------------------------------------------------ full disk

    def _on_write_error(self, error: OSError) -> None:
        """If the disk is full, pause, and keep the unflushed messages in the buffer. Raise any other error.

        The segment stays as it was after the last flush. Its end is kept in memory until there is room for it.
        """
        if not session_dir.is_full(error):
            raise error
        if self._segment is not None and not self.full:
            self._unended = len(self._unflushed)
        self._pause(f"{error.strerror or error}")

    def _pause(self, words: str) -> None:
        """Pause, or update the reason of a pause."""
        began, self.full = not self.full, f"{self._root}: {words}. Recording pauses until there is room."
        self.warning = ""
        self._buffered_bytes = sum(len(row[2]) for row in self._unflushed)
        if not began:
            return
        self.description.error = self.full
        if self._made:
            with contextlib.suppress(OSError):  # the status gives the reason, and session.json is written at the end
                self._write_info(None, closed=False)

    def _on_room(self) -> None:
        """Record again. session.json keeps a note of the pause, in the past tense."""
        if self.full:
            self.description.error = (
                f"{self.description.error.partition('. Recording pauses')[0]}. Recording had paused."
            )
        self.full = ""

    def _limit_buffer(self) -> None:
        """Drop the newest message if the buffer is full."""
        state, _, payload, _, _ = self._unflushed[-1]
        if len(self._unflushed) > MAX_BUFFERED_MESSAGES or self._buffered_bytes + len(payload) > MAX_BUFFERED_BYTES:
            self._unflushed.pop()
            self.drop(state.key)
        else:
            self._buffered_bytes += len(payload)

    def drop(self, key: str) -> None:
        """Count a dropped message."""
        self._drops[key] = self._drops.get(key, 0) + 1

    def drop_received(self, key: str, sender: Hashable, number: int, count: int) -> None:
        """Count messages that did not fit into the queue. `number` is that of the last one.

        `sender` is None if they have no numbers.
        """
        if sender is None:
            self._drops[key] = self._drops.get(key, 0) + count
            return
        tracker = self._trackers.setdefault(key, SequenceTracker())
        tracker.add_dropped(sender, number, count)
        self._overflows[key] = self._overflows.get(key, 0) + count
        self._irregular_keys.add(key)
        self._request(key, tracker.senders[sender])

    def _request(self, key: str, sender: TrackedSender) -> None:
        """Request a backfill of a key if messages of this sender are missing."""
        if sender.gaps:
            self.gaps[key] = min(sender.heard_ns, self.gaps.get(key, sender.heard_ns))

    def _drop_buffered(self) -> int:
        """Drop the buffer, and return the number of its messages."""
        rows, self._unflushed = self._unflushed, []
        return self._drop_all(rows)

    def _drop_all(self, rows: Sequence[Row]) -> int:
        for state, *_ in rows:
            self.drop(state.key)
        return len(rows)

    def _check_disk(self) -> None:
        """Enforce the quota, and pause if the disk is nearly full."""
        done = enforce(self._options.quota, self._root, self.path, self._pins.pins)
        self.quota_news += done.news
        self.warning = done.warning
        reserve, free = self._options.reserve, self.free_bytes
        self.warning = reserve.warning(self._root, free) or self.warning
        if why := reserve.why_broken(free):
            try:
                self._finish_segment()
            except OSError as error:
                self._on_write_error(error)
                return
            self._pause(why)

    def _resume(self, now_ns: int) -> None:
        reserve = self._options.reserve
        if self._segment is not None:
            if why := shortage(self.free_bytes, reserve.to_end + self._segment.waiting_bytes):
                self._pause(why)
                return
            self._try_to_finish()
        if self._segment is not None or not self._open(now_ns, reserve.to_resume):
            return
        if rest := self._write_buffered(reserve.to_end):
            if not self.full:
                self._try_to_finish()
            self._unflushed += rest
            self._pause(f"{len(self._unflushed)} waiting messages need more space")

    def _write_buffered(self, keep_bytes: int) -> list[Row]:
        """Write the buffer as long as `keep_bytes` stay free, and return the rest."""
        rows, self._unflushed = self._unflushed, []
        done = size = 0
        most = self.free_bytes - keep_bytes
        try:
            while done < len(rows):
                state, received_ns, payload, published_ns, sequence = rows[done]
                if size + len(payload) > most:
                    break
                done += 1
                self._write((self._key_state(state.key, state.encoding), received_ns, payload, published_ns, sequence))
                size += len(payload)
                if size >= OVERFLOW_BATCH_BYTES:
                    self._flush()
                    size, most = 0, self.free_bytes - keep_bytes
            self._flush()
        except OSError as error:
            if not session_dir.is_full(error):
                self._unflushed += rows[done:]  # `abandon` counts them
            self._on_write_error(error)
        return rows[done:]

    # ------------------------------------------------------------------ the directory

    def _copy_files(self) -> None:
        for name, source in self._options.copied.items():
            try:
                shutil.copyfile(source, self.path / name)
            except OSError as error:  # recording continues without the copy
                self.uncopied.append(f"{source} could not be copied into {self.path}: {error.strerror or error}")
        if self.uncopied:
            self.description.error = "; ".join(self.uncopied)
            self.description.write(self.path)

    def _write_info(self, now_ns: int | None, *, closed: bool) -> None:
        description = self.description
        if now_ns is not None:
            description.ended, description.closed = format_utc(_utc(now_ns)), closed
        description.messages, description.stops = self._written, self._stops.count
        description.drops, description.missed = self.drops, self.missed
        description.recovered = dict(self.recovered)
        self._describe_pins()
        description.write(self.path)


def _utc(now_ns: int) -> datetime:
    return datetime.fromtimestamp(now_ns / 1e9, UTC)
