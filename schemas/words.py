"""The closed sets of words: the values of fields, parts of keys and entries of files that allow only a few. Pure.

A word has the same spelling in messages, files, commands and code. How a word is written on a car's wire is in its
driver, below `gateway.drivers`. Messages hold words as text, so another version's word never breaks a reader. The verbs
of cars are in `commands`, each with its properties.
"""

from enum import StrEnum
from typing import Final

UNKNOWN: Final = "unknown"
"""The text in place of a word that is not known, such as a mode or a motion."""


class Platform(StrEnum):
    """The program that runs on a car."""

    ARDUINO = "arduino"
    STM32 = "stm32"
    RASPBERRY_PI = "raspberry_pi"
    UNKNOWN = "unknown"


class Motion(StrEnum):
    """A motion of the wheels."""

    STOP = "stop"
    FORWARD = "forward"
    BACK = "back"
    LEFT = "left"
    RIGHT = "right"
    SPIN_LEFT = "spin_left"
    SPIN_RIGHT = "spin_right"


class Mode(StrEnum):
    """A mode of the car's program.

    In `manual` commands drive the car, in `remote_control` only its infrared remote does, in `color_led` it only
    shines, and in the others it moves by itself.
    """

    MANUAL = "manual"
    REMOTE_CONTROL = "remote_control"
    TRACKING = "tracking"
    OBSTACLE_AVOIDANCE = "obstacle_avoidance"
    COLOR_LED = "color_led"
    LIGHT_SEEKING = "light_seeking"
    FOLLOWING = "following"


MODE_TEXTS: Final = {
    Mode.MANUAL: ("Manual", "Stops the car. Then you drive it."),
    Mode.REMOTE_CONTROL: ("Infrared remote", "Only the infrared remote drives the car. The car reports nothing."),
    Mode.TRACKING: ("Line tracking", "Drives off at once, along a line on the floor."),
    Mode.OBSTACLE_AVOIDANCE: (
        "Obstacle avoidance",
        "Drives off at once and avoids obstacles. It reports nothing. A stop may take 4 s.",
    ),
    Mode.COLOR_LED: ("Color LED", "Stands and shows colors. It reports nothing."),
    Mode.LIGHT_SEEKING: ("Light seeking", "Drives toward light, as soon as there is some."),
    Mode.FOLLOWING: ("Following", "Drives after what is in front of it."),
}
"""Each mode for a person: its name, and what the car does in it."""


MODE_COLORS: Final = {
    Mode.MANUAL: 0x5C7FA3,
    Mode.REMOTE_CONTROL: 0xA0522D,
    Mode.TRACKING: 0x8E6BBF,
    Mode.OBSTACLE_AVOIDANCE: 0xD08A3C,
    Mode.COLOR_LED: 0xC0689F,
    Mode.LIGHT_SEEKING: 0xC9B037,
    Mode.FOLLOWING: 0x3C9D9B,
}
"""The color of each mode on a time line, 0xRRGGBB."""


class Light(StrEnum):
    """A color of the light."""

    WHITE = "white"
    RED = "red"
    GREEN = "green"
    BLUE = "blue"
    CYAN = "cyan"
    MAGENTA = "magenta"
    YELLOW = "yellow"
    OFF = "off"


class FanState(StrEnum):
    """The state of the fan that a command asks for."""

    ON = "on"
    OFF = "off"


class Servo(StrEnum):
    """A servo that a command moves."""

    FRONT = "front"
    VERTICAL = "vertical"
    HORIZONTAL = "horizontal"

    @property
    def moves(self) -> tuple[str, ...]:
        """The words of a command beside this servo: `left` for `ServoAction.FRONT_LEFT`."""
        return tuple(each.removeprefix(f"{self}_") for each in ServoAction if each.startswith(f"{self}_"))


class ServoAction(StrEnum):
    """One movement of one servo."""

    FRONT_LEFT = "front_left"
    FRONT_RIGHT = "front_right"
    VERTICAL_UP = "vertical_up"
    VERTICAL_DOWN = "vertical_down"
    VERTICAL_RESET = "vertical_reset"
    HORIZONTAL_LEFT = "horizontal_left"
    HORIZONTAL_RIGHT = "horizontal_right"
    HORIZONTAL_RESET = "horizontal_reset"
    FRONT_RESET = "front_reset"


class SpeedStep(StrEnum):
    """A step of the speed, which is only relative."""

    UP = "up"
    DOWN = "down"


# ------------------------------------------------------------------ commands


CAPABILITIES: Final = (
    *("mode", "led", "servo_deg", "arm", "servo_vertical", "servo_horizontal"),
    *("drive", "whistle", "speed", "servo", "fan", "light"),
)
"""The capabilities of cars that a person uses; `state/health` lists others, too, such as `imu`. Those that only some of
Yahboom's cars have come first."""


class Rank(StrEnum):
    """The kind of a sender, which is its rank. Each outranks those below it."""

    LEAD = "lead"
    """A person whom the people table of the gateway names as a lead. No command may claim this rank."""
    PERSON = "person"
    SCRIPT = "script"
    COORDINATOR = "coordinator"


class Scope(StrEnum):
    """The reach of an e-stop: one car, or every car of the fleet."""

    CAR = "car"
    FLEET = "fleet"


class Phase(StrEnum):
    """One step in the life of a command."""

    ASKED = "asked"
    QUEUED = "queued"
    SENT = "sent"
    EFFECT_SEEN = "effect_seen"
    COMPLETE = "complete"
    SUPERSEDED = "superseded"
    EXPIRED = "expired"
    FAILED = "failed"
    REJECTED = "rejected"


class Reason(StrEnum):
    """Why a command was rejected or ended early. Answers use no other reasons."""

    BAD_VALUE = "bad_value"
    UNSUPPORTED = "unsupported"
    WRONG_MODE = "wrong_mode"
    LEASED = "leased"
    LENT = "lent"
    """The car is lent to another person."""
    NOT_ALLOWED = "not_allowed"
    """The people table does not allow the command to this sender."""
    PAUSED = "paused"
    HELD = "held"
    ESTOPPED = "estopped"
    BATTERY_LOW = "battery_low"
    LINK_DOWN = "link_down"
    WRITE_FAILED = "write_failed"
    QUEUE_FULL = "queue_full"
    EXPIRED = "expired"
    LAPSED = "lapsed"
    """The command only continues a drive, and that drive is over."""
    SUPERSEDED = "superseded"
    DUPLICATE = "duplicate"
    STALE = "stale"
    NOT_SHOWN = "not_shown"
    """The car could have shown the stop and did not."""
    STUCK = "stuck"
    """A wheel stood still during the drive."""


# ------------------------------------------------------------------ states


class LinkState(StrEnum):
    """The state of a link. `quiet`: an expected silence. `stale`: an unexpected silence. `lost`: the port is closed."""

    ONLINE = "online"
    QUIET = "quiet"
    STALE = "stale"
    LOST = "lost"


class Verdict(StrEnum):
    """The confidence in the commanded mode."""

    ASSUMED = "assumed"
    CONFIRMED = "confirmed"
    CONTRADICTED = "contradicted"


class MotionSource(StrEnum):
    """The source of the current motion of a car."""

    COMMANDED = "commanded"
    ASSUMED = "assumed"
    UNKNOWN = "unknown"


class Motors(StrEnum):
    """The claim about a car's motors. A `Basis` is the evidence for `off`."""

    OFF = "off"
    ON = "on"
    STOPPING = "stopping"
    """The frames of a stop were sent, but the car has not shown the stop yet."""
    UNKNOWN = "unknown"


class CarTrust(StrEnum):
    """The known state of the car."""

    UNKNOWN = "unknown"
    """The link is down. The car may stand or move."""
    RECOVERING = "recovering"
    """The link is open, and the gateway carries out a stop that brings the car to a known state."""
    STOPPING = "stopping"
    """The state of the car was known, and the gateway carries out a stop."""
    STOPPED = "stopped"
    """The stop is complete: the car has shown it, or cannot show it. `motors_basis` says which."""
    DRIVING = "driving"
    """The gateway has sent a motion."""
    IN_MODE = "in_mode"
    """The gateway has opened a mode in which the car drives by itself."""
    UNHEARD = "unheard"
    """The link is open, and the car is silent for longer than any normal silence. The stop goes on."""
    UNPROVEN = "unproven"
    """The car sends readings that could have shown the stop, and they did not in time. The stop goes on."""


class Basis(StrEnum):
    """The basis of the claim that the motors are off."""

    SHOWN = "shown"
    """The car's own readings."""
    SENT = "sent"
    """The written frames. The car cannot show that it obeyed them."""


class BatteryLevel(StrEnum):
    """The level of the battery, for a person."""

    OK = "ok"
    LOW = "low"
    CRITICAL = "critical"


class BatteryAction(StrEnum):
    """The reaction to a battery's level, a value of `gateway run --on-battery-low`."""

    WARN = "warn"
    REFUSE = "refuse"
    """Refuse new drives and modes. A running drive or mode goes on."""
    STOP = "stop"
    """Refuse new drives and modes, and stop the car."""


class Shows(StrEnum):
    """The finding whether the car's reports show that a stop arrived."""

    UNKNOWN = "not_known_yet"
    YES = "yes"
    """The car has shown a stop."""
    NO = "no"
    """The reports of the car do not react to frames."""


class Blocking(StrEnum):
    """The frames that may delay the next report."""

    MODE_CLOSE = "mode_close"
    WHISTLE = "whistle"
    SERVO = "servo"
    COLOR = "color"


# ------------------------------------------------------------------ frames and logs


class FrameVerdict(StrEnum):
    """The kind of a received frame. Bytes that are not a frame have a `Cause` instead."""

    SENSORS = "sensors"
    ARM = "arm"
    IMU = "imu"
    ECHO = "echo"
    TEXT = "text"


class Cause(StrEnum):
    """Why bytes are not a reading (docs/reference/protocol.md#bad-input)."""

    NO_START = "no_start"
    OVERLONG = "overlong"
    UNKNOWN_WORD = "unknown_word"
    MISSING_WORD = "missing_word"
    BAD_NUMBER = "bad_number"
    OUT_OF_RANGE = "out_of_range"
    TRUNCATED = "truncated"


class FrameOrigin(StrEnum):
    """The reason for a frame."""

    COMMAND = "command"
    REPEAT = "repeat"
    STOP = "stop"
    RECOVERY = "recovery"
    SETUP = "setup"
    """A frame that sets the car up, queries it, or keeps its link alive. It is no motion and no stop."""
    SHUTDOWN = "shutdown"


class Level(StrEnum):
    """The severity of a log record."""

    DEBUG = "debug"
    INFO = "info"
    WARNING = "warning"
    ERROR = "error"


# ------------------------------------------------------------------ processes


class RecorderVerb(StrEnum):
    """A command under `<fleet>/@recorder/@cmd/`. The payload of `mark` is JSON with `text` and `by`."""

    START = "start"
    STOP = "stop"
    STATUS = "status"
    MARK = "mark"


class RecorderState(StrEnum):
    """The state of the recorder."""

    RECORDING = "recording"
    CLOSED = "closed"
    FULL = "full"
    FAILED = "failed"
    STOPPED = "stopped"


class PinCause(StrEnum):
    """Why a time of a recording is pinned. The quota removes pinned times last, while they fit into half of it."""

    CONDITION = "condition"
    """A condition of the fleet file."""
    ESTOP = "estop"
    STOP_ALL = "stop_all"
    NOT_SHOWN = "not_shown"
    """A stop that the car did not show, or that did not reach it."""
    MARK = "mark"


class ProcessKind(StrEnum):
    """The kind of a process."""

    HUB = "hub"
    SIMULATOR = "simulator"
    GATEWAY = "gateway"
    COORDINATOR = "coordinator"
    RECORDER = "recorder"
    CONSOLE = "console"


class RunState(StrEnum):
    """The state of one process. ELSEWHERE: another program does the work of this process."""

    WAITING = "waiting"
    STARTING = "starting"
    RUNNING = "running"
    ENDING = "ending"
    ENDED = "ended"
    REFUSED = "refused"
    ELSEWHERE = "elsewhere"


class LinkVerdict(StrEnum):
    """The kind of a link, by the bytes from it."""

    CAR = "car"
    OTHER = "other"
    SILENT = "silent"
    BUSY = "busy"
    FAILED = "failed"
