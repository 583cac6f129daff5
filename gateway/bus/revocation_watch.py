"""Notices that the hub passes nothing on for this gateway: then nobody can command its car, or stop it.

Rules change with a restart of the hub. So it is enough to look after each new link to a hub. A hub that has just
started passes things on late, and a network may lose them, so one look proves nothing.
"""

import asyncio
from collections.abc import Callable
from typing import Final

from schemas.bus import Bus
from schemas.bus.passing_on import passes_on

TOKEN_LOOK_INTERVAL_S: Final = 1.0
TOKEN_LOOK_S: Final = 3.0
"""Time for which one look waits for the token. Where each way takes 100 ms and loses 5 %, it takes up to 1.5 s."""
LOOKS: Final = 3
"""Number of looks in a row that find nothing until the gateway takes its certificate for revoked: about 12 s."""


class RevocationWatch:
    """Looks for the gateway's own token after each new link to a hub with certificates."""

    def __init__(self, opened: Bus, token: str) -> None:
        self._bus = opened
        self._token = token

    async def run(self, on_revoked: Callable[[], object]) -> None:
        """Call `on_revoked` once for each link over which nothing is passed on. Runs until it is cancelled."""
        checked: tuple[str, ...] = ()
        silences = 0
        while True:
            await asyncio.sleep(TOKEN_LOOK_INTERVAL_S)
            hubs = self._bus.hubs
            if not hubs or hubs == checked:
                continue
            found = await asyncio.to_thread(passes_on, self._bus, self._token, TOKEN_LOOK_S)
            silences = silences + 1 if found is False and self._bus.hubs == hubs else 0
            if silences == LOOKS:
                on_revoked()
            if found or silences == LOOKS:
                checked, silences = hubs, 0
