"""A WebSocket that hands over a few messages at a time, so that a page which floods takes no long turn of the loop.

uvicorn parses all that one read has brought, up to 256 KiB: thousands of small messages, for a fifth of a second.
"""

import asyncio
from typing import Final

from uvicorn._types import ASGIReceiveEvent
from uvicorn.protocols.websockets.websockets_sansio_impl import WebSocketsSansIOProtocol

PIECE_BYTES: Final = 1024
"""Bytes that are parsed at a time: some thirty of the smallest messages."""
CLOSED_INTERVAL_S: Final = 0.01
"""Interval of the pieces that come after the page was closed. Only its answer to the closing is of use."""
CLOSE_TIMEOUT_S: Final = 2.0
"""Timeout of that answer. A page that floods does not read it."""


class FairWebSocket(WebSocketsSansIOProtocol):
    """Parses the received bytes piece by piece: the next piece when the messages of the last one were taken."""

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]  # uvicorn's own
        """Begin with no bytes."""
        self._rest = bytearray()
        self._waits = False
        super().connection_made(transport)
        self.close_timeout = CLOSE_TIMEOUT_S

    def data_received(self, data: bytes) -> None:
        """Keep the bytes, and parse the first piece."""
        self._rest += data
        if not self._waits:
            self._parse()

    def _parse(self) -> None:
        self._waits = False
        if self._rest and self.queue.empty() and not self.transport.is_closing():
            piece = bytes(self._rest[:PIECE_BYTES])
            del self._rest[:PIECE_BYTES]
            super().data_received(piece)
        if self._rest and not self.read_paused:
            self.read_paused = True
            self.transport.pause_reading()
        if self._rest and self.queue.empty() and not self.transport.is_closing():  # pings, or a part of a message
            self._waits = True
            self.loop.call_later(CLOSED_INTERVAL_S if self.close_sent else 0.0, self._parse)
        elif not self._rest and self.queue.empty() and self.read_paused:
            self.read_paused = False
            self.transport.resume_reading()

    async def receive(self) -> ASGIReceiveEvent:
        """Return the next message. Read on when all are taken."""
        message = await self.queue.get()
        if self.queue.empty() and not self._waits:
            self._parse()
        return message
