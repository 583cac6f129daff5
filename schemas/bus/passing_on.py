"""Finds out whether a hub with certificates passes on the messages of a session.

A hub applies its rules without telling anybody. So a program whose certificate was revoked is still linked, but no
message of it arrives anywhere, and it receives none. This module therefore looks for something that only this session
can have published: its own token. It asks for the token over a second session. Such a question is no command, and every
identity that a rule knows may declare and see tokens.
"""

import time
from typing import Final

import zenoh

from schemas.bus.credentials import NoCredentials
from schemas.bus.errors import BusError
from schemas.bus.zenoh_session import Bus

_TOKEN_POLL_S: Final = 0.1


def passes_on(bus: Bus, token: str, within_s: float) -> bool | None:
    """Return True if the hub passes on this token of the session, and False if it does not.

    Return None if this is unknown, because one of the two sessions has no link now. Blocks for the opening of a session
    and for about `within_s`.
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
    except NoCredentials:  # the certificate is no longer valid on this computer
        return False
    except (BusError, zenoh.ZError):
        return None
