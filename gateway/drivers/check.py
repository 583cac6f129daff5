"""Checks a family of cars: `python -m gateway.drivers.check mypackage.family`. Pure, on virtual time.

It tests what a gateway relies on in every driver: that the driver accepts any bytes, stops the car at once, claims only
what readings show, and shuts down in time. It cannot test what is special to a family. Exit code 0: no fault found, 1:
faults found, 2: wrong use.
"""

import json
import math
import random
import re
import sys
import traceback
from collections.abc import Callable, Iterator, Mapping, Sequence
from importlib import import_module
from itertools import pairwise, product
from typing import Any, Final

from gateway.control.commands import (
    Action,
    AimServo,
    ChangeSpeed,
    Command,
    Drive,
    Fan,
    Find,
    Led,
    MoveArm,
    MoveServo,
    SetLight,
    SetMode,
    Signal,
    Stop,
)
from gateway.control.control_output import CommandRecord, frame_of
from gateway.control.controller import Controller
from gateway.control.driver import TICK_S, Driver, Event
from gateway.drivers import BUILT_IN, Family, built_in_platforms, missing_names
from gateway.drivers.plain import SPEED_STEP, PlainDriver
from schemas import messages
from schemas.commands import COMMANDS
from schemas.keys import NAME_RULE, is_name
from schemas.limits import MAX_QUEUE_TIME_S, SHUTDOWN_S
from schemas.platform_name import AUTO
from schemas.rights import Sender
from schemas.topics import TOPICS
from schemas.words import CAPABILITIES, Basis, FrameOrigin, Mode, Motion, Motors, Phase, Rank, ServoAction, SpeedStep
from schemas.words import Light as LightWord

CHECK_STEP_S: Final = 0.02
FIRST_STOP_S: Final = 1.0
"""Maximum time from a person's stop to its first frame, unless the driver announces a longer worst case."""
JOINED_S: Final = 7.0
"""A new stop may join a running one, whose frames then count for it. They may be at most this much older than the new
stop. The number is one second more than the interval of a stop's repeats in both families (6.0 s)."""
MAX_FRAMES_AT_ONCE: Final = 50
ACTIONS: Final[tuple[Action, ...]] = (
    Led(1, 2, 3),
    *(SetLight(light) for light in LightWord),
    *(MoveServo(action) for action in ServoAction),
    AimServo(90),
    MoveArm((90,) * 6),
    *(Signal(row.verb, row.max_duration_s) for row in COMMANDS.values() if row.signal),
    ChangeSpeed(SpeedStep.UP),
    ChangeSpeed(SpeedStep.DOWN),
    Fan(),
    Find(),
    *(SetMode(mode) for mode in Mode),
)
STOP_ORIGINS: Final = (FrameOrigin.STOP, FrameOrigin.RECOVERY, FrameOrigin.SHUTDOWN)
OPPOSITES: Final = (
    (Motion.FORWARD, Motion.BACK),
    (Motion.LEFT, Motion.RIGHT),
    (Motion.SPIN_LEFT, Motion.SPIN_RIGHT),
)
PARTS: Final[Mapping[str, type[Action]]] = {
    "led": Led,
    "light": SetLight,
    "servo": MoveServo,
    "servo_deg": AimServo,
    "arm": MoveArm,
    "fan": Fan,
}
"""The kind of action of each capability. A car with the capability must have frames for at least one such action."""
PROFILE_TYPES: Final[Mapping[str, tuple[type, ...]]] = {
    "name": (str,),
    "capabilities": (frozenset,),
    "modes": (frozenset,),
    "silent_modes": (frozenset,),
    "possible_modes": (frozenset,),
    "lights": (frozenset,),
    "servos": (frozenset,),
    "has_readings": (bool,),
    "cells": (int,),
    "baud": (int,),
    "dead_man_s": (int, float, type(None)),
    "not_observed": (tuple,),
    "has_network": (bool,),
}
"""The types of a profile's fields. Other modules use the fields without checking them."""
PROFILE_WORDS: Final[Mapping[str, frozenset[str]]] = {
    "capabilities": frozenset((*CAPABILITIES, "imu")),
    "modes": frozenset(Mode),
    "silent_modes": frozenset(Mode),
    "possible_modes": frozenset(Mode),
    "lights": frozenset(LightWord),
    "servos": frozenset(ServoAction),
}
ANSWERS: Final[Mapping[str, tuple[type, ...]]] = {
    "lost_frames": (int,),
    "shutting_down": (bool,),
    "not_stopped": (str,),
    "is_stopping": (bool,),
    "finished": (bool,),
    "opened_as": (str,),
    "doubt_of_drive": (str,),
    "kept": (Mapping,),
    "flush_at": (int, float),
    "next_at": (int, float),
    "free_at": (int, float),
    "worst_s": (int, float),
    "accepts_commands": (bool,),
    "wait_words": (str,),
}
"""The types of what a driver answers at any time. The methods from `next_at` to the last one take the time."""
FINDINGS: Final = ("silent", "not_obeyed", "range")
"""Some of what `fleet doctor` asks `CarProfile.hint` about: two findings, and a field."""
HOSTILE: Final = (
    *(b"NaN", b"-Infinity", b"1e999", b"-1", b"9" * 400, b"9" * 5000),
    *(b"null", b'"x"', b"[]", b"{}", b"true", b""),
)
"""Values that may replace a number in a report of a car, if the report is damaged or from another program."""
LINE_ENDS: Final = b"\r\n"
NOT_MEASURED: Final = frozenset({"car", "seq", "boot_id", "level", "no_echo"})
"""Fields that the gateway fills, or for which false is the right value."""
NOISE: Final = b"?\r\nHello\r\n"
"""Bytes that are no report of any car."""
LOW_SPEED_MAX: Final = 0.3
"""A `speed_max` below the speed with which a car begins."""
TOLD_S: Final = 5.0
"""Time within which readings of a moving car must end the claim that it stands."""
WRONG_OPTION: Final = "+no_such_option"
_PERSON: Final = Sender("ann@desk", Rank.PERSON)


class Bench:
    """A gateway's control with a driver, and a car that sends nothing, or all its `samples` at each tick."""

    def __init__(self, family: Family, platform: str, samples: Sequence[bytes] = ()) -> None:
        self.samples = samples
        self.control: Controller[Driver] = Controller("red", family.driver_of(platform, {}))
        self.now = 100.0
        self.sent: list[tuple[float, bytes, FrameOrigin]] = []
        self.records: list[CommandRecord] = []
        self.faults: list[str] = []
        self._number = 0
        self._tick_at = 0.0
        self._due_at = 0.0
        """When a gateway would next ask for a frame, if nothing wakes it earlier."""

    def run(self, seconds: float) -> None:
        """Let time pass."""
        end = self.now + seconds
        driver = self.control.driver
        while self.now < end:
            self.now += CHECK_STEP_S
            said: list[Event] = []
            if ticked := self.now >= self._tick_at:
                self._tick_at = self.now + TICK_S
                self.control.tick(self.now)
                said = [event for each in self.samples for event in driver.feed(each, self.now)]
            said += driver.flush(self.now)
            for event in said:
                driver.on_event(event, self.now)
            # As in `gateway.writer_wakeup`: events and ticks wake the writer only if there are records, or if its next
            # frame is now due earlier than planned.
            is_early = (said or ticked) and (self.control.has_records or driver.next_at(self.now) < self._due_at)
            if is_early or self.now >= self._due_at:
                self.write()

    def write(self) -> None:
        """Write what is due."""
        driver = self.control.driver
        for count in range(MAX_FRAMES_AT_ONCE + 1):
            setup_due_at = driver.setup_at() if isinstance(driver, PlainDriver) else self.now
            write = driver.poll(self.now)
            if write is None:
                break
            if write.why is FrameOrigin.SETUP and setup_due_at > self.now:
                self.faults.append(
                    "setup_frame returns a frame earlier than setup_at says: a gateway asks at that time, so it would "
                    "write the frame late or never"
                )
            if not _is(write.data, bytes):
                self.faults.append(f"a frame ({write.why}) is {_kind(write.data)}, not bytes: {write.data!r}")
            elif not write.data:
                self.faults.append(f"an empty frame ({write.why})")
            if count == MAX_FRAMES_AT_ONCE:
                self.faults.append(f"more than {MAX_FRAMES_AT_ONCE} frames at one moment: {write.data!r}")
                break
            driver.sends(write.data, self.now)
            driver.on_written(write, self.now)
            self.sent.append((self.now, write.data, write.why))
        self._due_at = driver.next_at(self.now)
        if self._due_at < self.now:
            self.faults.append("next_at lies before now")
        self.records += [each for each in self.control.take_records() if isinstance(each, CommandRecord)]

    def ask(self, what: Action) -> str:
        """Give a command as a person. Return its id."""
        self._number += 1
        command = Command(f"c{self._number}", "check", _PERSON, what)
        self.control.command(command, self.now)
        self.write()
        return command.id

    def stop_frames(self, since: float = 0.0) -> list[float]:
        """Return when frames of stops were written. Frames that set a car up or query it do not count."""
        return [at for at, _, why in self.sent if at >= since and why in STOP_ORIGINS]

    def last(self, command_id: str) -> CommandRecord | None:
        """Return the last record of a command."""
        return next((each for each in reversed(self.records) if each.command.id == command_id), None)


def _connected(family: Family, platform: str, samples: Sequence[bytes] = ()) -> Bench:
    bench = Bench(family, platform, samples)
    bench.control.link_up(bench.now)
    bench.run(30.0)
    return bench


def check_names(family: Family, platform: str) -> Iterator[str]:
    """Check that a fleet file can name the platform, and that a wrong option is refused with a ValueError."""
    if not is_name(platform):
        yield f"{platform!r} cannot be named in a fleet file: use {NAME_RULE}"
    if family.PLATFORMS.count(platform) > 1:
        yield f"PLATFORMS has {platform} twice"
    if platform == AUTO or (
        platform in built_in_platforms() and getattr(family, "__name__", "") not in BUILT_IN.values()
    ):
        yield f"{platform} is the name of a built-in platform, so no fleet file could name this one"
    known = {each.name.partition("+")[0] for each in family.profiles()}
    if not known or known - set(family.PLATFORMS):
        yield f"profiles() has {', '.join(sorted(known)) or 'none'}, but PLATFORMS has {', '.join(family.PLATFORMS)}"
    try:
        family.profile_of(f"{platform}{WRONG_OPTION}")
    except ValueError:
        return
    except Exception as error:  # noqa: BLE001 - every other exception is a fault
        yield f"profile_of('{platform}{WRONG_OPTION}') raises {type(error).__name__}, not ValueError"
    else:
        yield f"profile_of('{platform}{WRONG_OPTION}') accepts an option that does not exist"


def check_profile(family: Family, platform: str) -> Iterator[str]:
    """Check a profile: its types and words, that one name has equal profiles, and what the car measures and lacks."""
    profile = family.profile_of(platform)
    for field, types in PROFILE_TYPES.items():
        value: Any = getattr(profile, field)
        if not _is(value, *types) or (bool not in types and _is(value, bool)):
            yield f"{field} is {_kind(value)}, not {' or '.join(each.__name__ for each in types)}: {value!r}"
            return
        if field in PROFILE_WORDS and (others := set(value) - PROFILE_WORDS[field]):
            yield f"{field} has unknown words: {', '.join(sorted(map(str, others)))}"
    for field in ("cells", "baud", "dead_man_s"):
        if (number := getattr(profile, field)) is not None and not 0 < number < math.inf:
            yield f"{field} is {number}: it must be a finite number above 0"
    if profile != family.profile_of(platform) or hash(profile) != hash(family.profile_of(platform)):
        yield "profile_of returns profiles that are not equal, or have no equal hash"
    if profile.name.partition("+")[0] != platform:
        yield f"the profile is named {profile.name}, which is another platform"
    if Mode.MANUAL not in profile.modes:
        yield "the profile lacks mode manual"
    topics = {each.removeprefix("sensor/") for each in TOPICS if each.startswith("sensor/")}
    for mode in profile.modes:
        if unknown := profile.measurable(mode) - topics:
            yield f"it measures {', '.join(sorted(unknown))}, which are no sensor topics"
    for word in CAPABILITIES:
        if word not in profile.capabilities and not profile.why_lacking(word):
            yield f"the car has no capability {word!r}, but why_lacking gives no reason"
    for odd in FINDINGS:
        if not _is(hint := profile.hint(odd), str):
            yield f"hint({odd!r}) is {_kind(hint)}, not str"


def check_bytes(family: Family, platform: str) -> Iterator[str]:
    """Check that the driver accepts any bytes, and makes the same events of them if they come in pieces."""
    rng = random.Random(1)  # noqa: S311 - no secret
    bench = _connected(family, platform)
    sent = b"".join(data for _, data, _ in bench.sent) or b"\0"
    for _ in range(300):
        data = rng.choice((rng.randbytes(rng.randrange(200)), sent[rng.randrange(len(sent)) :], b"\n"))
        whole, pieces = (family.driver_of(platform, {}) for _ in range(2))
        drivers = [Controller("red", each).driver for each in (whole, pieces)]
        cut = rng.randrange(len(data) + 1)
        one = [event.raw for event in drivers[0].feed(data, 1.0)]
        two = [event.raw for piece in (data[:cut], data[cut:]) for event in drivers[1].feed(piece, 1.0)]
        if one != two:
            yield f"{data!r} is decoded to other events if it comes in two pieces"
            return
        yield from _take(bench, data)
        bench.run(0.1)


def _take(bench: Bench, data: bytes) -> Iterator[str]:
    """Feed the driver with bytes, as a gateway does. Yield the faults of the events that it makes of them."""
    driver = bench.control.driver
    for event in driver.feed(data, bench.now):
        if not _is(event.raw, bytes) or not _is(event.at, float):
            yield f"raw and at of an event are {_kind(event.raw)} and {_kind(event.at)}, not bytes and float"
        for topic, fields in driver.measured(event).items():
            yield from _faults_of_values(topic, fields)
        if not _is(verdict := driver.verdict(event), str):
            yield f"the verdict of an event is {_kind(verdict)}, not str"
        driver.on_event(event, bench.now)


def _faults_of_values(topic: str, fields: Mapping[str, Any]) -> Iterator[str]:
    """Yield the faults of measured values that keep them from being published."""
    if topic not in TOPICS:
        yield f"{topic} is not a topic"
        return
    kind = messages.message_class(TOPICS[topic].message)
    known = kind.DESCRIPTOR.fields_by_name
    if unknown := fields.keys() - known.keys():
        yield f"{topic} has no field {', '.join(sorted(unknown))}: it has {', '.join(sorted(known))}"
        return
    for name, value in fields.items():
        try:
            kind(**{name: value})
        except (TypeError, ValueError) as error:
            yield f"{topic}: {name} is {_kind(value)}: {error}"
        else:
            if value is None or (_is(value, bool) and known[name].type != known[name].TYPE_BOOL):
                yield f"{topic}: {name} is {value}, which is no measurement: leave it out, or give its number"
            if isinstance(value, float) and not math.isfinite(value):
                yield f"{topic}: {name} is {value}: it was not measured, so leave it out"


def check_connect(family: Family, platform: str) -> Iterator[str]:
    """Check that a car is stopped when its link opens, and that a silent car never counts as having shown a stop."""
    bench = _connected(family, platform)
    if not bench.stop_frames():
        yield "no stop was written within 30 s after the link was opened: the car may drive"
    if bench.control.driver.model.basis is Basis.SHOWN:
        yield "a car that said nothing counts as one that has shown its stop"
    yield from dict.fromkeys(bench.faults)


def check_answers(family: Family, platform: str) -> Iterator[str]:
    """Check the types of what the driver answers before, during and after a connection."""
    bench = Bench(family, platform, _samples(family))
    driver = bench.control.driver
    steps: tuple[Callable[[float], object], ...] = (driver.flush, bench.control.link_up, driver.shut_down)
    for step in steps:
        step(bench.now)
        for seconds in (0.0, 10.0):
            bench.run(seconds)
            for name, types in ANSWERS.items():
                answer: Any = getattr(driver, name)
                if callable(answer):
                    answer = answer() if name in ("kept", "flush_at") else answer(bench.now)
                if not _is(answer, *types) or (bool not in types and _is(answer, bool)):
                    yield f"{name} is {_kind(answer)}, not {' or '.join(each.__name__ for each in types)}: {answer!r}"
                    return


def check_motions(family: Family, platform: str) -> Iterator[str]:
    """Check that there is a frame for each motion at each speed, and that a stop is not among them."""
    made = Bench(family, platform).control.driver
    if isinstance(made, PlainDriver) and not hasattr(made, "STOPS_WITHIN_S"):
        yield "STOPS_WITHIN_S is missing: the time within which a car stops after it has received its stop"
        return
    driver = _connected(family, platform).control.driver
    if not isinstance(driver, PlainDriver):
        return  # such a driver has no motion_frame; `check_drive` looks at the frames that it writes
    if driver.STOP_FRAMES < 1:
        yield f"STOP_FRAMES is {driver.STOP_FRAMES}: a stop needs at least one frame"
    stops = {driver.stop_frame(index) for index in range(driver.STOP_FRAMES)} | {driver.motion_frame(Motion.STOP)}
    frames: dict[tuple[float, Motion], bytes] = {}
    for speed, motion in product((SPEED_STEP, 0.5, 1.0), Motion):
        driver.model.speed = speed
        try:
            frame = frames[speed, motion] = driver.motion_frame(motion)
        except (KeyError, ValueError, TypeError) as error:
            yield f"motion_frame({motion}) raises {type(error).__name__}: {error}"
            continue
        if not frame or b"" in stops:
            yield f"the frame of {motion}, or of a stop, is empty"
        if motion is not Motion.STOP and frame in stops:
            yield f"the frame of {motion} at {speed:.0%} is also a frame of a stop"
    for one, other in OPPOSITES:
        if (1.0, one) in frames and frames[1.0, one] == frames.get((1.0, other)):
            yield f"the frames of {one} and {other} are the same"
    slowed = Controller("red", family.driver_of(platform, {}), speed_max=LOW_SPEED_MAX).driver
    if isinstance(slowed, PlainDriver) and slowed.model.speed > LOW_SPEED_MAX:
        yield f"it begins with {slowed.model.speed:.0%} of full speed, though speed_max is {LOW_SPEED_MAX:.0%}"
    slow, fast = frames.get((SPEED_STEP, Motion.FORWARD)), frames.get((1.0, Motion.FORWARD))
    if "speed" in driver.model.profile.capabilities and slow is not None and slow == fast:
        yield "it has the capability speed, but motion_frame returns the same frame at every self.model.speed"


def check_wheels(family: Family, platform: str) -> Iterator[str]:
    """Check with `wheels_after` of the module, if it has one, what the car does with each frame.

    `wheels_after(data)` returns the shares of full speed, -1..1, that the left and the right wheels have after these
    bytes, or None if the bytes do not change them. It plays the car, so it must not use the driver's own table. The
    bytes are a frame, or half a frame with a stop after it, as a car gets them after a failed write.
    """
    wheels_after: Callable[[bytes], tuple[float, float] | None] | None = getattr(family, "wheels_after", None)
    bench = _connected(family, platform, _samples(family))
    driver = bench.control.driver
    if wheels_after is None or not isinstance(driver, PlainDriver):
        return
    driver.model.speed = speed = 0.5
    for motion in Motion:
        wheels = wheels_after(driver.motion_frame(motion))
        if wheels is None or not _turns(motion, *wheels):
            yield f"the frame of {motion} turns the wheels by {wheels}"
        elif max(map(abs, wheels)) > speed + SPEED_STEP / 2:
            yield f"the frame of {motion} turns the wheels by {wheels}, though model.speed is {speed:g}"
    for index in range(driver.STOP_FRAMES):
        wheels = wheels_after(driver.stop_frame(index))
        if any(wheels or ()) or (wheels is None and index == driver.STOP_FRAMES - 1):
            yield f"the wheels turn by {wheels} after frame {index} of a stop"
    yield from _faults_after_half_frames(driver, wheels_after)
    able = [what for what in ACTIONS if not isinstance(what, SetMode) and driver.refusal(what) is None]
    others = [(f"a frame of {what}", frame_of(each)) for what in able for each in driver.frames(what)]
    others += [("a frame of the set-up", data) for _, data, why in bench.sent if why is FrameOrigin.SETUP]
    for name, data in dict.fromkeys(others):
        if any(wheels_after(data) or ()):
            yield f"{name} drives: {data!r}"


def _faults_after_half_frames(
    driver: PlainDriver, wheels_after: Callable[[bytes], tuple[float, float] | None]
) -> Iterator[str]:
    """Check that the last frame of a stop, which is also sent alone, stops a car with half a frame in its buffer."""
    last = driver.stop_frame(driver.STOP_FRAMES - 1)
    for motion in Motion:
        frame = driver.motion_frame(motion)
        for data in (frame[:length] + last for length in range(1, len(frame))):
            try:
                wheels = wheels_after(data)
            except Exception as error:  # noqa: BLE001 - the function of a family may raise anything
                yield f"wheels_after raises {type(error).__name__} for half a frame with a stop after it: {data!r}"
                return
            if wheels is None or any(wheels):
                yield (
                    f"the wheels turn by {wheels} after half a frame of {motion} with the last frame of a stop after "
                    f"it: {data!r}. Begin the stop with bytes that make half a frame invalid"
                )
                return


def _turns(motion: Motion, left: float, right: float) -> bool:
    """Return True if the wheels turn so in a motion."""
    match motion:
        case Motion.STOP:
            return left == right == 0
        case Motion.FORWARD | Motion.BACK:
            return min(left, right) > 0 if motion is Motion.FORWARD else max(left, right) < 0
        case Motion.LEFT | Motion.RIGHT:
            inner, outer = (left, right) if motion is Motion.LEFT else (right, left)
            return 0 <= inner < outer
        case _:
            return left < 0 < right if motion is Motion.SPIN_LEFT else right < 0 < left


def check_samples(family: Family, platform: str) -> Iterator[str]:
    """Check with `SAMPLES` of the module (bytes of a real car) that each measured value has a known topic and field.

    Nothing may be measured in the bytes of `UNMEASURED`, such as acknowledgements and values that mean "no value".
    """
    driver = _connected(family, platform).control.driver
    for sample in getattr(family, "UNMEASURED", ()):
        for event in (*driver.feed(sample, 100.0), *driver.flush(110.0)):
            for topic in driver.measured(event):
                yield f"{topic} is measured in {sample!r}, which is listed in UNMEASURED"
        driver.drop_bytes()
    profile = family.profile_of(platform)
    measurable = {topic for mode in profile.modes for topic in profile.measurable(mode)}
    for sample in _samples(family):
        events = [*driver.feed(sample, 200.0), *driver.flush(210.0)]
        found = [each for event in events for each in driver.measured(event).items()]
        if not found:
            yield f"nothing is measured in {sample!r}, which is listed in SAMPLES"
        raw = b"".join(event.raw for event in events)
        if raw.translate(None, LINE_ENDS) != sample.translate(None, LINE_ENDS):
            yield f"the events of {sample!r} have the bytes {raw!r}: each byte but line ends belongs to one event's raw"
        for topic, fields in found:
            yield from _faults_of_values(topic, fields)
            yield from _faults_of_sample(topic, fields)
            if topic in TOPICS and topic.removeprefix("sensor/") not in measurable:
                yield f"{topic} is measured, but the profile does not list it"


def _faults_of_sample(topic: str, fields: Mapping[str, Any]) -> Iterator[str]:
    """Yield the faults of what a real car's bytes give: fields that are missing, and values in another unit."""
    if topic not in TOPICS:
        return
    known = messages.message_class(TOPICS[topic].message).DESCRIPTOR.fields_by_name
    needed = {name for name, each in known.items() if not each.has_presence and not each.is_repeated}
    if missing := needed - NOT_MEASURED - fields.keys():
        yield (
            f"{topic} has no value for {', '.join(sorted(missing))}, so readers would see 0 or false: give each field "
            "that is not optional, or leave the topic out"
        )
    if topic == "sensor/range" and ("range_m" in fields) == bool(fields.get("no_echo")):
        yield f"{topic} needs either range_m or no_echo=True"
    for name, (low, high) in TOPICS[topic].ranges.items():
        if name in fields and not low <= fields[name] <= high:
            yield f"{topic}: {name} is {fields[name]:g}, not {low:.4g} .. {high:.4g}: is it in another unit?"


def check_hostile(family: Family, platform: str) -> Iterator[str]:
    """Check that the driver accepts `SAMPLES` with `HOSTILE` values for numbers, and measures nothing invalid."""
    bench = _connected(family, platform)
    for sample in _samples(family):
        for number in re.finditer(rb"-?\d+(\.\d+)?", sample):
            for value in HOSTILE:
                yield from dict.fromkeys(_take(bench, sample[: number.start()] + value + sample[number.end() :]))


def check_rest(family: Family, platform: str) -> Iterator[str]:
    """Check that a moving car never counts as having shown its stop.

    `MOVING` of the module has bytes of a car that moves. If `SAMPLES` show a stop, `MOVING` is required. Without it,
    any report of the car might count as one that shows a stop.
    """
    standing = _connected(family, platform, _samples(family))
    standing.ask(Stop())
    standing.run(30.0)
    moving: Sequence[bytes] = getattr(family, "MOVING", ())
    told = _connected(family, platform, (NOISE,))
    told.ask(Stop())
    told.run(30.0)
    if told.control.driver.model.basis is Basis.SHOWN:
        yield f"a car that sends {NOISE!r} counts as one that has shown its stop, though that is no report"
    if isinstance(told.control.driver, PlainDriver) and told.control.driver.model.heard_at is not None:
        yield f"{NOISE!r} counts as a sign of life, though it is no report: return it as Rejected or TextLine"
    if standing.control.driver.model.basis is Basis.SHOWN and not moving:
        yield "its SAMPLES show a stop: add MOVING, a list of bytes that such a car sends while it moves"
    if standing.control.driver.model.basis is Basis.SHOWN and moving:
        standing.samples = moving
        standing.run(TOLD_S)
        if standing.control.driver.model.basis is Basis.SHOWN:
            yield (
                f"a car that has shown its stop, and then sends MOVING for {TOLD_S:g} s, still counts as standing: set "
                "model.turned_at in on_reading, or call recover"
            )
    for sample in moving:
        bench = _connected(family, platform, (sample,))
        bench.ask(Stop())
        for _ in range(30):
            bench.run(1.0)
            if bench.control.driver.model.basis is Basis.SHOWN:
                yield f"a car that sends {sample!r}, of MOVING, counts as one that has shown its stop"
                break


def check_stop(family: Family, platform: str) -> Iterator[str]:
    """Check that a person's stop is sent in time at any moment, and never counts as shown without a reading."""
    for wait_s in (0.0, 0.05, 0.6, 3.0, 30.0):
        bench = Bench(family, platform)
        bench.control.link_up(bench.now)
        bench.run(wait_s)
        asked_at = bench.now
        stop = bench.ask(Stop())
        bench.run(30.0)
        announced_s = max((each.worst_case_s for each in bench.records if each.command.id == stop), default=0.0)
        # The stop may have joined an earlier one that is still going on. Then the frames of the earlier stop count.
        from_s, until_s = asked_at - JOINED_S, asked_at + max(FIRST_STOP_S, announced_s)
        if not any(at <= until_s for at in bench.stop_frames(from_s)):
            limit_s = until_s - asked_at
            yield f"a stop asked for {wait_s:g} s after the link was opened had no frame within {limit_s:g} s"
        if announced_s == 0:
            yield f"a stop asked for {wait_s:g} s after the link was opened announces 0 s, so nobody waits for its end"
        last = bench.last(stop)
        if last is None or last.phase not in (Phase.SENT, Phase.FAILED):
            yield f"a stop that no reading shows ends as {last.phase if last else 'nothing'}, not as sent or failed"


def check_drive(family: Family, platform: str) -> Iterator[str]:
    """Check that a drive is sent or fails, ends with a stop, and is repeated in time for the car's dead-man timer."""
    bench = _connected(family, platform, _samples(family))
    began, before = bench.now, len(bench.sent)
    dead_man_s = family.profile_of(platform).dead_man_s
    lasts_s = min(10.0, max(4.0, 2 * (dead_man_s or 0.0)))
    drive = bench.ask(Drive(Motion.FORWARD, lasts_s))
    bench.run(MAX_QUEUE_TIME_S + lasts_s + 6.0)
    last = bench.last(drive)
    if last is None or last.phase in (Phase.ASKED, Phase.QUEUED):
        yield "a drive waits for ever"
    moved = any(each.command.id == drive and each.phase is Phase.SENT for each in bench.records)
    if not moved:
        if _samples(family):
            waits = bench.control.driver.wait_words(bench.now)
            yield f"a drive is never sent while the car sends its SAMPLES{': it waits for ' if waits else ''}{waits}"
        return
    frames = bench.sent[before:]
    drive_origins = (FrameOrigin.COMMAND, FrameOrigin.REPEAT)
    during = [at for at, _, why in frames if at <= began + lasts_s and why in drive_origins]
    stopped = [at for at in bench.stop_frames() if during and at > during[0]]
    ended = min(stopped, default=began + lasts_s)
    gaps = [b - a for a, b in pairwise((*during, min(ended, began + lasts_s)))]
    if dead_man_s is not None and (not gaps or max(gaps) > dead_man_s / 2):
        yield f"a held motion is not repeated within half of the car's dead-man time, {dead_man_s:g} s"
    over_at = last.at if last is not None else ended
    if during and not any(over_at - CHECK_STEP_S <= at <= over_at + FIRST_STOP_S for at in stopped):
        yield "the end of a drive sends no stop"
    if bench.control.driver.model.motors is Motors.ON:
        yield "the motors count as on after the drive"
    yield from dict.fromkeys(bench.faults)


def check_actions(family: Family, platform: str) -> Iterator[str]:
    """Check that each action has frames, or a refusal in words."""
    bench = _connected(family, platform)
    driver = bench.control.driver
    for what in ACTIONS:
        refusal = driver.refusal(what)
        if not _is(refusal, str, type(None)):
            yield f"the refusal of {what} is {_kind(refusal)}, not str or None"
        if refusal is not None and not refusal:
            yield f"{what} is refused without a reason"
        if refusal is None and not isinstance(what, SetMode):
            if not driver.frames(what):
                yield f"{what} is accepted, but has no frames"
            bench.ask(what)
            bench.run(1.0)
        if isinstance(what, SetMode) and (refusal is None) != (what.mode in driver.model.profile.modes):
            yield f"{what} is {'accepted' if refusal is None else 'refused'}, contrary to the profile"


def check_capabilities(family: Family, platform: str) -> Iterator[str]:
    """Check that the profile and the frames agree: each capability of `PARTS`, the lights and the servos."""
    driver = _connected(family, platform).control.driver
    profile = family.profile_of(platform)
    if isinstance(driver, PlainDriver) and "mode" in profile.capabilities:
        yield "it has the capability mode, but a PlainDriver has no modes: no command can open one"
    for word, kind in PARTS.items():
        able = [what for what in ACTIONS if isinstance(what, kind) and driver.refusal(what) is None]
        has_frames = any(driver.frames(what) for what in able)
        if word in driver.model.profile.capabilities and not has_frames:
            yield f"it has the capability {word}, but no frames for any of its actions"
        if isinstance(driver, PlainDriver) and has_frames and word not in profile.capabilities:
            yield f"it has frames for {word}, but not the capability, so no page offers it"
    if isinstance(driver, PlainDriver):
        lights = {what.light for what in ACTIONS if isinstance(what, SetLight) and driver.part_frames(what)}
        servos = {what.action for what in ACTIONS if isinstance(what, MoveServo) and driver.part_frames(what)}
        for field, words in (("lights", lights), ("servos", servos)):
            if words != (listed := getattr(profile, field)):
                odd = ", ".join(sorted(words ^ listed))
                yield f"{field} of the profile and the frames of part_frames differ in {odd}"


def check_loss(family: Family, platform: str) -> Iterator[str]:
    """Check that a lost link ends a waiting stop and all frames, and that a stop is written when the link is back."""
    bench = _connected(family, platform)
    yield from _check_dropped(family, bench)
    stop = bench.ask(Stop())
    bench.run(0.1)
    bench.control.driver.link_down("unplugged", bench.now)
    bench.write()
    before, lost_at = len(bench.sent), bench.now
    bench.run(5.0)
    if len(bench.sent) > before:
        yield "frames are written without a link"
    last = bench.last(stop)
    if last is None or last.phase in (Phase.ASKED, Phase.QUEUED):
        yield "a stop still waits after its link was lost"
    if bench.control.driver.model.motors is Motors.OFF:
        yield "the motors count as off without a link"
    bench.control.link_up(bench.now)
    bench.run(10.0)
    if not [at for at in bench.stop_frames() if at > lost_at]:
        yield "no stop is written when the link is back"


def _check_dropped(family: Family, bench: Bench) -> Iterator[str]:
    """Check that a lost link makes the driver forget the bytes of an unfinished frame, so that the next one is read."""
    driver = bench.control.driver
    samples = _samples(family)
    for sample in (*samples, b"x"):
        driver.feed(sample[: max(1, len(sample) // 2)], bench.now)
        dropped = driver.drop_bytes()
        if not _is(dropped, list):
            yield f"drop_bytes returns {_kind(dropped)}, not a list of events"
            return
        for event in dropped:
            driver.measured(event)
            driver.on_event(event, bench.now)
    for sample in samples:
        if not any(
            driver.measured(event) for event in (*driver.feed(sample, bench.now), *driver.flush(bench.now + 10))
        ):
            yield f"{sample!r} is not read after drop_bytes, which did not forget the unfinished frame"


def check_kept(family: Family, platform: str) -> Iterator[str]:
    """Check that the result of `kept` survives JSON, and that the driver of the next gateway accepts it."""
    kept = _connected(family, platform, _samples(family)).control.driver.kept()
    again = json.loads(json.dumps(kept))
    Controller("red", family.driver_of(platform, again))
    if again != kept:
        yield f"kept() changes when it is written as JSON and read again: {kept!r}"


def check_end(family: Family, platform: str) -> Iterator[str]:
    """Check that a gateway which ends stops its car, and ends in time."""
    bench = _connected(family, platform)
    ended_at = bench.now
    bench.control.driver.shut_down(bench.now)
    bench.run(SHUTDOWN_S + 1.0)
    if not bench.control.driver.finished:
        yield f"it has not ended {SHUTDOWN_S:g} s after it was told to"
    if not bench.stop_frames(ended_at):
        yield "it ends without stopping the car, though the car has not shown that it stands still"


CHECKS: Final[tuple[Callable[[Family, str], Iterator[str]], ...]] = (
    check_names,
    check_profile,
    check_bytes,
    check_connect,
    check_answers,
    check_motions,
    check_wheels,
    check_samples,
    check_hostile,
    check_stop,
    check_rest,
    check_drive,
    check_actions,
    check_capabilities,
    check_loss,
    check_kept,
    check_end,
)


def check(family: Family) -> Iterator[tuple[str, str, list[str]]]:
    """Yield platform, check and faults, for each check of each platform."""
    names = family.PLATFORMS
    if not _is(names, tuple, list) or not names or not all(_is(each, str) for each in names):
        yield "PLATFORMS", "check_names", [f"it is {names!r}, not a tuple of names"]
        return
    for platform in names:
        for each in CHECKS:
            yield platform, each.__name__, list(_caught(each(family, platform)))


def _samples(family: Family) -> Sequence[bytes]:
    """Return the `SAMPLES` of a module: bytes of a real car. Empty if it has none."""
    return getattr(family, "SAMPLES", ())


def _is(value: object, *kinds: type) -> bool:
    """Return True for a value of these types. The driver may return other types than it declares."""
    return isinstance(value, kinds)


def _kind(value: object) -> str:
    """Return the name of a value's type."""
    return type(value).__name__


def _caught(faults: Iterator[str]) -> Iterator[str]:
    """Yield the faults, and an exception of the driver as one more."""
    try:
        yield from faults
    except Exception as error:  # noqa: BLE001 - an exception of the driver is a fault to report
        last = traceback.extract_tb(error.__traceback__)[-1]
        yield f"raises {type(error).__name__}: {error} ({last.filename}:{last.lineno}, in {last.name})"


def main(arguments: list[str]) -> int:
    """Check the families of the modules that are named. Return the exit code."""
    if not arguments or arguments[0] in ("-h", "--help"):
        sys.stdout.write(f"{__doc__}\nexample:\n  python -m gateway.drivers.check gateway.drivers.waveshare.family\n")
        return 0 if arguments else 2
    found = 0
    for name in arguments:
        try:
            family: Any = import_module(name)
            missing = missing_names(family)
        except (Exception, SystemExit) as error:  # noqa: BLE001 - a module may raise anything
            sys.stderr.write(f"gateway.drivers.check: {name} cannot be imported: {type(error).__name__}: {error}\n")
            return 2
        if missing:
            sys.stderr.write(
                f"gateway.drivers.check: {name} has no {', '.join(missing)} (see docs/how-to/write-a-driver.md)\n"
            )
            return 2
        told: dict[tuple[str, str], str] = {}
        for platform, what, faults in check(family):
            found += len(faults)
            check_name = what.removeprefix("check_")
            # One mistake may fail every check: write its words once.
            names = [told.setdefault((platform, fault), check_name) for fault in dict.fromkeys(faults)]
            words = [
                fault if name == check_name else f"as in {name}"
                for fault, name in zip(dict.fromkeys(faults), names, strict=True)
            ]
            sys.stdout.write(f"{platform} {check_name}: {'; '.join(words) or 'ok'}\n")
    return 1 if found else 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
