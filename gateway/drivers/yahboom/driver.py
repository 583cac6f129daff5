"""The driver of the cars that speak the `$...#` protocol (docs/reference/protocol.md). Pure.

`CarModel` estimates the state of the car. `CarMonitor` updates these estimates when a reading arrives or the car is
silent, `Executor` when a frame is written. `StopExecutor` carries out the stops. This module joins them to one driver,
which also decodes bytes and encodes actions.
"""

from collections.abc import Callable, Mapping
from typing import Any, Final, cast

from gateway.control.commands import (
    Action,
    AimServo,
    ChangeSpeed,
    Drive,
    Fan,
    Find,
    Led,
    MoveArm,
    MoveServo,
    PartAction,
    SetLight,
    SetMode,
    Signal,
)
from gateway.control.control_output import Later, frame_of
from gateway.control.driver import Desk, Event, Fields
from gateway.drivers.yahboom.car_model import CarModel
from gateway.drivers.yahboom.car_monitor import CarMonitor
from gateway.drivers.yahboom.estimate.learned import Learned
from gateway.drivers.yahboom.estimate.outputs import joined, kept_speeds, stepped
from gateway.drivers.yahboom.executor import Executor
from gateway.drivers.yahboom.protocol.frame_splitter import FrameSplitter
from gateway.drivers.yahboom.protocol.frames import ArmSet, ColorLed, Frame, General, ModeOpen, Ptz
from gateway.drivers.yahboom.protocol.measurements import measured, verdict_of
from gateway.drivers.yahboom.protocol.platforms import CAMERA_TURNS, Profile
from gateway.drivers.yahboom.protocol.timing import SERVO_S
from gateway.drivers.yahboom.protocol.wire_events import Event as WireEvent
from schemas.commands import Verb
from schemas.words import Mode, Motion, Platform, Reason, SpeedStep

STALE_TIMES_S: Final = 0.5
"""Maximum stall of our loop after which the times of reports still count. A stop delays the reports of a car, and this
shows that it arrived. After a longer stall, a report that we have read late looks like such a delay."""
CAMERA_STEP_S: Final = SERVO_S
"""How long a servo of a Raspberry Pi car's camera turns for one command. The car may be busy with it for so long."""


class YahboomDriver(Executor):
    """One car of this protocol."""

    def __init__(self, desk: Desk, profile: Profile, *, auto: bool = False, learned: Learned | None = None) -> None:
        """Make the driver of one car. With `auto`, it detects the platform; `profile` is then the unknown one."""
        super().__init__(desk, CarModel(desk.car, profile, auto, desk.log, desk.battery_policy, learned or Learned()))
        self._monitor = CarMonitor(self.model, self, desk.log)
        self._decoder = FrameSplitter(head=profile.dialect.head)

    @property
    def lost_frames(self) -> int:
        """Return the number of `MODE00` frames that were lost, as the reports of a car that has shown stops say."""
        return self._monitor.lost_frames

    # ------------------------------------------------------------------ bytes in

    def feed(self, data: bytes, now: float) -> list[Event]:
        """Return the events in the bytes."""
        return [*self._decoder.feed(data, now)]

    def flush(self, now: float) -> list[Event]:
        """Return the events whose frame was ended by a silence."""
        return [*self._decoder.flush(now)]

    def flush_at(self) -> float:
        """Return when `flush` has something to do if no byte arrives earlier, or inf if never."""
        deadline = self._decoder.deadline()
        return float("inf") if deadline is None else deadline

    def drop_bytes(self) -> list[Event]:
        """Forget the unfinished frame, and return the events of its bytes."""
        return [*self._decoder.end()]

    def sends(self, data: bytes, now: float) -> None:
        """Remember the bytes of a frame that is about to be written, because the link may echo them."""
        self._decoder.sends(data, now)

    def measured(self, event: Event) -> Mapping[str, Fields]:
        """Return the measured values of an event by topic."""
        model = self.model
        return measured(
            _as_wire_event(event), model.profile, model.mode.confirmed, may_be_stm32=model.may_send_constants
        )

    def verdict(self, event: Event) -> str:
        """Return the kind of an event, such as `sensors` or `echo`, or the cause for which its bytes were rejected."""
        return verdict_of(_as_wire_event(event))

    def on_event(self, event: Event, now: float) -> None:
        """Update the state with an event."""
        self._monitor.on_event(_as_wire_event(event), now)
        self._decoder.use_head(self.model.profile.dialect.head)

    # ------------------------------------------------------------------ the link, and time

    def link_up(self, now: float) -> None:
        """Begin to bring the car to a known state, because the link is open."""
        self._monitor.link_up()
        self._decoder = FrameSplitter(head=self.model.profile.dialect.head)
        super().link_up(now)

    def link_down(self, reason: str, now: float, *, cause: Reason = Reason.LINK_DOWN) -> None:
        """Fail all commands, because the link is down."""
        self.model.cut_write = self.model.cut_write or cause is Reason.WRITE_FAILED
        self._monitor.link_down()
        super().link_down(reason, now, cause=cause)

    def tick(self, now: float) -> None:
        """Check for silence."""
        self._monitor.tick(now)

    def on_stall(self, gap_s: float, now: float) -> None:
        """Stop a driven car after a gap of the loop, which has not run for `gap_s`.

        If the gap was long, ignore the times of the reports before and in it.
        """
        if gap_s > STALE_TIMES_S:
            self.model.evidence.reset_times()
        super().on_stall(gap_s, now)

    def on_sleep(self, slept_s: float, now: float) -> None:
        """Stop the car after a sleep of the computer, unless it has shown that it stands still.

        Do not count that time as a silence of the car.
        """
        self.model.evidence.reset_times()
        self.model.mode.excuse_silence(now)
        super().on_sleep(slept_s, now)

    def stop_after_sleep(self, now: float) -> None:
        """Stop the car, or make the next try of a stop that began before the sleep."""
        self.stops.on_sleep(now)

    # ------------------------------------------------------------------ commands

    def refusal(self, what: Action) -> str | None:
        """Return why this car cannot do this at all, or None if it can."""
        car, profile, believed = self.desk.car, self.model.profile, self.model.believed
        match what:
            case SetMode(mode) if mode is not Mode.MANUAL and mode not in profile.modes:
                if profile.kind is Platform.UNKNOWN:
                    return (
                        f"the platform of {car} is not known, and a mode frame ends the program of some cars. "
                        f"Name it: `platform:` in the fleet file, or `gateway run --platform`."
                    )
                return f"{car} ({profile.name}) has no mode {mode}. It has: {', '.join(sorted(profile.modes))}."
            case ChangeSpeed(step) if (words := self._step_too_fast(step)) is not None:
                return words
            case Find():
                return None
            case PartAction():
                frames = self._frames_of(what)
                words = next((why for each in frames if (why := profile.refusal(frame_of(each)))), None)
                if isinstance(what, Signal) and not frames:
                    return f"{car} ({profile.name}) has no {what.verb}."
                is_unknown = believed.fan is None and not profile.fan_is_level
                if words is None and isinstance(what, Fan) and what.on is not None and is_unknown:
                    return f"{car}'s fan state is unknown, so on/off is not possible. Toggle it: `fleet fan {car}`."
                return words
            case Drive(Motion.STOP):
                return None
            case Drive(motion):
                return profile.refusal(General(motion)) or self._always_too_fast()
            case _:
                return None

    def _step_too_fast(self, step: SpeedStep) -> str | None:
        """Return why this step would make the car too fast, or None if it would not."""
        speeds = self.model.believed.speeds
        for each in self.queue.part_actions:
            if isinstance(each.command.what, ChangeSpeed):  # it waits, and may be written before this one, or expire
                speeds = joined(speeds, stepped(speeds, each.command.what.step))
        return self.too_fast(step, speeds)

    def _always_too_fast(self) -> str | None:
        """Return why the car cannot drive as slowly as it must, or None if it can, perhaps after some steps."""
        believed, maximum, car = self.model.believed, self.desk.speed_max, self.desk.car
        if believed.steps_to(maximum) is not None:
            return None
        words = f"{car} is never as slow as {maximum:.0%} of full speed (speed_max)"
        if self.model.profile.kind is Platform.UNKNOWN:
            words += ", as far as is known without its platform. Name it (`platform:` in the fleet file)"
        return f"{words}."

    def drive_wait_words(self, now: float) -> str:
        """Name the stop and the steps of the speed that a drive waits for. Empty if it waits for no step."""
        if not (steps := len(self.steps_before_drive)):
            return ""
        what = "a step" if steps == 1 else f"{steps} steps"
        stop = "" if self.accepts_commands(now) else "a stop, and "
        return f"{stop}{what} of its speed, because the maximum is {self.desk.speed_max:.0%} (speed_max)"

    def frames(self, what: Action) -> tuple[Frame | Later, ...]:
        """Return the frames of an action on a part of the car. Leave out those that the car does not understand."""
        return tuple(each for each in self._frames_of(what) if self.model.profile.refusal(frame_of(each)) is None)

    def _frames_of(self, what: Action) -> tuple[Frame | Later, ...]:
        """Return the frames of an action.

        Each `General` frame has a motion. It is STOP here, and becomes the present motion when the frame is written.
        """
        match what:
            case Led(r, g, b):
                return (ColorLed(r, g, b),)
            case SetLight(light):
                return (General(Motion.STOP, light=light),)
            case Signal(Verb.WHISTLE):
                return (General(Motion.STOP, whistle=True),)
            case MoveServo(action) if action in CAMERA_TURNS:
                return General(Motion.STOP, servo=action), Later(General(Motion.STOP), CAMERA_STEP_S)
            case MoveServo(action):
                return (General(Motion.STOP, servo=action),)
            case AimServo(deg):
                return (Ptz(deg),)
            case MoveArm(joints):
                return (ArmSet(joints),)
            case ChangeSpeed(step):
                return (General(Motion.STOP, speed=step),)
            case Fan(on):
                is_level, fan = self.model.profile.fan_is_level, self.model.believed.fan
                return (General(Motion.STOP, fan=(not fan if on is None else on) if is_level else True),)
            case Find():
                return self._blinks()
            case _:
                return ()

    def _blinks(self) -> tuple[Frame, ...]:
        """Return the frames of `find`. The last one restores the LED color, or sets the color that was queued last."""
        frames = [frame_of(each) for act in self.queue.part_actions for each in act.frames]
        waiting = [each for each in frames if isinstance(each, ColorLed)]
        led = waiting[-1] if waiting else self.model.believed.led
        other = ColorLed(255, 255, 255) if led != ColorLed(255, 255, 255) else ColorLed(0, 0, 0)
        whistle = General(Motion.STOP, whistle=True)
        return whistle, other, whistle, led

    def opening_s(self, mode: Mode) -> float:
        """Return the maximum time, in s, for which the car is busy when it begins a mode."""
        return self.model.profile.block_s(ModeOpen(mode))

    def end_doubt(self, now: float) -> None:
        """End the doubt about a car that did not show its last stop, because a person says that it is fine."""
        self.stops.end_doubt(now)

    # ------------------------------------------------------------------ what outlives the gateway

    def kept(self) -> Mapping[str, Any]:
        """Return what was learned about the car."""
        return {**self.model.learned.kept(), "speeds": kept_speeds(self.model.believed.speeds)}

    @property
    def opened_as(self) -> str:
        """Return the detected platform if a mode that the gateway began may still run.

        Else return an empty text, also if the platform was not detected but configured.
        """
        return self.model.learned.opened_as


def _as_wire_event(event: Event) -> WireEvent:
    """Return the same event with its type. A gateway hands to its driver only what the driver's decoder has made."""
    return cast("WireEvent", event)


def yahboom(profile: Profile, *, auto: bool = False, learned: Learned | None = None) -> Callable[[Desk], YahboomDriver]:
    """Return a function that makes the driver of a Yahboom car, for `Controller`."""
    return lambda desk: YahboomDriver(desk, profile, auto=auto, learned=learned)
