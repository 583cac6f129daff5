"""Random bytes from a car, in random pieces, and the rules of the decoder."""

import random

from gateway.control.driver import Echo, Rejected
from gateway.drivers.yahboom.protocol.frame_splitter import FrameSplitter
from gateway.drivers.yahboom.protocol.sensors import Sensors
from tests.fuzz.controller import MANUAL, READINGS

FRESH = 2_000
"""Number of pieces until a new decoder takes over, as after a new connection."""


def piece(moments: random.Random) -> bytes:
    """Return the bytes of one read from the link."""
    chance = moments.randrange(12)
    if chance == 0:
        return moments.randbytes(moments.randrange(40))
    if chance == 1:
        return bytes(moments.choices(b"$#,4WDCSBPVGM0123456789.-", k=moments.randrange(30)))
    if chance == 2:
        return b"$" + b"x" * moments.randrange(600)
    frame = moments.choice(READINGS)
    if chance < 6:
        start = moments.randrange(len(frame))
        return frame[start : moments.randrange(start, len(frame)) + 1]
    if chance == 6:
        place = moments.randrange(len(frame))
        return frame[:place] + moments.randbytes(1) + frame[place + 1 :]
    return frame


def run(seed: int, pieces: int) -> int:
    """Feed `pieces` pieces. Return the number of events that they made."""
    moments = random.Random(seed)
    decoder, now, made = FrameSplitter(), 0.0, 0
    for number in range(pieces):
        try:
            now += moments.choice((0.0, 0.0, 0.001, 0.02, 0.049, 0.051, 3.0, 1e6 if number % 5000 == 0 else 0.5))
            if moments.random() < 0.05:
                decoder.sends(moments.choice((b"$4WD,MODE00#", b"#", READINGS[3])), now)
            events = decoder.flush(now) if moments.random() < 0.3 else []
            events += decoder.feed(piece(moments), now)
            for event in events:
                assert 0 < len(event.raw) <= 256
                assert event.at <= now
            made += len(events)
            assert len(decoder._buffer) <= 256
            assert len(decoder._sent) <= 256
            if number % FRESH == FRESH - 1:
                # Whatever the decoder has buffered, the second good frame after a silence decodes.
                decoder.sends(b"#", now - 10.0)
                event = decoder.feed(b"#\r\n" + MANUAL + MANUAL, now + 10.0)[-1]
                assert isinstance(event, Sensors)
                assert event.raw == MANUAL
                assert all(isinstance(event, Sensors | Rejected | Echo) or event.raw for event in decoder.end())
                decoder = FrameSplitter()
        except Exception as error:
            error.add_note(f"seed {seed}, piece {number}")
            raise
    return made
