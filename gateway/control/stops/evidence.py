"""What shows that a stop arrived: one table of the cases, and the watch on the car's readings that decides. Pure.

The car acknowledges nothing (docs/reference/protocol.md#evidence-of-a-stop). Three things show that it obeyed
`MODE00`:
it left a mode that it was seen in, it left a silent mode that was opened from a shown rest, or its reports paused.
Docs and README print `EVIDENCE`; `tests/tools/readme.py` writes them.
"""

from dataclasses import dataclass
from enum import StrEnum
from typing import Final

from gateway.protocol.enums import Mode
from gateway.protocol.events import Sensors
from gateway.protocol.timing import MODE_CLOSE_S

SETTLED_S: Final = 0.8
"""Minimum silence before a mode-0 report that counts. A mode that reports sends 20 frames a second: a damaged frame of
such a mode can look like mode 0 (there is no checksum), but silence never comes before it."""
BUNCHED_S: Final = 0.4
"""Reports closer than this were delayed by the link, so a pause before them may be the link's. A loaded machine takes a
report up to 0.5 s late."""
CLOSED_S: Final = 0.95
"""A report sooner after `MODE00` was written than this was sent before the car obeyed: closing takes 1.0 s."""
LEFT_S: Final = 2.2
"""Maximum time from `MODE00` to the first mode-0 report if that frame closed the mode: 1.0 s of closing, 0.9 s to the
report, and 0.2 s of turn and wire. A `MODE00` that lost a digit opens mode 0 instead, with the motors on. That blocks
for 2.3 s, so the report comes later."""
RANGING_S: Final = 1.0
"""A report without an echo comes so much later."""
SHAPE_UNTIL_S: Final = 1.0
"""Readings of the mode that is left end within this time if `MODE00` ended it, before the general stop at 1.1 s."""
OPENING_SILENCE_S: Final = 2.3
"""Minimum silence before the report that shows that a silent mode was left: opening alone blocks for 2.5 s. A slow link
delivers older reports meanwhile, one a second."""
OPENED_S: Final = 2.5
"""Minimum time that opening a mode blocks (docs/reference/protocol.md#blocking-times): the car can report that it
left the mode no sooner."""
PAUSE_MIN_S: Final = 1.88
PAUSE_MAX_S: Final = 2.6
"""Two reports around a `MODE00` that was obeyed are 1.9 s apart or a little more
(docs/reference/protocol.md#evidence-of-a-stop)."""
NORMAL_MIN_S: Final = 0.8
NORMAL_MAX_S: Final = 1.4
"""Two reports with nothing between them. Closer ones were delayed by the link, so their times show nothing."""
PAUSES: Final = 2
"""Pauses that show a stop in mode 0. One is not enough: a link that swallows both `MODE00` and the report after it
leaves the same gap. It does so for half of all gaps of 0.6 s around a stop."""
SHAPES: Final = 2
"""Readings in a row with the shape of another mode that show that the car is in it."""
ROUND_TRIP_S: Final = 2.5
"""From the second try on, reports this long after `MODE00` may still have been sent before it: a slow link."""


class StopCase(StrEnum):
    """What a stop can rest on."""

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
    """One row of the table. `shown_by` is empty where the car can show nothing."""

    stop: str
    shown_by: str
    otherwise: str
    words: str = ""
    """Why the stop ends as `sent`, for the record; `{car}` is the car's name."""


EVIDENCE: Final[dict[StopCase, EvidenceRow]] = {
    StopCase.LEFT_SHAPE: EvidenceRow(
        "full, out of tracking, light seeking or following",
        "a mode-0 report that begins after `MODE00` and comes within 2.2 s (3.2 s without an echo), when `MODE00` was "
        "the first frame since the mode was seen; else as in mode 0",
        "the stop goes on",
    ),
    StopCase.LEFT_SILENT: EvidenceRow(
        "full, out of obstacle avoidance, color LED or remote control",
        "the same, after 2.3 s of silence, when the mode was opened from a rest that was shown; else as in mode 0",
        "the stop goes on",
    ),
    StopCase.MANUAL: EvidenceRow(
        "full or recovery, in mode 0 with a sonar echo",
        "two pauses of 1.9 s between reports, each around a `MODE00`",
        "the stop goes on",
    ),
    StopCase.NO_ECHO: EvidenceRow(
        "full or recovery, in mode 0 without an echo",
        "",
        "`sent` after a report; four more `MODE00` within 18 s, then a general stop every 6 s",
        "{car} has no sonar echo, so its reports show no pause",
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
        "a general stop shows nothing; `fleet stop` shows it",
    ),
    StopCase.ACTED: EvidenceRow(
        "none: a light, servo, whistle or LED frame at a rest that was shown",
        "",
        "`sent`; a general stop every 6 s",
        "a frame went out since {car} showed that it stands; a link that loses bytes may make a motion of it",
    ),
    StopCase.RASPBERRY_PI: EvidenceRow(
        "any, Raspberry Pi",
        "",
        "`sent` after a report; a general stop every 6 s",
        "a Raspberry Pi car shows nothing of a stop",
    ),
    StopCase.UNKNOWN_PLATFORM: EvidenceRow(
        "full or recovery, platform unknown",
        "as for the other platforms",
        "`sent` if it reports on in mode 0, as a Raspberry Pi does; then as without an echo",
        "{car} reports on in mode 0, as a Raspberry Pi car does, which shows nothing of a stop",
    ),
}


class Finding(StrEnum):
    """What a reading says about the last `MODE00`."""

    NOTHING = "nothing"
    REPORT = "report"
    """A report of mode 0 with an echo, to which no pause can be compared: a `MODE00` now will show something."""
    PAUSE = "pause"
    """One pause; one more is needed."""
    LOST = "lost"
    """Reports came on as before."""
    NO_ECHO = "no_echo"
    """A report of mode 0 without an echo."""
    SHOWN = "shown"
    """The car obeyed."""


@dataclass(slots=True)
class StopEvidence:
    """Watches readings and frames for what they show. Times: s, monotonic, when bytes came or frames were written."""

    obeyed_at: float | None = None
    """When the car last showed that a frame arrived; None if never on this link."""
    words: str = ""
    """What `SHOWN` rests on."""
    without_echo: int = 0
    """Reports without an echo in a row."""
    _last_at: float = float("-inf")
    """When the last bytes came that are no report of the options (arm, gyro)."""
    _foreign_at: float = float("-inf")
    """When the last frame came, whole or damaged, that is no report of mode 0."""
    _before: float | None = None
    """When the last report with an echo came, if nothing else came since."""
    _pending: float | None = None
    """When `MODE00` was written whose effect is still open."""
    _pauses: int = 0
    _window_s: float = CLOSED_S
    _shapes: int = 0
    _shape_at: float | None = None
    """When the last reading of another mode came, if the car was seen in one since the last motion or opening."""
    _silent_mode: Mode | None = None
    """The silent mode that was opened from a shown rest."""
    _opened_at: float = float("-inf")
    """When the last mode was opened."""
    _closed_at: float | None = None
    """When the first `MODE00` since then was written; None if another frame came first."""
    _plain: bool = False
    """No other frame was written before that `MODE00`."""

    # ------------------------------------------------------------------ frames

    def begin_link(self) -> None:
        """Forget everything: the link is new."""
        self.obeyed_at = None
        self._last_at = self._foreign_at = float("-inf")
        self._window_s = CLOSED_S
        self.stalled()
        self.sent_motion()

    def sent_motion(self) -> None:
        """Forget what was shown: the car may drive."""
        self._pauses = 0
        self._pending = None
        self._leave_nothing()

    def opened(self, mode: Mode, now: float, *, silent: bool, shown: bool) -> None:
        """Note a mode that was opened; `shown`: from a rest that the car has shown."""
        self.sent_motion()
        self._opened_at = now
        self._plain = True
        self._silent_mode = mode if silent and shown else None

    def sent_other(self) -> None:
        """Note a frame that neither moves the car nor closes a mode."""
        if self._closed_at is None:
            self._plain = False

    def closed(self, now: float, *, awake: bool) -> None:
        """Note a `MODE00`; `awake`: no block of our own frames runs, so the pause that it makes is 1.0 s."""
        self._pending = now if awake else None
        if self._closed_at is None:
            self._closed_at = now
        else:
            self._plain = False

    def tried_again(self) -> None:
        """Give a slow link more time from now on."""
        self._window_s = ROUND_TRIP_S

    # ------------------------------------------------------------------ what is heard

    def noise(self, at: float, *, damaged: bool = True) -> None:
        """Take bytes that are no reading; `damaged`: they begin like a frame, so the next may be damaged as well."""
        self._last_at = at
        self._before = None
        if damaged:
            self._foreign_at = at

    def stalled(self) -> None:
        """Drop what depends on times: the loop slept, so reports may have come sooner than they were taken."""
        self._before = self._pending = None
        self._pauses = 0

    def is_settled(self, event: Sensors) -> bool:
        """Return False for a report of mode 0 just after other frames: it may be a damaged one of another mode."""
        return event.at - self._foreign_at >= SETTLED_S or Mode.MANUAL not in event.candidates

    def reading(self, event: Sensors) -> Finding:
        """Return what a sensors frame shows."""
        at, quiet_s = event.at, event.at - self._last_at
        self._last_at = at
        if Mode.MANUAL not in event.candidates:
            self._other_mode(at)
            return Finding.NOTHING
        self._shapes = 0
        if quiet_s < SETTLED_S:
            self._before = None
            if quiet_s < BUNCHED_S:
                self._pauses = 0
            return Finding.NOTHING
        if event.range_cm is None:  # damaged: it says nothing of an echo either
            self._before = None
            return Finding.NOTHING
        before, self._before = self._before, at if event.range_cm else None
        self.without_echo = 0 if event.range_cm else self.without_echo + 1
        if self._left(at, quiet_s, LEFT_S if event.range_cm else LEFT_S + RANGING_S):
            return self._obeyed(at)
        pending = self._pending
        if not event.range_cm:
            return Finding.NO_ECHO
        if pending is None:
            return Finding.REPORT
        if before is None:
            if at <= pending + CLOSED_S:
                return Finding.NOTHING
            self._pending = None
            return Finding.REPORT
        return self._compare(at - before, at - pending, at)

    def _compare(self, gap_s: float, after_s: float, at: float) -> Finding:
        """Compare two reports, the later one `after_s` after `MODE00`."""
        if after_s <= CLOSED_S:
            return Finding.NOTHING
        if PAUSE_MIN_S <= gap_s <= PAUSE_MAX_S:
            self._pending = None
            self._pauses += 1
            self.obeyed_at = at
            if self._pauses < PAUSES:
                return Finding.PAUSE
            self.words = f"{self._pauses} pauses in its reports, each after MODE00"
            return self._obeyed(at)
        if after_s <= self._window_s and gap_s <= NORMAL_MAX_S:
            return Finding.NOTHING
        self._pending = None
        self._pauses = 0
        return Finding.LOST if NORMAL_MIN_S < gap_s < NORMAL_MAX_S else Finding.REPORT

    def _other_mode(self, at: float) -> None:
        self._shapes += 1
        self._foreign_at = at
        self._before, self._pauses = None, 0
        if self._shapes >= SHAPES or self._shape_at is not None:
            self._shape_at = at
            self._silent_mode = None

    def _left(self, at: float, quiet_s: float, within_s: float) -> bool:
        """Return True if this report shows that `MODE00`, alone, closed the mode that the car was in."""
        closed_at = self._closed_at
        shape_at, silent = self._shape_at, self._silent_mode
        if closed_at is None or at <= closed_at + CLOSED_S:
            return False
        if silent is not None and (quiet_s < OPENING_SILENCE_S or at < self._opened_at + OPENED_S + CLOSED_S):
            return False  # an older report, on a slow link
        self._shape_at = self._silent_mode = None
        if not self._plain or at > closed_at + within_s:
            return False
        if silent is not None:
            self.words = f"a report of mode 0 {at - closed_at:.1f} s after MODE00, out of {silent}"
            return True
        if shape_at is None or shape_at > closed_at + SHAPE_UNTIL_S:
            return False
        self.words = f"a report of mode 0 {at - closed_at:.1f} s after MODE00, out of the mode that it reported"
        return True

    def _obeyed(self, at: float) -> Finding:
        self.obeyed_at = at
        self._pending = None
        self._pauses = PAUSES  # until a motion is sent, one more pause shows the next stop
        self._window_s = CLOSED_S
        self._leave_nothing()
        return Finding.SHOWN

    def _leave_nothing(self) -> None:
        self._shapes = 0
        self._shape_at = self._silent_mode = self._closed_at = None
        self._plain = False


assert CLOSED_S < MODE_CLOSE_S
