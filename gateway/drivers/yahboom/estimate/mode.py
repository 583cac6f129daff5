"""Estimates the mode of the car from the commanded mode and the readings. The car never reports its mode.

Silence never confirms a mode, so a mode in which this car sends nothing is at best assumed. The table
tests/vectors/mode_truth.tsv lists which modes can be distinguished, and how soon. The tests check that table.
"""

from collections import deque
from typing import Final

from msgspec import Struct, field

from gateway.drivers.yahboom.estimate.learned import Learned
from gateway.drivers.yahboom.protocol.modes import MODES, SILENT_MODES, candidate_modes
from gateway.drivers.yahboom.protocol.platforms import Profile
from gateway.drivers.yahboom.protocol.sensors import Sensors
from gateway.drivers.yahboom.protocol.timing import FRAME_S, MODE_CLOSE_S, REPEAT_INTERVAL_S, SERVO_S
from schemas.words import Mode, Verdict

CONTRADICTING_FRAMES: Final = 3
"""Number of consecutive readings of another mode that contradict the commanded one
(docs/explanation/how-sure-is-a-mode.md#contradiction)."""
MANUAL_SILENCE_S: Final = 3.0
RUNNING_SILENCE_S: Final = 1.0
"""Minimum silence that contradicts mode 0 (the first), or modes 2, 5 and 6 (the second). The time of known blocks is
not counted, nor that of a running fan if it may silence the car."""
FIRST_SILENCE_S: Final = 5.0
"""Minimum silence that contradicts mode 0 while the usual interval of the car's reports is not known yet."""
SILENCE_MARGIN_S: Final = 0.75
"""How much longer than the car's longest normal interval a silence must be to contradict mode 0."""
CORRUPTED_MATCH_S: Final = 0.5
"""Period after a reading of another mode in which a single reading of the commanded mode may be a corrupted frame, so
three are required."""
MAX_FADE_EXCUSE_S: Final = SERVO_S
"""Maximum time by which blocks prolong a confirmation: the block of a servo. In a block, the car is busy with a frame
of ours, and sends nothing. A stream of actions must not keep a claim alive that no reading supports any more."""
MAX_BLOCKS: Final = 256
"""Maximum number of blocking frames that are remembered. Only somebody who whistles without end reaches it."""


class ModeEstimator(Struct):
    """The commanded mode (`asked`), the inferred mode, and the verdict. Times: s, monotonic."""

    profile: Profile
    learned: Learned = field(default_factory=Learned)
    asked: Mode | None = None
    inferred: Mode | None = None
    """The only mode that fits the last readings or the silence, or None if several or none fit. While a mode is
    confirmed, ambiguous readings do not change it."""
    verdict: Verdict = Verdict.ASSUMED
    evidence: str = "no reading yet"
    evidence_at: float | None = None
    since: float | None = None
    """When the commanded mode or the verdict last changed, or None if no mode was commanded on this link."""
    candidates: tuple[Mode, ...] = ()
    """Candidate modes. Empty if the car should report in every mode but is silent."""
    _asked_at: float = field(default=float("-inf"))
    _in_mode_by: float = field(default=float("-inf"))
    """The time by which a car that obeys has entered the commanded mode."""
    _in_same_mode_by: float = field(default=float("-inf"))
    """The time by which a car has entered the commanded mode if it was in this mode already at the last frame."""
    _opened_at: float | None = None
    """When the commanded mode was open at the earliest, until its first reading has come."""
    _heard_at: float = field(default=float("-inf"))
    _own_at: float = field(default=float("-inf"))
    _other_at: float = field(default=float("-inf"))
    """When the last reading arrived that fits the commanded mode, and the last that does not."""
    _excused_at: float = field(default=float("-inf"))
    """When silence was last expected. An unexpected silence is measured from then on."""
    _ended_silence_s: float = 0.0
    """The longest silence on this link that proved to be normal for this car (`allow_silence`)."""
    _matches: int = 0
    _mismatches: int = 0
    """Number of consecutive readings that fit only the commanded mode, and that do not fit it."""
    _blocks: deque[tuple[float, float]] = field(default_factory=lambda: deque(maxlen=MAX_BLOCKS))
    """Time and duration of each block by one of our frames."""

    @property
    def confirmed(self) -> Mode | None:
        """Return the commanded mode if it is confirmed."""
        return self.asked if self.verdict is Verdict.CONFIRMED else None

    @property
    def is_over(self) -> bool:
        """Return True if readings show mode 0 although another mode was commanded, so the car has left that mode."""
        return self.asked is not Mode.MANUAL and self.verdict is Verdict.CONTRADICTED and self.inferred is Mode.MANUAL

    def on_mode_sent(self, mode: Mode, *, now: float, block_s: float) -> None:
        """Record a written frame that brings the car into `mode` and blocks it for `block_s`."""
        # The car obeys after the block of the previous frame, and when the loop of the previous mode has run through
        # once. If that mode is unknown, assume the slowest one.
        previous = self.asked if self.verdict is not Verdict.CONTRADICTED else None
        turn_s = self.profile.mode_turn_s(previous or Mode.OBSTACLE_AVOIDANCE)
        self._in_mode_by = max(self._in_mode_by, now + turn_s) + block_s
        self._in_same_mode_by = now + self.profile.mode_turn_s(mode) + block_s
        self._opened_at = None if mode is Mode.MANUAL else now + block_s
        if mode is self.asked is Mode.MANUAL and self.verdict is Verdict.CONFIRMED:
            return
        if mode is not self.asked or self.verdict is not Verdict.ASSUMED:
            self.since = now
        self.asked = mode
        self._asked_at = now
        self._matches = self._mismatches = 0
        self._other_at = float("-inf")
        self.verdict = Verdict.ASSUMED
        self.evidence = f"mode {mode} was commanded, no reading since"
        self.evidence_at = now

    def on_written(self, block_s: float, *, now: float) -> None:
        """Record any other written frame, because its block delays the readings."""
        if block_s > FRAME_S:
            self._blocks.append((now, block_s))

    def forget(self) -> None:
        """Forget the mode, because the link was lost."""
        self.asked = None
        self.inferred = None
        self.candidates = ()
        self._matches = self._mismatches = 0
        self._ended_silence_s = 0.0
        self._blocks.clear()
        self.verdict = Verdict.ASSUMED
        self.evidence = "the link was lost"
        self.evidence_at = self.since = None

    def on_reading(self, event: Sensors, *, counts: bool = True) -> None:
        """Update the estimate with a reading. With `counts` False, the reading only ends the silence."""
        at = event.at
        self._heard_at = at
        if not counts:
            return
        candidates = candidate_modes(event)
        self._set_candidates(candidates)
        if self.asked is None:
            return
        if self.asked in candidates:
            self._mismatches = 0
            self._own_at = at
            if len(candidates) > 1:
                return
            self._matches += 1
            if self._opened_at is not None and at > self._opened_at:
                self.learned.add_first_reading(self.asked, at - self._opened_at)
                self._opened_at = None
            self._in_mode_by = min(self._in_mode_by, self._in_same_mode_by)
            if at >= self._asked_at and (
                self._matches >= CONTRADICTING_FRAMES or at > self._other_at + CORRUPTED_MATCH_S
            ):
                self._conclude(Verdict.CONFIRMED, f"a reading as in mode {self.asked}", at)
            return
        self._matches = 0
        self._other_at = at
        if at < self._in_mode_by:
            return  # the previous mode may still have sent it
        self._mismatches += 1
        if self._mismatches >= CONTRADICTING_FRAMES:
            shape = " or ".join(candidates)
            self._conclude(Verdict.CONTRADICTED, f"{self._mismatches} consecutive readings as in mode {shape}", at)

    def on_silence(self, *, now: float, fan: bool) -> None:
        """Update the estimate with the silence. Some modes, our blocks and the fan make a car silent."""
        if self.asked is None:
            return
        limit = self.silence_limit(fan=fan)
        if limit is None:
            self._on_expected_silence(self.asked, now)
            return
        if self._heard_at == float("-inf"):
            return  # the silence of a car that never sent a reading shows nothing about its mode
        silent_s = self.unheard_s(now)
        if silent_s > self.manual_silence_s:
            self._set_candidates(self._silent_modes)
        if silent_s > limit:
            words = f"silent for {silent_s:.1f} s, but mode {self.asked} reports at least every {limit:g} s"
            if not self._silent_modes:
                words += "; the car has no silent mode, so it is off, out of range, or its program has ended"
            self._conclude(Verdict.CONTRADICTED, words, now)
        elif (own_s := self._silence_s(self._own_at, now)) > limit:
            shape = " or ".join(self.candidates)
            words = f"no reading as in mode {self.asked} for {own_s:.1f} s, the last one is as in mode {shape}"
            self._conclude(Verdict.CONTRADICTED, words, now)

    def allow_silence(self, silent_s: float) -> None:
        """Treat a silence as normal for this car on this link, because a report has ended it.

        Ignore a silence of over `FIRST_SILENCE_S`, because then the car was off or out of range.
        """
        if silent_s <= FIRST_SILENCE_S:
            self._ended_silence_s = max(self._ended_silence_s, silent_s)

    def excuse_silence(self, now: float) -> None:
        """Ignore the silence until now, because nobody could hear the car."""
        self._excused_at = max(self._excused_at, now)

    @property
    def heard_at(self) -> float:
        """Return when the last reading arrived, or -inf if none has."""
        return self._heard_at

    @property
    def why_quiet(self) -> str:
        """Return why a silence of the car is expected, in words."""
        if self.asked is None:
            return "in an unknown mode a car may be silent"
        if not self.profile.has_readings:
            return "this car sends no readings"
        if self.asked is Mode.MANUAL:
            return "its fan may be on"
        if self.asked in self.profile.silent_modes:
            return f"{self.asked} is silent"
        return f"it is not known whether this car reports in {self.asked}"

    def fade(self, now: float) -> None:
        """Withdraw a confirmation that is older than the longest silence of the commanded mode."""
        if self.verdict is not Verdict.CONFIRMED or self.asked is None:
            return
        limit = self.manual_silence_s if self.asked is Mode.MANUAL else RUNNING_SILENCE_S
        since_s = now - max(self.evidence_at or self._own_at, self._excused_at)
        blocked_s = min(MAX_FADE_EXCUSE_S, sum(block_s for at, block_s in self._blocks if at > now - since_s))
        if self.inferred is None or since_s > limit + blocked_s + MODE_CLOSE_S:
            self._conclude(Verdict.ASSUMED, f"no reading as in mode {self.asked} for {since_s:.1f} s", now)

    def unheard_s(self, now: float) -> float:
        """Return how many seconds (0 or more) the car gave no reading although no frame of ours blocked it."""
        return max(0.0, self._silence_s(self._heard_at, now))

    def silence_limit(self, *, fan: bool) -> float | None:
        """Return the longest normal silence of the commanded mode, in s.

        Return None if silence shows nothing, or if no mode was commanded.

        In a mode other than 0, silence shows something only if this car has reported in that mode before.
        """
        if self.asked is None or self.is_silent(self.asked) or (fan and self.profile.fan_silences):
            return None
        return self.manual_silence_s if self.asked is Mode.MANUAL else RUNNING_SILENCE_S

    def is_silent(self, mode: Mode) -> bool:
        """Return True if this car is not known to report in a mode."""
        if not self.profile.has_readings or mode in self.profile.silent_modes:
            return True
        return mode is not Mode.MANUAL and mode not in self.learned.reporting

    @property
    def manual_silence_s(self) -> float:
        """Return the minimum silence that contradicts mode 0, s."""
        learned = self.learned
        if not learned.echo.is_known and not learned.no_echo.is_known:
            return FIRST_SILENCE_S
        longest_s = max(learned.no_echo.median_s, learned.echo.median_s + self.profile.ranging_s)
        return max(MANUAL_SILENCE_S, max(longest_s, self._ended_silence_s) + SILENCE_MARGIN_S)

    @property
    def _silent_modes(self) -> tuple[Mode, ...]:
        return tuple(mode for mode in Mode if mode in self.profile.possible_modes and mode in SILENT_MODES)

    def _on_expected_silence(self, asked: Mode, now: float) -> None:
        """Let older evidence expire: silence is normal in this mode or with the fan on, so it proves nothing."""
        silent_s = now - max(self._heard_at, self._asked_at)
        if not self.is_silent(asked):
            self._excused_at = now
            if silent_s > self.manual_silence_s and self.verdict is not Verdict.CONTRADICTED:
                self._set_candidates(tuple(mode for mode in Mode if mode in self.profile.possible_modes))
                self._conclude(Verdict.ASSUMED, f"silent for {silent_s:.0f} s, as expected while its fan runs", now)
            return
        if now < self._in_mode_by:
            return
        if self.unheard_s(now) > self.manual_silence_s:
            self._mismatches = 0
            self._set_candidates(self._silent_modes)
        if self._mismatches == 0 and self.verdict is Verdict.ASSUMED:
            known = asked in self.profile.silent_modes or not self.profile.has_readings
            why = "as expected" if known else f"and it is not known whether this car reports in {asked}"
            self._conclude(Verdict.ASSUMED, f"silent for {silent_s:.0f} s, {why}", now)

    def _silence_s(self, heard_at: float, now: float) -> float:
        # The motors of a mode run for a while before its first reading, so that silence shows nothing.
        asked, first_s = self.asked, 0.0
        if asked is not None and self._opened_at is not None:
            first_s = self.learned.first_reading_s(asked, MODES[asked].first_reading_s)
        since = max(heard_at, self._in_mode_by + first_s, self._excused_at)
        # Do not count blocks that are much older than the last reading: the car had obeyed those frames before it began
        # that reading, which takes up to 1.0 s of ranging.
        return now - since - sum(block_s for at, block_s in self._blocks if at > since - REPEAT_INTERVAL_S)

    def _set_candidates(self, candidates: tuple[Mode, ...]) -> None:
        self.candidates = candidates
        # One ambiguous reading does not withdraw a confirmation, because it may be corrupted.
        if len(candidates) == 1 or self.verdict is not Verdict.CONFIRMED:
            self.inferred = candidates[0] if len(candidates) == 1 else None

    def _conclude(self, verdict: Verdict, evidence: str, at: float) -> None:
        if verdict is Verdict.CONFIRMED and self.asked is not None:
            self.learned.reporting.add(self.asked)
        if verdict is not self.verdict:
            self.since = at
        self.verdict = verdict
        self.evidence = evidence
        self.evidence_at = at
        if verdict is not Verdict.CONFIRMED:
            self.inferred = self.candidates[0] if len(self.candidates) == 1 else None
