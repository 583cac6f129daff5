"""Chooses the stop for the state of a car (`StopContext`), and computes its worst case. Pure: time is an argument.

The worst case is the longest time until the motors are off. `sequences` has the frames.
"""

from typing import Final

from msgspec import Struct

from gateway.drivers.yahboom.pacing import Gate, Pacing
from gateway.drivers.yahboom.protocol.frames import ColorLed
from gateway.drivers.yahboom.protocol.modes import MODES
from gateway.drivers.yahboom.protocol.platforms import Profile, StopStyle
from gateway.drivers.yahboom.protocol.timing import FRAME_S, RECOVERY_SILENCE_S, REPEAT_INTERVAL_S
from gateway.drivers.yahboom.stops import sequences
from gateway.drivers.yahboom.stops.sequences import StopSequence
from schemas.words import Mode, Platform

WIRE_S: Final = 0.02  # docs/reference/protocol.md#stops: 20 ms of wire for a frame of 19 bytes at 960 B/s
AVOIDING_TURN_S: Final = MODES[Mode.OBSTACLE_AVOIDANCE].turn_s
"""Longest turn of obstacle avoidance with an echo; without one, it never ends. A car in an unknown state may be in this
mode, whose turns are the longest."""
RECOVERY_WORST_S: Final = 7.3  # docs/reference/protocol.md#stops: in theory the maximum, except in obstacle avoidance
IN_TIME_S: Final = 0.2
"""Minimum time between writing a frame and the end of a block, so that the frame arrives before the end, unless the
link is slow."""


def style_of(profile: Profile, *, doubted: bool, open_mode: bool) -> StopStyle:
    """Return the kind of stop for a car.

    With `doubted`, its readings contradict its platform. With `open_mode`, they show a mode other than 0. A named frame
    ends the program of some cars (docs/reference/protocol.md#programs-that-people-have). So it is sent only if the
    platform or the readings of the car show that the car understands it.
    """
    if profile.stop_style is StopStyle.GENERAL:
        return StopStyle.BOTH if open_mode else StopStyle.GENERAL
    return StopStyle.BOTH if doubted else profile.stop_style


class StopContext(Struct, frozen=True):
    """The state of the car that decides which stop it needs."""

    profile: Profile
    known: bool
    """True if recovery is complete and no write has failed since."""
    mode: Mode | None
    """The last commanded mode."""
    contradicted: bool
    has_read_all: bool
    """True if the car has read all our frames by the time at which the first frame of the stop can be written."""
    blocked: bool = False
    """True if our last frame is blocking the car in mode 0. The car does not range directly after such a block."""
    doubted: bool = False
    """True if readings contradict the platform, so the car needs a stop that works on any platform."""
    open_mode: bool = False
    """True if readings show a mode other than 0."""
    clearing_color: ColorLed | None = None
    """The color frame to send in a recovery, if the car may hold a string that nothing else clears. It has the last
    color, so that nobody sees a change."""

    @property
    def style(self) -> StopStyle:
        """Return the kind of stop."""
        return style_of(self.profile, doubted=self.doubted, open_mode=self.open_mode)

    @property
    def manual(self) -> bool:
        """Return True if mode 0 was commanded last and is not contradicted."""
        return self.mode is Mode.MANUAL and not self.contradicted

    @property
    def turn_s(self) -> float:
        """Return how many seconds one turn of the mode's loop takes at most. The car reads nothing during a turn.

        If the mode is not known, assume the slowest mode.
        """
        known = self.mode is not None and not self.contradicted
        return self.profile.mode_turn_s(self.mode if known and self.mode is not None else Mode.OBSTACLE_AVOIDANCE)


def recovery(context: StopContext) -> StopSequence:
    """Return the stop that brings a car in an unknown state to rest in mode 0."""
    match context.style:
        case StopStyle.GENERAL:
            return sequences.GENERAL
        case StopStyle.BOTH:
            return sequences.BOTH
        case StopStyle.MODE_FRAME | StopStyle.TIMER:
            return sequences.RECOVERY if context.clearing_color is None else sequences.clearing(context.clearing_color)


def full(context: StopContext) -> StopSequence:
    """Return the stop that `stop`, `estop` and a shutdown send."""
    style = context.style
    if not context.known or style is StopStyle.GENERAL:
        return recovery(context)
    if style is StopStyle.BOTH:
        return sequences.BOTH_MANUAL if context.manual else sequences.BOTH
    if not context.manual:
        return sequences.FULL_MODE
    if style is StopStyle.TIMER:
        return sequences.GENERAL  # `MODE00` would show nothing, and turn the LED off
    return sequences.FULL if context.has_read_all else sequences.FULL_BEHIND


def soft(context: StopContext) -> StopSequence:
    """Return the stop that ends a drive."""
    if context.style is StopStyle.GENERAL:
        return sequences.GENERAL_SOFT
    if context.known and context.manual and context.style is not StopStyle.BOTH:
        return sequences.SOFT
    return full(context)


def worst_s(sequence: StopSequence, context: StopContext, pacing: Pacing, now: float) -> float:
    """Return the longest time until the motors are off for good, s, for a sequence that begins now."""
    # Add the waits before a frame, the rest of the running block, and the time on the wire
    # (docs/reference/protocol.md#stops). If an unread frame of ours may spoil the first frames, also add the wait until
    # a frame is alone in the buffer.
    flight_s = max(pacing.ready_at(Gate.FLIGHT) - now, 0.0)
    block_s = max(pacing.block_until - now, 0.0)
    ranging_s = FRAME_S if context.blocked else context.profile.mode_turn_s(Mode.MANUAL)
    lost_s = 0.0 if context.has_read_all else REPEAT_INTERVAL_S
    if sequence in (sequences.FULL, sequences.FULL_MODE):
        alone_s = max(pacing.buffer_until - now, 0.0)
        if not context.manual and now + alone_s + IN_TIME_S < pacing.earliest_block_end:
            return block_s + WIRE_S  # the car reads `MODE00` when the mode has opened, before the mode's first turn
        if not context.manual:
            return max(alone_s, block_s) + context.turn_s + WIRE_S
        return max(alone_s + ranging_s, block_s + FRAME_S) + WIRE_S
    if sequence.is_recovery and context.style is StopStyle.TIMER:
        return sequence.steps[1].after_s + FRAME_S + WIRE_S  # nothing blocks this car
    if sequence.is_recovery:
        return RECOVERY_WORST_S + AVOIDING_TURN_S
    if sequence is sequences.BOTH:
        # Even if the first frames merge with a partial frame and open a mode, the second half of the sequence closes
        # it.
        return RECOVERY_SILENCE_S + AVOIDING_TURN_S + WIRE_S
    if sequence is sequences.GENERAL and not context.known and context.profile.kind is not Platform.RASPBERRY_PI:
        lost_s = REPEAT_INTERVAL_S  # the first two frames are lost if the car has half a frame in its buffer
        return flight_s + FRAME_S + lost_s + ranging_s + WIRE_S
    begins_with_one = sequence in (sequences.SOFT, sequences.FULL_BEHIND) or (context.has_read_all and context.known)
    second_s = 0.0 if begins_with_one else FRAME_S  # of two frames, the car may read only the second
    if context.has_read_all:
        return max(flight_s + second_s + ranging_s, block_s + FRAME_S) + WIRE_S
    return max(flight_s + second_s + lost_s, block_s) + ranging_s + WIRE_S
