"""The one table of commands: verb, message, description, text of the outcome, wildcard, maximum age, limits. Pure."""

from collections.abc import Mapping
from enum import StrEnum
from types import MappingProxyType
from typing import Final, NamedTuple


class Verb(StrEnum):
    """The kind of a command. `COMMANDS` has a row for each."""

    DRIVE = "drive"
    MODE = "mode"
    LED = "led"
    LIGHT = "light"
    SERVO = "servo"
    ARM = "arm"
    WHISTLE = "whistle"
    SPEED = "speed"
    FAN = "fan"
    STOP = "stop"
    ESTOP = "estop"
    RESUME = "resume"
    PAUSE = "pause"
    UNPAUSE = "unpause"
    LEND = "lend"
    LEASE = "lease"
    FIND = "find"


class CommandType(NamedTuple):
    """One row: a command under `<fleet>/<car>/@cmd/<verb>`."""

    verb: Verb
    about: str
    effect: str = ""
    """Text of the outcome when the frames of the command were sent. Empty if `outcome_words` has its texts."""
    ttl_s: float = 2.0
    """Default of the maximum age at arrival (docs/reference/commands.md#payload)."""
    wildcard: bool = False
    """True if one query of the command may address several cars (docs/reference/keys.md#command-keys)."""
    stops: bool = False
    """True if the command needs no payload, and stops the car even if the payload is invalid."""
    max_duration_s: float = 0.0
    """Maximum of the field `duration_s`. 0 if there is none, or if each gateway has a limit of its own."""
    min_duration_s: float = 0.0
    """Minimum of the field `duration_s`. 0 if any duration above 0 is allowed."""
    signal: bool = False
    """True if the car only gives a signal, such as the whistle. The verb and `duration_s` describe it fully, so control
    needs no class for it."""
    subcommand: str = ""
    """The subcommand of `fleet` that is made from this row alone. Its arguments are cars, and `--for` if there is a
    maximum duration. Empty if none is."""
    section: str = ""
    """Heading of the subcommand in `fleet --help`."""

    @property
    def message(self) -> str:
        """The full name of the payload's message."""
        return f"fleet.v1.{self.verb.capitalize()}Command"

    @property
    def summary(self) -> str:
        """The description as a sentence."""
        return f"{self.about[:1].upper()}{self.about[1:]}."


_ROWS: Final = (
    CommandType(
        Verb.DRIVE,
        "hold a motion for `duration_s` (default 0.5 s, at most 10 s unless the gateway has another limit), then stop",
        ttl_s=0.5,
    ),
    CommandType(Verb.MODE, "bring the car into a mode; `manual` closes the open mode", "switching to mode{detail}"),
    CommandType(Verb.LED, "set the color LED: red, green and blue, 0..255 each", "LED color sent"),
    CommandType(Verb.LIGHT, "set the light's color, or `off`", "light{detail} sent"),
    CommandType(Verb.SERVO, "turn a servo (`action`), or the front servo to `deg` (0..180)", "servo movement sent"),
    CommandType(Verb.ARM, "move the six joints of the arm, 0..180 degrees each (option `+arm`)", "arm joints sent"),
    CommandType(
        Verb.WHISTLE,
        "sound the whistle once",
        "whistle sent",
        signal=True,
        subcommand="whistle",
        section="Lights and parts",
    ),
    CommandType(
        Verb.SPEED,
        "change the speed by one step, `up` or `down`: cars have no absolute speed",
        "speed step{detail} sent",
    ),
    CommandType(Verb.FAN, "toggle the fan; `on` and `off` work only while its state is known", "fan{detail} sent"),
    CommandType(Verb.STOP, "stop the car, and keep the coordinator from moving it (a hold)", wildcard=True, stops=True),
    CommandType(
        Verb.ESTOP,
        "stop the car, and reject everything until a resume with the id of this e-stop; `scope` is car or fleet",
        wildcard=True,
        stops=True,
    ),
    CommandType(Verb.RESUME, "end the e-stops of these ids; without ids, the hold; `all` ends both", wildcard=True),
    CommandType(
        Verb.PAUSE, "stop the car, and let only leads move the cars of the fleet until `unpause`", wildcard=True
    ),
    CommandType(Verb.UNPAUSE, "end the pause of the fleet; move nothing", "{words}", wildcard=True),
    CommandType(
        Verb.LEND,
        "let only one person drive the car for `duration_s`; `end` ends the loan",
        "{words}",
        max_duration_s=86_400.0,
    ),
    CommandType(Verb.LEASE, "reserve the car for a moment, or release it", "done"),
    CommandType(
        Verb.FIND,
        "blink without moving, and beep if the car can, to show which car is which",
        "blinking sent",
        subcommand="identify",
        section="Drive",
    ),
)

COMMANDS: Final[Mapping[str, CommandType]] = MappingProxyType({row.verb: row for row in _ROWS})
STOPS: Final = tuple(row.verb for row in _ROWS if row.stops)
STOPPING_VERBS: Final = frozenset({*STOPS, Verb.PAUSE})
"""Verbs that stop a car. After some of them, somebody must end the stop before the car may be driven again."""
