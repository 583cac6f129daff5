"""Updates `CarModel` with readings and silence, and stops the car if they require it. Pure."""

from typing import Final

from gateway.control.command_records import CommandLog
from gateway.control.commands import SetMode
from gateway.control.driver import Rejected
from gateway.control.trust import STOP_GOES_ON, TrustEvent
from gateway.drivers.yahboom.car_model import CarModel
from gateway.drivers.yahboom.estimate.platform import PlatformDetector
from gateway.drivers.yahboom.executor import Executor
from gateway.drivers.yahboom.pacing import FLIGHT_S
from gateway.drivers.yahboom.protocol.modes import only_candidate
from gateway.drivers.yahboom.protocol.platforms import StopStyle, parse_platform
from gateway.drivers.yahboom.protocol.sensors import Sensors
from gateway.drivers.yahboom.protocol.wire_events import Event
from gateway.drivers.yahboom.stops import cases
from gateway.drivers.yahboom.stops.evidence import Finding
from schemas.words import (
    Blocking,
    CarTrust,
    Cause,
    FrameOrigin,
    Level,
    Mode,
    Phase,
    Platform,
    Reason,
    Shows,
    Verdict,
)

FAN_SETTLED_S: Final = 2.0
"""Minimum time from a fan toggle to a reading that shows the new state of the fan."""


class CarMonitor:
    """Handles readings, silence, and changes of the detected platform."""

    def __init__(self, model: CarModel, executor: Executor, log: CommandLog) -> None:
        self.model = model
        self.lost_frames = 0
        """Number of judged `MODE00` frames that did not arrive. Counted only on a car that has shown a stop before."""
        self._executor = executor
        self._stops = executor.stops
        self._log = log
        self._not_obeyed_logged = False
        self._silent_since: float | None = None
        """Time of the last reading before a silence that was handled already. Commands may have arrived since then."""

    def link_up(self) -> None:
        """Forget the evidence of the last link."""
        model = self.model
        self._not_obeyed_logged = False
        self._silent_since = None
        model.platform.begin_link()
        if model.platform.auto:  # detect the platform again, because another car may have been plugged in
            opened_as = model.learned.opened_as
            remembered = parse_platform(opened_as) if opened_as else None
            model.platform = PlatformDetector(model.platform.configured, auto=True, remembered=remembered)
            model.treat_as(model.platform.profile)

    def link_down(self) -> None:
        """Forget the remembered platform, if the car was silent after a frame that only that platform understands."""
        model = self.model
        is_silent = model.mode_closed_at > model.link_since > model.mode.heard_at
        if model.platform.is_remembered and is_silent:
            model.learned.opened_as = ""

    def on_event(self, event: Event, now: float) -> None:
        """Update the model with an event of the decoder."""
        is_credible = not isinstance(event, Sensors) or self.model.evidence.is_credible(event)
        self._update_platform(event, now, counts=is_credible)
        if isinstance(event, Rejected) and event.raw.strip():  # some cars end a frame with CR and LF
            self.model.evidence.on_noise(event.at, damaged=event.cause is not Cause.NO_START)
        if isinstance(event, Sensors):
            self._on_reading(event, now, counts=is_credible)

    def _update_platform(self, event: Event, now: float, *, counts: bool) -> None:
        """Look at what an event says about the program of the car. Stop the car if its last stop did not fit that.

        With `counts` False, the event is a reading that may be damaged.
        """
        model = self.model
        was_open = model.platform.open_mode
        contradictions = model.platform.on_event(event, counts=counts)
        if model.platform.open_mode and not was_open and model.profile.stop_style is StopStyle.GENERAL:
            self._stops.leave_open_mode(now)
        for words in contradictions:
            self._log.log(Level.WARNING, "platform_contradicted", f"{model.name}: {words}", now)
            if model.platform.doubted:  # the last stop may have been of the wrong kind for this car
                self._on_other_program(now, words)

    def _on_reading(self, event: Sensors, now: float, *, counts: bool) -> None:
        """Update mode, evidence and learned habits with a reading, and let the stop in progress act on the finding.

        With `counts` False, the reading may be damaged, and says nothing about the mode.
        """
        model = self.model
        was_silent = self._silent_since is not None or model.trust.state is CarTrust.UNHEARD
        before, silent_s = model.mode.verdict, model.mode.unheard_s(event.at) if was_silent else 0.0
        heard_at = model.mode.heard_at
        model.mode.on_reading(event, counts=counts)
        self._log_contradiction(before, now)
        self._record_effect(event, now)
        # Stop the car after a silence, because a command may have been sent during it.
        if was_silent:
            self._silent_since = None
            # Allow such a silence. Otherwise, if a `MODE00` delays the report for longer than expected, each silence
            # would cause the next `MODE00`, for ever.
            model.mode.allow_silence(silent_s)
            self._on_contact(heard_at, now)
        finding = model.evidence.on_reading(event)
        self._check_timer(now)
        if only_candidate(event) is Mode.MANUAL:
            self._on_report(event, now)
        self._log_delivery(finding, now)
        self._stops.on_finding(finding, event.at, now)
        if model.evidence.changed_expectation:
            self._on_changed_expectation(now)

    def _check_timer(self, now: float) -> None:
        """Note a contradiction if `MODE00` delays the reports of a car whose platform reports by a timer."""
        model = self.model
        if Blocking.MODE_CLOSE in model.learned.blocks and model.stop_style is StopStyle.TIMER:
            words = f"its reports come late after MODE00, unlike those of {model.profile.name} cars"
            if model.platform.note(words):
                self._log.log(Level.WARNING, "platform_contradicted", f"{model.name}: {words}", now)

    def _on_report(self, event: Sensors, now: float) -> None:
        """Update the model with a report of mode 0."""
        model = self.model
        model.learned.on_fields(event, model.profile.rejects(event))
        if event.at > model.mode_closed_at + FLIGHT_S:
            model.mode_left_by = float("-inf")
            if model.trust.state is not CarTrust.IN_MODE or model.mode.is_over:
                model.learned.opened_as = ""
        if event.range_cm is not None:
            model.pacing.on_report(event.at)
            model.range_cm, model.range_at = event.range_cm or None, event.at
        if event.voltage_v is not None and "battery" in model.profile.measured(event, model.mode.confirmed):
            self._executor.on_voltage(event.voltage_v, now)
        if now > model.believed.fan_at + FAN_SETTLED_S:
            model.believed.fan_toggled = False
            if model.shows_fan:  # docs/reference/protocol.md#hazards: a car whose fan runs sends no readings
                model.believed.fan = False

    def _log_delivery(self, finding: Finding, now: float) -> None:
        """Log once that a car that has shown stops did not react to one, and once that it reacts again."""
        name = self.model.name
        if finding is Finding.LOST and self.model.learned.shows is Shows.YES:
            self.lost_frames += 1
            if not self._not_obeyed_logged:
                self._not_obeyed_logged = True
                words = f"{name} did not get a stop: readings arrive, but it does not react as before."
                self._log.log(Level.WARNING, "not_obeyed", f"{words} The gateway stops it again.", now)
        elif finding in (Finding.SHOWN, Finding.SETTLING) and self._not_obeyed_logged:
            self._not_obeyed_logged = False
            self._log.log(Level.INFO, "hears", f"{name} reacts to MODE00 again", now)

    def _on_changed_expectation(self, now: float) -> None:
        """Log that this car cannot show its stops, or that it runs another program.

        In the second case, drop the claims that rest on readings of the first program.
        """
        name, learned = self.model.name, self.model.learned
        if learned.shows is Shows.NO:
            words = cases.NO_REACTION.why(name)
            self._log.log(Level.INFO, "cannot_show", f"{words}. It can be used like any other car.", now)
        else:
            words = f"{name} reports every {learned.echo.median_s:.2f} s now: another program, or another car?"
            self._log.log(Level.WARNING, "rhythm_changed", f"{words} Earlier evidence of stops is forgotten.", now)
            if self.model.platform.auto:
                self.model.platform.forget()
            self._on_other_program(now, words)

    def _on_other_program(self, now: float, words: str) -> None:
        """Drop the claims that rest on another program's readings. Do not stop a car that drives or is in a mode."""
        model = self.model
        model.learned.forget_reactions()
        if model.link_open and (model.trust.state in STOP_GOES_ON or model.trust.basis is not None):
            self._stops.recover(now, words)

    def _apply_platform(self, now: float) -> None:
        """Use the profile of the detected platform.

        Postpone this during the first frames of a stop, because each stop is made for one platform. Do not postpone it
        if the readings show an open mode, because general stops do not end a mode.
        """
        model = self.model
        if model.platform.profile is model.profile or not model.link_open:
            return
        # The head is the first word of a named frame, such as `4WD` in `$4WD,PTZ90#`. With a wrong head, the car
        # ignores our named frames, and its readings cannot be read. So do not postpone a change of the head.
        has_other_head = model.platform.profile.dialect.head != model.profile.dialect.head
        may_replace = has_other_head or (model.platform.open_mode and model.stop_style is StopStyle.BOTH)
        if not may_replace and not self._executor.accepts_commands(now):
            return
        before = model.profile.kind
        model.treat_as(model.platform.profile)
        words = ": ".join((f"{model.name} counts as {model.profile.name}", *model.platform.evidence[:1]))
        if model.platform.auto:  # otherwise the log has the new platform already, in the warning of the contradiction
            self._log.log(Level.INFO, "platform_settled", words, now)
        if has_other_head and self._is_idle:  # motions are general frames, which have no head, so let a drive go on
            self._stops.recover(now, words)
        elif before not in (Platform.UNKNOWN, model.profile.kind):
            self._on_other_program(now, words)
        elif model.stop_style is StopStyle.MODE_FRAME and not model.trust.shown and self._is_idle:
            # The car can show its stop, so stop it again. Half a named frame may be in its buffer.
            if model.known:
                self._stops.begin(self._stops.full(now), FrameOrigin.RECOVERY, now)
            else:
                self._stops.recover(now, words)

    @property
    def _is_idle(self) -> bool:
        """Return True if no command waits, and the car neither drives nor is in a mode."""
        moves = self.model.trust.state in (CarTrust.DRIVING, CarTrust.IN_MODE)
        return not moves and not self._executor.queue.has_commands

    def tick(self, now: float) -> None:
        """Check for silence, and for a detected platform. It is called several times a second."""
        self._apply_platform(now)
        model = self.model
        before = model.mode.verdict
        if model.link_open:
            self._check_silence(now)
        self._log_contradiction(before, now)
        # Readings contradict that the car is at rest: the stop was lost, or somebody else opened a mode.
        if model.trust.state is CarTrust.STOPPED and model.mode.verdict is Verdict.CONTRADICTED and model.link_open:
            self._stops.recover(now, model.mode.evidence)

    def _check_silence(self, now: float) -> None:
        model = self.model
        fan = model.believed.fan_may_run
        limit_s = model.mode.silence_limit(fan=fan)
        # During a stop, silence shows nothing about the mode, so skip this. But if every silence is normal now (there
        # is no limit), do not skip it: this silence must not count later.
        if self._stops.running is None or limit_s is None:
            model.mode.on_silence(now=now, fan=fan)
        model.mode.fade(now)
        if model.trust.state is CarTrust.UNHEARD or limit_s is None:
            return
        silent_s = model.mode.unheard_s(now)
        if silent_s <= model.mode.manual_silence_s or self._silent_since == model.mode.heard_at:
            return
        # This gateway has heard the car, or an earlier one has.
        was_heard = model.mode.heard_at > float("-inf") or model.learned.reporting
        if not was_heard and (found := model.platform.on_never_heard()):
            self._log.log(Level.WARNING, "platform_contradicted", f"{model.name}: {found}", now)
            model.treat_as(model.platform.profile)
            self._stops.change_case()
            return
        self._silent_since = model.mode.heard_at
        words = (
            f"{model.name} may be moving: no reading for {silent_s:.1f} s. Is it on, in range, its fan off? "
            f"The gateway keeps stopping it.{model.silent_program}"
        )
        self._log.log(Level.WARNING, "unheard", words, now)
        self._executor.queue.drop(Phase.FAILED, Reason.LINK_DOWN, words, now)
        self._executor.senders.halt_streams(now)
        running = self._stops.running
        if running is None or running.case is cases.SOFT:
            self._stops.recover(now, words)
        model.update_trust(TrustEvent.SILENT, now, words)

    def _on_contact(self, heard_at: float, now: float) -> None:
        """Stop the car when it reports again, because a stuck link may deliver all frames of the silence at once.

        `heard_at` is the time of the last reading before the silence.
        """
        words = f"{self.model.name} sends readings again. The gateway stops it first."
        self._log.log(Level.INFO, "answers_again", words, now)
        self._executor.queue.drop(Phase.FAILED, Reason.LINK_DOWN, words, now)
        self._executor.senders.halt_streams(now)
        self.model.update_trust(TrustEvent.HEARD, now, words)
        self.model.believed.allow_restart()
        self._executor.allow_for_lost_steps(heard_at)
        self._stops.on_contact(now, words)

    def _log_contradiction(self, before: Verdict, now: float) -> None:
        mode = self.model.mode
        if mode.verdict is not before and mode.verdict is Verdict.CONTRADICTED:
            words = f"{self.model.name} is not in mode {mode.asked} as commanded: {mode.evidence}"
            self._log.log(Level.WARNING, "mode_contradicted", words, now)

    def _record_effect(self, event: Sensors, now: float) -> None:
        """Record the effect of a mode command, if this is a reading of that mode from after the command's frame."""
        mode_sent = self._executor.mode_sent
        if mode_sent is None or self.model.mode.verdict is not Verdict.CONFIRMED:
            return
        pending, sent_at = mode_sent
        what = pending.command.what
        if isinstance(what, SetMode) and only_candidate(event) is what.mode and event.at > sent_at + FLIGHT_S:
            self._executor.mode_sent = None
            self._log.record(pending, Phase.EFFECT_SEEN, now, evidence=(self.model.mode.evidence,))
