"""Restarts the hub when the link to it is lost. Zenoh reconnects by itself, but starts no hub."""

import time
from collections.abc import Callable
from typing import Final

from schemas.bus.endpoint import ensure_hub
from schemas.bus.errors import BusError

HUB_RESTART_DELAY_S: Final = 0.5
"""Time without a link after which a hub is started. A gateway adds jitter: a hundred may have lost the same hub."""


class HubKeeper:
    """Starts a hub if there has been no link for a while. `check` is called regularly."""

    def __init__(self, endpoint: str, on_error: Callable[[str], object] = lambda _: None) -> None:
        self._endpoint = endpoint
        self._on_error = on_error
        self._linked_at = time.monotonic()

    def check(self, *, connected: bool) -> None:
        """Start a hub if the link has been lost for long enough. This blocks until the hub listens."""
        if not connected and time.monotonic() - self._linked_at < HUB_RESTART_DELAY_S:
            return
        if not connected:
            try:
                ensure_hub(self._endpoint)
            except BusError as error:
                self._on_error(str(error))
        self._linked_at = time.monotonic()
