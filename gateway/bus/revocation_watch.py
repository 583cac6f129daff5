"""Notices that nobody can command or stop the car of this gateway over a bus with certificates any more.

Its certificate may have ended. Then Zenoh cuts the link, and the hub refuses each new one. So the gateway looks at the
dates while it has no link.

Or the hub no longer passes on messages of this gateway, because it was revoked. The rules of a hub change only with a
restart of the hub. So it is enough to look, after each new link to a hub, whether the hub passes on the gateway's own
token. A hub that has just started passes messages on late, and a network may lose them. So one look that does not find
the token proves nothing.
"""

import asyncio
from collections.abc import Callable
from datetime import UTC, datetime
from typing import Final

from schemas.bus import Bus
from schemas.bus.endpoint import credentials_of
from schemas.bus.passing_on import passes_on

TOKEN_LOOK_INTERVAL_S: Final = 1.0
TOKEN_LOOK_S: Final = 3.0
"""Time for which one look waits for the token. With 100 ms and 5 % loss each way, the token arrives within 1.5 s."""
LOOKS: Final = 3
"""Number of looks in a row without the token after which the certificate counts as revoked. They take about 12 s."""


class LinkChecks:
    """Decides when to look for the token, and when its absence means that the certificate was revoked. Pure."""

    def __init__(self) -> None:
        self._checked = ""
        self._silent = ""
        self._silences = 0

    def is_due(self, link: str) -> bool:
        """Return True while it is not known whether anything is passed on over this link (see `Bus.link`)."""
        return bool(link) and link != self._checked

    def take(self, before: str, after: str, *, found: bool | None) -> bool:
        """Take the links before and after one look, and what it has found. Return True if the certificate is revoked.

        `found` is the result of `passes_on`.
        """
        if found is not False or before != after:
            self._silences = 0
        else:
            self._silences = self._silences + 1 if before == self._silent else 1
            self._silent = before
        revoked = self._silences == LOOKS
        if found or revoked:
            self._checked, self._silences = before, 0
        return revoked


class RevocationWatch:
    """Looks at the certificate while there is no link, and for the gateway's own token after each new link."""

    def __init__(self, opened: Bus, token: str) -> None:
        self._bus = opened
        self._token = token

    async def run(self, on_revoked: Callable[[], object], on_ended: Callable[[datetime], object]) -> None:
        """Watch until cancelled.

        Call `on_revoked` once for each link over which nothing is passed on, and `on_ended` once for each certificate
        that has ended, with the time of its end.
        """
        checks, told = LinkChecks(), None
        while True:
            await asyncio.sleep(TOKEN_LOOK_INTERVAL_S)
            link = self._bus.link
            if not link and (ended := self._ended_at()) is not None and ended != told:
                told = ended
                on_ended(ended)
            if not checks.is_due(link):
                continue
            found = await asyncio.to_thread(passes_on, self._bus, self._token, TOKEN_LOOK_S)
            if checks.take(link, self._bus.link, found=found):
                on_revoked()

    def _ended_at(self) -> datetime | None:
        """Return when the certificate has ended. None if it is still in force, or replaced by a new one."""
        dates = credentials_of(self._bus.endpoint).dates(self._bus.identity)
        return dates.ends if dates is not None and dates.ends <= datetime.now(UTC) else None
