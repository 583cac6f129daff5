"""Learns one car's habits from its readings: its rhythm, its delays, and whether it can show that a stop arrived. Pure.

Cars of one protocol run different programs (docs/reference/protocol.md#programs-that-people-have). One program reports
once per turn of its loop, another every second by a timer. One is blocked by `MODE00` for a second, another not at all.
So a car must not be judged by the numbers of another program. It is compared with its own earlier behavior.

A *rhythm* is the interval of undisturbed reports: the last few intervals, their median and their spread. If the link
loses or holds a report, the interval is wrong, so an interval is added to the rhythm only if it fits the others. If
three in a row (two, if only one interval is known) fit each other but not the rhythm, they are a new rhythm: the car
runs another program, or it is another car.

A *delay* is how much later than the rhythm a report comes after one frame that may block the car. The delay is the only
acknowledgement of the frame. A car that reports by a timer is never late, so it acknowledges nothing.

The finding that a car cannot show a stop needs more than a first impression: `UNREACTED` blocking frames without any
delay, and none with a delay. It is withdrawn after `REACTED` delays that are as long as the block of a frame. No frame
is sent only to learn. `Learned.kept` and `Learned.restore` preserve the results over a restart, but not the counts.
"""

from collections import deque
from collections.abc import Iterable, Mapping
from typing import Any, Final

from msgspec import Struct, field

from gateway.drivers.yahboom.estimate.outputs import Speeds, restored_speeds, speeds_at_start
from gateway.drivers.yahboom.protocol.frames import ColorLed, Frame, General, ModeClose, Ptz
from gateway.drivers.yahboom.protocol.platforms import parse_platform
from gateway.drivers.yahboom.protocol.sensors import SENSOR_FIELDS, RejectedField, Sensors
from schemas.words import Blocking, Mode, Shows

KEPT_INTERVALS: Final = 9
"""Maximum number of intervals of a rhythm. The newest count."""
SAME_S: Final = 0.18
"""Maximum difference of an interval from the median of its rhythm. Intervals of one car are up to 0.08 s from their
mean."""
FIRM_INTERVALS: Final = 4
"""Minimum number of intervals to know their spread."""
FIRST_TOLERANCE_S: Final = 0.12
"""Tolerance until the spread is known."""
LINK_TOLERANCE_S: Final = 0.05
"""Tolerance for the link and the machine, in addition to the spread."""
CHANGED_INTERVALS: Final = 3
"""Number of consecutive intervals that replace a rhythm. Two replace a rhythm of one interval."""
AGREEING_DELAYS: Final = 3
"""Number of consecutive equal delays that count as the block of a frame."""
ALWAYS: Final = 5
"""Number of values out of range that make a finding, if no value was in range."""
UNREACTED: Final = 4
"""Number of undisturbed blocking frames without a reaction after which a car counts as one that cannot show a stop."""
REACTED: Final = 3
"""Number of consecutive reactions that withdraw the finding that a car cannot show a stop."""
FIRST_READINGS: Final = 2
"""Number of first readings of a mode that are remembered. The earlier one counts, because the link may lose some."""
MAX_LEARNED_S: Final = 10.0
"""Maximum interval or block: three times those of the slowest car. A longer gap comes from the link or our loop. If it
became the rhythm, as the first interval does, each stop would wait that long for a report before it is sent again."""


def blocking_kind(frame: Frame) -> Blocking | None:
    """Return the kind of a frame that may block. None if it never blocks, or if its block is not learned."""
    match frame:
        case ModeClose():
            return Blocking.MODE_CLOSE
        case Ptz():
            return Blocking.SERVO
        case ColorLed():
            return Blocking.COLOR
        case General(whistle=True, servo=None, fan=False):
            return Blocking.WHISTLE
        case _:
            return None


class Rhythm(Struct):
    """The interval of undisturbed reports, s."""

    intervals: deque[float] = field(default_factory=lambda: deque(maxlen=KEPT_INTERVALS))
    _others: deque[float] = field(default_factory=lambda: deque(maxlen=CHANGED_INTERVALS))
    """The last consecutive intervals that do not fit."""
    median_s: float = 0.0
    """The median, or 0 if no interval is known. It is stored, because it is used at every report and tick."""

    @property
    def is_known(self) -> bool:
        """Return True if there is an interval."""
        return bool(self.intervals)

    @property
    def spread_s(self) -> float:
        """Return the difference of the longest and the shortest interval, s."""
        return max(self.intervals) - min(self.intervals) if self.intervals else 0.0

    @property
    def is_changing(self) -> bool:
        """Return True if the last undisturbed interval did not fit, so that another rhythm may begin."""
        return bool(self._others)

    @property
    def is_firm(self) -> bool:
        """Return True if there are enough intervals to know their spread."""
        return len(self.intervals) >= FIRM_INTERVALS

    @property
    def seen_tolerance_s(self) -> float:
        """Return the maximum difference of an interval from the median, as the intervals until now show it."""
        return self.spread_s + LINK_TOLERANCE_S

    @property
    def tolerance_s(self) -> float:
        """Return the maximum difference of an interval of this car, on this link, from the median."""
        return max(self.seen_tolerance_s, 0.0 if self.is_firm else FIRST_TOLERANCE_S)

    def fits(self, interval_s: float) -> bool:
        """Return True if an interval belongs to this rhythm."""
        return self.is_known and abs(interval_s - self.median_s) <= SAME_S

    def add(self, interval_s: float) -> bool:
        """Add an undisturbed interval. Return True if it completes another rhythm, which replaces this one."""
        if not self.intervals or self.fits(interval_s):
            self.restore((interval_s,))
            self._others.clear()
            return False
        self._others.append(interval_s)
        is_unconfirmed = len(self.intervals) < 2  # a single interval may have been wrong
        needed = 2 if is_unconfirmed else CHANGED_INTERVALS
        latest = list(self._others)[-needed:]
        if len(latest) < needed or max(latest) - min(latest) > SAME_S:
            return False
        self.intervals.clear()
        self.restore(latest)
        self._others.clear()
        return not is_unconfirmed

    def restore(self, intervals: Iterable[float]) -> None:
        """Add intervals that belong to this rhythm."""
        self.intervals.extend(intervals)
        self.median_s = _median(self.intervals) if self.intervals else 0.0

    def is_multiple(self, delay_s: float, tolerance_s: float) -> bool:
        """Return True if a delay is a whole number of intervals, so that lost reports may have caused it."""
        if not self.is_known or delay_s < self.median_s / 2:
            return False
        count = max(1, round(delay_s / self.median_s))
        return abs(delay_s - count * self.median_s) <= tolerance_s


class Learned(Struct):
    """The habits of one car. Times: s."""

    echo: Rhythm = field(default_factory=Rhythm)
    """The rhythm of reports of mode 0 with a sonar echo."""
    no_echo: Rhythm = field(default_factory=Rhythm)
    """The rhythm of reports of mode 0 without an echo."""
    shows: Shows = Shows.UNKNOWN
    doubted: bool = False
    """True if the car has shown its stops before, and did not show the last one."""
    opened_as: str = ""
    """The platform that was detected when the gateway last opened a mode, until a report shows mode 0 again. In a
    silent mode, only this tells the next gateway how to end the mode. Empty if no mode is open, or if the platform is
    configured."""
    speeds: Speeds = field(default_factory=speeds_at_start)
    """The speeds that the car may have had when the last gateway ended."""
    reporting: set[Mode] = field(default_factory=set)
    """The modes in which the car has sent readings."""
    first_readings: dict[Mode, deque[float]] = field(default_factory=dict)
    """How long after the opening of a mode its first reading came, the last times. The motors run meanwhile."""
    extremes: dict[str, tuple[float, float]] = field(default_factory=dict)
    """The lowest and the highest accepted value of each field, as on the wire. 0 and 1 for a field of bits."""
    rejected: dict[str, int] = field(default_factory=dict)
    """How often the value of a field was out of its range, by the word of the field."""
    _delays: dict[Blocking, deque[float]] = field(default_factory=dict)
    """The last consecutive delays that may be the block of a kind of frame."""
    _blocks: dict[Blocking, float] = field(default_factory=dict)
    """The block of each kind of frame, once its delays have agreed."""
    _unreacted: int = 0
    """Number of blocking frames without a reaction since the last reaction."""
    _reacted: int = 0
    """Number of consecutive reactions since the finding that the car cannot show a stop."""

    # ------------------------------------------------------------------ rhythm and delays

    def add_interval(self, interval_s: float, *, echo: bool) -> bool:
        """Add an undisturbed interval. Return True if it completes a new rhythm, so that earlier findings are void."""
        if interval_s > MAX_LEARNED_S:
            return False
        was_known = self.shows is not Shows.UNKNOWN or self.echo.is_firm
        changed = (self.echo if echo else self.no_echo).add(interval_s) and echo
        if changed:
            self.forget_reactions()
        return changed and was_known

    def forget_reactions(self) -> None:
        """Forget whether the car can show a stop, and its values, because it may be another car or program now."""
        self.shows, self.doubted, self._unreacted = Shows.UNKNOWN, False, 0
        self._delays.clear()
        self._blocks.clear()
        self.first_readings.clear()
        self.extremes.clear()
        self.rejected.clear()

    def add_first_reading(self, mode: Mode, after_s: float) -> None:
        """Record how long after the opening of a mode its first reading came."""
        if 0.0 < after_s <= MAX_LEARNED_S:
            self.first_readings.setdefault(mode, deque(maxlen=FIRST_READINGS)).append(after_s)

    def first_reading_s(self, mode: Mode, expected_s: float) -> float:
        """Return the longest time from the opening of a mode to its first reading: as expected, or as observed."""
        return max(expected_s, min(self.first_readings.get(mode, (expected_s,))))

    def interval_s(self, expected_s: float) -> float:
        """Return the interval of the reports with an echo: the observed one, or else the expected one."""
        return self.echo.median_s if self.echo.is_known else expected_s

    def block_s(self, kind: Blocking, expected_s: float) -> float:
        """Return the time by which a frame of this kind delays the next report: as observed, or else as expected."""
        return self._blocks.get(kind, expected_s)

    def close_s(self, expected_s: float) -> float:
        """Return the time by which `MODE00` delays the next report: as observed, or else as expected."""
        return self.block_s(Blocking.MODE_CLOSE, expected_s)

    @property
    def blocks(self) -> Mapping[Blocking, float]:
        """Return the delays that were learned."""
        return self._blocks

    def add_delay(self, kind: Blocking, delay_s: float, longest_s: float, *, controlled: bool) -> bool:
        """Add the delay of an undisturbed report after a frame. Return True if the last delays agree.

        A delay counts if it is clearly longer than the spread and shorter than `longest_s`. If lost reports could have
        caused it, it counts only if `controlled`, which means that another frame of ours has delayed no report.
        """
        tolerance_s = self.echo.tolerance_s
        if not 2 * tolerance_s < delay_s < longest_s or (not controlled and self.is_confusable(delay_s)):
            self._delays.pop(kind, None)
            return False
        delays = self._delays.setdefault(kind, deque(maxlen=AGREEING_DELAYS))
        delays.append(delay_s)
        if len(delays) < AGREEING_DELAYS or max(delays) - min(delays) > 2 * tolerance_s:
            return False
        self._blocks[kind] = _median(delays)
        self._unreacted = 0
        return True

    def on_reaction(self, *, sure: bool) -> None:
        """Record that a report was late by the block of a frame. With `sure`, no lost report could cause the delay."""
        self._unreacted = 0
        if self.shows is Shows.NO and sure:
            self._reacted += 1
            if self._reacted >= REACTED:  # perhaps a wire was loose before, or another program runs now
                self.shows, self._reacted = Shows.UNKNOWN, 0

    def on_no_reaction(self) -> bool:
        """Record a blocking frame without a delay. Return True if the car now counts as one that cannot show a stop."""
        self._unreacted += 1
        self._reacted = 0
        if self.shows is not Shows.UNKNOWN or self._unreacted < UNREACTED:
            return False
        self.shows = Shows.NO
        return True

    def on_shown(self) -> None:
        """Record that the car has shown a stop."""
        self.shows, self.doubted, self._unreacted = Shows.YES, False, 0

    def is_confusable(self, delay_s: float) -> bool:
        """Return True if reports that the link has lost could cause the same delay."""
        return self.echo.is_multiple(delay_s, 2 * self.echo.tolerance_s)

    @property
    def always_rejected(self) -> tuple[str, ...]:
        """Return the fields whose values were often out of range, and never in range."""
        return tuple(word for word, count in self.rejected.items() if count >= ALWAYS and word not in self.extremes)

    def on_fields(self, event: Sensors, rejects: tuple[RejectedField, ...]) -> None:
        """Record the values of the fields of a report of mode 0. `rejects` are out of the range of this car."""
        rejected = {reject.word for reject in rejects}
        for name in rejected:
            self.rejected[name] = self.rejected.get(name, 0) + 1
        for each in SENSOR_FIELDS:
            value = getattr(event, each.attribute)
            word = each.word.decode()
            if value is None or word in rejected:
                continue
            if isinstance(value, tuple):
                self.extremes.setdefault(word, (0.0, 1.0))
            else:
                self.on_number(word, value)

    def on_number(self, field_name: str, value: float) -> None:
        """Record the value of a field."""
        low, high = self.extremes.get(field_name, (value, value))
        self.extremes[field_name] = min(low, value), max(high, value)

    # ------------------------------------------------------------------ state file

    def kept(self) -> dict[str, Any]:
        """Return the part that must survive a restart, as JSON values."""
        return {
            "echo_s": [round(each, 4) for each in self.echo.intervals],
            "no_echo_s": [round(each, 4) for each in self.no_echo.intervals],
            "shows": str(self.shows),
            "doubted": self.doubted,
            "reporting": sorted(self.reporting),
            "opened_as": self.opened_as,
            "blocks_s": {str(kind): round(block_s, 4) for kind, block_s in self._blocks.items()},
            "first_readings_s": {
                str(mode): [round(each, 4) for each in times] for mode, times in self.first_readings.items()
            },
        }

    @classmethod
    def restore(cls, kept: Mapping[str, Any]) -> "Learned":
        """Make the object from the result of `kept`. Raises ValueError, KeyError or TypeError if that is damaged."""
        learned = cls(
            shows=Shows(kept["shows"]),
            doubted=bool(kept["doubted"]),
            reporting={Mode(mode) for mode in kept["reporting"]},
            opened_as=parse_platform(kept["opened_as"]).name if kept.get("opened_as") else "",
        )
        for rhythm, name in ((learned.echo, "echo_s"), (learned.no_echo, "no_echo_s")):
            intervals = [float(each) for each in kept[name]]
            if not all(0.0 < each <= MAX_LEARNED_S for each in intervals):  # also refuses NaN
                raise ValueError(f"{name}: {intervals}")
            rhythm.restore(intervals)
        learned.speeds = restored_speeds(kept.get("speeds", {}))
        learned._blocks = {Blocking(kind): float(block_s) for kind, block_s in kept["blocks_s"].items()}
        if not all(0.0 < each <= MAX_LEARNED_S for each in learned._blocks.values()):
            raise ValueError(f"blocks_s: {learned._blocks}")
        for mode, times in kept.get("first_readings_s", {}).items():
            for each in times:
                learned.add_first_reading(Mode(mode), float(each))
        return learned


def _median(values: Iterable[float]) -> float:
    """Return the median of at least one value.

    The module `statistics` imports `decimal` and `fractions`: 0.5 MB and 4 ms for each gateway.
    """
    ordered = sorted(values)
    middle = len(ordered) // 2
    return ordered[middle] if len(ordered) % 2 else (ordered[middle - 1] + ordered[middle]) / 2
