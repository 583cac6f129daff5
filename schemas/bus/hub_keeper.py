"""Restarts the hub when the link to it is lost. Zenoh reconnects by itself, but starts no hub."""

import time
from collections.abc import Callable

from schemas.bus.endpoint import ensure_hub
from schemas.bus.errors import BusError


class HubKeeper:
    """Starts a hub if there has been no link for `delay_s`. `check` is called regularly."""

    def __init__(self, endpoint: str, delay_s: float, on_error: Callable[[str], object] = lambda _: None) -> None:
        self._endpoint = endpoint
        self._delay_s = delay_s
        self._on_error = on_error
        self._linked_at = time.monotonic()

    def check(self, *, connected: bool) -> None:
        """Start a hub if it is time to. It blocks until the hub listens."""
        if not connected and time.monotonic() - self._linked_at < self._delay_s:
            return
        if not connected:
            try:
                ensure_hub(self._endpoint)
            except BusError as error:
                self._on_error(str(error))
        self._linked_at = time.monotonic()
