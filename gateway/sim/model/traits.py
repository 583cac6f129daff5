"""The traits in which cars with one program differ. Pure.

Public programs of one family differ in how often they report, in what blocks them and in what they print. A trait is a
parameter of a simulated car, so that each of these cars can be tried.
"""

from typing import Final

from msgspec import Struct

from schemas.words import Mode

# For a ranging at 120 cm, at which the intervals of real cars were measured: 4 ms, plus the time of the sound.
ECHO_RANGING_S: Final = 0.011
"""Time of one ranging with an echo, which is part of the interval between two reports."""

# Measured: 1.69 s in tracking, 1.6 s in light seeking. Assumed in following.
SIM_FIRST_READING_S: Final = 1.62
"""Time from the end of the opening of a mode until the program prints in it. The motors run meanwhile."""


class CarTraits(Struct, frozen=True):
    """The parameters of one car. The defaults are those of the simulated Arduino car."""

    interval_s: float = 1.254
    """Time from one mode-0 report to the next on the wire, with an echo.

    Without echo, the ranging makes it longer, unless a `timer` sends the reports.
    """
    spread_s: float = 0.0
    """Maximum by which an interval is longer or shorter than `interval_s`."""
    timer: bool = False
    """True if a hardware timer sends the reports, so that no frame delays them."""
    close_s: float = 1.0
    """Time for which `MODEx0` blocks the program."""
    first_reading_s: float = SIM_FIRST_READING_S
    """Time from the end of the opening of a mode to the first reading in it (not of the STM32 program)."""
    last_frame_wins: bool = False
    """True if only the last of several whole frames in the buffer counts. Then a `$` restarts the string."""
    silent_modes: frozenset[Mode] = frozenset()
    """Modes in which this car prints nothing, besides those in which the vendor's Arduino program prints nothing."""
    text: bool = False
    """True if the car prints the line `EXEC:F` after each general frame."""
    readings: bool = True
    """False if the car sends nothing at all."""
    cells: int = 2
    """Number of cells of the battery. Three cells give up to 12.6 V."""
    head: str = "4WD"
    """First word of the frames in both directions."""
    fan_level: bool = False
    """True if place 8 is a level: 1 turns the fan on, 0 turns it off in every general frame."""
    ptz_direct: bool = False
    """True if the servo goes to the angle of a PTZ frame, and not to 180 degrees minus that angle."""
    gray_max: int = 1023
    """Maximum of the grayscale reading."""
    more: str = ""
    """Fields that the program prints at the end of the mode-0 report, such as `TP31.5`. Empty if there are none."""
    constants: bool = False
    """True if the mode-0 report has constants in place of line, obstacle, light and grayscale."""

    @property
    def loop_s(self) -> float:
        """Loop time between two reports, without the ranging."""
        return max(0.0, self.interval_s - ECHO_RANGING_S)
