"""A car's Bluetooth LE module through bleak: which device, which characteristics, frames in pieces, and always a limit.

Nothing is taken from bleak's `is_connected`: it stays true when the system's Bluetooth service dies. A link is lost
when the system says so and we did not close it, or when a write fails; a car that is only silent is the caller's to
judge. bleak cleans up after itself without a limit, so what is called runs in a task that is cancelled until it ends.
"""

import asyncio
import contextlib
import errno
import socket
import sys
from collections.abc import Coroutine, Iterable, Mapping
from typing import Any, Final, TypeVar

from bleak import BleakAdapter, BleakClient, BleakScanner
from bleak.backends.characteristic import BleakGATTCharacteristic
from bleak.backends.device import BLEDevice
from bleak.backends.scanner import AdvertisementData
from bleak.backends.service import BleakGATTService

from gateway.link.base import Busy, CannotOpen, Link, LinkLost
from gateway.link.url import BleUrl

T = TypeVar("T")

WRITE_S: Final = 1.0
"""For a whole frame; a piece takes 11 ms (90 writes/s, measured). What takes longer comes too late to be a command."""
DISCONNECT_S: Final = 4.0
"""BlueZ ends a connection 2 s after it was asked to, so that what is under way still goes out."""
NAMESAKES_S: Final = 2.0
"""How long to listen on for another device of the same name: modules leave their factory with one name."""
HELD_BYTES: Final = 64 * 1024
"""Bytes that may wait for who reads: over a minute of a car's 960 a second. Radio cannot be held back."""
_CLEAN_UP_S: Final = 0.5
_LEAST_PIECE: Final = 20  # at the least MTU there is, 23
_TOLD: Final = 5
"""Devices or services that an error lists."""
_NOTIFY: Final = frozenset({"notify", "indicate"})
_WRITE: Final = frozenset({"write", "write-without-response"})


def _uuid(short: int) -> str:
    return f"0000{short:04x}-0000-1000-8000-00805f9b34fb"


_NORDIC: Final = "6e40000{}-b5a3-f393-e0a9-e50e24dcca9e"
_UARTS: Final = (
    ((_uuid(0xFFE0), _uuid(0xFFE5)), (_uuid(0xFFE1), _uuid(0xFFE2), _uuid(0xFFE4), _uuid(0xFFE9))),
    ((_NORDIC.format(1),), (_NORDIC.format(2), _NORDIC.format(3))),
)
"""The services of a UART over BLE, and their characteristics, the preferred ones first
(docs/reference/protocol.md#framing)."""
UART_SERVICES: Final = tuple(service for services, _ in _UARTS for service in services)


class BleLink(Link):
    """One connection. Made by `open_ble`."""

    def __init__(self, url: BleUrl) -> None:
        self._url = url
        self._client: BleakClient | None = None
        self._to_car: BleakGATTCharacteristic | None = None
        self._claim: socket.socket | None = None
        self._data = bytearray()
        self._came = asyncio.Event()
        self._writing = asyncio.Lock()
        self._pieces: asyncio.Task[None] | None = None
        self._closing: asyncio.Task[None] | None = None
        self._lost: str | None = None
        self._stage = "Bluetooth does not answer: is its service running?"

    # ------------------------------------------------------------------ opening

    async def open(self, timeout_s: float) -> None:
        """Find the device, connect, and listen; raises CannotOpen."""
        try:
            await _within(timeout_s, self._open())
        except BaseException as error:
            await self.close()
            if isinstance(error, TimeoutError):
                raise CannotOpen(f"{self._url}: {self._stage} (waited {timeout_s:g} s)") from None
            if isinstance(error, CannotOpen) or not isinstance(error, Exception):
                raise
            raise CannotOpen(
                f"{self._url}: Bluetooth cannot be used, {_cause(error)}: is there an adapter, is it on, and does "
                "the system's Bluetooth service run?"
            ) from None

    async def _open(self) -> None:
        # A gateway that was killed leaves its module connected, and what is connected is not found by a scan.
        known = {device.address: device for device in await _connected() if self._is_asked(device.address, device.name)}
        if known and self._url.name is None:
            try:
                await self._use(*known.values())
            except Busy:
                raise
            except CannotOpen:  # a service that was restarted has no such connection any more
                await self._let_go()
            else:
                return
        await self._use(await self._look(known))

    def _is_asked(self, address: str, *names: str | None) -> bool:
        return address.upper() == self._url.address if self._url.name is None else self._url.name in names

    async def _look(self, known: Mapping[str, BLEDevice]) -> BLEDevice:
        """Scan until the device is heard; by name, until it is likely the only one. Has no limit of its own."""
        loop = asyncio.get_running_loop()
        found, others = dict(known), dict[str, str]()
        self._stage = _not_heard(self._url, others)
        # Not `advertisement_data()`: it misses what is heard before it is first asked, which may be all there is.
        heard = asyncio.Queue[tuple[BLEDevice, AdvertisementData]]()
        async with BleakScanner(lambda device, said: heard.put_nowait((device, said))):
            with contextlib.suppress(TimeoutError):
                async with asyncio.timeout(NAMESAKES_S if found else None) as limit:
                    while True:
                        device, said = await heard.get()
                        if self._is_asked(device.address, device.name, said.local_name):
                            if self._url.name is None:
                                return device
                            if not found:
                                limit.reschedule(loop.time() + NAMESAKES_S)
                            found[device.address] = device
                        elif any(service.lower() in UART_SERVICES for service in said.service_uuids):
                            others[device.address] = said.local_name or device.name or "no name"
                            self._stage = _not_heard(self._url, others)
        if len(found) > 1:
            raise CannotOpen(
                f"{self._url}: {len(found)} devices have this name: give the address of one, "
                f"{_listed(f'ble://{address}' for address in found)}"
            )
        return next(iter(found.values()))

    async def _use(self, device: BLEDevice) -> None:
        """Connect to it, and listen; raises CannotOpen."""
        self._claim = self._claim or _claim(self._url, device.address)
        client = BleakClient(device, self._disconnected)
        self._stage = (
            f"{device.address} is there, but does not connect: is a phone or another computer connected to it?"
        )
        try:
            await client.connect()
            self._client = client  # now, and not before, it is to be disconnected: a failed connect cleans up itself
            await self._listen(client, device.address)
        except CannotOpen:
            raise
        except Exception as error:  # noqa: BLE001 - whatever a system's Bluetooth stack raises, it is not open
            raise CannotOpen(f"{self._url}: no connection, {_cause(error)}") from None

    async def _listen(self, client: BleakClient, address: str) -> None:
        chosen = choose(client.services)
        if chosen is None:
            there = _listed(sorted(service.uuid for service in client.services)) or "none"
            raise CannotOpen(f"{self._url}: it has no UART service that is known (FFE0, Nordic's), but: {there}")
        from_car, self._to_car = chosen
        self._stage = f"{address} is connected, but its notifications do not begin: switch it off and on again"
        await client.start_notify(from_car, self._notified)
        if self._lost is not None:
            raise CannotOpen(f"{self._lost}, while it was opened")

    # ------------------------------------------------------------------ reading and writing

    async def read(self) -> bytes:
        """The next bytes as they came; raises LinkLost."""
        while not self._data:
            if self._lost is not None:
                raise LinkLost(self._lost)
            self._came.clear()
            await self._came.wait()
        data = bytes(self._data)
        self._data.clear()
        return data

    async def write(self, data: bytes) -> None:
        """Hand the frame to the system in pieces, no other between them; raises LinkLost, then some may be out.

        A frame that was begun and not ended, for whatever reason, ends the link: nothing may be sent behind a half one.
        """
        async with self._writing:
            if self._lost is not None:
                raise LinkLost(self._lost)
            pieces = self._pieces = asyncio.ensure_future(self._write_pieces(data))
            try:
                await asyncio.wait({pieces}, timeout=WRITE_S)
            finally:
                if not pieces.done():
                    self._lose(f"{self._url} takes no bytes: out of range, or stuck?")
                    await asyncio.wait({pieces})
            if not pieces.cancelled() and (error := pieces.exception()) is not None:
                self._lose(f"{self._url} is gone: {_cause(error)}")
            if self._lost is not None:  # also if it went out whole: who reads was told that the link is gone
                raise LinkLost(self._lost)

    async def _write_pieces(self, data: bytes) -> None:
        assert self._client is not None
        assert self._to_car is not None
        size = max(self._to_car.max_write_without_response_size, _LEAST_PIECE)
        response = "write-without-response" not in self._to_car.properties
        for start in range(0, len(data), size):
            await self._client.write_gatt_char(self._to_car, data[start : start + size], response)

    async def close(self) -> None:
        """End the connection, and wait for that; what does not end in time is left to the system."""
        self._lose(f"{self._url} was closed")
        if self._closing is None:
            self._closing = asyncio.ensure_future(self._close())
        await asyncio.shield(self._closing)

    async def _close(self) -> None:
        await self._let_go()
        if self._claim is not None:
            self._claim.close()

    async def _let_go(self) -> None:
        client, self._client = self._client, None
        if client is not None:
            with contextlib.suppress(Exception):  # there is nobody who could do anything about it
                await _within(DISCONNECT_S, client.disconnect())

    def _lose(self, reason: str) -> LinkLost:
        """The link is of no more use; the first reason is kept."""
        self._lost = self._lost or reason
        self._came.set()
        if self._pieces is not None:
            self._pieces.cancel()
        return LinkLost(self._lost)

    # ------------------------------------------------------------------ told by bleak, on the loop

    def _notified(self, _: BleakGATTCharacteristic, data: bytearray) -> None:
        if self._lost is None:
            self._data += data
            self._came.set()
            if len(self._data) > HELD_BYTES:
                self._lose(f"{self._url} sends more than is read: {HELD_BYTES} bytes wait")

    def _disconnected(self, client: BleakClient) -> None:
        if client is self._client:  # not one that we let go
            self._lose(f"{self._url} is gone: the Bluetooth connection ended")


async def open_ble(url: BleUrl, timeout_s: float) -> Link:
    """Find a module and connect to it; raises CannotOpen."""
    link = BleLink(url)
    await link.open(timeout_s)
    return link


def choose(
    services: Iterable[BleakGATTService],
) -> tuple[BleakGATTCharacteristic, BleakGATTCharacteristic] | None:
    """The characteristics of a UART: which notifies, and which is written, often the same; None without one."""
    there = list(services)
    for uuids, preferred in _UARTS:
        found = [each for service in there if service.uuid in uuids for each in service.characteristics]
        found.sort(key=lambda each: preferred.index(each.uuid) if each.uuid in preferred else len(preferred))
        from_car = [each for each in found if not _NOTIFY.isdisjoint(each.properties)]
        to_car = [each for each in found if not _WRITE.isdisjoint(each.properties)]
        if from_car and to_car:
            return from_car[0], to_car[0]
    return None


async def _connected() -> list[BLEDevice]:
    """UART modules that this computer is connected to, by whomever."""
    try:
        adapter = await BleakAdapter.get()
        return await adapter.get_connected_devices(list(UART_SERVICES))
    except NotImplementedError:
        return []


async def _within(seconds: float, work: Coroutine[Any, Any, T]) -> T:
    """Its result; raises TimeoutError if there is none in time, however long it would take to be cancelled."""
    task = asyncio.ensure_future(work)
    try:
        await asyncio.wait({task}, timeout=seconds)
        if not task.done():
            raise TimeoutError
        return task.result()
    finally:
        while not task.done():  # again, if what it does when it is cancelled waits too
            task.cancel()
            await asyncio.wait({task}, timeout=_CLEAN_UP_S)
        if not task.cancelled():
            task.exception()


def _claim(url: BleUrl, address: str) -> socket.socket | None:
    """Take the device for this program; raises Busy. The system shares a connection between programs, and says nothing.

    An abstract socket of Linux is gone with its process, however that ends. Elsewhere nothing is claimed.
    """
    if sys.platform != "linux":
        return None
    claim = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
    try:
        claim.bind(f"\0zenoh-car-fleet ble {address.upper()}")
    except OSError as error:
        claim.close()
        if error.errno == errno.EADDRINUSE:
            raise Busy(f"{url}: {address} is in use by another program (a second gateway?): end that first") from None
        raise
    return claim


def _not_heard(url: BleUrl, others: Mapping[str, str]) -> str:
    hint = ": macOS tells no addresses, give the UUID of `gateway scan`, or ble://name=" if _is_mac_without(url) else ""
    there = _listed(f"{address} ({name})" for address, name in others.items())
    return f"no such device was heard{hint}: is it on, in range, and no phone connected to it? " + (
        f"There are: {there}" if there else "No other UART module was heard either"
    )


def _is_mac_without(url: BleUrl) -> bool:
    return sys.platform == "darwin" and url.address is not None and ":" in url.address


def _listed(items: Iterable[str]) -> str:
    """For one line, without what a device has chosen to be called that cannot be printed."""
    every = list(items)
    more = f" and {len(every) - _TOLD} more" if len(every) > _TOLD else ""
    return "".join(each if each.isprintable() else "?" for each in ", ".join(every[:_TOLD])) + more


def _cause(error: BaseException) -> str:
    return " ".join(str(error).split()) or type(error).__name__
