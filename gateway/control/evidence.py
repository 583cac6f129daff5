"""What is heard of one car, or not, and what follows: its mode, platform, battery, and the stops that calls for."""

from typing import Final

from gateway.control.battery import Action, BatteryLevel
from gateway.control.execution import TRIES, Execution
from gateway.control.mode import MANUAL_SILENCE_S, Verdict
from gateway.control.obedience import Shown
from gateway.control.records import (
    Level,
    Phase,
    Reason,
    SetMode,
    Why,
)
from gateway.protocol.profile import StopStyle
from gateway.protocol.readings import Event, Sensors
from gateway.protocol.values import Mode

STALL_S: Final = 0.5
"""A loop that slept longer than this with motion held stops the car first (design.md, "Processes and threads")."""
UNDER_WAY_S: Final = 0.06
"""A reading that came sooner after a frame was under way when the frame was sent."""
TRY_AGAIN_S: Final = 5.0
"""After so long, each time so much longer, a car that showed nothing of `MODE00` is sent another by itself."""
FAN_SETTLED_S: Final = 2.0
"""Readings this long after a toggle were sent with the fan as it is now."""


class Evidence(Execution):
    """Weighs readings, silence and the loop's own stalls."""

    def heard(self, event: Event, now: float) -> None:
        """Take an event of the decoder as evidence."""
        for words in self.platform.heard(event):
            self._ledger.log(Level.WARNING, "platform_contradicted", f"{self.car}: {words}", now)
            self._unsure = self.platform.doubted
        if not isinstance(event, Sensors):
            return
        before = self.mode.verdict
        self.mode.heard(event)
        self._note_verdict(before, now)
        self._note_effect(event, now)
        if self._unheard:
            self._heard_again(now)
            return
        if event.signature is not Mode.MANUAL:
            return
        if event.at > self._left_at + UNDER_WAY_S:
            self._left_until = float("-inf")
        if event.range_cm is not None:
            self.pacing.heard(event.at)
        if event.voltage_v is not None and "battery" in self.profile.measured(event, self.mode.confirmed):
            self._weigh_battery(event.voltage_v, now)
        if now > self.believed.fan_at + FAN_SETTLED_S and self.profile.stop_style is not StopStyle.RASPBERRY_PI:
            self.believed.fan = False  # protocol.md: a car whose fan runs sends no readings
        self._weigh_obedience(event, now)
        running = self._running
        if running is None:
            if self._gave_up and self._link_open:
                self._gave_up = False
                self._ledger.log(Level.INFO, "answers_again", "a reading came: recovery begins again", now)
                self._begin(self._recovery(now), Why.RECOVERY, now)
        elif (
            running.frames_sent
            and not running.disobeyed
            and event.at > running.last_at + UNDER_WAY_S
            and now >= self._obedience.doubt_until
        ):
            self._finish(running, now)

    def _weigh_obedience(self, event: Sensors, now: float) -> None:
        """A car that was heard to obey is stopped until it does again; of one that never was, it is only said.

        That may be deaf from the start, but also one that does not beep, or no car at all: protocol.md's recovery asks
        for no more than a reading, and no number of stops would tell.
        """
        shown = self._obedience.heard(event.at, echo=bool(event.range_cm))
        if shown is Shown.OBEYED and self.deaf:
            self.deaf = False
            self._ledger.log(Level.INFO, "hears", f"{self.car} was silent for MODE00's second: it hears", now)
        if shown is not Shown.LOST:
            return
        self.disobeyed += 1
        seen = f"{self.car} reported as before through the second for which MODE00 blocks a car that obeys it: "
        if not self._obedience.ever:
            if not self.deaf:
                words = "it has not shown yet that it hears (is its receiving line connected?): rely on no stop"
                self._ledger.log(Level.WARNING, "not_obeyed", seen + words, now)
            self.deaf = True
            return
        words = "it did not get it, and perhaps nothing else (a link that loses what is written); stopping it again"
        self._ledger.log(Level.WARNING, "not_obeyed", seen + words, now)
        running = self._running
        if running is not None and running.recipe.confirmed:
            running.disobeyed = True  # no reading confirms it any more: it tries again
        else:
            self.known = False
            self._recover(now)

    def _settle(self, now: float) -> None:
        """Treat the car as what its bytes have shown it to be; between stops only, each of which is one platform's."""
        if self.platform.profile is self.profile or not self.known or self._running is not None:
            return
        self._treat_as(self.platform.profile)
        words = f"{self.car} is treated as {self.profile.name} from now on: {self.platform.evidence[0]}"
        self._ledger.log(Level.INFO, "platform_settled", words, now)

    def _weigh_battery(self, voltage_v: float, now: float) -> None:
        """Tell of a level that has changed, and stop the car if it should be stopped at that level."""
        if not self.battery.heard(voltage_v, loaded=self.motors != "off", now=now):
            return
        level, words = self.battery.level, f"{self.car}: {self.battery.words}"
        grave = {BatteryLevel.LOW: Level.WARNING, BatteryLevel.CRITICAL: Level.ERROR}
        self._ledger.log(grave.get(level or BatteryLevel.OK, Level.INFO), f"battery_{level}", words, now)
        if self.battery.action is Action.STOP and not self.at_rest:
            self._halt(words, now)
            if self._link_open and not self._closing:
                self._begin(self._full(now), Why.STOP, now)

    def tick(self, now: float) -> None:
        """Weigh silence; called a few times a second."""
        self._settle(now)
        before = self.mode.verdict
        if self._link_open and self.known and self._running is None:
            self._weigh_silence(now)
            self._try_again(now)
        self._note_verdict(before, now)

    def _weigh_silence(self, now: float) -> None:
        fan = bool(self.believed.fan)
        self.mode.silent(now=now, fan=fan)
        expected = self.mode.silence_limit(fan=fan) is not None
        silent_s = self.mode.unheard_s(now)
        if expected and not self._unheard and silent_s > MANUAL_SILENCE_S:
            self._unheard = True
            self.known = False
            words = (
                f"{self.car} was not heard for {silent_s:.1f} s: whether it moves is not known "
                "(off, out of reach, or its link stuck); it is stopped when it is heard again"
            )
            self._ledger.log(Level.WARNING, "unheard", words, now)

    def _try_again(self, now: float) -> None:
        """Ask a doubted car whether it hears: it may have been us, a link or a machine that stood for a second.

        Only one that nobody has told anything yet: of what is done to others, their stops show it.
        """
        due = self.pacing.written_at + TRY_AGAIN_S * (TRIES - self._tries_left + 1)
        if self.deaf and self._tries_left and self.at_rest and now >= due:
            self._tries_left -= 1
            self._begin(self._full(now), Why.RECOVERY, now)

    def _heard_again(self, now: float) -> None:
        """A link that was stuck may deliver at once what was written meanwhile, of which a car obeys only the first."""
        self._unheard = self._gave_up = False
        words = f"{self.car} is heard again: it is stopped first"
        self._ledger.log(Level.INFO, "answers_again", words, now)
        self._waiting.drop(Phase.FAILED, Reason.LINK_DOWN, words, now)
        self._recover(now)  # what ran may have its frames among what was held up

    def stalled(self, gap_s: float, now: float) -> None:
        """The loop slept for `gap_s`: with motion held the car is stopped first."""
        self._obedience.stalled(gap_s)
        if gap_s > STALL_S and self._waiting.held is not None:
            words = f"the gateway stalled for {gap_s:.1f} s with motion held: stopping"
            self._ledger.log(Level.ERROR, "stalled", words, now)
            self._release(Phase.EXPIRED, Reason.EXPIRED, words, now)

    def _note_verdict(self, before: Verdict, now: float) -> None:
        verdict = self.mode.verdict
        if verdict is before:
            return
        if verdict is Verdict.CONTRADICTED:
            words = f"asked for mode {self.mode.asked}, but: {self.mode.evidence}"
            self._ledger.log(Level.WARNING, "mode_contradicted", words, now)

    def _note_effect(self, event: Sensors, now: float) -> None:
        """A reading that began after the mode's frame, and has its shape, is the effect."""
        if self._mode_sent is None or self.mode.verdict is not Verdict.CONFIRMED:
            return
        pending, sent_at = self._mode_sent
        what = pending.command.what
        if isinstance(what, SetMode) and event.signature is what.mode and event.at > sent_at + UNDER_WAY_S:
            self._mode_sent = None
            self._ledger.record(pending, Phase.EFFECT_SEEN, now, evidence=(self.mode.evidence,))
