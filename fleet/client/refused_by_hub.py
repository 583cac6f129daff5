"""Tells whether a hub with certificates refuses us, which looks as if no car were connected.

The rules of a hub are silent. Whoever was revoked is still linked, and hears and reaches nothing. So we look for
something that only we can have said: the token of our own client, asked for over a second session. It is not a command,
and every identity that a rule knows may have and see one.
"""

import time
from contextlib import suppress
from typing import Final

import zenoh

from fleet.client.client import Fleet
from schemas import keys
from schemas.bus import Bus, BusError

_LOOK_S: Final = 1.5
"""Time for which the token is looked for: a hub whose rules have changed has everybody back after half a second."""
_TOKEN_POLL_S: Final = 0.1


def why_refused(client: Fleet) -> str:
    """Return why the hub refuses everything to this client. Empty if it does not, or has no certificates."""
    identity = client.bus.identity
    if not identity:
        return ""
    token = keys.operator_token(client.name, client.sender)
    until = time.monotonic() + _LOOK_S
    with suppress(BusError, zenoh.ZError), Bus.open(client.bus.endpoint, identity=identity) as second:
        while True:
            if second.tokens(token, _LOOK_S) or not client.bus.connected:
                return ""
            if time.monotonic() >= until:
                return (
                    f"The hub refuses this certificate of {identity}: it was revoked. "
                    "`fleet hub invite` on the hub's computer and `fleet join` here make another one. "
                    "Cars may be there: to stop one, ask somebody else, or go to it."
                )
            time.sleep(_TOKEN_POLL_S)
    return ""
