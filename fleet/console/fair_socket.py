"""A WebSocket that hands over a few messages at a time, so that a page which floods cannot block the loop.

uvicorn itself parses all bytes of one read, up to 256 KiB. Those may be thousands of small messages, which block the
loop for a fifth of a second.
"""

import asyncio
import socket
from typing import Final, cast

from uvicorn._types import ASGIReceiveEvent, ASGISendEvent
from uvicorn.protocols.websockets.websockets_sansio_impl import WebSocketsSansIOProtocol
from websockets.frames import Frame

from fleet.console.page_link import SEND_TIMEOUT_S

PIECE_BYTES: Final = 1024
"""Bytes that are parsed at a time: some thirty of the smallest messages."""
CLOSED_INTERVAL_S: Final = 0.01
"""Interval at which pieces are parsed after the console has closed the WebSocket. Then only the page's answer to the
closing matters, so the rest of the page's bytes may wait."""
CLOSE_TIMEOUT_S: Final = 2.0
"""Timeout for the page's answer to the closing by the console. A page that floods may never read the closing."""
WRITE_BUFFER_BYTES: Final = 64 * 1024
"""Maximum number of bytes that wait for a page that does not read. Further messages have to wait. It is smaller than
asyncio's own limit for TLS, which is 512 KiB for each page."""


class FairWebSocket(WebSocketsSansIOProtocol):
    """Parses the received bytes piece by piece.

    The next piece is parsed when the console has taken all messages of the one before.
    """

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]  # uvicorn's own
        """Begin a connection, without any received bytes."""
        self._rest = bytearray()
        self._waits = False
        self._full: asyncio.TimerHandle | None = None
        super().connection_made(transport)
        transport.set_write_buffer_limits(WRITE_BUFFER_BYTES)
        # The kernel's own buffer grows to some megabytes, so a page that reads nothing would be noticed only after
        # minutes.
        transport.get_extra_info("socket").setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, WRITE_BUFFER_BYTES)
        self.close_timeout = CLOSE_TIMEOUT_S

    def data_received(self, data: bytes) -> None:
        """Store the bytes, and parse the first piece."""
        self._rest += data
        if not self._waits:
            self._parse()

    def pause_writing(self) -> None:
        """Let the senders wait. End the connection if the page does not read for too long."""
        super().pause_writing()
        # A message that closes the connection would wait behind the others, so abort the connection.
        self._full = self.loop.call_later(SEND_TIMEOUT_S, self.transport.abort)

    def resume_writing(self) -> None:
        """Let the senders continue."""
        super().resume_writing()
        self._read_again()

    def connection_lost(self, exc: Exception | None) -> None:
        """End all waits."""
        self._read_again()
        super().connection_lost(exc)

    async def send(self, message: ASGISendEvent) -> None:
        """Send a message. If it closes the WebSocket, make sure that the connection ends."""
        await super().send(message)
        # If the page disappears while reading is paused, asyncio's TLS forgets the connection. Then it would count
        # against the limit of open connections for ever.
        if message["type"] == "websocket.close":
            self._end_later()
            self._drop_messages()

    def _drop_messages(self) -> None:
        """Drop the messages before the closing: nobody takes them any more, and the page's answer waits behind them."""
        while not self.queue.empty():
            self.queue.get_nowait()
        if not self._waits:
            self._parse()

    def handle_close(self, event: Frame) -> None:
        """Answer when the page closes the WebSocket, and make sure that the connection ends."""
        super().handle_close(event)
        self._end_later()

    def _end_later(self) -> None:
        # The timeout applies twice: to the answer, and to the end of TLS.
        self.loop.call_later(2 * CLOSE_TIMEOUT_S, self.transport.abort)

    def _read_again(self) -> None:
        if self._full is not None:
            self._full.cancel()
            self._full = None

    def handle_ping(self) -> None:
        """Answer a ping, and count it as a message, because the console limits how many messages a page may send.

        Do not answer if the page reads nothing, because answers would pile up.
        """
        answer = b"".join(self.conn.data_to_send())
        if self.writable.is_set():
            self.transport.write(answer)
        self._count()

    def handle_pong(self, event: Frame) -> None:
        """Handle the answer to our ping. Count an answer that we did not ask for as a message."""
        if bytes(event.data) != self.pending_ping_payload:
            self._count()
        super().handle_pong(event)

    def handle_cont(self, event: Frame) -> None:
        """Handle a part of a message. Count it as a message, because even an empty part takes memory."""
        super().handle_cont(event)
        if not event.fin:
            self._count()

    def _count(self) -> None:
        """Hand over an empty message, which the console only counts."""
        if not self.close_sent:
            self.queue.put_nowait(cast("ASGIReceiveEvent", {"type": "websocket.receive", "text": ""}))

    def _parse(self) -> None:
        self._waits = False
        if self._rest and self.queue.empty() and not self.transport.is_closing():
            piece = bytes(self._rest[:PIECE_BYTES])
            del self._rest[:PIECE_BYTES]
            super().data_received(piece)
        if self._rest and not self.read_paused:
            self.read_paused = True
            self.transport.pause_reading()
        # A piece may yield no message: it has only a part of one, or the answer to our ping, or the console has closed
        # the WebSocket. So parse the next piece soon.
        if self._rest and self.queue.empty() and not self.transport.is_closing():
            self._waits = True
            self.loop.call_later(CLOSED_INTERVAL_S if self.close_sent else 0.0, self._parse)
        elif not self._rest and self.queue.empty() and self.read_paused:
            self.read_paused = False
            self.transport.resume_reading()

    async def receive(self) -> ASGIReceiveEvent:
        """Return the next message. Read more bytes when all messages are taken."""
        message = await self.queue.get()
        if self.queue.empty() and not self._waits:
            self._parse()
        return message
