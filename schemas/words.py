"""The closed sets of words: whatever a field of a message, a key or a file names by one of a few words. Pure.

A word has the same spelling in messages, files, commands and code. What a word is on a car's wire is in
`gateway.protocol`. Messages hold words as text, so another version's word never breaks a reader.
"""

from enum import StrEnum


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
    """A mode of the car's program. In `MANUAL` its driver steers; in the others it moves by itself or only shines."""

    MANUAL = "manual"
    REMOTE_CONTROL = "remote_control"
    TRACKING = "tracking"
    OBSTACLE_AVOIDANCE = "obstacle_avoidance"
    COLOR_LED = "color_led"
    LIGHT_SEEKING = "light_seeking"
    FOLLOWING = "following"


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


class Cause(StrEnum):
    """Why bytes are not a reading (docs/reference/protocol.md#bad-input)."""

    NO_START = "no_start"
    OVERLONG = "overlong"
    UNKNOWN_WORD = "unknown_word"
    MISSING_WORD = "missing_word"
    BAD_NUMBER = "bad_number"
    OUT_OF_RANGE = "out_of_range"
    TRUNCATED = "truncated"


class Reason(StrEnum):
    """Why a command was rejected or ended early. Answers use no other reasons."""

    BAD_VALUE = "bad_value"
    UNSUPPORTED = "unsupported"
    WRONG_MODE = "wrong_mode"
    LEASED = "leased"
    LENT = "lent"
    """The car is lent to another person."""
    NOT_ALLOWED = "not_allowed"
    """The people table does not allow it to this sender."""
    PAUSED = "paused"
    HELD = "held"
    ESTOPPED = "estopped"
    BATTERY_LOW = "battery_low"
    LINK_DOWN = "link_down"
    WRITE_FAILED = "write_failed"
    QUEUE_FULL = "queue_full"
    EXPIRED = "expired"
    SUPERSEDED = "superseded"
    DUPLICATE = "duplicate"
    STALE = "stale"
    NOT_SHOWN = "not_shown"
    """The car could have shown the stop and did not."""


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


class Rank(StrEnum):
    """The kind of a sender, which is its rank. Each outranks those below it."""

    LEAD = "lead"
    """A person whom the people table of the gateway names as a lead. No command may claim it."""
    PERSON = "person"
    SCRIPT = "script"
    COORDINATOR = "coordinator"
