"""The kinds of cars: the frames that they understand, how they are stopped, and which of their readings are measured.

Every number cites docs/reference/protocol.md: "platforms: speed" is the row `speed` of its section Platforms, and
"programs that people have" is the section of that name. The times are in `timing` and `modes`.
"""

from collections.abc import Mapping
from enum import StrEnum
from functools import cache, cached_property
from typing import Final

from msgspec import Struct

from gateway.drivers.yahboom.protocol.frames import (
    STANDARD_HEAD,
    ArmSet,
    ColorLed,
    Dialect,
    Frame,
    General,
    LoneHash,
    ModeClose,
    ModeOpen,
    Ptz,
    encode,
    parse_sent,
)
from gateway.drivers.yahboom.protocol.modes import EVERY_MEASUREMENT, MODES, SILENT_MODES, candidate_modes
from gateway.drivers.yahboom.protocol.sensors import ATTRIBUTES, RejectedField, Sensors
from gateway.drivers.yahboom.protocol.timing import (
    DIGITLESS_OPEN_S,
    FRAME_S,
    RANGING_S,
    RASPBERRY_PI_FAN_S,
    REPORT_INTERVAL_S,
    block_s,
)
from schemas.links import BAUD
from schemas.platform_name import HEAD, NO_READINGS, OPTIONS, parse_name
from schemas.words import Light, Mode, Motion, Platform, ServoAction, SpeedStep


class StopStyle(StrEnum):
    """The stop sequences of a car (docs/reference/protocol.md#stops)."""

    MODE_FRAME = "mode_frame"
    """`MODE00` stops the car in every mode. It blocks the car, and the late report after that shows that it arrived."""
    TIMER = "timer"
    """`MODE00` ends a mode, general stops stop the car in mode 0, and no reading shows that either arrived."""
    GENERAL = "general"
    """Only general stops, because the car understands no MODE frame, or may not understand it."""
    BOTH = "both"
    """Both kinds of frames, because readings contradict the platform."""


FRONT_SERVO: Final = frozenset({ServoAction.FRONT_LEFT, ServoAction.FRONT_RIGHT, ServoAction.FRONT_RESET})
_VERTICAL: Final = frozenset({ServoAction.VERTICAL_UP, ServoAction.VERTICAL_DOWN, ServoAction.VERTICAL_RESET})
_HORIZONTAL: Final = frozenset(
    {ServoAction.HORIZONTAL_LEFT, ServoAction.HORIZONTAL_RIGHT, ServoAction.HORIZONTAL_RESET}
)
CAMERA_TURNS: Final = (_VERTICAL | _HORIZONTAL) - {ServoAction.VERTICAL_RESET, ServoAction.HORIZONTAL_RESET}
"""Movements that last until the next general frame, or to the end of the servo (docs/reference/protocol.md)."""


class SpeedModel(Struct, frozen=True):
    """The speeds of one kind of program and its steps, in the car's own unit."""

    start: float
    increment: float
    low: float  # a step down to less than this ends at `rebound`
    rebound: float
    top: float
    set_by: frozenset[Mode]
    """Modes that may leave the car at any speed."""

    def step(self, value: float, step: SpeedStep) -> float:
        """Return the speed after one step."""
        if step is SpeedStep.UP:
            return min(value + self.increment, self.top)
        lower = value - self.increment
        return lower if lower >= self.low else self.rebound

    def fraction(self, value: float) -> float:
        """Return the speed as a fraction of the maximum, 0..1."""
        return min(max(value / self.top, 0.0), 1.0)


# In this mode, a person changes the speed with an infrared remote.
_BY_PERSON: Final = frozenset({Mode.REMOTE_CONTROL})
# The Arduino program sets the speed itself in these modes, and keeps it afterwards.
_BY_PROGRAM: Final = frozenset({Mode.TRACKING, Mode.OBSTACLE_AVOIDANCE, Mode.LIGHT_SEEKING, Mode.FOLLOWING})
SPEEDS: Final[Mapping[Platform, SpeedModel]] = {
    # platforms: speed. Arduino 150 of 255, +-50, ceiling 255, a step down to less than 50 becomes 100
    Platform.ARDUINO: SpeedModel(
        start=150, increment=50, low=50, rebound=100, top=255, set_by=_BY_PERSON | _BY_PROGRAM
    ),
    # programs that people have: 200 of 1000, steps of 100. The slowest speed was not measured: one step is assumed
    Platform.STM32: SpeedModel(start=200, increment=100, low=100, rebound=100, top=1000, set_by=_BY_PERSON),
    # platforms: speed. Raspberry Pi +-20 in 20..100 %. The start is 80 % in one program and 50 % in another. The faster
    # one is assumed, so that no car exceeds `speed_max`
    Platform.RASPBERRY_PI: SpeedModel(start=80, increment=20, low=20, rebound=20, top=100, set_by=frozenset()),
}
"""The speeds and steps of each kind of program. While the platform is unknown, the fastest of them counts."""

# platforms: constants in mode 0 of raspberry_pi: `PV8.4`, `GS0`, whole centimeters
_PI_VOLTAGE_V, _PI_GRAYSCALE = 8.4, 0
_CONSTANTS: Final = (("battery", _PI_VOLTAGE_V), ("grayscale", float(_PI_GRAYSCALE)))
# programs that people have: the tracking, light seeking and following of stm32 print nothing
_STM32_SILENT: Final = frozenset({Mode.TRACKING, Mode.LIGHT_SEEKING, Mode.FOLLOWING})
# programs that people have: one stm32 program has these constants in its mode-0 report, all of them or none
_STM32_CONSTANTS: Final = frozenset({"grayscale", "line", "obstacle", "light"})
# docs/reference/protocol.md#ranges
_PV_MAX: Final = {2: 12.0, 3: 13.0}
GRAY_10_BIT, _GRAY_12_BIT = 1023, 4095


SPECIAL_CAPABILITIES: Final[Mapping[str, Frame]] = {
    "mode": ModeOpen(Mode.TRACKING),
    "led": ColorLed(0, 0, 0),
    "servo_deg": Ptz(90),
    "arm": ArmSet((90,) * 6),
    "servo_vertical": General(Motion.STOP, servo=ServoAction.VERTICAL_UP),
    "servo_horizontal": General(Motion.STOP, servo=ServoAction.HORIZONTAL_LEFT),
}
"""The capabilities that some cars lack, each with a frame that needs it."""


@cache
def _common_measurements(modes: tuple[Mode, ...], shown: tuple[Mode, ...]) -> frozenset[str]:
    """Return the measurements that all these modes have in common. A silent mode excludes no measurement.

    `shown` are the modes whose text the frame has. Such a mode counts even if it is silent in the vendor's program.
    """
    counted = (mode for mode in modes if mode not in SILENT_MODES or mode in shown)
    common = EVERY_MEASUREMENT.intersection(*(MODES[mode].measures for mode in counted))
    if len(modes) > 1 and Mode.FOLLOWING in modes:
        return common - {"obstacle"}  # following inverts it
    return common


class Profile(Struct, frozen=True, dict=True):
    """One kind of car: a column of the table in docs/reference/protocol.md#platforms."""

    kind: Platform
    options: frozenset[str]
    modes: frozenset[Mode]
    capabilities: frozenset[str]
    lights: frozenset[Light]
    servos: frozenset[ServoAction]
    stop_style: StopStyle
    constants: tuple[tuple[str, float], ...] = ()  # readings that are constants in mode 0
    not_observed: tuple[str, ...] = ()  # properties that were only read or assumed, for a person

    @cached_property
    def name(self) -> str:
        """The text that `parse_platform` accepts."""
        return "+".join((self.kind, *sorted(self.options)))

    @property
    def observed(self) -> bool:
        """True if all of this profile was observed on a running program."""
        return not self.not_observed

    @cached_property
    def dialect(self) -> Dialect:
        """The spelling of the car's frames, for `FrameSplitter` and `encode`."""
        head = next((option.partition("=")[2] for option in self.options if option.startswith(HEAD)), STANDARD_HEAD)
        return Dialect(head, swaps_green_and_blue=self.kind is Platform.STM32)

    @property
    def fan_is_level(self) -> bool:
        """True if place 8 is a level, so that each general frame with 0 turns the fan off. False if 1 toggles it."""
        return "fan_level" in self.options

    @property
    def ptz_direct(self) -> bool:
        """True if the servo goes to the angle of a PTZ frame. False if it goes to 180 degrees minus that angle."""
        return "ptz_direct" in self.options

    @cached_property
    def has_readings(self) -> bool:
        """False if the car never sends a reading."""
        return NO_READINGS not in self.options

    @property
    def cells(self) -> int:
        """The number of cells of the car's battery."""
        return 3 if "3s" in self.options else 2

    @property
    def baud(self) -> int:
        """The rate of the car's UART, baud."""
        return BAUD

    @property
    def dead_man_s(self) -> None:
        """Always None: no such car is certain to stop by itself (docs/reference/protocol.md#general-frame)."""
        return None

    @cached_property
    def voltage_max(self) -> float:
        """The maximum of PV in V. A greater value is not a measurement."""
        return _PV_MAX[self.cells]

    @cached_property
    def grayscale_max(self) -> int:
        """The maximum of GS. A greater value is not a measurement."""
        return _GRAY_12_BIT if self.kind in {Platform.STM32, Platform.UNKNOWN} else GRAY_10_BIT

    @cached_property
    def close_s(self) -> float:
        """The expected block of `MODE00`, s. It is used until the readings show the block of this car."""
        return self.block_s(ModeClose())

    @property
    def interval_s(self) -> float:
        """The expected interval of reports in mode 0, s. It is used until the interval of the car is learned."""
        return REPORT_INTERVAL_S

    @property
    def ranging_s(self) -> float:
        """The maximum number of seconds by which a report takes longer if the ranging gets no echo."""
        return RANGING_S

    @property
    def reopened_s(self) -> float:
        """The shortest block of a `MODE00` that lost its digits, s."""
        return DIGITLESS_OPEN_S

    @cached_property
    def shortest_opening_s(self) -> float:
        """The shortest block of the opening of a mode, s."""
        return min((row.open_s for mode, row in MODES.items() if mode is not Mode.MANUAL), default=0.0)

    @cached_property
    def silent_modes(self) -> frozenset[Mode]:
        """The modes in which this car sends no readings."""
        if not self.has_readings:
            return self.modes
        return self.modes & (SILENT_MODES | _STM32_SILENT if self.kind is Platform.STM32 else SILENT_MODES)

    @cached_property
    def possible_modes(self) -> frozenset[Mode]:
        """The modes in which this car may be, whoever opened them. All modes if the platform is unknown."""
        return frozenset(Mode) if self.kind is Platform.UNKNOWN else self.modes

    @property
    def fan_silences(self) -> bool:
        """True if a running fan may make the car silent (docs/reference/protocol.md#hazards).

        It only blocks a Raspberry Pi for 1 s. An stm32 car reports by a timer. Its readings while the fan runs were not
        observed.
        """
        return self.kind in {Platform.ARDUINO, Platform.UNKNOWN}

    def encode(self, frame: Frame) -> bytes:
        """Return the bytes of a frame as this car spells it. Raises EncodeError for a value that is not allowed."""
        return encode(frame, self.dialect)

    def parse_sent(self, data: bytes) -> Frame | None:
        """Return the frame with these bytes for this car. None if they are not one whole frame."""
        return parse_sent(data, self.dialect)

    def refusal(self, frame: Frame) -> str | None:
        """Return a sentence on why the car must not get this frame. None if it may get the frame."""
        match frame:
            case General():
                return self._general_refusal(frame)
            case Ptz():
                return self._unless("servo_deg", "the pan/tilt frame (a servo angle in degrees)")
            case ColorLed():
                return self._unless("led", "the color LED frame")
            case ModeOpen(mode):
                if mode in self.modes and mode is not Mode.MANUAL:
                    return None
                return f"{self._these} do not know mode {mode}; {self._list_known(self.modes - {Mode.MANUAL})}"
            case ModeClose(mode):
                if "mode" in self.capabilities or (self.kind is Platform.UNKNOWN and mode is Mode.MANUAL):
                    return None
                return f"{self._these} may ignore the frame that closes mode {mode}"
            case ArmSet():
                return self._unless("arm", "the arm frame (an option: +arm)")
            case LoneHash():
                # hazards of the Raspberry Pi programs: a lone `#` is never sent to this platform
                return self._unless("mode", "a lone '#'")

    def why_lacking(self, capability: str) -> str | None:
        """Return a sentence on why the car lacks a capability. None if the car, or every car, has the capability."""
        frame = SPECIAL_CAPABILITIES.get(capability)
        return None if frame is None else self.refusal(frame)

    @property
    def has_network(self) -> bool:
        """False if a TCP port of the car belongs to a bridge (docs/reference/protocol.md#platforms)."""
        return self.kind not in {Platform.ARDUINO, Platform.STM32}

    def hint(self, odd: str) -> str:
        """Return the likely cause of something odd in such cars, as a sentence. Empty if there is none."""
        # The reports of most arduino programs show a stop, if the frames arrive.
        if odd == "not_obeyed" and self.kind is not Platform.ARDUINO:
            return ""
        return _HINTS.get(odd, "")

    def block_s(self, frame: Frame) -> float:
        """Return the maximum time in seconds for which this frame blocks the car (see `timing.block_s`)."""
        if self.kind is Platform.STM32:
            return FRAME_S
        slow_fan = self.kind in {Platform.RASPBERRY_PI, Platform.UNKNOWN}
        return block_s(frame, fan_s=RASPBERRY_PI_FAN_S if slow_fan else 0.0)

    def mode_turn_s(self, mode: Mode) -> float:
        """Return the longest block of one turn of this mode's own loop, during which the car obeys no frame."""
        # An stm32 car obeys in every mode at once. Only a report of 48 ms delays it.
        return FRAME_S if self.kind is Platform.STM32 else MODES[mode].turn_s

    def modes_of_frame(self, event: Sensors, mode: Mode | None = None) -> tuple[Mode, ...]:
        """Return the modes in which the car may have sent this frame.

        If the confirmed `mode` is among the candidates, return only that. If not, return it, too: until three frames
        in a row contradict the mode, the frame may be a corrupted one of that mode.
        """
        candidates = candidate_modes(event)
        if mode is None:
            return candidates
        return (mode,) if mode in candidates else (*candidates, mode)

    def measured(self, event: Sensors, mode: Mode | None = None, *, may_be_stm32: bool = False) -> frozenset[str]:
        """Return the fields of this frame that are measurements in every mode in which it may have been sent.

        `mode` is the confirmed mode, or None (see `modes_of_frame`). A rejected field is no measurement. A range of a
        ranging without an echo is a measurement. With `may_be_stm32`, the constants of an stm32 program are none.
        """
        common = _common_measurements(self.modes_of_frame(event, mode), candidate_modes(event))
        names = {name for name in common if getattr(event, ATTRIBUTES[name]) is not None}
        if self.constants and self._may_be_constant(event):
            names -= {name for name, value in self.constants if getattr(event, ATTRIBUTES[name]) == value}
        is_stm32 = may_be_stm32 or self.kind is Platform.STM32
        if is_stm32 and candidate_modes(event) == (Mode.MANUAL,) and stm32_constants(event):
            names -= _STM32_CONSTANTS
        return frozenset(names - self._out_of_range(event))

    def rejects(self, event: Sensors) -> tuple[RejectedField, ...]:
        """Return the rejected fields of a frame, and those that are out of range only for this kind of car."""
        words = {"battery": ("PV", event.voltage_v), "grayscale": ("GS", event.grayscale)}
        own = (words[name] for name in sorted(self._out_of_range(event)))
        return (*event.rejects, *(RejectedField(word, f"{value:g}") for word, value in own))

    def _out_of_range(self, event: Sensors) -> set[str]:
        """Return the fields that are out of the range of this car."""
        found = set()
        if event.voltage_v is not None and event.voltage_v > self.voltage_max:
            found.add("battery")
        if event.grayscale is not None and event.grayscale > self.grayscale_max:
            found.add("grayscale")
        return found

    def measurable(self, mode: Mode) -> frozenset[str]:
        """Return the names of all readings that the car can send in this mode, without constants of the platform."""
        if mode not in self.modes or mode in self.silent_modes:
            return frozenset()
        if mode is not Mode.MANUAL:
            return MODES[mode].measures
        return (EVERY_MEASUREMENT | (self.options & OPTIONS)) - {name for name, _ in self.constants}

    def obstacle(self, event: Sensors, mode: Mode | None = None) -> tuple[bool, bool] | None:
        """Return the obstacle left and right, with the inversion of following undone. None if not measured."""
        if event.obstacle is None or "obstacle" not in self.measured(event, mode):
            return None
        left, right = event.obstacle
        # In mode 6 HW is inverted: 0 = object seen (docs/reference/protocol.md#placeholders).
        return (not left, not right) if self.modes_of_frame(event, mode) == (Mode.FOLLOWING,) else (left, right)

    def contradictions(self, event: Sensors) -> tuple[str, ...]:
        """Return the contradictions between this frame and the platform, in words. An empty result proves nothing."""
        if self.kind is Platform.UNKNOWN:
            return ()
        candidates = candidate_modes(event)
        found: list[str] = []
        if self.modes.isdisjoint(candidates):
            found.append(f"a reading of mode {' or '.join(candidates)}, which {self._these} do not have")
        elif (self.silent_modes - SILENT_MODES).issuperset(candidates):
            found.append(f"a reading of mode {' or '.join(candidates)}, in which {self._these} send none")
        if candidates != (Mode.MANUAL,):
            return tuple(found)
        if self.kind is Platform.RASPBERRY_PI:
            if not whole_cm(event):
                found.append("decimals in CSB; a raspberry_pi car sends whole centimeters")
            if event.voltage_v not in {None, _PI_VOLTAGE_V}:
                found.append("PV is not 8.4, the constant of a raspberry_pi car")
            if event.grayscale not in {None, _PI_GRAYSCALE}:
                found.append("GS is not 0, the constant of a raspberry_pi car")
            return tuple(found)
        if pi_constants(event):
            found.append("PV8.4 and GS0, the constants of a raspberry_pi car")
        if self.kind is Platform.ARDUINO and whole_cm(event):
            found.append("whole centimeters in CSB; an arduino car sends decimals in mode 0")
        return tuple(found)

    def _may_be_constant(self, event: Sensors) -> bool:
        return self.kind is not Platform.UNKNOWN or (whole_cm(event) and pi_constants(event))

    def _general_refusal(self, frame: General) -> str | None:
        if frame.sing:
            return "no car can sing (in the table: temporarily not supported)"
        if frame.servo and frame.servo not in self.servos:
            return f"{self._these} do not know servo action {frame.servo}; {self._list_known(self.servos)}"
        if frame.light and frame.light not in self.lights:
            return f"{self._these} do not know light {frame.light}; {self._list_known(self.lights)}"
        return None

    def _unless(self, capability: str, what: str) -> str | None:
        return None if capability in self.capabilities else f"{self._these} do not know {what}"

    @property
    def _these(self) -> str:
        return "cars of an unknown platform" if self.kind is Platform.UNKNOWN else f"{self.name} cars"

    @staticmethod
    def _list_known(words: frozenset[Light] | frozenset[Mode] | frozenset[ServoAction]) -> str:
        return f"they know {', '.join(sorted(words))}" if words else "they know none"


def parse_platform(text: str) -> Profile:
    """Return the profile of a platform such as `arduino` or `stm32+arm+head=BALA` in any case, or raise ValueError."""
    return _profile(*parse_name(text))


_HINTS: Final = {
    "silent": f"If it drives but never sends readings, set `platform: raspberry_pi+{NO_READINGS}` in the fleet file.",
    "not_obeyed": "If it obeys nothing: look at the wire to its RX pin",
    "PV": "A battery of three cells is named by +3s, as in `platform: arduino+3s`.",
    "GS": "Over 1023 it is a converter of 12 bits: `platform: stm32`?",
}
"""The hints, by finding of `fleet doctor` or by field whose values are always out of range."""

# docs/reference/protocol.md#platforms
_EVERY_CAR: Final = frozenset({"drive", "whistle", "speed", "servo", "fan", "light"})
_MODE_CAR: Final = _EVERY_CAR | {"servo_deg", "led", "mode"}
_PI_CAR: Final = _EVERY_CAR | {"servo_deg", "led", "servo_vertical", "servo_horizontal"}
_ALL_MODES: Final = frozenset(Mode)
_MODE_0: Final = frozenset({Mode.MANUAL})
_ALL_LIGHTS: Final = frozenset(Light)
_STM32_CAR: Final = _MODE_CAR - {"led"}
_STM32_LIGHTS: Final = frozenset({Light.WHITE, Light.RED, Light.GREEN, Light.BLUE, Light.OFF})
_LIGHTS_2_TO_4: Final = frozenset({Light.RED, Light.GREEN, Light.BLUE})


def _profile(kind: Platform, options: frozenset[str]) -> Profile:
    parts = options & OPTIONS
    match kind:
        case Platform.ARDUINO:
            return Profile(
                kind,
                options,
                _ALL_MODES,
                _MODE_CAR | parts,
                _ALL_LIGHTS,
                FRONT_SERVO,
                StopStyle.MODE_FRAME,
            )
        case Platform.STM32:
            return Profile(
                kind,
                options,
                _ALL_MODES,
                _STM32_CAR | parts,
                _STM32_LIGHTS,
                FRONT_SERVO,
                StopStyle.TIMER,
                not_observed=("the slowest speed", "readings while the fan runs"),
            )
        case Platform.RASPBERRY_PI:
            return Profile(
                kind,
                options,
                _MODE_0,
                _PI_CAR | parts,
                _LIGHTS_2_TO_4,
                FRONT_SERVO | _VERTICAL | _HORIZONTAL,
                StopStyle.GENERAL,
                constants=_CONSTANTS,
                not_observed=("the speed at the start",),
            )
        case Platform.UNKNOWN:
            return Profile(
                kind,
                options,
                _MODE_0,
                _EVERY_CAR | parts,
                _LIGHTS_2_TO_4,
                FRONT_SERVO,
                StopStyle.GENERAL,
                constants=_CONSTANTS,
                not_observed=("only what every known platform has is used",),
            )


def whole_cm(event: Sensors) -> bool:
    """Return True if the distance has no decimals."""
    return b"." not in event.raw.partition(b",PV")[0]


def stm32_constants(event: Sensors) -> bool:
    """Return True if grayscale, line, obstacle and light are the constants of one stm32 program."""
    return b",GS0,LF0000,HW00,GM00" in event.raw


def pi_constants(event: Sensors) -> bool:
    """Return True if voltage and grayscale are the constants of a raspberry_pi car."""
    return b",PV8.4,GS0," in event.raw
