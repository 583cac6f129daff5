"""Finds out whether a hub with certificates refuses us. To the client, this looks as if no car were connected."""

from typing import Final

from fleet.client.client import Fleet
from schemas import keys
from schemas.bus.passing_on import passes_on
from schemas.identity import IdentityRole, role_of

_LOOK_S: Final = 1.5
"""Time to look for our token. After a change of its rules, a hub has everybody connected again within half a second."""


def why_refused(client: Fleet) -> str:
    """Return why the hub refuses everything to this client. Empty if the hub does not, or has no certificates."""
    identity = client.bus.identity
    if not identity:
        return ""
    token = keys.operator_token(client.name, client.sender)
    if role_of(identity) is IdentityRole.CAR:
        # The hub passes on a car's token only under the name of the car, and the sender is the user of its computer.
        token = keys.operator_token(client.name, f"{identity.partition('.')[2]}@{client.sender.partition('@')[2]}")
        client.bus.token(token)
    if passes_on(client.bus, token, _LOOK_S) is not False:
        return ""
    return (
        f"The hub refuses this certificate of {identity}: it was revoked. "
        "`fleet hub invite` on the hub's computer and `fleet join` here make another one. "
        "Cars may be there: to stop one, ask somebody else, or go to it."
    )
