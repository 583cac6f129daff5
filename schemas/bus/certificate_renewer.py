"""Renews the certificate of a session in time, and makes the session use the new one.

Each program has such a keeper for its session, so a certificate is also renewed on a computer on which only commands
run. If another program with the same identity has renewed it first, the new certificate is read from the file.
"""

import sys
import threading
from collections.abc import Callable
from datetime import UTC, datetime, timedelta
from typing import Final

from schemas.bus.certificate_dates import CertificateDates
from schemas.bus.credentials import Credentials
from schemas.bus.errors import BusError

CHECK_INTERVAL: Final = timedelta(minutes=10)
"""Maximum interval at which a program looks at its certificate, and at which it repeats a failed renewal."""
SHORTEST_CHECK_INTERVAL: Final = timedelta(seconds=1)
SHARE_OF_A_CHECK: Final = 0.1
"""Interval of the checks as a share of the time that the certificate has left, if that is shorter than
CHECK_INTERVAL."""
WARNED_SHARE: Final = 0.1
"""Share of a certificate's life that is left when a program warns that nobody has renewed it."""
RENEWAL_QUERY_TIMEOUT_S: Final = 10.0
"""Timeout of a request to the hub, which starts a process to sign the certificate."""
REOPEN_DELAY_S: Final = 5.0
"""Time until a session uses the new certificate. Most commands have ended by then, and need not reopen their
session."""


class CertificateKeeper(threading.Thread):
    """A thread beside one session. It ends when `closing` is set."""

    def __init__(
        self,
        credentials: Credentials,
        identity: str,
        *,
        ask: Callable[[bytes, float], bytes],
        reopen: Callable[[], object],
        closing: threading.Event,
        clock: Callable[[], datetime] = lambda: datetime.now(UTC),
    ) -> None:
        """Begin with the certificate that is in the file now. `ask` and `reopen` are functions of the session."""
        super().__init__(name="bus-certificate", daemon=True)
        self._credentials = credentials
        self._identity = identity
        self._ask = ask
        self._reopen = reopen
        self._closing = closing
        self._clock = clock
        self._used = credentials.dates(identity)
        self._has_warned = False

    def run(self) -> None:
        """Look at the certificate until the session is closed."""
        wait_s = 0.0
        while not self._closing.wait(wait_s):
            wait_s = self.check()

    def check(self) -> float:
        """Renew the certificate if it is due, or use a new one. Return the time in s until the next check."""
        now = self._clock()
        found = self._credentials.dates(self._identity)
        if found is None or self._used is None:
            return CHECK_INTERVAL.total_seconds()
        if found.ends > self._used.ends:
            try:
                self._reopen()
                self._used = found
            except BusError:
                return REOPEN_DELAY_S
        elif found.is_due(now):
            why = self._renew(now)
            if not why:
                return min(REOPEN_DELAY_S, (found.ends - now).total_seconds() * SHARE_OF_A_CHECK)
            self._warn(found, now, why)
        left = (found.ends - now) * SHARE_OF_A_CHECK
        return max(SHORTEST_CHECK_INTERVAL, min(CHECK_INTERVAL, left)).total_seconds()

    def _renew(self, now: datetime) -> str:
        """Fetch and store the next certificate. Return why that failed, or an empty text if it is stored."""
        me = self._identity
        return renew_file(self._credentials, me, me, now, lambda _, asked: self._ask(asked, RENEWAL_QUERY_TIMEOUT_S))

    def _warn(self, found: CertificateDates, now: datetime, why: str) -> None:
        if not self._has_warned and found.ends - now < (found.ends - found.begins) * WARNED_SHARE:
            self._has_warned = True
            sys.stderr.write(
                f"The certificate of {self._identity} ends on {found.ends:%Y-%m-%d}, and the hub has not renewed it: "
                f"{why}. After that it cannot even stop a car. `fleet hub invite` on the hub's computer and "
                "`fleet join` here renew it, too.\n"
            )


def renew_file(
    credentials: Credentials, identity: str, file: str, now: datetime, ask: Callable[[str, bytes], bytes]
) -> str:
    """Fetch and store the next certificate of an identity. Return why that failed, or an empty text if it is stored.

    Without `identity`, use the one in the certificate. `file` is the name of the certificate's file. `ask` sends an
    identity and its request to the hub, and returns the answer.
    """
    try:
        from schemas.bus import certificate_request  # cryptography takes a while to load

        name = identity or certificate_request.identity_in(credentials.directory / f"{file}.pem")
        return certificate_request.renew(credentials, name, file, now, lambda request: ask(name, request))
    except ImportError:
        return "the package cryptography is missing here: pip install 'zenoh-car-fleet[secure]'"
    except (OSError, ValueError) as error:
        return f"it cannot be read or stored: {error}"
