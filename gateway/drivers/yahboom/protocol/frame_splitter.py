"""Finds the frames in a car's bytes: bytes in any pieces go in, events come out. No I/O, no clock.

Work is linear, and memory is bounded: the buffer has at most `max_frame` bytes. Every byte is in the `raw` of
exactly one event, with two harmless exceptions: separators (CR, LF, space, tab) between frames, and a late `#` after a
frame that a silence has ended.
A whole line of text between frames is an event. Other junk is one event for each run of up to `max_frame` bytes. After
an overlong frame, everything up to the next `$` is junk.

The events depend only on the bytes and on gaps of 50 ms and 0.5 s between them, not on the pieces. `frame_parser` makes
the reading of one whole frame.
"""

import re
from math import inf
from typing import Final

from gateway.control.driver import Echo, Rejected, TextLine
from gateway.drivers.yahboom.protocol.frame_parser import parse
from gateway.drivers.yahboom.protocol.frames import STANDARD_HEAD
from gateway.drivers.yahboom.protocol.sensors import read_sensors, sensors_matcher
from gateway.drivers.yahboom.protocol.wire_events import Event
from schemas.words import Cause

MAX_FRAME: Final = 256  # docs/reference/protocol.md#bad-input: a frame longer than this is cut off as noise
_MIN_FRAME: Final = 64  # a sensors frame in its longest observed spelling has 46 bytes
MISSING_END_SILENCE_S: Final = 0.050
"""Silence after which a frame is accepted without its `#` (docs/reference/protocol.md#readings)."""
# After an outage, a link joins the beginning of one frame and the end of another. Such a frame is no measurement, so
# end an incomplete frame after a silence. A radio link repeats lost bytes in less time than this.
CUT_FRAME_SILENCE_S: Final = 0.5
"""Silence that ends an incomplete frame. It is rejected as truncated (docs/reference/protocol.md#readings)."""
ECHO_S: Final = 2.0  # docs/reference/protocol.md#readings: bytes equal to a frame that we sent in the last 2 s
_SENT_MAX: Final = 256  # the wire carries 101 frames of 19 bytes in 2 s; a lone `#` is one entry

_START, _END = b"$"[0], b"#"[0]
_MARK = re.compile(rb"[$#]")
_SEPARATORS = b"\r\n \t"
_LINE_END_BYTES = frozenset(b"\r\n")
_LINE = re.compile(rb"[^\r\n]*(?:\r\n|[\r\n])")
# If the car prints a line end after each frame, a piece of a damaged frame also ends with one. So a line counts as text
# only if it contains a word, and no word of the protocol.
_TEXT = re.compile(rb"(?=.*[A-Za-z]{2})[\t\x20-\x22\x24-\x7e]+")
_PROTOCOL_WORD = re.compile(rb"(?<![A-Za-z])(?:4WD|CSB|PV|GS|LF|HW|GM|J[1-6]|MPU|Servo|PTZ|CL[RGB]|MODE)")


class FrameSplitter:
    """Splits the bytes of one link. Make a new one for a new link, whose bytes must not complete an old frame."""

    def __init__(self, max_frame: int = MAX_FRAME, *, head: str = STANDARD_HEAD) -> None:
        """`head` is the first word of the frames of this car."""
        if not _MIN_FRAME <= max_frame <= MAX_FRAME:
            raise ValueError(f"max_frame: {max_frame}, allowed are {_MIN_FRAME}..{MAX_FRAME}")
        self._max = max_frame
        self.use_head(head)
        self._buffer = bytearray()  # a frame from its `$` on, or junk from its first byte that is not a separator
        self._last_at = 0.0  # time of the last byte in the buffer
        self._silence_s = inf  # how long nothing must arrive after that byte for the buffer to become an event
        self._late_end = False  # True if silence ended the last frame: its `#` may still come
        self._is_mid_line = False  # True if an earlier event has the beginning of this line
        self._sent: dict[bytes, float] = {}

    def use_head(self, head: str) -> None:
        """Use this as the first word of the frames from now on."""
        self._head, self._head_bytes = head, head.encode()
        self._matcher = sensors_matcher(head)
        self._match_ended = self._matcher.match_ended

    def feed(self, data: bytes, now: float) -> list[Event]:
        """Return the events that these bytes complete. `now` is their time of arrival in seconds, any fixed origin."""
        events = self.flush(now) if self._buffer else []
        buffer, sent, pos, size, most = self._buffer, self._sent, 0, len(data), self._max
        match_ended = self._match_ended
        while pos < size:
            if not buffer and (found := match_ended(data, pos, pos + most)):  # the fast path
                raw = found[0]
                events.append(Echo(raw, now) if raw in sent and self._is_echo(raw, now) else read_sensors(found, now))
                pos = found.end()
                self._late_end = self._is_mid_line = False
            elif buffer and buffer[0] == _START:
                pos = self._inside(data, pos, now, events)
            else:
                pos = self._outside(data, pos, now, events)
        if size:
            self._silence_s = self._ending_silence_s() if buffer else inf
        return events

    def flush(self, now: float) -> list[Event]:
        """Return the events that the silence until `now` completes. `feed` calls this first."""
        if now < self._last_at + self._silence_s:
            return []
        self._silence_s = inf
        if self._buffer[0] != _START:
            return self._take_junk()
        self._late_end = True
        return self._take_unended(by_silence=True)

    def deadline(self) -> float | None:
        """Return when to call `flush`, on the clock of `now`. None if a silence would complete no event."""
        return self._last_at + self._silence_s if self._buffer else None

    def sends(self, data: bytes, now: float) -> None:
        """Remember a frame that is about to be written, to recognize its echo (the same bytes) for 2 s."""
        self._sent.pop(data, None)
        self._sent[data] = now
        while len(self._sent) > _SENT_MAX or now - next(iter(self._sent.values())) > ECHO_S:
            del self._sent[next(iter(self._sent))]

    def end(self) -> list[Event]:
        """Return the events of the buffered bytes at the end of the link or file, and empty the buffer."""
        self._silence_s, self._late_end = inf, False
        events: list[Event] = []
        if self._buffer:
            events = self._take_unended(by_silence=True) if self._buffer[0] == _START else self._take_junk()
        self._is_mid_line = False
        return events

    def _ending_silence_s(self) -> float:
        """Return the silence that ends the buffered bytes. The buffer must not be empty."""
        whole = self._buffer[0] != _START or self._matcher.is_complete(self._buffer)
        return MISSING_END_SILENCE_S if whole else CUT_FRAME_SILENCE_S

    def _outside(self, data: bytes, pos: int, now: float, events: list[Event]) -> int:
        """Consume junk up to the next `$` and that `$`, at most `max_frame` bytes. Return the next position."""
        if self._late_end:
            self._late_end = False
            if data[pos] == _END:
                return pos + 1
        limit = min(len(data), pos + self._max - len(self._buffer))
        start = data.find(b"$", pos, limit)
        stop = limit if start < 0 else start
        if stop > pos:
            piece = data[pos:stop]
            if not self._buffer:
                piece = piece.lstrip(_SEPARATORS)
                if self._is_mid_line and not _LINE_END_BYTES.isdisjoint(data[pos : stop - len(piece)]):
                    self._is_mid_line = False
            self._buffer += piece
            self._last_at = now
        if start >= 0:
            events += self._take_junk()
            self._begin(now)
            return start + 1
        if len(self._buffer) == self._max:
            events += self._take_junk()
        return stop

    def _inside(self, data: bytes, pos: int, now: float, events: list[Event]) -> int:
        """Consume a frame up to its `#`, the next `$`, or `max_frame` bytes. Return the next position."""
        room = self._max - len(self._buffer)
        mark = _MARK.search(data, pos, pos + room)
        if mark and data[mark.start()] == _END:
            events.append(self._event_of_ended(self._take(data[pos : mark.end()]), now))
            return mark.end()
        stop = mark.start() if mark else min(len(data), pos + room)
        if stop > pos:
            self._buffer += data[pos:stop]
            self._last_at = now
        # The search ends where the buffer is full. So look at the next byte, too: a `$` there begins another frame.
        if mark or (stop < len(data) and data[stop] == _START):
            events += self._take_unended()
            self._begin(now)
            return stop + 1
        if stop < len(data):
            self._is_mid_line = True
            events.append(Rejected(self._take(b""), self._last_at, Cause.OVERLONG, f"no end in {self._max} bytes"))
        return stop

    def _begin(self, now: float) -> None:
        self._buffer.append(_START)
        self._last_at = now
        self._is_mid_line = False

    def _take(self, rest: bytes) -> bytes:
        raw = bytes(self._buffer) + rest
        self._buffer.clear()
        return raw

    def _take_junk(self) -> list[Event]:
        """Empty the buffer of junk. Return its events: whole lines of text, and the runs between them."""
        raw = self._take(b"")
        if not raw:
            return []
        events: list[Event] = []
        begin, is_whole = 0, not self._is_mid_line
        for found in _LINE.finditer(raw):
            text = found[0].rstrip(_SEPARATORS)
            if is_whole and self._is_text(text):
                events += self._events_of_run(raw[begin : found.start()])
                events.append(TextLine(found[0], self._last_at))
                begin = found.end()
            is_whole = True
        events += self._events_of_run(raw[begin:])
        self._is_mid_line = raw[-1] not in _LINE_END_BYTES
        return events

    def _is_text(self, line: bytes) -> bool:
        return bool(_TEXT.fullmatch(line)) and not _PROTOCOL_WORD.search(line) and self._head_bytes not in line

    def _events_of_run(self, junk: bytes) -> list[Event]:
        """Return the event of a run of junk that is not text. Separators alone are no event."""
        raw = junk.strip(_SEPARATORS)
        if not raw:
            return []
        if self._is_echo(raw, self._last_at):
            return [Echo(raw, self._last_at)]
        return [Rejected(raw, self._last_at, Cause.NO_START, f"{len(raw)} bytes outside a frame")]

    def _event_of_ended(self, raw: bytes, at: float) -> Event:
        return Echo(raw, at) if self._is_echo(raw, at) else parse(raw, at, self._head)

    def _take_unended(self, *, by_silence: bool = False) -> list[Event]:
        """Empty the buffer of a frame without `#`. Return its event."""
        raw, at = self._take(b""), self._last_at
        if self._is_echo(raw, at):
            return [Echo(raw, at)]
        found = self._matcher.fullmatch_unended(raw)
        if found:
            return [read_sensors(found, at, terminated=False, by_silence=by_silence)]
        self._is_mid_line = True
        return [
            Rejected(
                raw,
                at,
                Cause.TRUNCATED,
                f"another frame began, nothing came for {CUT_FRAME_SILENCE_S:g} s, or the link ended",
            )
        ]

    def _is_echo(self, raw: bytes, at: float) -> bool:
        return raw in self._sent and at - self._sent[raw] <= ECHO_S
