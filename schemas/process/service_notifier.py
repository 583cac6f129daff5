"""Tells systemd that a service is up, and that its loop still runs (sd_notify(3)). Without systemd it does nothing."""

import os
import socket
from collections.abc import Mapping
from contextlib import suppress
from math import inf
from typing import Final

NOTIFY_SOCKET: Final = "NOTIFY_SOCKET"
WATCHDOG_USEC: Final = "WATCHDOG_USEC"
WATCHDOG_PID: Final = "WATCHDOG_PID"
FEEDS_PER_WATCHDOG: Final = 4
"""Number of messages within the watchdog's timeout. systemd asks for two. With four, one turn of the loop may take
three quarters of the timeout."""
READY_RETRY_S: Final = 1.0
"""Maximum delay before a message that could not be sent is repeated. Without `READY=1`, systemd ends the service after
its TimeoutStartSec (90 s)."""


class ServiceNotifier:
    """Sends `READY=1` with the first `feed`, and `WATCHDOG=1` while `feed` is called. Times: s, of one clock."""

    def __init__(self, environment: Mapping[str, str] = os.environ, pid: int | None = None) -> None:
        self._socket: socket.socket | None = None
        self._interval_s = inf
        self.due_at = inf
        """When `feed` has to be called next. Infinite if there is nothing to tell systemd."""
        address = environment.get(NOTIFY_SOCKET, "")
        if not address.startswith(("/", "@")) or not hasattr(socket, "AF_UNIX"):
            return
        self._address = f"\0{address[1:]}" if address[0] == "@" else address
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
        self._socket.settimeout(0)  # a full queue must not hold up the loop
        self.due_at = -inf
        # A child process inherits the variables, but systemd does not watch it, so compare the process ids.
        watched, usec = environment.get(WATCHDOG_PID, ""), environment.get(WATCHDOG_USEC, "")
        if usec.isdecimal() and int(usec) > 0 and watched in ("", str(os.getpid() if pid is None else pid)):
            self._interval_s = int(usec) / 1e6 / FEEDS_PER_WATCHDOG
        self._message = b"READY=1\nWATCHDOG=1"

    def feed(self, now: float) -> None:
        """Tell systemd that the loop is running, if a message is due."""
        if self._socket is None or now < self.due_at:
            return
        self.due_at = now + min(self._interval_s, READY_RETRY_S)  # in case the message cannot be sent
        with suppress(OSError):  # systemd restarts, or its queue is full: the next message follows soon
            self._socket.sendto(self._message, self._address)
            self._message = b"WATCHDOG=1"
            self.due_at = now + self._interval_s

    def close(self) -> None:
        """Close the socket."""
        if self._socket is not None:
            self._socket.close()
            self._socket = None
