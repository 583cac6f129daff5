"""The one table of commands: verb, message, description, whether it takes a wildcard, maximum age. Pure."""

from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Final


@dataclass(frozen=True, slots=True)
class CommandType:
    """One row: a command under `<fleet>/<car>/@cmd/<verb>`."""

    verb: str
    about: str
    ttl_s: float = 2.0
    """Default of the maximum age at arrival (docs/reference/commands.md#payload)."""
    wildcard: bool = False
    """True if one query may address several cars (docs/reference/keys.md#command-keys)."""
    stops: bool = False
    """True if it needs no payload, and stops the car even if the payload is invalid."""

    @property
    def message(self) -> str:
        """The full name of the payload's message."""
        return f"fleet.v1.{self.verb.capitalize()}Command"


_ROWS: Final = (
    CommandType(
        "drive",
        "hold a motion for `duration_s` (0.5 s by default, at most 10 or what its gateway allows), then stop",
        ttl_s=0.5,
    ),
    CommandType("mode", "bring the car into a mode; `manual` closes whatever is open"),
    CommandType("led", "the color LED, 0..255 each"),
    CommandType("light", "the light's color, or `off`"),
    CommandType("servo", "move a servo a step, or the front one to `deg` (0..180)"),
    CommandType("arm", "six joints, 0..180 degrees each (option `+arm`)"),
    CommandType("whistle", "sound once"),
    CommandType("speed", "one step `up` or `down`: cars have no absolute speed"),
    CommandType("fan", "toggle; `on` or `off` while its state is known"),
    CommandType("stop", "stop, and hold the car against the coordinator", wildcard=True, stops=True),
    CommandType(
        "estop",
        "stop, and reject everything until it is resumed by its id; `scope` is car or fleet",
        wildcard=True,
        stops=True,
    ),
    CommandType("resume", "end the e-stops of these ids; without ids, the hold; `all` ends both", wildcard=True),
    CommandType("pause", "stop, and let only leads move the cars of the fleet until `unpause`", wildcard=True),
    CommandType("unpause", "end the pause of the fleet; move nothing", wildcard=True),
    CommandType("lend", "let only one person drive the car for `duration_s`, or `end` that"),
    CommandType("lease", "reserve the car for a moment, or release it"),
    CommandType("find", "blink and beep, without moving"),
)

COMMANDS: Final[Mapping[str, CommandType]] = MappingProxyType({row.verb: row for row in _ROWS})
STOPS: Final = tuple(row.verb for row in _ROWS if row.stops)
