"""Detects from the car's readings whether a stop arrived. `cases` lists the possible evidence of each stop. Pure.

car_monitor.py and stop_executor.py act on what is found here: the first reports it, the second stops the car again.

The car acknowledges nothing. A gateway only knows the frames that it wrote, and the times at which readings arrived.
This essay is about what those times can prove, what they cannot, and what is still doubtful. Two frames stop a car. The
general stop ends a motion of mode 0, and other modes ignore it. `MODE00` brakes and closes any mode.

*Why block gaps.* On most cars `MODE00` makes the program beep, which blocks it for about a second. Meanwhile the car
sends nothing, so the next report comes later by just that second. This delay is the acknowledgement that the protocol
lacks. The general stop does not block, so no reading ever shows it. So a stop that is to be shown ends with a lone
`MODE00`, and no other frame of ours may follow it. If a general stop followed, the link could turn it into a motion,
and no evidence would judge it. The frame that is judged must be the last one.

*Why not one number.* How often a car reports, and for how long `MODE00` blocks it, are properties of its program
(docs/reference/protocol.md#programs-that-people-have). Reports come every 0.7 s from one car and every 2.2 s from
another. So nothing here compares a car with a constant: `Learned` has the rhythm (the usual interval of the reports)
and the blocks of this car. A *block gap* is an interval that is longer than the rhythm by just the block. A car that
reports by a timer has no block gaps, so its stops are never shown. That has no other disadvantage: they end as `sent`,
and the text says why.

*Why not one block gap.* A link that loses both `MODE00` and the report after it doubles the interval. If the interval
is about as long as the block, twice the interval looks like a block gap. On a car that reports every second, half of
all outages of 0.6 s around a stop do so. So two block gaps are needed, each around its own `MODE00`. Three are needed
if one of them is in doubt. A block gap is in doubt if it is too long: the link may be slow, or may have held a report.
While few intervals have been seen, it is also in doubt if it differs from the block by more than those intervals differ
from each other.

*Why a control.* A half-duplex link receives nothing for a moment at each write. If the car does not receive our frames
either, each `MODE00` seems to make a block gap, for ever. Often the length of the interval shows whether a report was
lost or the car was blocked. But a block of about a whole number of intervals looks like lost reports. In this case the
gateway writes a *control*: a general stop, a third of an interval after a report. It does not block, so the next report
must come on time. Suppose that the link made the block gaps: after each write it is mute until it has lost the next
report. Then it is mute for the same time after the general stop, and loses the report after that, too, however much the
intervals differ. So if that report is missing or damaged, the link made the block gaps.

*Why silence must follow.* A link that holds reports makes intervals of any length. But only the held report comes late.
The next one comes on time, so the interval between the two is too short. Therefore the last block gap counts only after
the time in which that next report would have come.

*Modes.* If a car reports in a mode, the form of its next report shows that it left the mode. On a car that has
shown a stop before, one report is enough, if it comes at the right time. It must not come too early: the car must have
begun this report after it obeyed `MODE00`. And it must not come too late: if `MODE00` lost its digits on the way, the
car opens mode 0 with the motors on, and that blocks it for longer. The silence of a silent mode shows nothing. But if
the car was shown to stand before the mode was opened, the end of the silence shows that it left the mode.

*Damaged reports.* Reports have no checksum. A damaged frame of another mode can look like one of mode 0, so a report
counts only after a silence that no other mode has. The start of one frame and the end of another can be joined. So the
decoder ends a frame at a silence, and damage of any kind ends the comparison of intervals.

*What is still doubtful.* A link that flips bits could turn the judged `MODE00` into another frame that blocks as long,
but no such frame is known. A car that by itself reports late twice at just the right times would be believed. And a
half-duplex link whose mute time changes from write to write can pass the control by chance.
"""

from enum import StrEnum
from typing import Final

from msgspec import Struct, field

from gateway.drivers.yahboom.estimate.learned import SAME_S, Learned, Rhythm
from gateway.drivers.yahboom.protocol.modes import candidate_modes
from gateway.drivers.yahboom.protocol.platforms import Profile
from gateway.drivers.yahboom.protocol.sensors import Sensors
from gateway.drivers.yahboom.protocol.timing import FRAME_S
from schemas.words import Blocking, Mode, Shows

MIN_SILENCE_SHARE: Final = 0.6
MIN_SILENCE_S: Final = 0.8
"""A report of mode 0 counts only after a silence of this share of the interval, or of this time if that is shorter. In
other modes the car sends a frame every 0.12 s or sooner, so a damaged frame that looks like mode 0 has no such silence
before it."""
FASTEST_S: Final = 0.3
"""Interval of the fastest car. It is used until the interval of this car is known."""
BUNCHED_SHARE: Final = 0.3
BUNCHED_S: Final = 0.4
"""Interval below which the link must have delayed reports: this share of the normal interval, at most this time."""
EARLY_S: Final = 0.05
"""How much earlier than the end of a block a report may seem to arrive."""
WIRE_S: Final = 0.02
"""Minimum time from the end of a block to the arrival of the report after it: a report takes longer on the wire."""
LATE_S: Final = 0.2
"""Time by which a slow link may delay the report that shows the end of a mode. A report that is late by up to this time
shows only a block gap."""
OTHER_MODE_LINGERS_S: Final = 1.0
"""Maximum time for which readings of a mode still arrive after the `MODE00` that ends it."""
LONGER_S: Final = 0.65
"""Maximum time by which a block gap may be longer than the block. Such a block gap is in doubt."""
BLOCK_GAPS: Final = 2
"""Number of block gaps that show a stop in mode 0."""
BLOCK_GAPS_IN_DOUBT: Final = 3
"""Number of block gaps that are needed if one of them is in doubt."""
MISFITS: Final = 2
"""After this many intervals that are neither normal nor a block gap, the gateway measures the rhythm again, without a
`MODE00`."""
SETTLING_S: Final = 0.25
"""Minimum time without a reading after the last block gap, before the block gaps count."""
OTHER_MODE_READINGS: Final = 2
"""After this many consecutive readings in the form of another mode, the car is in that mode."""
ROUND_TRIP_S: Final = 2.5
"""Round trip of a slow link, which is allowed for from the second try on: the car may have sent an earlier report
before it received `MODE00`."""
READ_LATE_S: Final = 0.3
"""If a report comes sooner than this after a frame, the car may have sent it before it read the frame."""
IN_FLIGHT_S: Final = 0.1
"""If a report comes sooner than this after a frame, the car must have sent it before it read the frame."""


class Finding(StrEnum):
    """The result of one reading, for the last `MODE00`."""

    NOTHING = "nothing"
    REPORT = "report"
    """A report of mode 0 whose sonar heard an echo. No `MODE00` is waiting for it, so one could be judged now."""
    UNJUDGED = "unjudged"
    """A report like `REPORT`, but the rhythm of the car is not known well enough, so a `MODE00` could not be judged
    now."""
    BLOCK_GAP = "block_gap"
    """A block gap. More are needed."""
    CONTROL = "control"
    """A block gap that the link may have made by itself. The next frame must be the control, which does not block."""
    SETTLING = "settling"
    """The last needed block gap. The stop is shown if no reading follows too early."""
    LOST = "lost"
    """The reports continued without a block gap."""
    NO_ECHO = "no_echo"
    """A report of mode 0 without an echo."""
    SHOWN = "shown"
    """The car obeyed."""


_NEVER: Final = float("-inf")


class _Block(Struct, frozen=True):
    """A frame that blocks the car: its kind, its maximum block, and when it was written.

    `kind` is None if the block is not learned: `MODE00` that will not be judged, or a frame without a `blocking_kind`.
    """

    kind: Blocking | None
    block_s: float
    at: float


class StopEvidence(Struct):
    """Compares readings with written frames. Times: s, monotonic, when bytes arrived or frames were written."""

    profile: Profile
    learned: Learned = field(default_factory=Learned)
    reacted_at: float | None = None
    """When the car last reacted to a frame. None if it never did on this link, or did not react to the last stop."""
    words: str = ""
    """The evidence for `SHOWN`."""
    settles_at: float | None = None
    """When the block gaps count, unless a reading arrives earlier. None if there are not enough block gaps."""
    without_echo: int = 0
    """Number of consecutive reports without an echo."""
    changed_expectation: bool = False
    """True if the last reading showed that this car cannot show a stop after all, or has another rhythm than before."""

    # The last arrivals.
    _last_at: float = _NEVER
    """When the last bytes arrived, except text, echoes, and frames of the options (arm, gyro)."""
    _foreign_at: float = _NEVER
    """When the last reading of another mode or the last damaged frame arrived."""
    _echo_report_at: float | None = None
    """When the last report with an echo arrived. None if anything else has arrived since."""
    _no_echo_report_at: float | None = None
    """When the last report without an echo arrived. None if anything else has arrived since."""
    _ended_with_echo: bool = False
    """True if the last bytes were a report with an echo, also if it arrived too early to count."""

    # The frames since the last report.
    _blocks: list[_Block] = field(default_factory=list)
    """The other frames that block, written since the last report."""
    _other_frame_written: bool = False
    """True if a frame other than `MODE00` was written since the last report."""

    # The `MODE00` that waits for a result.
    _mode_00_at: float | None = None
    """When the last `MODE00` was written. None if it has a result, or will not be judged."""
    _first_delay_s: float | None = None
    """The delay of the first report after the `MODE00` that waits for a result. None if it is not known."""
    _unjudged: bool = False
    """True if a frame was written after the `MODE00` that the next block gap would judge."""
    _older_reports_s: float = 0.0
    """Time after `MODE00` for which reports may arrive that the car sent before it. 0 until a stop is tried again."""

    # The findings of this stop.
    _block_gaps: int = 0
    _gaps_needed: int = BLOCK_GAPS
    _controlled: bool = False
    """True if the control of this stop was passed: the report after a frame that does not block came on time."""
    _delayed: int = 0
    """Number of this stop's `MODE00` frames whose first report had another delay than the block, or none."""
    _misfits: int = 0
    """Number of intervals with a `MODE00` that were neither normal nor a block gap. Another program may be running."""

    # The mode that the car is leaving.
    _other_mode_readings: int = 0
    """Number of consecutive readings in the form of another mode."""
    _other_mode_at: float | None = None
    """When the last reading of another mode arrived, since the last motion or the opening of a mode."""
    _silent_mode: Mode | None = None
    """The silent mode that was opened while the car had shown its rest."""
    _opened_at: float = _NEVER
    """When the last mode was opened."""
    _closed_at: float | None = None
    """When the first `MODE00` after the opening of the mode was written, or None if none was."""
    _closed_alone: bool = False
    """True if no frame was written between the opening of the mode and that `MODE00`, and no second `MODE00` after
    it."""

    # ------------------------------------------------------------------ the car's own numbers

    @property
    def close_s(self) -> float:
        """Return the time by which `MODE00` delays this car's next report, s."""
        return self.learned.close_s(self.profile.close_s)

    @property
    def _rhythm(self) -> Rhythm:
        return self.learned.echo

    @property
    def interval_s(self) -> float:
        """Return the interval of this car's reports with an echo, s."""
        return self.learned.interval_s(self.profile.interval_s)

    @property
    def min_silence_s(self) -> float:
        """Return the minimum silence after which a report of mode 0 counts, s."""
        return min(MIN_SILENCE_S, MIN_SILENCE_SHARE * self.learned.interval_s(FASTEST_S))

    @property
    def _leaving_s(self) -> float:
        """Return the maximum time from the `MODE00` that closed a mode to the first report of mode 0."""
        latest_s = self.close_s + self.interval_s + self._rhythm.tolerance_s
        return min(latest_s + EARLY_S, self.profile.reopened_s + WIRE_S)

    @property
    def is_awaited(self) -> bool:
        """Return True if the next report, or the silence after the last one, decides about a `MODE00`."""
        return self._mode_00_at is not None or self.settles_at is not None

    @property
    def settling_s(self) -> float:
        """Return the wait after the last block gap, s. If the link held a report, the next one comes in this time."""
        return max(0.0, self.interval_s - self.close_s) + SETTLING_S

    # ------------------------------------------------------------------ frames

    def begin_link(self) -> None:
        """Drop the evidence of the last link. Keep what was learned, and the number of reports without an echo."""
        self.reacted_at = None
        self._last_at = self._foreign_at = _NEVER
        self._older_reports_s = 0.0
        self.reset_times()
        self.on_motion()

    def begin_stop(self) -> None:
        """Prepare for another stop. Keep the block gaps of the last stop, but not its control."""
        self.settles_at = None
        self._controlled = False
        self._delayed = 0

    def on_motion(self) -> None:
        """Drop the evidence, because the car may drive now."""
        self._drop_gaps()
        if self._mode_00_at is not None:  # that `MODE00` will not be judged any more, but it blocks the car
            self._blocks.append(_Block(None, self.close_s, self._mode_00_at))
        self._mode_00_at = self.settles_at = None
        self._other_frame_written = True
        self._forget_mode()

    def on_mode_opened(self, mode: Mode, now: float, *, silent: bool, shown: bool) -> None:
        """Record the opening of a mode. If `shown`, the car had shown its rest before."""
        self.on_motion()
        self._echo_report_at = self._no_echo_report_at = None
        self._opened_at = now
        self._closed_alone = True
        self._silent_mode = mode if silent and shown else None

    def on_other_frame(self) -> None:
        """Record a frame that neither moves the car nor closes a mode."""
        self._other_frame_written = self._unjudged = True
        self.settles_at = None
        if self._closed_at is None:
            self._closed_alone = False

    def on_block(self, kind: Blocking | None, block_s: float, now: float) -> None:
        """Record a frame other than `MODE00`, which may block the car for `block_s` and so delay a report."""
        if block_s > FRAME_S:
            self._blocks.append(_Block(kind, block_s, now))

    def on_mode_00(self, now: float, *, awake: bool) -> None:
        """Record a `MODE00`. With `awake`, no other frame of ours blocks the car: its block gap will be exact."""
        self._mode_00_at = now if awake else None
        if not awake:
            self._blocks.append(_Block(None, self.close_s, now))  # so that nothing is learned from this interval
        self._first_delay_s = None
        self._unjudged = False
        self.settles_at = None
        if self._closed_at is None:
            self._closed_at = now
        else:
            self._closed_alone = False

    def on_retry(self) -> None:
        """Allow for the round trip of a slow link from now on."""
        self._older_reports_s = ROUND_TRIP_S

    # ------------------------------------------------------------------ readings

    def on_noise(self, at: float, *, damaged: bool = True) -> None:
        """Record bytes that are not readings. With `damaged`, they begin like a frame: the next may be damaged, too."""
        self._last_at = at
        self._echo_report_at = self._no_echo_report_at = self.settles_at = None
        self._ended_with_echo = False
        if damaged:
            self._foreign_at = at

    def reset_times(self) -> None:
        """Drop the evidence that depends on times, because a stall of the loop made the times of reports wrong."""
        self._echo_report_at = self._no_echo_report_at = self._mode_00_at = self.settles_at = None
        self._drop_gaps()

    def is_credible(self, event: Sensors) -> bool:
        """Return False for a report of mode 0 just after other frames: it may be a damaged frame of another mode."""
        return event.at - self._foreign_at >= self.min_silence_s or Mode.MANUAL not in candidate_modes(event)

    def on_reading(self, event: Sensors) -> Finding:
        """Record a reading, and return its finding."""
        at, silence_s = event.at, event.at - self._last_at
        has_echo, is_report = bool(event.range_cm), Mode.MANUAL in candidate_modes(event)
        self._last_at = at
        self.changed_expectation = False
        # If this report comes a normal interval after the last block gap, the link did not hold the report before it.
        on_time = self.settles_at is not None and silence_s >= self.interval_s - self._rhythm.tolerance_s
        if on_time and is_report:
            self._echo_report_at = at if has_echo else None
            self._ended_with_echo = has_echo
            self._blocks, self._other_frame_written = [], False
            return self._on_shown(at)
        self.settles_at = None
        if not is_report:
            self._on_other_mode(at)
            return Finding.NOTHING
        self._other_mode_readings = 0
        if silence_s < self.min_silence_s:
            self._learn_faster(at, silence_s, has_echo=has_echo)
            self._echo_report_at = self._no_echo_report_at = None
            if silence_s < min(BUNCHED_S, BUNCHED_SHARE * self.learned.interval_s(FASTEST_S)):
                self._drop_gaps()
            return Finding.NOTHING
        self._ended_with_echo = has_echo
        if event.range_cm is None:  # the frame is damaged, and does not show whether there is an echo
            self._echo_report_at = self._no_echo_report_at = None
            return Finding.NOTHING
        return self._on_report(at, silence_s, has_echo=has_echo)

    def _on_report(self, at: float, silence_s: float, *, has_echo: bool) -> Finding:
        """Judge a report of mode 0 after a silence."""
        ranging_s = 0.0 if has_echo else self.profile.ranging_s  # without an echo, the ranging delays the report
        before, self._echo_report_at = self._echo_report_at, at if has_echo else None
        before_no_echo, self._no_echo_report_at = self._no_echo_report_at, None if has_echo else at
        # If a frame was written just before this report, or during its ranging, the car may read it only after the
        # report. So keep its block for the next report, too.
        blocks, self._blocks = self._blocks, [each for each in self._blocks if at - each.at < READ_LATE_S + ranging_s]
        other_written, self._other_frame_written = self._other_frame_written, False
        self.without_echo = 0 if has_echo else self.without_echo + 1
        left = self._judge_leaving(at, silence_s, self._leaving_s + ranging_s)
        if left is Finding.SHOWN:
            return self._on_shown(at)
        if not has_echo:
            return self._on_report_without_echo(before_no_echo, at, blocks)
        if left is Finding.BLOCK_GAP:
            return self._count_late_leaving(at)
        mode_00_at = self._mode_00_at
        if mode_00_at is None:
            return self._without_mode_00(before, at, blocks, other_written=other_written)
        if before is None:
            if at <= mode_00_at + self.close_s - EARLY_S:
                return Finding.NOTHING
            self._mode_00_at = None
            return self._report_finding
        if not self._rhythm.is_known:
            if at > mode_00_at + self.close_s - EARLY_S:
                self._mode_00_at = None
            return Finding.UNJUDGED
        return self._judge_interval(before, mode_00_at, at, blocks)

    def _on_report_without_echo(self, before: float | None, at: float, blocks: list[_Block]) -> Finding:
        """Learn from the interval of two reports without an echo. `MODE00` is not judged by it."""
        if self._mode_00_at is None:
            if before is not None and not blocks:
                self.learned.add_interval(at - before, echo=False)
        elif at > self._mode_00_at + self.close_s + self.profile.ranging_s:
            self._mode_00_at = None  # if that `MODE00` blocked a report, it was this one
        return Finding.NO_ECHO

    def settle(self, now: float) -> bool:
        """Return True if the block gaps count from now on, because no reading has followed them too early."""
        if self.settles_at is None or now < self.settles_at:
            return False
        self.settles_at = None
        self._on_shown(self._last_at)
        return True

    @property
    def _report_finding(self) -> Finding:
        is_judged = self._rhythm.is_known and not (self._misfits >= MISFITS and self._rhythm.is_changing)
        return Finding.REPORT if is_judged else Finding.UNJUDGED

    def _without_mode_00(
        self, before: float | None, at: float, blocks: list[_Block], *, other_written: bool
    ) -> Finding:
        """Learn from an interval without a `MODE00`: the rhythm, the delay of another frame, or the control."""
        if before is None:
            if other_written:
                self._drop_gaps()  # there was damage instead of a report after the control
            return self._report_finding
        gap_s = at - before
        if not blocks:
            if other_written and self._rhythm.is_known:
                self._controlled = self._rhythm.fits(gap_s)
                if not self._controlled:
                    self._drop_gaps()  # writing makes the link lose reports
                    return self._report_finding
            self._learn_interval(gap_s)
        elif len(blocks) == 1 and (kind := blocks[0].kind) is not None and self._rhythm.is_known:
            expected_s = blocks[0].block_s
            delay_s = gap_s - self._rhythm.median_s
            self.learned.add_delay(kind, delay_s, self.profile.reopened_s, controlled=True)
            if abs(delay_s - self.learned.block_s(kind, expected_s)) <= self._rhythm.tolerance_s:
                self.learned.on_reaction(sure=True)
                self.reacted_at = at
            elif self._rhythm.fits(gap_s) and expected_s > 2 * self._rhythm.tolerance_s:
                self.changed_expectation = self.learned.on_no_reaction()
        return self._report_finding

    def _learn_faster(self, at: float, silence_s: float, *, has_echo: bool) -> None:
        """Learn the rhythm of a car that reports faster than before."""
        if self._mode_00_at is not None and at > self._mode_00_at + self._leaving_s + ROUND_TRIP_S:
            self._mode_00_at = (
                None  # the block of that `MODE00` is over, and no report in the earlier rhythm can judge it
            )
        clean = self._ended_with_echo and self._mode_00_at is None and not self._blocks
        self._ended_with_echo = has_echo
        if clean and has_echo and silence_s >= MIN_SILENCE_SHARE * FASTEST_S:
            self._learn_interval(silence_s)

    def _learn_interval(self, gap_s: float) -> None:
        if self.learned.add_interval(gap_s, echo=True):
            self.changed_expectation = True
            self._misfits = 0
            self._drop_gaps()

    def _judge_interval(self, before: float, mode_00_at: float, at: float, blocks: list[_Block]) -> Finding:
        """Judge the interval of two reports. `MODE00` was written at `mode_00_at`."""
        gap_s, after_s, rhythm, close_s = at - before, at - mode_00_at, self._rhythm, self.close_s
        delay_s, tolerance_s = gap_s - rhythm.median_s, rhythm.tolerance_s
        blocked_s = sum(each.block_s for each in blocks)
        # A block cannot delay a report by more than the time since its frame. A longer delay comes from the link.
        is_possible = after_s > IN_FLIGHT_S and delay_s <= after_s + EARLY_S
        if mode_00_at >= before and is_possible and not blocks:
            self._first_delay_s = delay_s
        if after_s <= close_s - EARLY_S:
            return Finding.NOTHING
        matches = -tolerance_s <= delay_s - close_s <= blocked_s + tolerance_s
        longer = -tolerance_s <= delay_s - close_s <= LONGER_S
        if close_s > 2 * tolerance_s and (matches or longer):
            self._mode_00_at = None
            # Require more block gaps if too few intervals are known to tell their spread, or if an unjudged earlier
            # `MODE00` may have delayed this report.
            seen_s = rhythm.seen_tolerance_s
            is_close = -seen_s <= delay_s - close_s <= blocked_s + seen_s
            if not is_close or any(each.kind is None for each in blocks):
                self._gaps_needed = BLOCK_GAPS_IN_DOUBT
            return self._count_gap(at, delay_s, learn=not matches)
        if after_s <= self._older_reports_s and gap_s <= rhythm.median_s + SAME_S:
            return Finding.NOTHING
        self._mode_00_at = None
        first_delay_s, self._first_delay_s = self._first_delay_s, None
        if first_delay_s is not None and self._count_other_delay(first_delay_s):
            # The block of this car has another length than expected. The equal delays before this one were block gaps,
            # too.
            self._block_gaps = self._gaps_needed
            return self._count_gap(at, first_delay_s)
        # The interval is not a block gap. If the rhythm is not firm yet, let it become firm before the next `MODE00`.
        no_gap = Finding.REPORT if rhythm.is_firm else Finding.UNJUDGED
        max_spread_s = max(SAME_S, 2 * tolerance_s) if rhythm.is_firm else tolerance_s
        if abs(delay_s) > max_spread_s:
            self._drop_gaps()
            self._misfits += 1
            return Finding.UNJUDGED if self._misfits >= MISFITS else no_gap
        if first_delay_s is not None and abs(first_delay_s) > max_spread_s:
            return no_gap
        self._misfits = 0
        self._drop_gaps()
        if not blocks and rhythm.fits(gap_s):
            self._learn_interval(gap_s)
        if self.profile.close_s > 2 * tolerance_s:
            self.changed_expectation = self.learned.on_no_reaction() or self.changed_expectation
        return Finding.LOST

    def _count_other_delay(self, delay_s: float) -> bool:
        """Count a delay that is not the expected block. Return True if enough delays of this stop agree."""
        self._delayed += 1
        return self._add_close(delay_s) and self._delayed >= BLOCK_GAPS

    def _add_close(self, delay_s: float) -> bool:
        """Learn from the delay after a `MODE00`. Return True if the last delays agree."""
        kind, longest_s = Blocking.MODE_CLOSE, self.profile.reopened_s
        return self.learned.add_delay(kind, delay_s, longest_s, controlled=self._controlled)

    def _count_gap(self, at: float, delay_s: float, *, learn: bool = False) -> Finding:
        """Count a block gap. With `learn`, its length is not the expected one, but may be the block of this car."""
        self._block_gaps += 1
        self.reacted_at = at
        self._first_delay_s = None
        self._misfits = 0
        self.learned.on_reaction(sure=self._controlled or not self.learned.is_confusable(delay_s))
        if learn:
            self._add_close(delay_s)
        if not self._controlled and self.learned.is_confusable(delay_s):
            return Finding.CONTROL
        if self._block_gaps < self._gaps_needed or self._unjudged:
            return Finding.BLOCK_GAP
        self.words = f"{self._block_gaps} gaps in its reports, each after MODE00"
        self.settles_at = at + self.settling_s
        return Finding.SETTLING

    def _drop_gaps(self) -> None:
        self._block_gaps, self._gaps_needed, self._controlled = 0, BLOCK_GAPS, False

    def _on_other_mode(self, at: float) -> None:
        """Record a reading in the form of another mode."""
        self._other_mode_readings += 1
        self._foreign_at = at
        self._echo_report_at = self._no_echo_report_at = None
        self._ended_with_echo = False
        self._drop_gaps()
        if self._other_mode_readings >= OTHER_MODE_READINGS or self._other_mode_at is not None:
            self._other_mode_at = at
            self._silent_mode = None

    def _judge_leaving(self, at: float, silence_s: float, within_s: float) -> Finding:
        """Return SHOWN if this report shows that `MODE00` alone closed the mode.

        Return BLOCK_GAP if it comes a little too late, or if the car has not shown a stop before. `within_s` is the
        maximum time from `MODE00` to a report that shows it.
        """
        closed_at = self._closed_at
        other_mode_at, silent = self._other_mode_at, self._silent_mode
        if closed_at is None or at <= closed_at + self.close_s - EARLY_S:
            return Finding.NOTHING
        opening_s = self.profile.shortest_opening_s
        # Opening the mode blocks for at least this time. Meanwhile a slow link may deliver older reports, so a shorter
        # silence is no evidence.
        earliest_at = self._opened_at + opening_s + self.close_s - EARLY_S
        if silent is not None and (silence_s < opening_s - LATE_S or at < earliest_at):
            return Finding.NOTHING
        self._other_mode_at = self._silent_mode = None
        if not self._closed_alone or at > closed_at + within_s + LATE_S:
            return Finding.NOTHING
        if silent is None and (other_mode_at is None or other_mode_at > closed_at + OTHER_MODE_LINGERS_S):
            return Finding.NOTHING
        mode = "the mode that it reported" if silent is None else silent
        self.words = f"a report of mode 0 {at - closed_at:.1f} s after MODE00, out of {mode}"
        # A car that was never seen to block may send a report in the middle of a block, with the motors on.
        is_judged = at <= closed_at + within_s and not self._unjudged and self.learned.shows is Shows.YES
        return Finding.SHOWN if is_judged else Finding.BLOCK_GAP

    def _count_late_leaving(self, at: float) -> Finding:
        """Count a report that is not enough to show that the car left its mode. It is the first block gap, no more."""
        self.reacted_at = at
        self._mode_00_at = None
        self._drop_gaps()
        self._block_gaps = 1
        return Finding.BLOCK_GAP

    def _on_shown(self, at: float) -> Finding:
        """Begin anew, because the stop is shown."""
        self.reacted_at = at
        self._mode_00_at = None
        self.settles_at = None
        self._drop_gaps()
        self._older_reports_s = 0.0
        self._forget_mode()
        self.learned.on_shown()
        return Finding.SHOWN

    def _forget_mode(self) -> None:
        """Forget what could show that the car left a mode."""
        self._other_mode_readings = 0
        self._other_mode_at = self._silent_mode = self._closed_at = None
        self._closed_alone = False
