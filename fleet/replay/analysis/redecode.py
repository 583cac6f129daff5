"""Recorded raw frames through today's decoder, and every difference to what was made of them then. Pure.

What is a measurement depends on the platform that the car was treated as and on the mode that it was known to be in:
both are the recorded ones. Two things a recording does not tell exactly: which of two states held at the very moment
of a frame, and whether a frame without its # was ended by silence or by the next one. Where the result depends on
that, and what was recorded is one of the possible results, there is no difference and the frame counts as undecided.
"""

from collections import deque
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from itertools import product
from typing import Any, Final

from fleet.replay.analysis.recorded_frames import Confirmed, Item, Rx, Treated, Tx
from gateway.protocol.decoder import ECHO_S, MAX_FRAME, Decoder
from gateway.protocol.enums import Mode
from gateway.protocol.events import Event
from gateway.protocol.measurements import measured, verdict_of
from gateway.protocol.platforms import Profile, parse_platform

MODE_NS: Final = 500_000_000
"""A mode is published so much later than it follows, at most: a gateway's loop takes what came in turns."""
PLATFORM_NS: Final = 1_500_000_000
"""The same of the platform, which is in what comes once a second."""
WAIT_NS: Final = 2_500_000_000
"""A frame waits so long for the state after it: states come once a second."""
_EARLY_NS: Final = 300_000_000
"""An echo may come so long before its frame is told: the frame is told when the write is over."""

Outcome = tuple[str, dict[str, dict[str, Any]]]
"""The verdict, and the fields of each reading by topic."""


@dataclass(frozen=True, slots=True)
class ReadingDifference:
    """One thing that is otherwise now."""

    car: str
    at_ns: int
    data: bytes
    what: str
    """`verdict`, `published`, or a topic and its field."""
    then: Any
    now: Any


@dataclass(slots=True)
class Counts:
    """What was compared of one car."""

    frames: int = 0
    readings: int = 0
    undecided: int = 0
    """Frames of which the recording does not tell which result is right."""
    absent: int = 0
    """Readings that a frame says were published, and that are not there: they were lost before they were recorded."""


class NoPlatform(Exception):
    """What a car was treated as is not in the recording; the text says what to do."""


@dataclass(slots=True)
class Redecoding:
    """Takes items of one car in their order, gives differences. `platform`: instead of the recorded one."""

    car: str
    platform: str | None = None
    counts: Counts = field(default_factory=Counts)
    _decoder: Decoder = field(default_factory=Decoder)
    _waiting: deque[Rx] = field(default_factory=deque)
    _sent: deque[Tx] = field(default_factory=deque)
    _modes: deque[Confirmed] = field(default_factory=deque)
    _platforms: deque[Treated] = field(default_factory=deque)
    _began_ns: int | None = None

    def take(self, item: Item) -> Iterator[ReadingDifference]:
        """One more item; the differences of frames that nothing more can be learnt of. Raises NoPlatform."""
        if self._began_ns is None:
            self._began_ns = item.at_ns
        match item:
            case Rx():
                self._waiting.append(item)
            case Tx():
                self._sent.append(item)
            case Confirmed():
                self._modes.append(item)
            case Treated():
                self._platforms.append(item)
        while self._waiting and item.at_ns - self._waiting[0].at_ns > WAIT_NS:
            yield from self._judge(self._waiting.popleft())

    def end(self) -> Iterator[ReadingDifference]:
        """Nothing more comes."""
        while self._waiting:
            yield from self._judge(self._waiting.popleft())

    def _judge(self, frame: Rx) -> Iterator[ReadingDifference]:
        self.counts.frames += 1
        self.counts.readings += len(frame.readings)
        self.counts.absent += len(frame.published) - len(frame.readings)
        outcomes = self._outcomes(frame)
        if len(outcomes) > 1:
            self.counts.undecided += 1
        found = [list(_compared(self.car, frame, outcome)) for outcome in outcomes]
        if all(found):
            # Of several possible results the nearest is shown.
            yield from min(found, key=len)

    def _outcomes(self, frame: Rx) -> list[Outcome]:
        """What today's decoder may make of a frame: one result, if the recording tells all that matters."""
        assert self._began_ns is not None
        at = (frame.at_ns - self._began_ns) / 1e9
        while self._sent and self._sent[0].at_ns <= frame.at_ns + _EARLY_NS:
            sent = self._sent.popleft()
            self._decoder.sent(sent.data, (sent.at_ns - self._began_ns) / 1e9)
        modes = [each.mode for each in _around(self._modes, frame.at_ns, MODE_NS)] or [None]
        found: list[Outcome] = []
        for events, profile, mode in product(
            _decoded(self._decoder, frame.data, at), self._profiles(frame.at_ns), dict.fromkeys(modes)
        ):
            outcome = _outcome(events, profile, mode)
            if outcome not in found:
                found.append(outcome)
        if frame.verdict == "echo" and at < ECHO_S and all(verdict != "echo" for verdict, _ in found):
            found.append(("echo", {}))  # of a frame that was sent before the recording began
        return found

    def _profiles(self, at_ns: int) -> list[Profile]:
        if self.platform is not None:
            return [parse_platform(self.platform)]
        names = dict.fromkeys(each.platform for each in _around(self._platforms, at_ns, PLATFORM_NS))
        found = []
        for name in names:
            try:
                found.append(parse_platform(name))
            except ValueError:
                raise NoPlatform(
                    f"{self.car} was treated as platform {name!r}, which this version does not know: give --platform"
                ) from None
        if not found:
            raise NoPlatform(
                f"the recording does not say what {self.car} was treated as (no state/health of it): give --platform"
            )
        return found


def _around(states: deque[Any], at_ns: int, late_ns: int) -> list[Any]:
    """The state before a moment (or the first), and those told so soon after it that they may be of then."""
    while len(states) > 1 and states[1].at_ns < at_ns:
        states.popleft()
    return [state for number, state in enumerate(states) if not number or state.at_ns <= at_ns + late_ns]


def _decoded(decoder: Decoder, data: bytes, at: float) -> list[tuple[Event, ...]]:
    """The events of one frame's bytes; of one without its # for each way in which it may have been ended."""
    silence = (*decoder.feed(data, at), *decoder.end())
    if data.endswith(b"#") or not data.startswith(b"$"):
        return [silence]
    another = tuple(decoder.feed(data + b"$", at))
    decoder.end()
    found = [another, silence]
    if len(data) >= MAX_FRAME:
        more = tuple(decoder.feed(data + b"0", at))
        decoder.end()
        found.append(more)
    return found


def _outcome(events: Iterable[Event], profile: Profile, mode: Mode | None) -> Outcome:
    verdicts = []
    readings: dict[str, dict[str, Any]] = {}
    for event in events:
        verdicts.append(verdict_of(event))
        readings |= measured(event, profile, mode)
    return " ".join(verdicts), readings


def _compared(car: str, frame: Rx, outcome: Outcome) -> Iterator[ReadingDifference]:
    verdict, readings = outcome
    if verdict != frame.verdict:
        yield ReadingDifference(car, frame.at_ns, frame.data, "verdict", frame.verdict, verdict)
    if set(readings) != set(frame.published):
        yield ReadingDifference(car, frame.at_ns, frame.data, "published", frame.published, tuple(readings))
    for topic, fields in readings.items():
        recorded: Mapping[str, Any] = frame.readings.get(topic, {})
        for name, now in fields.items():
            if topic in frame.readings and recorded.get(name) != now:
                yield ReadingDifference(car, frame.at_ns, frame.data, f"{topic} {name}", recorded.get(name), now)
        if "range_m" in recorded and "range_m" not in fields:
            yield ReadingDifference(car, frame.at_ns, frame.data, f"{topic} range_m", recorded["range_m"], None)
