"""The hub's part in the renewal of certificates. The hub routes; another process signs (fleet/hub/renewals.py).

So the hub need not load a library of cryptography, nor hold the key of the authority. It also renews its own
certificate. The hub of another site has no authority, so it asks the first hub, as all others do.
"""

import queue
import subprocess
import sys
import threading
from contextlib import suppress
from datetime import UTC, datetime
from typing import Final

import zenoh

from schemas import keys
from schemas.bus.certificate_renewer import RENEWAL_QUERY_TIMEOUT_S, renew_file
from schemas.bus.credentials import HUB, Credentials
from schemas.bus.endpoint import is_secure
from schemas.bus.replies import BUSY

MAX_RENEWAL_BYTES: Final = 16_384
MAX_QUEUED_RENEWALS: Final = 16
"""Maximum requests that wait for a certificate. Further ones are refused as busy, and repeated later."""
OWN_CHECK_INTERVAL_S: Final = 600.0
FIRST_OWN_CHECK_S: Final = 10.0
"""Delay of the second check of the hub's own certificate. At the first check, the hub of another site is not yet linked
to the first hub."""
SIGN_TIMEOUT_S: Final = 10.0


class HubRenewals:
    """Answers renewal queries in one session of a hub, one at a time, on a thread. Close it before the session."""

    def __init__(self, endpoint: str, session: zenoh.Session) -> None:
        self._endpoint = endpoint
        self._session = session
        self._queue: queue.Queue[zenoh.Query | None] = queue.Queue(MAX_QUEUED_RENEWALS)
        self._thread: threading.Thread | None = None
        if not is_secure(endpoint):
            return
        self._credentials = Credentials.of(endpoint)
        if not self._credentials.first_hubs:
            session.declare_queryable(keys.renewal_key("*"), self._on_query)
        self._thread = threading.Thread(target=self._run, name="hub-renewals", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """End the thread, after it has finished a certificate that it is making."""
        if self._thread is not None:
            with suppress(queue.Full):
                self._queue.put(None, timeout=SIGN_TIMEOUT_S)
            self._thread.join(SIGN_TIMEOUT_S)

    def _on_query(self, query: zenoh.Query) -> None:
        payload = query.payload
        if payload is None or len(payload) > MAX_RENEWAL_BYTES:
            with query:
                query.reply_err("it is not a request for a certificate")
            return
        try:
            self._queue.put_nowait(query)
        except queue.Full:
            with query:
                query.reply_err(BUSY)

    def _run(self) -> None:
        interval_s = FIRST_OWN_CHECK_S
        while True:
            with suppress(OSError, subprocess.SubprocessError):
                self._renew_own()
            try:
                query = self._queue.get(timeout=interval_s)
            except queue.Empty:
                interval_s = OWN_CHECK_INTERVAL_S
                continue
            if query is None:
                return
            self._answer(query)

    def _answer(self, query: zenoh.Query) -> None:
        """Answer one query with a certificate, or with an error. The hub's rules prove the identity in the key."""
        identity = str(query.key_expr).rpartition("/")[2]
        with query:
            assert query.payload is not None
            try:
                made = self._sign(query.payload.to_bytes(), "--identity", identity)
            except (OSError, subprocess.SubprocessError) as error:
                query.reply_err(f"the hub cannot sign: {error}")
                return
            if made.returncode:
                query.reply_err(made.stderr)
            else:
                query.reply(keys.renewal_key(identity), made.stdout)

    def _sign(self, request: bytes, *more: str) -> "subprocess.CompletedProcess[bytes]":
        command = [sys.executable, "-m", "fleet.hub.renewals", "--endpoint", self._endpoint, *more]
        return subprocess.run(command, input=request, capture_output=True, timeout=SIGN_TIMEOUT_S, check=False)

    def _renew_own(self) -> None:
        """Renew the hub's own certificate if it is due. The hub notices the new file, and opens a new session."""
        now, dates = datetime.now(UTC), self._credentials.dates(HUB)
        if dates is None or not dates.is_due(now):
            return
        if not self._credentials.first_hubs:
            self._sign(b"")
            return
        renew_file(self._credentials, "", HUB, now, self._ask)

    def _ask(self, identity: str, request: bytes) -> bytes:
        replies = self._session.get(keys.renewal_key(identity), payload=request, timeout=RENEWAL_QUERY_TIMEOUT_S)
        return next((reply.ok.payload.to_bytes() for reply in replies if reply.ok is not None), b"")
