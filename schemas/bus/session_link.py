"""The link of a session to its hub, from the moment in which it carries messages."""

import threading
from typing import Final

import zenoh

_NEWEST_EVENTS: Final = 16
"""Number of kept events. A session has one link at a time, and only the newest event matters."""


class SessionLink:
    """Follows the link of one session.

    Zenoh lists a new link a moment before messages take it. Until then it answers each question for tokens at once, as
    if there were none. The event of the link comes after that moment.
    """

    def __init__(self, session: zenoh.Session) -> None:
        self._session = session
        # A ring never makes Zenoh wait, however seldom it is read.
        events = session.info.declare_link_events_listener(zenoh.handlers.RingChannel(_NEWEST_EVENTS), history=True)
        self._next_event = events.handler.try_recv
        self._events = events  # the listener ends with this object
        self._reading = threading.Lock()
        self._opened = ""

    @property
    def address(self) -> str:
        """Address of our end, which no two links share. Empty while messages reach no hub, and of a closed session."""
        with self._reading:
            try:
                while (event := self._next_event()) is not None:
                    if event.kind == zenoh.SampleKind.PUT:
                        self._opened = str(event.link.src)
                    elif self._opened == str(event.link.src):
                        self._opened = ""
                is_listed = any(str(link.src) == self._opened for link in self._session.info.links())
            except zenoh.ZError:  # the session is closed, perhaps by another thread just now
                return ""
            return self._opened if is_listed else ""
