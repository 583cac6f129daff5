"""The infrared remote's buttons, and what each does to a car that is in remote control mode.

docs/reference/protocol.md#modes says who obeys (nobody but a car in mode 1) and not which buttons there are: these
are what the other ways of driving have in common.
"""

from enum import StrEnum
from typing import Final


class Button(StrEnum):
    """A button; a motion holds until another one is pressed."""

    FORWARD = "forward"
    BACK = "back"
    LEFT = "left"
    RIGHT = "right"
    SPIN_LEFT = "spin_left"
    SPIN_RIGHT = "spin_right"
    STOP = "stop"
    WHISTLE = "whistle"
    FASTER = "faster"
    SLOWER = "slower"


SIGNS: Final = {
    Button.FORWARD: (1, 1),
    Button.BACK: (-1, -1),
    Button.LEFT: (0, 1),
    Button.RIGHT: (1, 0),
    Button.SPIN_LEFT: (-1, 1),
    Button.SPIN_RIGHT: (1, -1),
    Button.STOP: (0, 0),
}
"""Sign of the left and the right motor."""
