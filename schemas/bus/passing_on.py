"""Asks whether a hub with certificates passes on what a session says.

The rules of a hub are silent. Whoever was revoked is still linked, and hears and reaches nothing. So we look for
something that only we can have said: the token of our own session, asked for over a second one. That is not a command,
and every identity that a rule knows may have and see a token.
"""

import time
from typing import Final

import zenoh

from schemas.bus.credentials import NoCredentials
from schemas.bus.errors import BusError
from schemas.bus.zenoh_session import Bus

_TOKEN_POLL_S: Final = 0.1


def passes_on(bus: Bus, token: str, within_s: float) -> bool | None:
    """Return True if the hub passes on this token of the session, and False if it passes it on to nobody.

    Return None if that is not known: a session has no link now. Blocks for `within_s`, s, and the opening of a session.
    """
    try:
        until = time.monotonic() + within_s
        with Bus.open(bus.endpoint, identity=bus.identity) as second:
            while True:
                if second.tokens(token, within_s):
                    return True
                if not bus.connected or not second.connected:
                    return None
                if time.monotonic() >= until:
                    return False
                time.sleep(_TOKEN_POLL_S)
    except NoCredentials:  # it was revoked on this computer
        return False
    except (BusError, zenoh.ZError):
        return None
