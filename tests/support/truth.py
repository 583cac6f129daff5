"""Worlds for a car, and ways to make its true mode differ from the commanded one. The simulated car judges."""

import random
from collections.abc import Callable

from gateway.control.commands import SetMode
from gateway.drivers.yahboom.protocol.frames import ModeClose, ModeOpen, encode
from gateway.sim.model.objects import Lamp
from gateway.sim.model.world import World
from schemas.geometry import Segment
from schemas.words import Mode
from tests.support.virtual import Pair


def near_walls() -> World:
    """Return a cupboard with a lamp: a wall is near in every direction."""
    return World((*_box(1.0), *_box(3.0)), (), (Lamp(0.3, 0.1),))


def _box(metres: float) -> tuple[Segment, ...]:
    h = metres / 2
    return ((-h, -h, h, -h), (h, -h, h, h), (h, h, -h, h), (-h, h, -h, -h))


RENEWED_S = 26.0
"""Time after which control no longer repeats `MODE00` to a car that has not shown that it is at rest."""
WORLDS: dict[str, Callable[[], World]] = {"room": World.room, "no-echo": World.open_field, "near-walls": near_walls}


def frame_of(mode: Mode) -> bytes:
    """Return the frame that brings a car into a mode."""
    return encode(ModeClose() if mode is Mode.MANUAL else ModeOpen(mode))


def car_in(mode: Mode, world: str, *, seed: int, platform: str = "arduino") -> Pair:
    """Return a car that has been in a mode for a while, with no frame of control pending.

    A car that has not shown that it is at rest first gets repeats of `MODE00`, which would end the mode.
    """
    moments = random.Random(seed)
    pair = Pair(platform, seed=seed, world=WORLDS[world](), start_s=1.0 + moments.random()).ready()
    if mode is not Mode.MANUAL:
        pair.run(2.0 * moments.random())
        pair.ask(SetMode(mode))
        pair.until(lambda: pair.car.truth.mode is mode, 8.0)
        pair.run(6.0)
    elif pair.control.driver.model.basis != "shown":
        pair.run(RENEWED_S)
    pair.run(2.0 * moments.random())
    return pair


def lose_next_mode_frame(pair: Pair) -> list[float]:
    """Lose control's next mode frame. The returned list then has the time of its write."""
    feed = pair.car.feed
    lost: list[float] = []

    def lossy(data: bytes, now: float) -> None:
        if b"MODE" in data and not lost:
            lost.append(now)
        else:
            feed(data, now)

    pair.car.feed = lossy  # type: ignore[method-assign]  # the wire between the two has no other handle
    return lost
