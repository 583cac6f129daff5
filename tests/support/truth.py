"""Worlds for a car, and ways to make its true mode another than the one that was asked. The simulated car judges."""

import random
from collections.abc import Callable

from gateway.control.commands import SetMode
from gateway.protocol.enums import Mode
from gateway.protocol.frames import ModeClose, ModeOpen, encode
from gateway.sim.model.geometry import Segment
from gateway.sim.model.objects import Lamp
from gateway.sim.model.world import World
from tests.support.virtual import Pair


def near_walls() -> World:
    """A cupboard: whichever way the car looks, a wall is near; a lamp stands in it."""
    return World((*_box(1.0), *_box(3.0)), (), (Lamp(0.3, 0.1),))


def _box(metres: float) -> tuple[Segment, ...]:
    h = metres / 2
    return ((-h, -h, h, -h), (h, -h, h, h), (h, h, -h, h), (-h, h, -h, -h))


RENEWED_S = 26.0
"""The renewals with `MODE00` of a rest that nothing has shown are over."""
WORLDS: dict[str, Callable[[], World]] = {"room": World.room, "no-echo": World.open_field, "near-walls": near_walls}


def frame_of(mode: Mode) -> bytes:
    """The frame that brings a car into a mode."""
    return encode(ModeClose() if mode is Mode.MANUAL else ModeOpen(mode))


def car_in(mode: Mode, world: str, *, seed: int, platform: str = "arduino") -> Pair:
    """A car that was brought to a mode, has been there for a while, and of which nothing else is to be expected.

    A rest that nothing has shown is renewed with `MODE00` at first, which would end another mode.
    """
    moments = random.Random(seed)
    pair = Pair(platform, seed=seed, world=WORLDS[world](), start_s=1.0 + moments.random()).ready()
    if mode is not Mode.MANUAL:
        pair.run(2.0 * moments.random())
        pair.ask(SetMode(mode))
        pair.until(lambda: pair.car.truth.mode is mode, 8.0)
        pair.run(4.0)
    elif pair.control.model.basis != "shown":
        pair.run(RENEWED_S)
    pair.run(2.0 * moments.random())
    return pair


def lose_next_mode_frame(pair: Pair) -> list[float]:
    """The next mode frame of control does not reach the car; the list then has the moment when it was written."""
    feed = pair.car.feed
    lost: list[float] = []

    def lossy(data: bytes, now: float) -> None:
        if b"MODE" in data and not lost:
            lost.append(now)
        else:
            feed(data, now)

    pair.car.feed = lossy  # type: ignore[method-assign]  # the wire between the two has no other handle
    return lost
