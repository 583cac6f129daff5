"""Finds frames in what a car sends: bytes in any pieces go in, events come out. No I/O, no clock.

Linear and bounded: a byte is looked at once, and at most `max_frame` bytes are kept. Every byte that comes in is in the
`raw` of exactly one event, but for the separators (CR, LF, space, tab) around junk, which are harmless and make no
event, and for a `#` that follows a frame which silence has already ended.

The events depend only on the bytes and on gaps of 50 ms between them, not on how they were cut. How to make a reading
of one whole frame is in `parse`.
"""

import re
from typing import Final

from gateway.protocol.parse import fullmatch_sensors, match_sensors, parse, sensors
from gateway.protocol.readings import ArmReading, Cause, Echo, Event, ImuReading, Reject, Rejected, Sensors

__all__ = [
    "ArmReading",
    "Cause",
    "Decoder",
    "Echo",
    "Event",
    "ImuReading",
    "Reject",
    "Rejected",
    "Sensors",
]

MAX_FRAME: Final = 256  # protocol.md, bad input: a frame longer than this is cut off as noise
SILENCE_S: Final = 0.050  # protocol.md, readings: a missing `#` is accepted when nothing follows for 50 ms
ECHO_S: Final = 2.0  # protocol.md, readings: bytes equal to a frame that we sent in the last 2 s
_SENT_MAX: Final = 256  # 2 s of the wire's 960 bytes/s hold 101 frames of 19 bytes; a lone `#` is one entry

_START, _END = b"$"[0], b"#"[0]
_MARK = re.compile(rb"[$#]")
_SEPARATORS = b"\r\n \t"


class Decoder:
    """The events of one link's bytes. One decoder per connection: a new link never completes an old frame."""

    def __init__(self, max_frame: int = MAX_FRAME) -> None:
        self._max = max_frame
        self._held = bytearray()  # a frame from its `$` on, or junk from its first byte that is no separator
        self._last = 0.0  # when the last byte of it came
        self._waiting = False  # a silence after what is held means something
        self._late_end = False  # the last frame was ended by silence: its `#` may still come
        self._sent: dict[bytes, float] = {}

    def feed(self, data: bytes, now: float) -> list[Event]:
        """The events that these bytes complete; `now` is when they were had (seconds, any fixed origin)."""
        events = self.tick(now) if self._waiting else []
        held, sent, pos, size = self._held, self._sent, 0, len(data)
        while pos < size:
            if not held:
                # the fast path: a whole sensors frame lies here
                found = match_sensors(data, pos)
                if found and found[7] and found.end() - pos <= self._max:
                    pos = found.end()
                    self._late_end = False
                    events.append(self._ended(found[0], now) if sent else sensors(found, now))
                    continue
            if held and held[0] == _START:
                pos = self._inside(data, pos, now, events)
            else:
                pos = self._outside(data, pos, now, events)
        if size:
            self._last = now
            self._waiting = bool(held) and (held[0] != _START or held[-4:-2] == b"GM")
        return events

    def tick(self, now: float) -> list[Event]:
        """The events that silence up to `now` completes; `feed` does this by itself first."""
        if not self._waiting or now < self._last + SILENCE_S:
            return []
        self._waiting = False
        if self._held[0] != _START:
            return self._junk()
        found = fullmatch_sensors(bytes(self._held))
        if not found:
            return []
        self._held.clear()
        self._late_end = True
        return [sensors(found, self._last, by_silence=True)]

    def deadline(self) -> float | None:
        """When `tick` is next wanted, on the clock of `now`; None if silence would complete nothing."""
        return self._last + SILENCE_S if self._waiting else None

    def sent(self, data: bytes, now: float) -> None:
        """Remember a frame of ours, as written, so that its echo is known for 2 s."""
        self._sent.pop(data, None)
        self._sent[data] = now
        while len(self._sent) > _SENT_MAX or now - next(iter(self._sent.values())) > ECHO_S:
            del self._sent[next(iter(self._sent))]

    def end(self) -> list[Event]:
        """The events of what is still held when the link or file has ended; the decoder is empty afterwards."""
        self._waiting = self._late_end = False
        if not self._held:
            return []
        return self._unended(self._take(b""), self._last) if self._held[0] == _START else self._junk()

    def _outside(self, data: bytes, pos: int, now: float, events: list[Event]) -> int:
        """Consume junk up to the next `$`, and that `$`; at most `max_frame` bytes at a time."""
        if self._late_end:
            self._late_end = False
            if data[pos] == _END:
                return pos + 1
        start = data.find(b"$", pos, pos + self._max - len(self._held))
        stop = min(len(data), pos + self._max - len(self._held)) if start < 0 else start
        junk = data[pos:stop]
        self._held += junk if self._held else junk.lstrip(_SEPARATORS)
        self._last = now
        if start >= 0:
            events += self._junk()
            self._held.append(_START)
            return start + 1
        if len(self._held) == self._max:
            events += self._junk()
        return stop

    def _inside(self, data: bytes, pos: int, now: float, events: list[Event]) -> int:
        """Consume a frame up to its `#`, the next `$`, or `max_frame` bytes."""
        room = self._max - len(self._held)
        mark = _MARK.search(data, pos, pos + room)
        if mark and data[mark.start()] == _END:
            events.append(self._ended(self._take(data[pos : mark.end()]), now))
            return mark.end()
        stop = mark.start() if mark else min(len(data), pos + room)
        if stop > pos:
            self._held += data[pos:stop]
            self._last = now
        if mark or (stop < len(data) and data[stop] == _START):
            events += self._unended(self._take(b""), self._last)
            self._held.append(_START)
            return stop + 1
        if stop < len(data):
            events.append(Rejected(self._take(b""), self._last, Cause.OVERLONG, f"no end in {self._max} bytes"))
        return stop

    def _take(self, rest: bytes) -> bytes:
        raw = bytes(self._held) + rest
        self._held.clear()
        return raw

    def _junk(self) -> list[Event]:
        """What is held and is no frame, as an event; nothing if it is only separators."""
        raw = self._take(b"").strip(_SEPARATORS)
        if not raw:
            return []
        if self._is_echo(raw, self._last):
            return [Echo(raw, self._last)]
        return [Rejected(raw, self._last, Cause.NO_START, f"{len(raw)} bytes outside a frame")]

    def _ended(self, raw: bytes, at: float) -> Event:
        return Echo(raw, at) if self._is_echo(raw, at) else parse(raw, at)

    def _unended(self, raw: bytes, at: float) -> list[Event]:
        if self._is_echo(raw, at):
            return [Echo(raw, at)]
        found = fullmatch_sensors(raw)
        return [sensors(found, at) if found else Rejected(raw, at, Cause.TRUNCATED, "another frame began, or it ended")]

    def _is_echo(self, raw: bytes, at: float) -> bool:
        return raw in self._sent and at - self._sent[raw] <= ECHO_S
