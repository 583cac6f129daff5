"""The estimates of one car: platform, mode, battery, outputs, trust, and evidence of a stop. Nothing is decided here.

`Executor` updates it with each written frame, `CarMonitor` with each reading and silence, `StopExecutor` with each
stop.
"""

from dataclasses import dataclass, field, replace
from typing import Any

from gateway.control.battery import Battery, BatteryPolicy
from gateway.control.command_records import CommandLog
from gateway.control.driver import Findings, Outputs, describe_distance_change, update_trust
from gateway.control.trust import KNOWN, TrustEvent, TrustState
from gateway.drivers.yahboom.estimate.learned import Learned
from gateway.drivers.yahboom.estimate.mode import ModeEstimator
from gateway.drivers.yahboom.estimate.outputs import StateEstimate
from gateway.drivers.yahboom.estimate.platform import PlatformDetector
from gateway.drivers.yahboom.pacing import FLIGHT_S, Pacing
from gateway.drivers.yahboom.protocol.frames import ColorLed
from gateway.drivers.yahboom.protocol.platforms import Profile, StopStyle
from gateway.drivers.yahboom.protocol.timing import RECOVERY_SILENCE_S
from gateway.drivers.yahboom.stops import cases, stop_choice
from gateway.drivers.yahboom.stops.cases import StopCase
from gateway.drivers.yahboom.stops.evidence import StopEvidence
from schemas.words import Basis, Blocking, CarTrust, Mode, Motion, Motors, Platform, Shows, Verdict


@dataclass(slots=True)
class CarModel:
    """The estimates of one car. Times: s, monotonic."""

    name: str
    profile: Profile
    auto: bool
    log: CommandLog
    battery_policy: BatteryPolicy
    learned: Learned = field(default_factory=Learned)
    platform: PlatformDetector = field(init=False)
    mode: ModeEstimator = field(init=False)
    battery: Battery = field(init=False)
    pacing: Pacing = field(init=False)
    believed: StateEstimate = field(init=False)
    evidence: StopEvidence = field(init=False)
    trust: TrustState = field(default_factory=TrustState)
    rest_case: StopCase = cases.SOFT
    """The case of the last stop (see `stops.cases`). It is used while the claim that the car is at rest has the basis
    `sent`."""
    mode_closed_at: float = float("-inf")
    mode_left_by: float = float("-inf")
    """When the last `MODE00` that closes a mode was written, and the latest time at which the car has left the mode."""
    range_cm: float | None = None
    """The last measured distance, and its time. The distance is None if the last ranging had no echo."""
    range_at: float = float("-inf")
    cut_write: bool = False
    """True if a write has failed since the last recovery. Then the car may hold half a frame, which only a color frame
    clears."""
    missed_stop: bool = False
    """True if the time for the evidence of a stop on this link has run out, although the car reported meanwhile."""
    link_since: float = float("-inf")
    """When the link was opened."""
    link_open: bool = False
    link_reason: str = "not connected yet"

    def __post_init__(self) -> None:
        self.platform = PlatformDetector(self.profile, auto=self.auto)
        self.mode = ModeEstimator(self.profile, self.learned)
        self.evidence = StopEvidence(self.profile, self.learned)
        self.battery = self._battery()
        self.pacing = Pacing(self.profile, self.learned)
        self.believed = StateEstimate(self.profile, speeds=self.learned.speeds)

    def _battery(self) -> Battery:
        return Battery(self.battery_policy.of_cells(self.profile.cells), self.profile.cells)

    def treat_as(self, profile: Profile) -> None:
        """Use the profile of another platform from now on."""
        self.profile = self.mode.profile = self.pacing.profile = self.evidence.profile = profile
        self.believed = replace(self.believed, profile=profile)
        if profile.cells != self.battery.cells:
            self.battery = self._battery()

    def update_trust(self, event: TrustEvent, now: float, evidence: str = "") -> None:
        """Update the trust state, and log each change. Nothing else changes it."""
        update_trust(self, self.log, event, now, evidence)

    @property
    def outputs(self) -> Outputs:
        """Return the estimated state of speed, fan and servo."""
        believed = self.believed
        return Outputs(believed.share, believed.fan, believed.servo_deg)

    @property
    def findings(self) -> Findings:
        """Return the findings about the car."""
        learned = self.learned
        numbers: dict[str, Any] = {
            "blocks_s": {str(kind): block_s for kind, block_s in learned.blocks.items()},
            "reporting_modes": tuple(sorted(learned.reporting)),
            "out_of_range": tuple(sorted(learned.always_rejected)),
        }
        if learned.echo.is_known:
            numbers |= {"interval_s": learned.echo.median_s, "interval_spread_s": learned.echo.spread_s}
        if learned.no_echo.is_known:
            numbers["interval_no_echo_s"] = learned.no_echo.median_s
        return Findings(self.platform.evidence, self.platform.contradictions, numbers)

    @property
    def doubted(self) -> bool:
        """Return True if the car has shown its stops before, and did not show the last one."""
        return self.learned.doubted

    @property
    def shows(self) -> Shows:
        """Return whether the reports of the car show its stops, as far as that is known."""
        return self.learned.shows

    @property
    def silence_limit_s(self) -> float | None:
        """Return the longest normal silence now, or None if every silence is normal."""
        return self.mode.silence_limit(fan=self.believed.fan_may_run)

    @property
    def why_quiet(self) -> str:
        """Return why a silence is normal now."""
        return self.mode.why_quiet

    def unheard_s(self, now: float) -> float:
        """Return how long the car has been silent, without the time for which our frames kept it busy."""
        return self.mode.unheard_s(now)

    def silent_s(self, now: float) -> float:
        """Return how long ago the last reading of this link arrived, or how long the link is open without one, s."""
        return now - max(self.link_since, self.mode.heard_at)

    @property
    def known(self) -> bool:
        """Return True if the car reads frames as they are meant."""
        return self.trust.state in KNOWN

    @property
    def manual(self) -> bool:
        """Return True if mode 0 was commanded last, and neither readings nor silence contradict it."""
        return self.mode.asked is Mode.MANUAL and self.mode.verdict is not Verdict.CONTRADICTED

    @property
    def at_rest(self) -> bool:
        """Return True if the car stands still in mode 0 after a stop. The basis may be `shown` or `sent`."""
        return self.trust.state is CarTrust.STOPPED and self.manual

    @property
    def rest_is_sure(self) -> bool:
        """Return True if the car is at rest, and has shown that, need not show it, or cannot show it."""
        return self.at_rest and (self.trust.shown or self.rest_case.is_sure or not self.can_show)

    @property
    def can_show(self) -> bool:
        """Return False if the program or the reports of this car show that it cannot show a stop."""
        match self.stop_style:
            case StopStyle.GENERAL:
                return False
            case StopStyle.TIMER:
                return self.learned.shows is Shows.YES
            case StopStyle.MODE_FRAME | StopStyle.BOTH:
                return self.profile.has_readings and self.learned.shows is not Shows.NO

    @property
    def shows_fan(self) -> bool:
        """Return True if every reading of this car shows that its fan is off.

        A car that reports by a timer sends readings even with the fan on. A car that was only detected as an arduino
        may be such a car, until it has shown that its reports wait for its loop.
        """
        is_sure = not self.auto or self.learned.shows is Shows.YES
        return self.profile.kind is Platform.ARDUINO and is_sure and not self.profile.fan_is_level

    @property
    def may_send_constants(self) -> bool:
        """Return True if this may be the stm32 program whose mode-0 report has constants.

        The bytes of arduino and stm32 cars are usually the same, so a car that was only detected may be either. A car
        that has shown its stops is no stm32, and one that has ever sent another grayscale than 0 has no constants.
        """
        is_other = self.profile.kind is Platform.RASPBERRY_PI or self.learned.shows is Shows.YES
        return self.auto and not is_other and self.learned.extremes.get("GS", (0.0, 0.0))[1] == 0.0

    @property
    def is_deaf(self) -> bool:
        """Return True if the car can show a stop, but never reacted on this link, or did not show the last one."""
        shows = self.can_show and self.stop_style is StopStyle.MODE_FRAME
        return shows and self.evidence.reacted_at is None and not self.evidence.without_echo

    @property
    def stop_style(self) -> StopStyle:
        """Return the kind of stop for this car now."""
        return stop_choice.style_of(self.profile, doubted=self.platform.doubted, open_mode=self.platform.open_mode)

    def stop_case(self, *, is_soft: bool) -> StopCase:
        """Return the case that decides when a stop may end although the car has not shown it."""
        return cases.case_of(self.stop_style, self.profile, is_soft=is_soft, can_show=self.can_show)

    @property
    def silent_program(self) -> str:
        """Return what to do about a car that never sent a reading. Empty if it has, or if its profile expects none."""
        if self.mode.heard_at > float("-inf") or not self.profile.has_readings:
            return ""
        if self.profile.kind is not Platform.UNKNOWN:
            return (
                f" If it never sends readings, say so: `platform: {self.profile.name}+no_readings` in the fleet file."
            )
        return (
            " In some modes a car sends nothing, and general stops do not end a mode: name its platform in the fleet "
            "file, as in `platform: arduino`. If it never sends readings: `platform: raspberry_pi+no_readings`."
        )

    @property
    def is_heard(self) -> bool:
        """Return False if the car is silent for longer than any normal silence."""
        return self.trust.state is not CarTrust.UNHEARD

    @property
    def motors(self) -> Motors:
        """Return the claim about the motors."""
        believed_moving = self.trust.state in (CarTrust.DRIVING, CarTrust.IN_MODE, CarTrust.STOPPED)
        if believed_moving and self.mode.verdict is Verdict.CONTRADICTED:
            return Motors.UNKNOWN
        return self.trust.motors

    @property
    def basis(self) -> Basis | None:
        """Return the basis of the claim that the motors are off, or None if there is no such claim."""
        return self.trust.basis if self.motors is Motors.OFF else None

    @property
    def motion(self) -> Motion | None:
        """Return the last motion sent, or None if the state is unknown or the car drives by itself."""
        return self.believed.motion if self.known and self.manual else None

    @property
    def is_without_echo(self) -> bool:
        """Return True if the last ranging had no echo. Return False if the car has sent no range yet."""
        return self.range_cm is None and self.range_at > float("-inf")

    def moved_since(self, range_cm: float | None, since: float) -> str:
        """Describe how the distance has changed since a drive began. Empty if no reading shows a change."""
        return "" if self.range_at < since + FLIGHT_S else describe_distance_change(range_cm, self.range_cm)

    @property
    def shows_stops(self) -> tuple[Shows, str]:
        """Return whether the reports of this car show that a stop arrived, with the reason in words."""
        if not self.profile.has_readings:
            return Shows.NO, cases.NO_READINGS.why(self.name)
        if self.stop_style is StopStyle.GENERAL and self.auto and not self.platform.is_settled:
            return Shows.UNKNOWN, cases.NOT_KNOWN.why(self.name)
        if self.stop_style is StopStyle.GENERAL:
            return Shows.NO, self.stop_case(is_soft=False).why(self.name)
        if self.learned.doubted:
            return Shows.YES, f"{self.name} has shown its stops before, and did not show the last one"
        if self.learned.shows is Shows.YES:
            now = ", but not now: it has no sonar echo" if self.evidence.without_echo > 1 else ""
            return Shows.YES, f"the reports of {self.name} show that a stop arrived{now}"
        if not self.can_show and Blocking.MODE_CLOSE not in self.learned.blocks:
            return Shows.NO, cases.NO_REACTION.why(self.name)
        return Shows.UNKNOWN, cases.NOT_KNOWN.why(self.name)

    def for_stop(self, now: float) -> stop_choice.StopContext:
        """Return the context for the choice of a stop."""
        contradicted = self.mode.verdict is Verdict.CONTRADICTED
        has_read_all, blocked = self.pacing.has_read_all(now), self.pacing.is_blocked(now)
        return stop_choice.StopContext(
            self.profile,
            self.known,
            self.mode.asked,
            contradicted,
            has_read_all,
            blocked,
            doubted=self.platform.doubted,
            open_mode=self.platform.open_mode,
            clearing_color=self._clearing_color,
        )

    @property
    def _clearing_color(self) -> ColorLed | None:
        """Return the color frame that clears a string beginning with `4WD,`, if the car may hold such a string."""
        suspected = self.cut_write or (self.learned.shows is Shows.YES and self.trust.state is CarTrust.UNPROVEN)
        color = self.believed.led
        return color if suspected and self.profile.refusal(color) is None else None

    @property
    def ready_at(self) -> float:
        """Return the earliest time for a frame that belongs to no stop."""
        return max(self.pacing.flight_until, self.mode_left_by)

    def is_awake(self, now: float) -> bool:
        """Return True if no frame of ours blocks the car any more. A ranging without an echo may still delay it.

        In a block, the program of the car is busy, and reads nothing.
        """
        pacing = self.pacing
        if now <= pacing.awake_until and now >= pacing.earliest_block_end - FLIGHT_S / 2:
            return True
        if now < pacing.block_until - FLIGHT_S:
            return False
        if self.known and self.manual:
            return True
        return now >= pacing.written_at + RECOVERY_SILENCE_S - 0.1
