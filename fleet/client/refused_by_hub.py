"""Tells whether a hub with certificates refuses us, which looks as if no car were connected."""

from typing import Final

from fleet.client.client import Fleet
from schemas import keys
from schemas.bus.passing_on import passes_on

_LOOK_S: Final = 1.5
"""Time for which the token is looked for: a hub whose rules have changed has everybody back after half a second."""


def why_refused(client: Fleet) -> str:
    """Return why the hub refuses everything to this client. Empty if it does not, or has no certificates."""
    identity = client.bus.identity
    if not identity:
        return ""
    token = keys.operator_token(client.name, client.sender)
    if passes_on(client.bus, token, _LOOK_S) is not False:
        return ""
    return (
        f"The hub refuses this certificate of {identity}: it was revoked. "
        "`fleet hub invite` on the hub's computer and `fleet join` here make another one. "
        "Cars may be there: to stop one, ask somebody else, or go to it."
    )
