"""Finds frames in what a car sends: bytes in any pieces go in, events come out. No I/O, no clock.

Linear and bounded: at most `max_frame` bytes are kept, and what is kept is not searched again. Every byte that comes in
is in the `raw` of exactly one event, but for two kinds that are harmless and make none: separators (CR, LF, space, tab)
between frames, and a `#` that comes late, after a frame which silence has already ended.
Junk is one event per run, in pieces of `max_frame` bytes; what follows an overlong frame is junk up to the next `$`.

The events depend only on the bytes and on gaps of 50 ms between them, not on how they were cut. How to make a reading
of one whole frame is in `parse`.
"""

import re
from typing import Final

from gateway.protocol.events import ArmReading, Cause, Echo, Event, ImuReading, Reject, Rejected, Sensors
from gateway.protocol.parser import fullmatch_sensors, match_ended_sensors, parse, sensors

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

MAX_FRAME: Final = 256  # docs/reference/protocol.md#bad-input: a frame longer than this is cut off as noise
_MIN_FRAME: Final = 64  # a sensors frame in its longest observed spelling has 46 bytes
SILENCE_S: Final = 0.050  # docs/reference/protocol.md#readings: accept a missing `#` if nothing follows for 50 ms
ECHO_S: Final = 2.0  # docs/reference/protocol.md#readings: bytes equal to a frame that we sent in the last 2 s
_SENT_MAX: Final = 256  # 2 s of the wire's 960 bytes/s hold 101 frames of 19 bytes; a lone `#` is one entry

_START, _END = b"$"[0], b"#"[0]
_MARK = re.compile(rb"[$#]")
_SEPARATORS = b"\r\n \t"


class Decoder:
    """The events of one link's bytes. One decoder per connection: a new link never completes an old frame."""

    def __init__(self, max_frame: int = MAX_FRAME) -> None:
        if not _MIN_FRAME <= max_frame <= MAX_FRAME:
            raise ValueError(f"max_frame: {max_frame}, allowed are {_MIN_FRAME}..{MAX_FRAME}")
        self._max = max_frame
        self._held = bytearray()  # a frame from its `$` on, or junk from its first byte that is no separator
        self._last = 0.0  # when the last byte of it came
        self._waiting = False  # a silence after what is held means something
        self._late_end = False  # the last frame was ended by silence: its `#` may still come
        self._sent: dict[bytes, float] = {}

    def feed(self, data: bytes, now: float) -> list[Event]:
        """The events that these bytes complete; `now` is when they were had (seconds, any fixed origin)."""
        events = self.tick(now) if self._waiting else []
        held, sent, pos, size, most = self._held, self._sent, 0, len(data), self._max
        while pos < size:
            if not held and (found := match_ended_sensors(data, pos, pos + most)):  # the fast path
                raw = found[0]
                events.append(Echo(raw, now) if raw in sent and self._is_echo(raw, now) else sensors(found, now))
                pos = found.end()
                self._late_end = False
            elif held and held[0] == _START:
                pos = self._inside(data, pos, now, events)
            else:
                pos = self._outside(data, pos, now, events)
        if size:
            self._waiting = bool(held) and (held[0] != _START or held[-4:-2] == b"GM")
        return events

    def tick(self, now: float) -> list[Event]:
        """The events that silence up to `now` completes; `feed` does this by itself first."""
        if not self._waiting or now < self._last + SILENCE_S:
            return []
        self._waiting = False
        if self._held[0] != _START:
            return self._junk()
        if not fullmatch_sensors(self._held):
            return []
        self._late_end = True
        return self._unended(by_silence=True)

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
        return self._unended(by_silence=True) if self._held[0] == _START else self._junk()

    def _outside(self, data: bytes, pos: int, now: float, events: list[Event]) -> int:
        """Consume junk up to the next `$`, and that `$`; at most `max_frame` bytes at a time."""
        if self._late_end:
            self._late_end = False
            if data[pos] == _END:
                return pos + 1
        start = data.find(b"$", pos, pos + self._max - len(self._held))
        stop = min(len(data), pos + self._max - len(self._held)) if start < 0 else start
        if stop > pos:
            self._held += data[pos:stop] if self._held else data[pos:stop].lstrip(_SEPARATORS)
            self._last = now
        if start >= 0:
            events += self._junk()
            self._begin(now)
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
            events += self._unended()
            self._begin(now)
            return stop + 1
        if stop < len(data):
            events.append(Rejected(self._take(b""), self._last, Cause.OVERLONG, f"no end in {self._max} bytes"))
        return stop

    def _begin(self, now: float) -> None:
        self._held.append(_START)
        self._last = now

    def _take(self, rest: bytes) -> bytes:
        raw = bytes(self._held) + rest
        self._held.clear()
        return raw

    def _junk(self) -> list[Event]:
        """What is held outside a frame, as an event; nothing if nothing is."""
        raw = self._take(b"").strip(_SEPARATORS)
        if not raw:
            return []
        if self._is_echo(raw, self._last):
            return [Echo(raw, self._last)]
        return [Rejected(raw, self._last, Cause.NO_START, f"{len(raw)} bytes outside a frame")]

    def _ended(self, raw: bytes, at: float) -> Event:
        return Echo(raw, at) if self._is_echo(raw, at) else parse(raw, at)

    def _unended(self, *, by_silence: bool = False) -> list[Event]:
        raw, at = self._take(b""), self._last
        if self._is_echo(raw, at):
            return [Echo(raw, at)]
        found = fullmatch_sensors(raw)
        if found:
            return [sensors(found, at, terminated=False, by_silence=by_silence)]
        return [Rejected(raw, at, Cause.TRUNCATED, "another frame began, or the link ended")]

    def _is_echo(self, raw: bytes, at: float) -> bool:
        return raw in self._sent and at - self._sent[raw] <= ECHO_S
