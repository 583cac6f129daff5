"""Weighs what is heard of one car, or not: mode, platform, battery, and what that shows of a stop. Pure.

It changes `CarModel`, and tells `Executor` when the car must be stopped.
"""

from typing import Final

from gateway.control.car_model import CarModel
from gateway.control.command_log import CommandLog
from gateway.control.commands import Phase, Reason, SetMode
from gateway.control.estimate.battery import BatteryLevel, BatteryReaction
from gateway.control.estimate.mode import MANUAL_SILENCE_S, Verdict
from gateway.control.estimate.platform import PlatformDetector
from gateway.control.estimate.trust import STOP_GOES_ON, Basis, CarTrust, TrustEvent
from gateway.control.events import FrameOrigin, Level
from gateway.control.executor import Executor
from gateway.control.pacing import FLIGHT_S
from gateway.control.stops.evidence import Finding, StopCase
from gateway.protocol.enums import Mode
from gateway.protocol.events import Cause, Event, Rejected, Sensors
from gateway.protocol.platforms import StopStyle

STALL_S: Final = 0.5
"""A loop that slept longer than this with motion held stops the car first
(docs/explanation/how-it-works.md#processes-and-threads)."""
STALE_TIMES_S: Final = 0.5
"""If the loop slept longer, reports were taken so much later than they came that a normal gap may look like a pause."""
FAN_SETTLED_S: Final = 2.0
"""Readings this long after a toggle were sent with the fan as it is now."""


class CarMonitor:
    """Readings, silence, and the loop's own stalls."""

    def __init__(self, model: CarModel, executor: Executor, ledger: CommandLog) -> None:
        self.model = model
        self.lost_frames = 0
        """How often the car's reports have shown that a `MODE00` did not arrive."""
        self._executor = executor
        self._ledger = ledger
        self._not_obeyed_logged = False

    def link_up(self) -> None:
        """Forget what the last link showed."""
        model = self.model
        self._not_obeyed_logged = False
        if model.platform.auto:  # another car may have been plugged in
            model.platform = PlatformDetector(model.platform.told, auto=True)
            model.treat_as(model.platform.told)

    def heard(self, event: Event, now: float) -> None:
        """Take an event of the decoder as evidence."""
        model = self.model
        settled = not isinstance(event, Sensors) or model.evidence.is_settled(event)
        for words in model.platform.heard(event) if settled else ():
            self._ledger.log(Level.WARNING, "platform_contradicted", f"{model.name}: {words}", now)
            # The last stop may have been of the wrong kind, unless the car has shown it.
            stopping = model.trust.state in STOP_GOES_ON or model.trust.basis is Basis.SENT
            if model.platform.doubted and stopping and model.link_open:
                self._executor.recover(now, words)
        if isinstance(event, Rejected) and event.raw.strip():  # some cars end a frame with CR and LF
            model.evidence.noise(event.at, damaged=event.cause is not Cause.NO_START)
        if not isinstance(event, Sensors):
            return
        before = model.mode.verdict
        model.mode.heard(event, counts=settled)
        self._note_verdict(before, now)
        self._note_effect(event, now)
        if model.trust.state is CarTrust.UNHEARD:
            self._heard_again(now)
        finding = model.evidence.reading(event)
        if event.signature is Mode.MANUAL:
            self._report(event, now)
        self._log_delivery(finding, now)
        self._executor.found(finding, event.at, now)

    def _report(self, event: Sensors, now: float) -> None:
        """Take a report of mode 0."""
        model = self.model
        if event.at > self._executor.left_at + FLIGHT_S:
            self._executor.left_until = float("-inf")
        if event.range_cm is not None:
            model.pacing.heard(event.at)
        if event.voltage_v is not None and "battery" in model.profile.measured(event, model.mode.confirmed):
            self._weigh_battery(event.voltage_v, now)
        if now > model.believed.fan_at + FAN_SETTLED_S and model.profile.stop_style is not StopStyle.RASPBERRY_PI:
            model.believed.fan = False  # docs/reference/protocol.md#hazards: a car whose fan runs sends no readings

    def _log_delivery(self, finding: Finding, now: float) -> None:
        """Log that frames do not arrive, once, and that they do again."""
        name = self.model.name
        if finding is Finding.LOST and self.model.for_stop_style is not StopStyle.UNKNOWN:
            self.lost_frames += 1
            if not self._not_obeyed_logged:
                self._not_obeyed_logged = True
                words = f"{name} did not react to MODE00. The link may be losing frames. Stopping it again."
                self._ledger.log(Level.WARNING, "not_obeyed", words, now)
        elif finding is Finding.SHOWN and self._not_obeyed_logged:
            self._not_obeyed_logged = False
            self._ledger.log(Level.INFO, "hears", f"{name} reacts to MODE00 again", now)

    def _settle(self, now: float) -> None:
        """Treat the car as what its bytes have shown it to be; between stops only, each of which is one platform's."""
        model = self.model
        if model.platform.profile is model.profile or not model.known or self._executor.running is not None:
            return
        model.treat_as(model.platform.profile)
        words = f"{model.name} is treated as {model.profile.name} from now on: {model.platform.evidence[0]}"
        self._ledger.log(Level.INFO, "platform_settled", words, now)

    def _weigh_battery(self, voltage_v: float, now: float) -> None:
        """Log a level that has changed, and stop the car if it should be stopped at that level."""
        model, executor = self.model, self._executor
        if not model.battery.heard(voltage_v, loaded=model.motors != "off", now=now):
            return
        level, words = model.battery.level, f"{model.name}: {model.battery.words}"
        grave = {BatteryLevel.LOW: Level.WARNING, BatteryLevel.CRITICAL: Level.ERROR}
        self._ledger.log(grave.get(level or BatteryLevel.OK, Level.INFO), f"battery_{level}", words, now)
        if model.battery.action is BatteryReaction.STOP and not model.at_rest:
            executor.halt(words, now)
            if model.link_open and not executor.closing:
                executor.begin(executor.full(now), FrameOrigin.STOP, now)

    def tick(self, now: float) -> None:
        """Weigh silence; called a few times a second."""
        self._settle(now)
        model = self.model
        before = model.mode.verdict
        if model.link_open:
            self._weigh_silence(now)
        self._note_verdict(before, now)
        # A rest that readings contradict is none: the stop was lost, or somebody else opened a mode.
        if model.trust.state is CarTrust.STOPPED and model.mode.verdict is Verdict.CONTRADICTED and model.link_open:
            self._executor.recover(now, model.mode.evidence)

    def _weigh_silence(self, now: float) -> None:
        model = self.model
        fan = bool(model.believed.fan)
        limit_s = model.mode.silence_limit(fan=fan)
        # While a stop goes on, silence shows nothing of the mode; where it is expected it still excuses itself.
        if self._executor.running is None or limit_s is None:
            model.mode.silent(now=now, fan=fan)
        model.mode.fade(now)
        if model.trust.state is CarTrust.UNHEARD or limit_s is None:
            return
        silent_s = model.mode.unheard_s(now)
        if silent_s <= MANUAL_SILENCE_S:
            return
        words = (
            f"{model.name} was not heard for {silent_s:.1f} s: whether it moves is not known "
            "(off, out of reach, its fan on, or its link stuck). The gateway goes on stopping it."
        )
        self._ledger.log(Level.WARNING, "unheard", words, now)
        self._executor.waiting.drop(Phase.FAILED, Reason.LINK_DOWN, words, now)
        running = self._executor.running
        if model.at_rest and running is None:
            self._executor.stop_again(now)
        elif running is None or running.case is StopCase.SOFT:
            self._executor.recover(now, words)
        model.learn(TrustEvent.SILENT, now, words)

    def _heard_again(self, now: float) -> None:
        """Go on with the stop: a link that was stuck may deliver at once what was written meanwhile."""
        words = f"{self.model.name} is heard again: it is stopped first"
        self._ledger.log(Level.INFO, "answers_again", words, now)
        self._executor.waiting.drop(Phase.FAILED, Reason.LINK_DOWN, words, now)
        self.model.learn(TrustEvent.HEARD, now, words)
        self._executor.heard_again(now, words)

    def stalled(self, gap_s: float, now: float) -> None:
        """Stop a car that is driven: the loop slept for `gap_s`."""
        if gap_s > STALE_TIMES_S:
            self.model.evidence.stalled()
        if gap_s > STALL_S and self._executor.waiting.held is not None:
            words = f"the gateway stalled for {gap_s:.1f} s with motion held: stopping"
            self._ledger.log(Level.ERROR, "stalled", words, now)
            self._executor.release(Phase.EXPIRED, Reason.EXPIRED, words, now)

    def _note_verdict(self, before: Verdict, now: float) -> None:
        mode = self.model.mode
        if mode.verdict is not before and mode.verdict is Verdict.CONTRADICTED:
            words = f"asked for mode {mode.asked}, but: {mode.evidence}"
            self._ledger.log(Level.WARNING, "mode_contradicted", words, now)

    def _note_effect(self, event: Sensors, now: float) -> None:
        """Record the effect of a mode's frame: a reading that began after it, and has the mode's shape."""
        mode_sent = self._executor.mode_sent
        if mode_sent is None or self.model.mode.verdict is not Verdict.CONFIRMED:
            return
        pending, sent_at = mode_sent
        what = pending.command.what
        if isinstance(what, SetMode) and event.signature is what.mode and event.at > sent_at + FLIGHT_S:
            self._executor.mode_sent = None
            self._ledger.record(pending, Phase.EFFECT_SEEN, now, evidence=(self.model.mode.evidence,))
