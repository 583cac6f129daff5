"""The buttons of the infrared remote and their motions.

docs/reference/protocol.md#modes says that only a car in mode 1 obeys. It does not list the buttons, so the buttons here
are the motions and the speed steps of the general frame.
"""

from enum import StrEnum
from typing import Final


class Button(StrEnum):
    """A button. A motion lasts until the next button."""

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
