"""Repeats the stop of a car that counts as stopped but has not shown it: its frames may have been lost. Pure.

Each repeat is called a renewal.
"""

from typing import Final

from gateway.drivers.yahboom.car_model import CarModel
from gateway.drivers.yahboom.pacing import Gate
from gateway.drivers.yahboom.protocol.frames import Frame, ModeClose
from gateway.drivers.yahboom.protocol.timing import REPEAT_INTERVAL_S
from gateway.drivers.yahboom.stops.sequences import STOP_FRAME
from gateway.drivers.yahboom.stops.stop_in_progress import HELD_UP_S

RENEWAL_INTERVALS_S: Final = (2.2, 4.0, 6.0)
"""Intervals between renewals. The last one repeats."""
CLEARING_RENEWALS: Final = 4
"""Maximum renewals by `MODE00` after one stop. `MODE00` clears half a frame from the car's buffer, but also beeps."""


class StopRenewal:
    """The schedule of the renewals, and their frames."""

    def __init__(self, model: CarModel) -> None:
        self.left_mode = False
        """True if the last stop had to end a mode. A car that is still in the mode ignores general stops."""
        self._model = model
        self._count = 0
        self._next_at = float("inf")
        self._cleared_at = float("-inf")
        """When the last renewal began."""
        self._general_stop_follows = False
        """True if the last renewal was a `MODE00`. A car without modes ignores it, so a general stop must follow."""

    def suspend(self) -> None:
        """Send no more renewals until the next `schedule`."""
        self._next_at = float("inf")

    def reset(self) -> None:
        """Suspend the renewals, and begin with the shortest interval next time."""
        self._count = 0
        self.suspend()

    def restart(self, now: float) -> None:
        """Schedule the first renewal after a stop."""
        self._count, self._general_stop_follows = 0, False
        self.schedule(now)

    def schedule(self, now: float) -> None:
        """Schedule the next renewal."""
        self._next_at = now + RENEWAL_INTERVALS_S[min(self._count, len(RENEWAL_INTERVALS_S) - 1)]
        self._count += 1

    @property
    def due_at(self) -> float:
        """Return when the next frame of a renewal is due, or inf if never."""
        if self._general_stop_follows:
            return self._model.pacing.written_at + REPEAT_INTERVAL_S
        # `MODE00` must not reach the car together with a servo frame before it. The car would read both as one string,
        # take the digits of the servo frame for those of the mode, and open a mode. And without an echo the car may
        # read the frame before while this one arrives: it would take the rest of this one for a motion.
        is_alone = self._clears or self._model.is_without_echo
        return max(self._next_at, self._model.pacing.ready_at(Gate.ALONE)) if is_alone else self._next_at

    @property
    def goes_first_at(self) -> float:
        """Return when the next frame of a renewal goes before a stream of actions, or inf if never."""
        follows_at = self._cleared_at + REPEAT_INTERVAL_S
        return (follows_at if self._general_stop_follows else self._next_at) + HELD_UP_S

    @property
    def is_full_stop(self) -> bool:
        """Return True if the whole stop must be sent again, because the car may still be in the mode."""
        return not self._general_stop_follows and self._model.rest_case.renews_whole and self.left_mode

    def next_frame(self, now: float) -> Frame:
        """Return the frame that is due, and schedule the next one."""
        if self._general_stop_follows:
            self._general_stop_follows = False
            return STOP_FRAME
        self._general_stop_follows = self._clears
        self._cleared_at = now
        self.schedule(now)
        return ModeClose() if self._general_stop_follows else STOP_FRAME

    @property
    def _clears(self) -> bool:
        """Return True if the next renewal is a `MODE00`.

        A car that holds half a named frame ignores a general stop (docs/reference/protocol.md#hazards). `MODE00` clears
        that half.
        """
        model = self._model
        if model.profile.refusal(ModeClose()) is not None:
            return False  # the programs of some cars end with an error at a named frame
        return model.rest_case.clears and self._count <= CLEARING_RENEWALS
