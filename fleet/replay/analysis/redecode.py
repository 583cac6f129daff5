"""Decodes recorded raw frames with today's decoder, and yields every difference to the recorded readings. Pure.

The readings of a frame depend on the platform and the mode of the car. Both come from the recording. But a recording
leaves three things open: which of two modes or platforms applied at the moment of a frame, whether silence or the next
frame ended a frame that has no # at its end, and whether the gateway took some values for constants, because the car
might have been an stm32. So a frame may have several possible results. It then counts as
undecided, and it is a difference only if none of the results is the recorded one.
"""

from collections import deque
from collections.abc import Iterable, Iterator, Mapping
from itertools import product
from typing import Any, Final

from msgspec import Struct, field

from fleet.replay.analysis.recorded_frames import Item, KnownMode, KnownPlatform, Rx, Tx
from gateway import drivers
from gateway.drivers.yahboom.protocol.frame_splitter import ECHO_S, MAX_FRAME, FrameSplitter
from gateway.drivers.yahboom.protocol.frames import STANDARD_HEAD
from gateway.drivers.yahboom.protocol.measurements import measured, verdict_of
from gateway.drivers.yahboom.protocol.platforms import Profile, parse_platform, stm32_constants
from gateway.drivers.yahboom.protocol.sensors import Sensors
from gateway.drivers.yahboom.protocol.wire_events import Event
from schemas.words import FrameVerdict, Mode, Platform

MAX_MODE_DELAY_NS: Final = 500_000_000
"""Maximum delay from a mode change to its publication, because the loop of a gateway processes input in batches."""
MAX_PLATFORM_DELAY_NS: Final = 1_500_000_000
"""Maximum delay from a platform change to its publication: state/health is published once a second."""
MAX_FRAME_WAIT_NS: Final = 2_500_000_000
"""How long a frame is kept until the next state has certainly come: states are published once a second."""
_MAX_ECHO_LEAD_NS: Final = 300_000_000
"""An echo (a frame of ours that comes back) may have an earlier stamp than the frame that it repeats, because a frame
is published after it was written. This is the maximum difference."""

Outcome = tuple[str, dict[str, dict[str, Any]]]
"""Verdict, and fields of each reading by topic."""


class ReadingDifference(Struct, frozen=True):
    """One difference between the recorded and the new result."""

    car: str
    at_ns: int
    data: bytes
    what: str
    """`verdict`, `published`, or a topic and its field."""
    then: Any
    now: Any


class Counts(Struct):
    """Counts of the comparison of one car."""

    frames: int = 0
    readings: int = 0
    undecided: int = 0
    """Frames with several possible results."""
    absent: int = 0
    """Readings that are missing in the session, although the record of their frame says that they were published. They
    were lost on the way to the recorder."""


class NoPlatform(Exception):
    """The recording does not contain the platform of a car, or its frames cannot be decoded again.

    The message says what to do.
    """


class Redecoding(Struct):
    """Compares the items of one car in their order. A `platform` that is not None replaces the recorded platform."""

    car: str
    platform: str | None = None
    counts: Counts = field(default_factory=Counts)
    _decoder: FrameSplitter = field(default_factory=FrameSplitter)
    _head: str = STANDARD_HEAD
    _waiting: deque[Rx] = field(default_factory=deque)
    _sent: deque[Tx] = field(default_factory=deque)
    _modes: deque[KnownMode] = field(default_factory=deque)
    _platforms: deque[KnownPlatform] = field(default_factory=deque)
    _began_ns: int | None = None

    def take(self, item: Item) -> Iterator[ReadingDifference]:
        """Add an item, and yield the differences of frames that later items cannot affect. Raises NoPlatform."""
        if self._began_ns is None:
            self._began_ns = item.at_ns
        match item:
            case Rx():
                self._waiting.append(item)
            case Tx():
                self._sent.append(item)
            case KnownMode():
                self._modes.append(item)
            case KnownPlatform():
                self._platforms.append(item)
        while self._waiting and item.at_ns - self._waiting[0].at_ns > MAX_FRAME_WAIT_NS:
            yield from self._judge(self._waiting.popleft())

    def end(self) -> Iterator[ReadingDifference]:
        """Yield the differences of the remaining frames. Raises NoPlatform."""
        while self._waiting:
            yield from self._judge(self._waiting.popleft())

    def _judge(self, frame: Rx) -> Iterator[ReadingDifference]:
        self.counts.frames += 1
        self.counts.readings += len(frame.readings)
        self.counts.absent += len(frame.published) - len(frame.readings)
        outcomes = self._outcomes(frame)
        if len(outcomes) > 1:
            self.counts.undecided += 1
        found = [list(_differences(self.car, frame, outcome)) for outcome in outcomes]
        if all(found):
            # Of several possible results, show the one with the fewest differences.
            yield from min(found, key=len)

    def _outcomes(self, frame: Rx) -> list[Outcome]:
        """Return the possible results of a frame. There is exactly one if the recording leaves nothing open."""
        assert self._began_ns is not None
        at = (frame.at_ns - self._began_ns) / 1e9
        profiles = self._profiles(frame.at_ns)
        if (head := profiles[0].dialect.head) != self._head:
            self._decoder, self._head = FrameSplitter(head=head), head
        while self._sent and self._sent[0].at_ns <= frame.at_ns + _MAX_ECHO_LEAD_NS:
            sent = self._sent.popleft()
            self._decoder.sends(sent.data, (sent.at_ns - self._began_ns) / 1e9)
        modes = [each.mode for each in _around(self._modes, frame.at_ns, MAX_MODE_DELAY_NS)] or [None]
        found: list[Outcome] = []
        decoded = _decode(self._decoder, frame.data, at)
        for events, profile, mode in product(decoded, profiles, dict.fromkeys(modes)):
            for may_be_stm32 in (False, True) if _may_have_constants(events, profile) else (False,):
                outcome = _outcome(events, profile, mode, may_be_stm32=may_be_stm32)
                if outcome not in found:
                    found.append(outcome)
        if (
            frame.verdict == FrameVerdict.ECHO
            and at < ECHO_S
            and all(verdict != FrameVerdict.ECHO for verdict, _ in found)
        ):
            found.append((str(FrameVerdict.ECHO), {}))  # the echo of a frame sent before the recording
        return found

    def _profiles(self, at_ns: int) -> list[Profile]:
        if self.platform is not None:
            return [parse_platform(self.platform)]
        names = dict.fromkeys(each.platform for each in _around(self._platforms, at_ns, MAX_PLATFORM_DELAY_NS))
        found = []
        for name in names:
            try:
                if drivers.family_name(name) != drivers.YAHBOOM:
                    words = f"{self.car} is of platform {name}, whose frames are not decoded again."
                    raise NoPlatform(f"{words} Name the other cars: --car")
                found.append(parse_platform(name))
            except ValueError:
                raise NoPlatform(
                    f"{self.car} was recorded as {name!r}, which this version does not know. Name it: --platform"
                ) from None
        if not found:
            raise NoPlatform(f"The recording has no platform of {self.car} (no state/health). Name it: --platform")
        return found


def _around(states: deque[Any], at_ns: int, late_ns: int) -> list[Any]:
    """Return the last state before a moment (or the first of all), and later ones that may have applied already.

    The states before these are dropped.
    """
    while len(states) > 1 and states[1].at_ns < at_ns:
        states.popleft()
    return [state for number, state in enumerate(states) if not number or state.at_ns <= at_ns + late_ns]


def _decode(decoder: FrameSplitter, data: bytes, at: float) -> list[tuple[Event, ...]]:
    """Return the events of a frame.

    If it has no # at its end, return the events of each way in which it may have ended.
    """
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


def _may_have_constants(events: Iterable[Event], profile: Profile) -> bool:
    """Return True if the gateway may have taken values of these events for the constants of an stm32 program."""
    if profile.kind is Platform.RASPBERRY_PI:
        return False
    return any(isinstance(event, Sensors) and stm32_constants(event) for event in events)


def _outcome(events: Iterable[Event], profile: Profile, mode: Mode | None, *, may_be_stm32: bool) -> Outcome:
    verdicts = []
    readings: dict[str, dict[str, Any]] = {}
    for event in events:
        verdicts.append(verdict_of(event))
        readings |= measured(event, profile, mode, may_be_stm32=may_be_stm32)
    return " ".join(verdicts), readings


def _differences(car: str, frame: Rx, outcome: Outcome) -> Iterator[ReadingDifference]:
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
