"""A serial port through pyserial. One thread finds, opens and closes the port, because these calls can block.

The event loop reads and writes. On Windows it cannot watch a port, so the thread reads as well.
A write never waits (on Windows, it waits up to 0.25 s). A port can buffer far more than one frame. So a port that does
not accept a whole frame at once is stuck, and the link counts as lost.
Every use of the descriptor needs `_lock`, because the thread may close a dead port at any moment. Another car's port
may get the same descriptor number a moment later.
"""

import asyncio
import contextlib
import errno
import os
import re
import threading
from collections.abc import Sequence
from typing import Final

import serial

from gateway.link.base import CLOSE_S, Link, LinkKind
from gateway.link.link_exceptions import Busy, CannotOpen, LinkLost
from gateway.link.serial_port_list import SerialPort, serial_ports
from gateway.link.usb import ListedPort, check_same_device, choose, list_serial_ports, port_at
from schemas.links import SerialUrl, UsbUrl
from schemas.process import serial_port_users
from schemas.process.serial_port_permission import permission_hint
from schemas.process.usb_bus import explain_missing_port

SERIAL_WRITE_TIMEOUT_S: Final = 0.25
"""Timeout of pyserial's own write, used on Windows only."""
MAX_BUFFERED_CHUNKS: Final = 256
"""Number of buffered chunks. At the next one, the link stops reading the port."""
READ_BYTES: Final = 4096
CAN_WATCH: Final = os.name == "posix"
"""True if the event loop can watch the port."""

try:
    import termios

    # tcflush and tcsetattr of an unplugged port raise termios.error, which is not an OSError.
    _GONE: tuple[type[Exception], ...] = (OSError, termios.error)
except ImportError:  # Windows
    _GONE = (OSError,)

# ValueError: a path or a baud rate that the system cannot express.
_NOT_OPENED: Final[tuple[type[Exception], ...]] = (*_GONE, ValueError)
_BUSY: Final = frozenset({errno.EBUSY, errno.EAGAIN, errno.EWOULDBLOCK})
_UNPLUGGED: Final = frozenset({errno.EIO, errno.ENXIO, errno.ENODEV})
"""Errors of an open port while it is being unplugged. After that, a read returns an end of file."""
_RFCOMM: Final = re.compile(r"rfcomm\d+")
_RFCOMM_FAR: Final = frozenset(
    {errno.ECONNREFUSED, errno.EHOSTUNREACH, errno.ETIMEDOUT, errno.EIO, getattr(errno, "EHOSTDOWN", errno.EIO)}
)
"""Errors when opening the port of a Bluetooth Classic module that is off, out of range or not paired."""
# If another program reads the same port, each byte causes at most one empty read, so there are at most 500 within
# `_EMPTY_READS_S`. A broken port returns empty reads without end.
_MAX_EMPTY_READS: Final = 2000
"""Number of empty reads within _EMPTY_READS_S after which the port counts as gone."""
_EMPTY_READS_S: Final = 0.5


_opening: Final[set[str]] = set()
"""URLs whose port a thread is opening now."""
# After a replug, the same path may lead to another car. That car must not get this car's commands.
_first_device: Final[dict[str, ListedPort]] = {}
"""The device that was opened first for each URL."""
# The system does not list pseudo terminals, and `gateway run` starts faster if it does not list the ports.
_PSEUDO: Final = re.compile(r"/dev/(pts/|ttys)\d+")


class SerialLink(Link):
    """One serial port. `SerialKind.open` creates and opens it."""

    def __init__(self, url: SerialUrl | UsbUrl, loop: asyncio.AbstractEventLoop) -> None:
        self._url = url
        self._loop = loop
        self._lock = threading.Lock()
        self._port: serial.Serial | None = None
        self._chunks: list[bytes] = []
        self._came = asyncio.Event()
        self._room = threading.Semaphore(MAX_BUFFERED_CHUNKS)
        self._paused = False
        self._closing = threading.Event()
        self._lost: str | None = None
        self._stuck = False
        self._trouble = ""
        self._is_searching = False
        self._empty_reads = 0
        """Empty reads since `_empty_since`."""
        self._empty_since = 0.0
        self._opened: asyncio.Future[None] = loop.create_future()
        self._ended: asyncio.Future[None] = loop.create_future()
        # It is a daemon thread, because opening or closing a port can block (on a Bluetooth tty), and that must not
        # keep the process from ending.
        self._thread = threading.Thread(target=self._run, name=f"read {url}", daemon=True)

    async def open(self, timeout_s: float) -> None:
        """Start the thread and wait until the port is open. Raises CannotOpen if it does not open in time."""
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

    @property
    def trouble(self) -> str:
        """A text that says which other program uses the port. Empty if none was found."""
        return self._trouble

    def look_for_trouble(self) -> None:
        """Find out in a thread which other program has the port open. The search takes some 10 ms."""
        if not self._trouble and not self._is_searching:
            self._is_searching = True
            threading.Thread(target=self._find_users, name=f"who reads {self._url}", daemon=True).start()

    async def read(self) -> bytes:
        """Wait for bytes and return them as they arrived. Raises LinkLost if the link ends."""
        while not self._chunks:
            if self._lost is not None:
                raise LinkLost(self._lost)
            self._came.clear()
            await self._came.wait()
        chunks, self._chunks = self._chunks, []
        if not CAN_WATCH:
            self._room.release(len(chunks))
        elif self._paused:
            self._paused = False
            self._watch()
        return chunks[0] if len(chunks) == 1 else b"".join(chunks)

    async def write(self, data: bytes) -> None:
        """Write these bytes. Raises LinkLost if the port does not accept all of them. Some may have been sent then."""
        if self._lost is not None:
            raise LinkLost(self._lost)
        try:
            with self._lock:
                written = None if self._port is None else _write_now(self._port, data)
        except serial.SerialTimeoutException:
            written = 0
        except _GONE as error:
            raise self._lose(f"{self._url} is gone: {_why_gone(error)}") from None
        if written is None:
            raise self._lose(f"{self._url} is gone: unplugged")  # the thread has closed the port and reports that soon
        self._stuck = written != len(data)
        if written == 0 and data:
            raise self._lose(f"{self._url} accepts no bytes: unplugged, or stuck?")
        if written != len(data):
            raise self._lose(f"{self._url} accepted {written} of {len(data)} bytes: unplugged, or stuck?")

    async def close(self) -> None:
        """Close the port and wait until it is closed. If that takes too long, leave the rest to the thread."""
        self._lose(f"{self._url} was closed")
        if self._opened.done() and not self._opened.cancelled() and self._opened.exception() is None:
            with contextlib.suppress(TimeoutError):
                await asyncio.wait_for(asyncio.shield(self._ended), CLOSE_S)
                self._thread.join()

    def _lose(self, reason: str) -> LinkLost:
        """Mark the link as lost and return the error. If the link is lost already, the first reason stays."""
        self._lost = self._lost or reason
        self._came.set()
        self._end()
        return LinkLost(self._lost)

    def _end(self) -> None:
        """Stop the thread. A thread that is still opening the port closes it afterwards."""
        with self._lock, contextlib.suppress(*_GONE):
            if self._port is not None:
                if CAN_WATCH:
                    self._loop.remove_reader(self._port.fileno())
                else:
                    self._port.cancel_read()
        self._closing.set()
        self._room.release()

    # ------------------------------------------------------------------ reading in the loop

    def _watch(self) -> None:
        with self._lock:
            if self._port is not None and not self._closing.is_set():
                self._loop.add_reader(self._port.fileno(), self._readable)

    def _readable(self) -> None:
        try:
            with self._lock:
                if self._port is None:
                    return
                descriptor = self._port.fileno()
                data = os.read(descriptor, READ_BYTES)
                if not data:
                    # This fails with EIO if the port is unplugged. If it succeeds, another program has read the bytes.
                    termios.tcgetattr(descriptor)
                self._paused = len(self._chunks) >= MAX_BUFFERED_CHUNKS
                if self._paused:
                    self._loop.remove_reader(self._port.fileno())
        except BlockingIOError:
            self._on_empty_read()
            return
        except _GONE as error:
            self._lose(f"{self._url} is gone: {_why_gone(error)}")
            return
        if data:
            self._on_data(data)
        else:
            self._on_empty_read()

    def _on_empty_read(self) -> None:
        """Find out which program has read the bytes. Keep the link open, because a stop still reaches the car."""
        now = self._loop.time()
        if now - self._empty_since > _EMPTY_READS_S:
            self._empty_reads, self._empty_since = 0, now
        self._empty_reads += 1
        if self._empty_reads > _MAX_EMPTY_READS:
            self._lose(f"{self._url} is gone: it reports bytes and returns none")
        else:
            self.look_for_trouble()

    def _find_users(self) -> None:
        with self._lock:
            path = "" if self._port is None else str(self._port.port)
        users = serial_port_users.find_users(path) if path else []
        self._call_on_loop(self._on_found, path, users)

    def _on_found(self, path: str, users: list[str]) -> None:
        self._is_searching = False
        if self._empty_reads:
            fact = f"another program reads {self._url}, too, so bytes from the car are missing"
        else:
            fact = f"another program has {self._url} open, too, so bytes from the car may be missing"
        if users:
            stop = "Stop that program." if len(users) == 1 else "Stop those programs."
            self._trouble = f"{fact}: {', '.join(users)}. {stop}"
        elif path and self._empty_reads:
            command = serial_port_users.how_to_find_users(path)
            self._trouble = f"{fact}. `{command}` shows which program: stop it."

    # ------------------------------------------------------------------ in the thread

    def _run(self) -> None:
        port: serial.Serial | CannotOpen
        try:
            port = self._open_port()
        except CannotOpen as error:
            port = error
        except Exception as error:  # noqa: BLE001 - whatever a driver raises, the thread must report it
            port = CannotOpen(f"{self._url}: the port cannot be opened ({_cause(error)})")
        _opening.discard(str(self._url))  # before the failure is reported, because the caller may retry at once
        if isinstance(port, CannotOpen):
            self._call_on_loop(self._on_open_failed, port)
            return
        with self._lock:
            self._port = port
        self._call_on_loop(self._on_opened)
        reason = f"{self._url} was closed"
        try:
            if CAN_WATCH:
                self._closing.wait()
            while not self._closing.is_set():
                data = port.read(1)
                if waiting := port.in_waiting:
                    data += port.read(waiting)
                if data:
                    self._room.acquire()
                    self._call_on_loop(self._on_data, data)
        except _GONE as error:
            reason = f"{self._url} is gone: {_why_gone(error)}"
        finally:
            with self._lock:
                self._port = None
            if self._stuck:
                # Discard unsent bytes, which must not reach the car later. Closing would also wait for them, 30 s on a
                # UART.
                with contextlib.suppress(*_GONE):
                    port.reset_output_buffer()
            with contextlib.suppress(*_GONE):
                port.close()
            self._call_on_loop(self._on_closed, reason)

    def _open_port(self) -> serial.Serial:
        """Find the port again and open it. Raises CannotOpen if there is no such port, or if it does not open."""
        first = _first_device.get(str(self._url))
        found: ListedPort | None
        if isinstance(self._url, SerialUrl):
            path = self._url.path
            found = _device(path, required=first is not None)
        else:
            found = choose(self._url, list_serial_ports())
            path = found.device
        check_same_device(self._url, path, first, found)
        try:
            # `exclusive` locks the port against a second gateway. Windows always locks it, and pyserial refuses the
            # argument there.
            exclusive = os.name == "posix" or None
            port = serial.Serial(
                path, self._url.baud, timeout=None, write_timeout=SERIAL_WRITE_TIMEOUT_S, exclusive=exclusive
            )
        except _NOT_OPENED as error:
            kind = Busy if _code(error) in _BUSY else CannotOpen
            raise kind(why_not_open(self._url, path, error)) from None
        if found is not None:
            _first_device.setdefault(str(self._url), found)
        return port

    def _call_on_loop(self, method: object, *arguments: object) -> None:
        with contextlib.suppress(RuntimeError):  # the loop is closed
            self._loop.call_soon_threadsafe(method, *arguments)  # type: ignore[arg-type]  # a method of this class

    # ------------------------------------------------------------------ reports of the thread, on the loop

    def _on_open_failed(self, error: CannotOpen) -> None:
        if not self._opened.done():
            self._opened.set_exception(error)
            self._opened.exception()  # mark it as retrieved, because `open` may have timed out meanwhile

    def _on_opened(self) -> None:
        if not self._opened.done():
            self._opened.set_result(None)
        if CAN_WATCH:
            self._watch()

    def _on_data(self, data: bytes) -> None:
        self._chunks.append(data)
        self._came.set()

    def _on_closed(self, reason: str) -> None:
        self._lost = self._lost or reason
        self._came.set()
        if not self._ended.done():
            self._ended.set_result(None)


class SerialKind(LinkKind[SerialUrl | UsbUrl]):
    """Serial ports, by path or by USB device."""

    async def open(self, url: SerialUrl | UsbUrl, timeout_s: float, *, first: bool) -> Link:  # noqa: ARG002 - there is no queue
        """Open a serial port. Each call searches for a USB device again. Raises CannotOpen if it does not open."""
        if str(url) in _opening:  # another attempt would leave another hanging thread
            raise CannotOpen(f"{url}: an earlier attempt to open the port still hangs: unplug it, and plug it in again")
        _opening.add(str(url))
        link = SerialLink(url, asyncio.get_running_loop())
        await link.open(timeout_s)
        return link

    def ports(self) -> Sequence[SerialPort]:
        """Return the serial ports. Raises CannotOpen if the system cannot list them."""
        return serial_ports()


KIND: Final = SerialKind()


def _write_now(port: serial.Serial, data: bytes) -> int:
    """Write as much as the port accepts at once. Return the number of bytes."""
    # Do not use pyserial's write: on a full port, it spins for ever without a write_timeout, and with one it blocks the
    # loop.
    if os.name != "posix":
        return port.write(data) or 0
    try:
        return os.write(port.fileno(), data)  # pyserial opens it O_NONBLOCK
    except BlockingIOError:
        return 0


def why_not_open(url: SerialUrl | UsbUrl, path: str, error: Exception) -> str:
    """Return one line for a person that says why the port at this path does not open, and what to do."""
    code = _code(error)
    which = f"{url}: " if isinstance(url, SerialUrl) else f"{url}: {path}: "
    if code in _RFCOMM_FAR and _is_rfcomm(path):
        what = "Switch it on and bring it near. If it was never paired with this computer: `bluetoothctl pair ADDRESS`."
        return f"{which}the car is off, out of range or not paired ({_cause(error)}). {what}"
    if code in (errno.ENOENT, errno.ENODEV, errno.ENXIO):
        is_windows_name = path.upper().startswith("COM") and os.name == "posix"
        windows = " (COM... is a name on Windows)" if is_windows_name else ""
        return f"{which}no such port on this computer{windows}. {_list_ports_text()}"
    if code in (errno.EACCES, errno.EPERM):
        return f"{which}no permission. {permission_hint(path)}"
    if code in _BUSY:
        return f"{which}in use by {_find_holder(path)}. Stop that program first."
    if code == errno.EISDIR or os.path.isdir(path):  # noqa: PTH112 - a device path, not a file to work with
        return f"{which}this is a directory, not a serial port. {_list_ports_text()}"
    if not isinstance(error, ValueError) and os.path.exists(path):  # noqa: PTH110 - a device path
        return f"{which}this is not a serial port ({_cause(error)}). {_list_ports_text()}"
    return f"{which}the port cannot be opened ({_cause(error)}). {_list_ports_text()}"


def _is_rfcomm(path: str) -> bool:
    """Return True if the path, or what it links to, is the port of a Bluetooth Classic module."""
    return any(_RFCOMM.fullmatch(os.path.basename(each)) for each in (path, os.path.realpath(path)))  # noqa: PTH119


def _find_holder(path: str) -> str:
    """Return the program that has locked the port, else the programs that have it open."""
    try:
        holder = serial_port_users.find_holder(os.stat(path))  # noqa: PTH116 - a device path
    except (OSError, ValueError):
        holder = None
    # A terminal program locks a port in another way (TIOCEXCL, or a lock file), which `find_holder` cannot find.
    return holder or ", ".join(serial_port_users.find_users(path)) or "another program"


def _why_gone(error: Exception) -> str:
    return "unplugged" if _code(error) in _UNPLUGGED else _cause(error)


def _code(error: Exception) -> int | None:
    """Return the error number, or None if the error has none. termios.error has the number only in its arguments."""
    code = getattr(error, "errno", None)
    if code is None and isinstance(error, _GONE) and error.args:
        code = error.args[0]
    return code if isinstance(code, int) else None


def _cause(error: Exception) -> str:
    code = _code(error)
    if code is not None:
        return os.strerror(code).lower()
    if "readiness to read" in str(error):  # pyserial's message for an end of file, as after an unplug
        return "unplugged"
    return " ".join(str(error).split()) or type(error).__name__


def _device(path: str, *, required: bool) -> ListedPort | None:
    """Return the listed port at this path, or None if there is none.

    If the system cannot list the ports, return None as well. Raises CannotOpen instead if the port is `required`.
    """
    if _PSEUDO.fullmatch(path):
        return None
    try:
        return port_at(path, list_serial_ports())
    except CannotOpen:
        if required:
            raise
        return None


def _list_ports_text() -> str:
    """Return a sentence about the serial ports of this computer, or about why the port may be missing."""
    try:
        found = sorted(port.device for port in list_serial_ports())
    except CannotOpen as error:
        return str(error)
    if missing := explain_missing_port():
        return missing
    return f"Found: {', '.join(found)}. `fleet scan` checks them." if found else "No serial port is plugged in."
