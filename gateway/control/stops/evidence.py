"""Detects from the car's readings whether a stop arrived; a table lists the cases. Pure.

The car acknowledges nothing (docs/reference/protocol.md#evidence-of-a-stop). A car shows in three ways that it obeyed
`MODE00`. It leaves a mode that it reported. It leaves a silent mode that was opened from a shown rest. Or its reports
pause. The docs print `EVIDENCE` (docs/reference/stop-evidence.md).
"""

from dataclasses import dataclass
from enum import StrEnum
from typing import Final

from gateway.protocol.enums import Mode
from gateway.protocol.modes import candidate_modes
from gateway.protocol.sensors import Sensors
from gateway.protocol.timing import FRAME_S, MODE_CLOSE_S

# A reporting mode sends 20 frames a second. A corrupted frame of such a mode can look like mode 0, because there is no
# checksum. But no silence comes before it.
SETTLED_S: Final = 0.8
"""Minimum silence before a mode-0 report that counts."""
# A loaded machine reads a report up to 0.5 s late.
BUNCHED_S: Final = 0.4
"""Maximum interval of reports that the link has delayed. A pause before them may be the link's."""
CLOSED_S: Final = 0.95
"""Minimum time from `MODE00` to a report that the car sent after it obeyed: closing takes 1.0 s."""
# 1.0 s of closing, up to 0.9 s to the report, and 0.1 s of wire. A `MODE00` that lost a digit or both opens mode 0
# instead, with the motors on. That blocks for 2.3 s or 2.0 s. A report of 41 bytes or more can follow at once, so it
# comes after 2.05 s.
LEFT_S: Final = 2.05
"""Maximum time from `MODE00` to the first mode-0 report if that frame closed the mode."""
LATE_S: Final = 0.2
"""Additional time of such a report on a slow link. It counts as a pause only, so one more shows the stop."""
RANGING_S: Final = 1.0
"""Additional time of a report without an echo."""
SHAPE_UNTIL_S: Final = 1.0
"""Maximum time that readings of a mode go on after the `MODE00` that ends it. The general stop follows at 1.1 s."""
# Opening alone blocks for 2.5 s. During it a slow link delivers older reports, one a second.
OPENING_SILENCE_S: Final = 2.3
"""Minimum silence before the report that shows the end of a silent mode."""
OPENED_S: Final = 2.5
"""Minimum block by opening a mode (docs/reference/protocol.md#blocking-times). The car cannot report the end of the
mode earlier."""
PAUSE_MIN_S: Final = 1.88
PAUSE_MAX_S: Final = 2.6
"""Range of the interval of two reports around an obeyed `MODE00`: 1.9 s or a little more
(docs/reference/protocol.md#evidence-of-a-stop)."""
NORMAL_MIN_S: Final = 0.8
NORMAL_MAX_S: Final = 1.4
"""Range of the normal interval of two reports. The link has delayed closer ones, so their times show nothing."""
# A link that loses both `MODE00` and the report after it leaves the same gap as a pause. Half of all outages of 0.6 s
# around a stop do that, so one pause is not enough. Not even at a rest that was shown before: a damaged frame of the
# next stop can start the motors.
PAUSES: Final = 2
"""Number of pauses that show a stop in mode 0."""
# A damaged `MODE00` may open mode 0 with the motors on, which blocks for 2.0 to 2.3 s. If the link held the report
# before for a second, both gaps look like pauses. But they are not 1.0 s longer than the normal interval of this car.
PAUSES_IN_DOUBT: Final = 3
"""Number of pauses that are needed if one of them does not match the normal interval."""
MATCH_S: Final = 0.12
"""Maximum difference of a matching pause from the normal interval and the 1.0 s that `MODE00` takes."""
# A link that holds the reports for two seconds leaves such a gap, too. Then the next report comes with the held one, or
# 0.2 s later.
SETTLING_S: Final = 0.25
"""Time without a reading after the last pause, before the pauses count."""
SHAPES: Final = 2
"""Number of consecutive readings with the shape of another mode that show that mode."""
ROUND_TRIP_S: Final = 2.5
"""Round trip of a slow link, from the second try on: the car may have sent earlier reports before `MODE00`."""


class StopCase(StrEnum):
    """The basis of a stop, by what was stopped and what the car can report."""

    LEFT_SHAPE = "left_shape"
    LEFT_SILENT = "left_silent"
    MANUAL = "manual"
    NO_ECHO = "no_echo"
    FAN = "fan"
    SOFT = "soft"
    ACTED = "acted"
    RASPBERRY_PI = "raspberry_pi"
    UNKNOWN_PLATFORM = "unknown_platform"


@dataclass(frozen=True, slots=True)
class EvidenceRow:
    """One row of the table. `shown_by` is empty if the car cannot show the stop."""

    stop: str
    shown_by: str
    otherwise: str
    words: str = ""
    """Why the stop ends as `sent`, for the record; `{car}` is the car's name."""


EVIDENCE: Final[dict[StopCase, EvidenceRow]] = {
    StopCase.LEFT_SHAPE: EvidenceRow(
        "full, out of tracking, light seeking or following",
        "a mode-0 report that begins after `MODE00` and comes within 2.05 s (3.05 s without an echo), when `MODE00` "
        "was the first frame since the mode was seen; up to 0.2 s later it counts as a pause; else as in mode 0",
        "the stop goes on",
    ),
    StopCase.LEFT_SILENT: EvidenceRow(
        "full, out of obstacle avoidance, color LED or remote control",
        "the same, after 2.3 s of silence, when the mode was opened from a rest that was shown; else as in mode 0",
        "the stop goes on",
    ),
    StopCase.MANUAL: EvidenceRow(
        "full or recovery, in mode 0 with a sonar echo",
        "two pauses of 1.9 s between reports, each around a `MODE00` (three if one is not 1.0 s longer than a normal "
        "interval), and no reading for 0.25 s after the last",
        "the stop goes on",
    ),
    StopCase.NO_ECHO: EvidenceRow(
        "full or recovery, in mode 0 without an echo",
        "",
        "`sent` after a report; four more `MODE00` within 18 s, then a general stop every 6 s",
        "{car} has no sonar echo, so its readings cannot show a stop",
    ),
    StopCase.FAN: EvidenceRow(
        "full or recovery, the fan runs (not Raspberry Pi)",
        "",
        "`sent`; the stop again every 6 s",
        "{car} sends nothing while its fan runs",
    ),
    StopCase.SOFT: EvidenceRow(
        "soft (a drive's end, or its sender lost)",
        "",
        "`sent`; a general stop every 6 s",
        "readings do not show the end of a drive; `fleet stop {car}` checks it",
    ),
    StopCase.ACTED: EvidenceRow(
        "none: a light, servo, whistle or LED frame at a rest that was shown",
        "",
        "`sent`; a general stop every 6 s",
        "{car} got another frame after its confirmed stop; a link that loses bytes can turn it into a motion",
    ),
    StopCase.RASPBERRY_PI: EvidenceRow(
        "any, Raspberry Pi",
        "",
        "`sent` after a report; a general stop every 6 s",
        "a Raspberry Pi car never confirms a stop",
    ),
    StopCase.UNKNOWN_PLATFORM: EvidenceRow(
        "full or recovery, platform unknown",
        "as for the other platforms",
        "`sent` if it reports on in mode 0, as a Raspberry Pi does; then as without an echo",
        "{car} keeps reporting in mode 0 like a Raspberry Pi car, which never confirms a stop",
    ),
}


class Finding(StrEnum):
    """The result of one reading, about the last `MODE00`."""

    NOTHING = "nothing"
    REPORT = "report"
    """A report of mode 0 with an echo, and no `MODE00` before it to judge. The car can react to a `MODE00` now."""
    PAUSE = "pause"
    """A pause; more are needed."""
    SETTLING = "settling"
    """The last pause that is needed. The stop is shown if no reading follows at once."""
    LOST = "lost"
    """Reports went on without a pause."""
    NO_ECHO = "no_echo"
    """A report of mode 0 without an echo."""
    SHOWN = "shown"
    """The car obeyed."""


@dataclass(slots=True)
class StopEvidence:
    """Compares readings with written frames. Times: s, monotonic, when bytes arrived or frames were written."""

    obeyed_at: float | None = None
    """When the car last reacted to a frame; None if never on this link, or not to the last stop."""
    words: str = ""
    """The evidence for `SHOWN`."""
    settles_at: float | None = None
    """When the pauses count, unless a reading comes before; None if they do not suffice."""
    without_echo: int = 0
    """Number of consecutive reports without an echo."""
    _last_at: float = float("-inf")
    """When the last bytes arrived, except frames of the options (arm, gyro)."""
    _foreign_at: float = float("-inf")
    """When the last frame arrived, whole or corrupted, that is no report of mode 0."""
    _before: float | None = None
    """When the last report with an echo arrived, if nothing else has arrived since."""
    _pending: float | None = None
    """When the last `MODE00` without a result was written."""
    _pauses: int = 0
    _pauses_needed: int = PAUSES
    _interval_s: float | None = None
    """The last normal interval of two reports, without a frame that blocks in between."""
    _blocked_s: float = 0.0
    """For how long the frames since the last report block the car."""
    _window_s: float = CLOSED_S
    _shapes: int = 0
    _shape_at: float | None = None
    """When the last reading of another mode arrived, since the last motion or opening."""
    _silent_mode: Mode | None = None
    """The silent mode that was opened from a shown rest."""
    _opened_at: float = float("-inf")
    """When the last mode was opened."""
    _closed_at: float | None = None
    """When the first `MODE00` since then was written; None if none was."""
    _plain: bool = False
    """True if no other frame was written before that `MODE00`."""

    # ------------------------------------------------------------------ frames

    def begin_link(self) -> None:
        """Forget everything: the link is new."""
        self.obeyed_at = self._interval_s = None
        self._last_at = self._foreign_at = float("-inf")
        self._window_s = CLOSED_S
        self.reset_times()
        self.sent_motion()

    def sent_motion(self) -> None:
        """Drop the evidence: the car may drive."""
        self._drop_pauses()
        self._pending = self.settles_at = None
        self._leave_nothing()

    def opened(self, mode: Mode, now: float, *, silent: bool, shown: bool) -> None:
        """Record the opening of a mode. `shown`: the car had shown its rest before."""
        self.sent_motion()
        self._opened_at = now
        self._plain = True
        self._silent_mode = mode if silent and shown else None

    def sent_other(self) -> None:
        """Record a frame that neither moves the car nor closes a mode."""
        if self._closed_at is None:
            self._plain = False

    def blocked(self, block_s: float) -> None:
        """Record a frame that blocks the car for so long: the next report comes later."""
        if block_s > FRAME_S:
            self._blocked_s += block_s

    def closed(self, now: float, *, awake: bool) -> None:
        """Record a `MODE00`. `awake`: no block of our frames runs, so the reports pause for exactly 1.0 s."""
        self._pending = now if awake else None
        if self._closed_at is None:
            self._closed_at = now
        else:
            self._plain = False

    def tried_again(self) -> None:
        """Allow for a slow link from now on."""
        self._window_s = ROUND_TRIP_S

    # ------------------------------------------------------------------ readings

    def on_noise(self, at: float, *, damaged: bool = True) -> None:
        """Record bytes that are no reading. `damaged`: they begin like a frame, so the next may be corrupted too."""
        self._last_at = at
        self._before = self.settles_at = None
        if damaged:
            self._foreign_at = at

    def reset_times(self) -> None:
        """Drop the evidence that depends on times: after a stall of the loop the report times are too late."""
        self._before = self._pending = self.settles_at = None
        self._drop_pauses()

    def is_settled(self, event: Sensors) -> bool:
        """Return False for a report of mode 0 just after other frames: it may be a corrupted one of another mode."""
        return event.at - self._foreign_at >= SETTLED_S or Mode.MANUAL not in candidate_modes(event)

    def on_reading(self, event: Sensors) -> Finding:
        """Record a reading. Return what it shows."""
        at, quiet_s = event.at, event.at - self._last_at
        self._last_at = at
        self.settles_at = None
        if Mode.MANUAL not in candidate_modes(event):
            self._other_mode(at)
            return Finding.NOTHING
        self._shapes = 0
        if quiet_s < SETTLED_S:
            self._before = None
            if quiet_s < BUNCHED_S:
                self._drop_pauses()
            return Finding.NOTHING
        if event.range_cm is None:  # a corrupted frame, which does not show whether there is an echo
            self._before = None
            return Finding.NOTHING
        before, self._before = self._before, at if event.range_cm else None
        blocked_s, self._blocked_s = self._blocked_s, 0.0
        self.without_echo = 0 if event.range_cm else self.without_echo + 1
        left = self._left(at, quiet_s, LEFT_S if event.range_cm else LEFT_S + RANGING_S)
        if left is Finding.SHOWN:
            return self._obeyed(at)
        if left is Finding.PAUSE and event.range_cm:
            return self._left_late(at)
        pending = self._pending
        if not event.range_cm:
            return Finding.NO_ECHO
        if pending is None:
            if before is not None and not blocked_s and at - before < NORMAL_MAX_S:
                self._interval_s = at - before
            return Finding.REPORT
        if before is None:
            if at <= pending + CLOSED_S:
                return Finding.NOTHING
            self._pending = None
            return Finding.REPORT
        return self._compare(at - before, at - pending, at, blocked_s)

    def settle(self, now: float) -> bool:
        """Return True if the pauses count from now on: no reading came just after them."""
        if self.settles_at is None or now < self.settles_at:
            return False
        self.settles_at = None
        self._obeyed(self._last_at)
        return True

    def _compare(self, gap_s: float, after_s: float, at: float, blocked_s: float) -> Finding:
        """Judge the interval of two reports. The later one came `after_s` after `MODE00`."""
        if after_s <= CLOSED_S:
            return Finding.NOTHING
        if PAUSE_MIN_S <= gap_s <= PAUSE_MAX_S:
            self._pending = None
            self._pauses += 1
            if not self._matches(gap_s, blocked_s):
                self._pauses_needed = PAUSES_IN_DOUBT
            self.obeyed_at = at
            if self._pauses < self._pauses_needed:
                return Finding.PAUSE
            self.words = f"{self._pauses} pauses in its reports, each after MODE00"
            self.settles_at = at + SETTLING_S
            return Finding.SETTLING
        if after_s <= self._window_s and gap_s <= NORMAL_MAX_S:
            return Finding.NOTHING
        self._pending = None
        self._drop_pauses()
        if not NORMAL_MIN_S < gap_s < NORMAL_MAX_S:
            return Finding.REPORT
        if not blocked_s:
            self._interval_s = gap_s
        return Finding.LOST

    def _matches(self, gap_s: float, blocked_s: float) -> bool:
        """Return True if a pause is as long as `MODE00` makes it: 1.0 s more than the normal interval of this car."""
        if self._interval_s is None:  # a new link: the first pause is the measure of the next ones
            self._interval_s = gap_s - MODE_CLOSE_S
        return -MATCH_S <= gap_s - MODE_CLOSE_S - self._interval_s <= blocked_s + MATCH_S

    def _drop_pauses(self) -> None:
        self._pauses, self._pauses_needed = 0, PAUSES

    def _other_mode(self, at: float) -> None:
        self._shapes += 1
        self._foreign_at = at
        self._before = None
        self._drop_pauses()
        if self._shapes >= SHAPES or self._shape_at is not None:
            self._shape_at = at
            self._silent_mode = None

    def _left(self, at: float, quiet_s: float, within_s: float) -> Finding:
        """Return SHOWN if this report shows that `MODE00` alone closed the mode of the car, PAUSE if it is late."""
        closed_at = self._closed_at
        shape_at, silent = self._shape_at, self._silent_mode
        if closed_at is None or at <= closed_at + CLOSED_S:
            return Finding.NOTHING
        if silent is not None and (quiet_s < OPENING_SILENCE_S or at < self._opened_at + OPENED_S + CLOSED_S):
            return Finding.NOTHING  # an older report, on a slow link
        self._shape_at = self._silent_mode = None
        if not self._plain or at > closed_at + within_s + LATE_S:
            return Finding.NOTHING
        if silent is None and (shape_at is None or shape_at > closed_at + SHAPE_UNTIL_S):
            return Finding.NOTHING
        mode = "the mode that it reported" if silent is None else silent
        self.words = f"a report of mode 0 {at - closed_at:.1f} s after MODE00, out of {mode}"
        return Finding.SHOWN if at <= closed_at + within_s else Finding.PAUSE

    def _left_late(self, at: float) -> Finding:
        self.obeyed_at = at
        self._pending = None
        self._drop_pauses()
        self._pauses = 1
        return Finding.PAUSE

    def _obeyed(self, at: float) -> Finding:
        self.obeyed_at = at
        self._pending = None
        self._drop_pauses()
        self._window_s = CLOSED_S
        self._leave_nothing()
        return Finding.SHOWN

    def _leave_nothing(self) -> None:
        self._shapes = 0
        self._shape_at = self._silent_mode = self._closed_at = None
        self._plain = False


assert CLOSED_S < MODE_CLOSE_S
