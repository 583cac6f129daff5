"""A serial port through pyserial: one thread finds, opens and closes it, which can block; the loop reads and writes.

Where the loop cannot watch a port (Windows), the thread reads it too; a reading is there sooner without that.
A write never waits: a port has room for far more than one frame, so a port that does not take a frame whole and at
once has stopped taking bytes, and the link is lost. Who uses the descriptor holds `_hold`: the thread lets go
of a port that died at any moment, and the number of a closed descriptor may be another car's a moment later.
"""

import asyncio
import contextlib
import errno
import os
import re
import threading
from typing import Final

import serial

from gateway.link.base import CLOSE_S, Busy, CannotOpen, Link, LinkLost
from gateway.link.url import SerialUrl, UsbUrl
from gateway.link.usb import UsbSerialPort, at, choose, plugged, refuse_another

WRITE_TIMEOUT_S: Final = 0.25
"""Only where the port cannot be written without waiting (Windows)."""
WAITING_CHUNKS: Final = 256
"""Chunks that may wait for who reads; then the port is not read any more, and fills."""
READ_BYTES: Final = 4096
WATCHED: Final = os.name == "posix"
"""The loop can watch the port."""

try:
    import termios

    # tcflush and tcsetattr of a port that is gone raise termios.error, which is no OSError.
    _GONE: tuple[type[Exception], ...] = (OSError, termios.error)
except ImportError:  # Windows
    _GONE = (OSError,)

# ValueError: a path or a baud rate that the system cannot express.
_NOT_OPENED: Final[tuple[type[Exception], ...]] = (*_GONE, ValueError)
_BUSY: Final = frozenset({errno.EBUSY, errno.EAGAIN, errno.EWOULDBLOCK})
_UNPLUGGED: Final = frozenset({errno.EIO, errno.ENXIO, errno.ENODEV})
"""What an open port says while it goes; once it has gone it is an end of file."""


_opening: Final[set[str]] = set()
"""Ports that a thread is opening now."""
_first: Final[dict[str, UsbSerialPort]] = {}
"""The device that each URL led to first. A path is soon another's: its car would be given what this one was to do."""
# The system tells nothing of a pseudo terminal; `gateway run` starts faster without the lists.
_PSEUDO: Final = re.compile(r"/dev/(pts/|ttys)\d+")


class SerialLink(Link):
    """One open port. Made by `open_serial`."""

    def __init__(self, url: SerialUrl | UsbUrl, loop: asyncio.AbstractEventLoop) -> None:
        self._url = url
        self._loop = loop
        self._hold = threading.Lock()
        self._port: serial.Serial | None = None
        self._chunks: list[bytes] = []
        self._came = asyncio.Event()
        self._room = threading.Semaphore(WAITING_CHUNKS)
        self._paused = False
        self._closing = threading.Event()
        self._lost: str | None = None
        self._stuck = False
        self._opened: asyncio.Future[None] = loop.create_future()
        self._ended: asyncio.Future[None] = loop.create_future()
        # A daemon: opening or closing a port can block (a Bluetooth tty does), and must not keep the process.
        self._thread = threading.Thread(target=self._run, name=f"read {url}", daemon=True)

    async def open(self, timeout_s: float) -> None:
        """Start the thread and wait until the port is open; raises CannotOpen."""
        self._thread.start()
        try:
            await asyncio.wait_for(asyncio.shield(self._opened), timeout_s)
        except asyncio.CancelledError:
            self._end()
            raise
        except TimeoutError:
            self._end()
            raise CannotOpen(
                f"{self._url}: the port did not open within {timeout_s:g} s: is the device there?"
            ) from None

    async def read(self) -> bytes:
        """The next bytes as they came; raises LinkLost."""
        while not self._chunks:
            if self._lost is not None:
                raise LinkLost(self._lost)
            self._came.clear()
            await self._came.wait()
        chunks, self._chunks = self._chunks, []
        if not WATCHED:
            self._room.release(len(chunks))
        elif self._paused:
            self._paused = False
            self._watch()
        return chunks[0] if len(chunks) == 1 else b"".join(chunks)

    async def write(self, data: bytes) -> None:
        """Write these bytes whole; raises LinkLost, after which some of them may be out."""
        if self._lost is not None:
            raise LinkLost(self._lost)
        try:
            with self._hold:
                written = None if self._port is None else _write_now(self._port, data)
        except serial.SerialTimeoutException:
            written = 0
        except _GONE as error:
            raise self._lose(f"{self._url} is gone: {_why_gone(error)}") from None
        if written is None:
            raise self._lose(f"{self._url} is gone: unplugged")  # the thread knows, and is about to say so
        self._stuck = written != len(data)
        if written == 0 and data:
            raise self._lose(f"{self._url} takes no bytes: unplugged, or stuck?")
        if written != len(data):
            raise self._lose(f"{self._url} took {written} of {len(data)} bytes: unplugged, or stuck?")

    async def close(self) -> None:
        """Let go of the port, and wait for that; one that does not close in time is left to the thread."""
        self._lose(f"{self._url} was closed")
        if self._opened.done() and not self._opened.cancelled() and self._opened.exception() is None:
            with contextlib.suppress(TimeoutError):
                await asyncio.wait_for(asyncio.shield(self._ended), CLOSE_S)
                self._thread.join()

    def _lose(self, reason: str) -> LinkLost:
        """The link is of no more use; the first reason is kept."""
        self._lost = self._lost or reason
        self._came.set()
        self._end()
        return LinkLost(self._lost)

    def _end(self) -> None:
        """Tell the thread to end, whatever it waits for; one that still opens the port closes it again."""
        with self._hold, contextlib.suppress(*_GONE):
            if self._port is not None:
                if WATCHED:
                    self._loop.remove_reader(self._port.fileno())
                else:
                    self._port.cancel_read()
        self._closing.set()
        self._room.release()

    # ------------------------------------------------------------------ reading in the loop

    def _watch(self) -> None:
        with self._hold:
            if self._port is not None and not self._closing.is_set():
                self._loop.add_reader(self._port.fileno(), self._readable)

    def _readable(self) -> None:
        try:
            with self._hold:
                if self._port is None:
                    return
                data = os.read(self._port.fileno(), READ_BYTES)
                self._paused = len(self._chunks) >= WAITING_CHUNKS
                if self._paused:
                    self._loop.remove_reader(self._port.fileno())
        except BlockingIOError:
            return
        except _GONE as error:
            self._lose(f"{self._url} is gone: {_why_gone(error)}")
            return
        if data:
            self._received(data)
        else:
            self._lose(f"{self._url} is gone: unplugged")

    # ------------------------------------------------------------------ in the thread

    def _run(self) -> None:
        port: serial.Serial | CannotOpen
        try:
            port = self._open_port()
        except CannotOpen as error:
            port = error
        except Exception as error:  # noqa: BLE001 - whatever a driver does: the thread must not end without a word
            port = CannotOpen(f"{self._url}: the port cannot be opened ({_cause(error)})")
        _opening.discard(str(self._url))  # before anybody is told, who may try again at once
        if isinstance(port, CannotOpen):
            self._tell(self._failed_to_open, port)
            return
        with self._hold:
            self._port = port
        self._tell(self._succeeded)
        reason = f"{self._url} was closed"
        try:
            if WATCHED:
                self._closing.wait()
            while not self._closing.is_set():
                data = port.read(1)
                if waiting := port.in_waiting:
                    data += port.read(waiting)
                if data:
                    self._room.acquire()
                    self._tell(self._received, data)
        except _GONE as error:
            reason = f"{self._url} is gone: {_why_gone(error)}"
        finally:
            with self._hold:
                self._port = None
            if self._stuck:
                # What it never took must not reach the car later; and closing would wait for it, 30 s on a UART.
                with contextlib.suppress(*_GONE):
                    port.reset_output_buffer()
            with contextlib.suppress(*_GONE):
                port.close()
            self._tell(self._over, reason)

    def _open_port(self) -> serial.Serial:
        """Find the port, each time again, and open it; raises CannotOpen."""
        first = _first.get(str(self._url))
        found: UsbSerialPort | None
        if isinstance(self._url, SerialUrl):
            path = self._url.path
            found = _device(path, needed=first is not None)
        else:
            found = choose(self._url, plugged())
            path = found.device
        refuse_another(self._url, path, first, found)
        try:
            # `exclusive` locks it against a second gateway.
            port = serial.Serial(
                path, self._url.baud, timeout=None, write_timeout=WRITE_TIMEOUT_S, exclusive=_exclusive()
            )
        except _NOT_OPENED as error:
            kind = Busy if getattr(error, "errno", None) in _BUSY else CannotOpen
            raise kind(why_not_open(self._url, path, error)) from None
        if found is not None:
            _first.setdefault(str(self._url), found)
        return port

    def _tell(self, what: object, *arguments: object) -> None:
        with contextlib.suppress(RuntimeError):  # the loop is closed: nobody is left to tell
            self._loop.call_soon_threadsafe(what, *arguments)  # type: ignore[arg-type]  # a method of this class

    # ------------------------------------------------------------------ told by the thread, on the loop

    def _failed_to_open(self, error: CannotOpen) -> None:
        if not self._opened.done():
            self._opened.set_exception(error)
            self._opened.exception()  # looked at even if `open` has timed out meanwhile

    def _succeeded(self) -> None:
        if not self._opened.done():
            self._opened.set_result(None)
        if WATCHED:
            self._watch()

    def _received(self, data: bytes) -> None:
        self._chunks.append(data)
        self._came.set()

    def _over(self, reason: str) -> None:
        self._lost = self._lost or reason
        self._came.set()
        if not self._ended.done():
            self._ended.set_result(None)


async def open_serial(url: SerialUrl | UsbUrl, timeout_s: float) -> Link:
    """Open a serial port; raises CannotOpen. A USB device is looked for at each opening."""
    if str(url) in _opening:  # each further try would be one more thread that hangs
        raise CannotOpen(f"{url}: the port still hangs in an earlier try to open it: unplug it, and plug it in again")
    _opening.add(str(url))
    link = SerialLink(url, asyncio.get_running_loop())
    await link.open(timeout_s)
    return link


def _write_now(port: serial.Serial, data: bytes) -> int:
    """Write what the port takes at once; how much that was.

    Not pyserial's write: without a write_timeout a full port makes it spin for ever, with one it waits in the loop.
    """
    if os.name != "posix":
        return port.write(data) or 0
    try:
        return os.write(port.fileno(), data)  # pyserial opens it O_NONBLOCK
    except BlockingIOError:
        return 0


def why_not_open(url: SerialUrl | UsbUrl, path: str, error: Exception) -> str:
    """One line: what is wrong with the port at this path, and what to do."""
    code = getattr(error, "errno", None)
    which = f"{url}: " if isinstance(url, SerialUrl) else f"{url}: {path}: "
    if code in (errno.ENOENT, errno.ENODEV, errno.ENXIO):
        return f"{which}there is no such port; {_ports()}"
    if code in (errno.EACCES, errno.EPERM):
        return f"{which}no permission; {_group(path)}"
    if code in _BUSY:
        return f"{which}the port is in use by another program (a second gateway?): end that one first"
    if code == errno.EISDIR or os.path.isdir(path):  # noqa: PTH112 - a device path, not a file to work with
        return f"{which}this is a directory, not a serial port; {_ports()}"
    if not isinstance(error, ValueError) and os.path.exists(path):  # noqa: PTH110 - likewise
        return f"{which}this is not a serial port ({_cause(error)}); {_ports()}"
    return f"{which}the port cannot be opened ({_cause(error)}); {_ports()}"


def _why_gone(error: Exception) -> str:
    return "unplugged" if getattr(error, "errno", None) in _UNPLUGGED else _cause(error)


def _cause(error: Exception) -> str:
    code = getattr(error, "errno", None)
    if isinstance(code, int):
        return os.strerror(code).lower()
    if "readiness to read" in str(error):  # pyserial's words for an end of file, which is what an unplug looks like
        return "unplugged"
    return " ".join(str(error).split()) or type(error).__name__


def _device(path: str, *, needed: bool) -> UsbSerialPort | None:
    """What is at this path; None if the system does not tell, or, unless `needed`, does not list its ports now."""
    if _PSEUDO.fullmatch(path):
        return None
    try:
        return at(path, plugged())
    except CannotOpen:
        if needed:
            raise
        return None


def _ports() -> str:
    try:
        found = sorted(port.device for port in plugged())
    except CannotOpen as error:
        return str(error)
    return f"there are: {', '.join(found)}" if found else "no serial port is plugged in"


def _group(path: str) -> str:
    try:
        import grp

        group = grp.getgrgid(os.stat(path).st_gid).gr_name  # noqa: PTH116 - a device path, not a file to work with
    except (ImportError, OSError, KeyError):
        return "ask for access to the port"
    return f"it belongs to group {group}: `sudo usermod -aG {group} $USER`, then log in again"


def _exclusive() -> bool | None:
    """A lock between programs is a matter of POSIX; Windows ports are exclusive anyway, and refuse the argument."""
    return True if os.name == "posix" else None
