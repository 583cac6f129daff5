"""A car's Bluetooth LE module through bleak: finds the device and its characteristics, and writes frames in pieces.

The link is lost when the system reports a disconnect, a write fails, or too many bytes wait. The caller judges whether
a silent car is lost. bleak's `is_connected` is not used, because it stays true when the system's Bluetooth service
dies. bleak's clean-up has no timeout, so its calls run in a task that is cancelled again and again until it ends.
"""

import asyncio
import contextlib
import errno
import socket
import sys
import time
from collections.abc import Coroutine, Iterable, Mapping, Sequence
from typing import Any, Final, TypeVar

from bleak import BleakAdapter, BleakClient, BleakScanner
from bleak.backends.characteristic import BleakGATTCharacteristic
from bleak.backends.device import BLEDevice
from bleak.backends.scanner import AdvertisementData
from bleak.backends.service import BleakGATTService

from gateway.link import ble_adapter_turns, bluez
from gateway.link.base import Device, Link, LinkKind
from gateway.link.ble_adapter_turns import ConnectionNote, Turn
from gateway.link.ble_devices import list_devices
from gateway.link.buffered_link import MAX_BUFFERED_BYTES, BufferedLink
from gateway.link.link_exceptions import Busy, CannotOpen, LinkLost
from schemas.bluetooth import ADAPTER_CONNECTIONS, SMALL_ADAPTER_CONNECTIONS, describe_full
from schemas.links import AUTO_ADAPTER, BleUrl
from schemas.process.stdio import printable

T = TypeVar("T")
_Devices = dict[str | None, BLEDevice]
"""One device as each adapter knows it. None stands for the system's choice of an adapter."""

# A piece takes 11 ms (90 writes/s, measured). A frame that takes longer than the timeout is too old to be obeyed.
BLE_WRITE_TIMEOUT_S: Final = 1.0
"""Timeout for a whole frame."""
# BlueZ ends a connection 2 s after the request, so that pending data can still be sent.
DISCONNECT_TIMEOUT_S: Final = 4.0
# All modules leave the factory with the same name.
NAMESAKE_SCAN_S: Final = 2.0
"""Time of the scan for another device with the same name."""
OTHER_ADAPTERS_S: Final = 1.0
"""Time for which the scan goes on after one adapter has found the device, as others may find it too."""
# Connecting takes 1.1 s, for the fourth car 4 s. Other gateways wait meanwhile, also for a module that does not answer.
CONNECT_TIMEOUT_S: Final = 10.0
TURN_TIMEOUT_S: Final = 60.0
"""Timeout for connecting, and for the wait before it: only one gateway connects at a time (`ble_adapter_turns.Turn`).
It is long enough if eight cars are before this one."""
_CANCEL_RETRY_S: Final = 0.5
_MIN_PIECE: Final = 20  # at the minimum MTU of 23
_MAX_LISTED: Final = 5
"""Maximum of devices or services in an error message."""
_NOTIFY: Final = frozenset({"notify", "indicate"})
_WRITE: Final = frozenset({"write", "write-without-response"})


def _uuid(short: int) -> str:
    return f"0000{short:04x}-0000-1000-8000-00805f9b34fb"


_NORDIC: Final = "6e40000{}-b5a3-f393-e0a9-e50e24dcca9e"
_FFE: Final = (_uuid(0xFFE1), _uuid(0xFFE2), _uuid(0xFFE4), _uuid(0xFFE9))
_UARTS: Final = (
    ((_uuid(0xFFE0), _uuid(0xFFE5)), _FFE, _FFE),
    # Some clones accept writes to FFF1, too, but pass on only what was written to FFF2.
    ((_uuid(0xFFF0),), (_uuid(0xFFF1),), (_uuid(0xFFF2),)),
    ((_NORDIC.format(1),), (_NORDIC.format(3),), (_NORDIC.format(2),)),
)
"""The kinds of UART over BLE. Each has its services, then the characteristics from the car and those to the car, both
in order of preference (docs/reference/protocol.md#framing)."""
UART_SERVICES: Final = tuple(service for services, _, _ in _UARTS for service in services)


class BleLink(BufferedLink):
    """One connection, created by `BleKind.open`."""

    def __init__(self, url: BleUrl, *, first: bool = False) -> None:
        super().__init__()
        self._url = url
        self._first = first
        self._client: BleakClient | None = None
        self._to_car: BleakGATTCharacteristic | None = None
        self._claim: socket.socket | None = None
        self._note: ConnectionNote | None = None
        self._writing = asyncio.Lock()
        self._pieces: asyncio.Task[None] | None = None
        self._closing: asyncio.Task[None] | None = None
        self._stage = "Bluetooth does not answer: is its service running?"

    # ------------------------------------------------------------------ opening

    async def open(self, timeout_s: float) -> None:
        """Find the device, connect when it is this gateway's turn, and subscribe. Raises CannotOpen."""
        began = time.monotonic()
        try:
            found = await _within(timeout_s, self._search())
            if found:
                self._claim = self._claim or _claim(self._url, next(iter(found.values())).address)
                await self._connect(found, min(timeout_s, CONNECT_TIMEOUT_S))
        except BaseException as error:
            await self.close()
            if isinstance(error, TimeoutError):
                raise CannotOpen(f"{self._url}: {self._stage} (waited {time.monotonic() - began:.0f} s)") from None
            if isinstance(error, CannotOpen) or not isinstance(error, Exception):
                raise
            raise CannotOpen(
                f"{self._url}: Bluetooth cannot be used, {_cause(error)}: is there an adapter, is it on, and does "
                "the system's Bluetooth service run?"
            ) from None

    async def _search(self) -> _Devices:
        """Return the device as each adapter knows it. Empty if an existing connection was taken over."""
        connections = await bluez.start_bleak()
        adapters = self._allowed(list(connections))
        # A killed gateway leaves its module connected, and a scan does not find connected modules. So look at the
        # connected ones, on all adapters: the module may be connected to an adapter that is no longer allowed.
        connected = [(name, each) for name in connections or adapters for each in await _connected(name)]
        known = {each.address: {name: each} for name, each in connected if self._is_wanted(each.address, each.name)}
        if known and self._url.name is None:
            if await self._take_over(known[next(iter(known))]):
                return {}
            known = {}
        found = await self._find(known, adapters)
        address = next(iter(found.values())).address
        return {} if address in known and await self._take_over(known[address]) else found

    async def _take_over(self, devices: _Devices) -> bool:
        """Use the connection that a killed gateway has left. Return False if it does not work any more."""
        ((adapter, device),) = devices.items()
        try:
            await self._use(device, adapter)
        except Busy:
            raise
        except CannotOpen:  # the Bluetooth service was restarted and has lost that connection
            await self._disconnect()
            return False
        return True

    def _allowed(self, adapters: list[str]) -> list[str | None]:
        """Return the names of the allowed adapters. None stands for the system's choice. Raises CannotOpen."""
        wanted = self._url.adapter
        if sys.platform != "linux" and wanted not in (None, AUTO_ADAPTER):
            raise CannotOpen(f"{self._url}: this system has one Bluetooth adapter: leave adapter= out")
        if wanted not in (None, AUTO_ADAPTER) and adapters and wanted not in adapters:
            there = ", ".join(adapters)
            raise CannotOpen(f"{self._url}: no Bluetooth adapter {wanted} that is on. There are: {there}")
        if not adapters:  # the adapters are unknown, and bleak will report why
            return [None if wanted == AUTO_ADAPTER else wanted]
        if wanted == AUTO_ADAPTER:
            return [*adapters]
        return [wanted or adapters[0]]

    def _is_wanted(self, address: str, *names: str | None) -> bool:
        return address.upper() == self._url.address if self._url.name is None else self._url.name in names

    async def _find(self, known: Mapping[str, _Devices], adapters: Sequence[str | None]) -> _Devices:
        """Scan until the device advertises. Scan on for others of its name, or for its other adapters. No timeout."""
        loop = asyncio.get_running_loop()
        found, others = {address: dict(devices) for address, devices in known.items()}, dict[str, str]()
        self._stage = _not_found(self._url, others)
        more_s = NAMESAKE_SCAN_S if self._url.name is not None else OTHER_ADAPTERS_S
        # Do not use `advertisement_data()`: it misses advertisements before the first call, and these may be the only
        # ones.
        queue = asyncio.Queue[tuple[str | None, BLEDevice, AdvertisementData]]()
        async with contextlib.AsyncExitStack() as scanners:
            for name in adapters:
                await scanners.enter_async_context(_scanner(name, queue))
            with contextlib.suppress(TimeoutError):
                async with asyncio.timeout(more_s if found else None) as timeout:
                    while True:
                        adapter, device, advert = await queue.get()
                        if self._is_wanted(device.address, device.name, advert.local_name):
                            if not found:
                                timeout.reschedule(loop.time() + more_s)
                            seen = found.setdefault(device.address, {})
                            seen[adapter] = device
                            if self._url.name is None and len(seen) == len(adapters):
                                return seen
                        elif any(service.lower() in UART_SERVICES for service in advert.service_uuids):
                            others[device.address] = advert.local_name or device.name or "no name"
                            self._stage = _not_found(self._url, others)
        if len(found) > 1:
            raise CannotOpen(
                f"{self._url}: {len(found)} devices have this name: give the address of one, "
                f"{_listed(f'ble://{address}' for address in found)}"
            )
        return next(iter(found.values()))

    async def _connect(self, devices: _Devices, timeout_s: float) -> None:
        """Connect through the first adapter with room, at this gateway's turn. Raises CannotOpen if all are full."""
        turns = {adapter: Turn(adapter or "default", first=self._first) for adapter in devices}
        try:
            async with asyncio.timeout(TURN_TIMEOUT_S):
                while True:
                    adapter = await self._take_turn(turns)
                    try:
                        return await _within(timeout_s, self._use(devices[adapter], adapter))
                    except (CannotOpen, TimeoutError) as error:
                        connections = (await bluez.list_connections()).get(adapter or "", 0)
                        if isinstance(error, Busy) or adapter is None or connections < SMALL_ADAPTER_CONNECTIONS:
                            raise
                        if await self._free(adapter):
                            continue
                        full = describe_full(adapter, connections)
                        turns[adapter].release()
                        del turns[adapter]
                        if not turns:
                            raise CannotOpen(f"{self._url}: {full}") from None
                    finally:
                        if adapter in turns:
                            turns[adapter].release()
        finally:
            for turn in turns.values():
                turn.release()

    async def _take_turn(self, turns: dict[str | None, Turn]) -> str | None:
        """Wait for the turn at an adapter with room, or at the last one that is left. Return its name."""
        self._stage = "other gateways connect through this adapter, and it was not this one's turn"
        connections = await bluez.list_connections()
        while True:
            for adapter in sorted(turns, key=lambda each: connections.get(each or "", 0)):
                if not turns[adapter].try_take():
                    continue
                # Nobody else connects now, so the number of connections does not grow. The last adapter is tried even
                # if it has ADAPTER_CONNECTIONS, because some can hold more.
                connections = await bluez.list_connections()
                if connections.get(adapter or "", 0) >= ADAPTER_CONNECTIONS and await self._free(adapter):
                    connections = await bluez.list_connections()
                if len(turns) == 1 or connections.get(adapter or "", 0) < ADAPTER_CONNECTIONS:
                    return adapter
                turns.pop(adapter).release()
                break
            else:
                await asyncio.sleep(ble_adapter_turns.TURN_POLL_S)

    async def _use(self, device: BLEDevice, adapter: str | None) -> None:
        """Connect to the device and subscribe. Raises CannotOpen if the device refuses."""
        self._claim = self._claim or _claim(self._url, device.address)
        client = BleakClient(device, self._on_disconnected)
        self._stage = (
            f"{device.address} is there, but does not connect. Is a phone or another computer connected to it?"
        )
        try:
            await client.connect()
            self._client = client  # set it only now, as bleak cleans up after a failed connect
            await self._subscribe(client, device.address)
        except CannotOpen:
            raise
        except Exception as error:  # noqa: BLE001 - a system's Bluetooth stack may raise anything
            raise CannotOpen(f"{self._url}: no connection, {_cause(error)}") from None
        if adapter is not None:
            self._note = ConnectionNote(adapter, device.address)
            self._note.write()

    async def _free(self, adapter: str | None) -> bool:
        """End the connections that killed gateways have left. Return True if there were any."""
        freed = False
        for note in () if adapter is None else ConnectionNote.all_of(adapter):
            try:
                claim = _claim(self._url, note.address)
            except CannotOpen:  # another program has this device
                continue
            if claim is not None:
                await note.disconnect()
                claim.close()
                freed = True
        return freed

    async def _subscribe(self, client: BleakClient, address: str) -> None:
        chosen = choose(client.services)
        if chosen is None:
            there = _listed(sorted(service.uuid for service in client.services)) or "none"
            raise CannotOpen(f"{self._url}: no known UART service (FFE0, FFF0, Nordic's). It has: {there}")
        from_car, self._to_car = chosen
        self._stage = f"{address} is connected, but sends nothing. Switch it off and on again."
        await client.start_notify(from_car, self._on_notification)
        if self._lost is not None:
            raise CannotOpen(f"{self._lost}, while it was opened")

    # ------------------------------------------------------------------ writing

    async def write(self, data: bytes) -> None:
        """Send the frame in pieces, with nothing between them. After LinkLost, some pieces may have been sent.

        A truncated frame ends the link, because the car would read the next frame as the rest of this one.
        """
        async with self._writing:
            if self._lost is not None:
                raise LinkLost(self._lost)
            pieces = self._pieces = asyncio.ensure_future(self._write_pieces(data))
            try:
                await asyncio.wait({pieces}, timeout=BLE_WRITE_TIMEOUT_S)
            finally:
                if not pieces.done():
                    self._lose(f"{self._url} accepts no bytes: out of range, or stuck?")
                    await asyncio.wait({pieces})
            if not pieces.cancelled() and (error := pieces.exception()) is not None:
                self._lose(f"{self._url} is gone: {_cause(error)}")
            if self._lost is not None:  # raise even if the frame was sent, because `read` has reported the loss
                raise LinkLost(self._lost)

    async def _write_pieces(self, data: bytes) -> None:
        assert self._client is not None
        assert self._to_car is not None
        size = max(self._to_car.max_write_without_response_size, _MIN_PIECE)
        response = "write-without-response" not in self._to_car.properties
        for start in range(0, len(data), size):
            await self._client.write_gatt_char(self._to_car, data[start : start + size], response)

    async def close(self) -> None:
        """Close the connection, and wait until it is closed. If that takes too long, leave it to the system."""
        self._lose(f"{self._url} was closed")
        if self._closing is None:
            self._closing = asyncio.ensure_future(self._close())
        await asyncio.shield(self._closing)

    async def _close(self) -> None:
        await self._disconnect()
        if self._note is not None:
            self._note.remove()
        if self._claim is not None:
            self._claim.close()

    async def _disconnect(self) -> None:
        client, self._client = self._client, None
        if client is not None:
            with contextlib.suppress(Exception):  # nothing can be done about an error here
                await _within(DISCONNECT_TIMEOUT_S, client.disconnect())

    def _lose(self, reason: str) -> LinkLost:
        """Mark the link as lost and return the error. The first reason stays."""
        self._lost = self._lost or reason
        self._came.set()
        if self._pieces is not None:
            self._pieces.cancel()
        return LinkLost(self._lost)

    # ------------------------------------------------------------------ callbacks of bleak, on the loop

    def _on_notification(self, _: BleakGATTCharacteristic, data: bytearray) -> None:
        if self._lost is None:
            self._data += data
            self._came.set()
            if len(self._data) > MAX_BUFFERED_BYTES:
                self._lose(f"{self._url} sends faster than the gateway reads: {MAX_BUFFERED_BYTES} bytes wait")

    def _on_disconnected(self, client: BleakClient) -> None:
        if client is self._client:  # else it is a client that we have disconnected
            self._lose(f"{self._url} is gone: the Bluetooth connection ended")


class BleKind(LinkKind[BleUrl]):
    """Opens Bluetooth LE links, and lists devices."""

    # A module advertises about once a second, and a scan often misses the first advertisement. The fourth car needs 4 s
    # to connect.
    open_timeout_s = 20.0

    async def open(self, url: BleUrl, timeout_s: float, *, first: bool) -> Link:
        """Find a module and connect to it, or raise CannotOpen. With `first`, go before other gateways."""
        link = BleLink(url, first=first)
        await link.open(timeout_s)
        return link

    async def devices(self, seconds: float) -> Sequence[Device]:
        """Return the modules and other devices that advertise. Raises CannotList if Bluetooth does not work."""
        return await list_devices(seconds, UART_SERVICES)


KIND: Final = BleKind()


def choose(
    services: Iterable[BleakGATTService],
) -> tuple[BleakGATTCharacteristic, BleakGATTCharacteristic] | None:
    """Return the notifying and the writable characteristic of a UART, which are often one. None if there is no UART."""
    available = list(services)
    for uuids, notifying, writable in _UARTS:
        found = [each for service in available if service.uuid in uuids for each in service.characteristics]
        from_car = _preferred(found, _NOTIFY, notifying)
        to_car = _preferred(found, _WRITE, writable)
        if from_car and to_car:
            return from_car, to_car
    return None


def _preferred(
    found: Iterable[BleakGATTCharacteristic], properties: frozenset[str], order: Sequence[str]
) -> BleakGATTCharacteristic | None:
    """Return the most preferred characteristic that has one of the properties. None if none has."""
    fit = [each for each in found if not properties.isdisjoint(each.properties)]
    return min(fit, key=lambda each: order.index(each.uuid) if each.uuid in order else len(order), default=None)


async def _connected(adapter: str | None) -> list[BLEDevice]:
    """Return the UART modules to which any program on this computer is connected through an adapter."""
    try:
        found = await (BleakAdapter.get() if adapter is None else BleakAdapter.get(bluez={"adapter": adapter}))
        return await found.get_connected_devices(list(UART_SERVICES))
    except NotImplementedError:
        return []


def _scanner(
    adapter: str | None, queue: "asyncio.Queue[tuple[str | None, BLEDevice, AdvertisementData]]"
) -> BleakScanner:
    def on_advertisement(device: BLEDevice, advert: AdvertisementData) -> None:
        queue.put_nowait((adapter, device, advert))

    return (
        BleakScanner(on_advertisement)
        if adapter is None
        else BleakScanner(on_advertisement, bluez={"adapter": adapter})
    )


async def _within(seconds: float, work: Coroutine[Any, Any, T]) -> T:
    """Return the result of the work. After `seconds`, cancel it repeatedly until it ends, and raise TimeoutError."""
    task = asyncio.ensure_future(work)
    try:
        await asyncio.wait({task}, timeout=seconds)
        if not task.done():
            raise TimeoutError
        return task.result()
    finally:
        while not task.done():  # the task may wait in its clean-up, too: cancel it again
            task.cancel()
            await asyncio.wait({task}, timeout=_CANCEL_RETRY_S)
        if not task.cancelled():
            task.exception()


def _claim(url: BleUrl, address: str) -> socket.socket | None:
    """Claim the device for this program. Raises Busy if another program has it. Returns None if not on Linux."""
    # The system lets several programs share a connection without an error, so use a lock. An abstract socket is a lock
    # that disappears with its process, even if the process is killed.
    if sys.platform != "linux":
        return None
    claim = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
    try:
        claim.bind(f"\0zenoh-car-fleet ble {address.upper()}")
    except OSError as error:
        claim.close()
        if error.errno == errno.EADDRINUSE:
            raise Busy(f"{url}: {address} is in use by another program (a second gateway?). Stop it first.") from None
        raise
    return claim


def _not_found(url: BleUrl, others: Mapping[str, str]) -> str:
    no_addresses = sys.platform == "darwin" and url.address is not None and ":" in url.address
    hint = " (macOS has no addresses: use the UUID of `fleet scan`, or ble://name=)" if no_addresses else ""
    there = _listed(f"{address} ({name})" for address, name in others.items())
    found = f"Found: {there}." if there else "No other car module was found."
    return f"no such device found{hint}. Is it on, in range, and no phone connected to it? {found}"


def _listed(items: Iterable[str]) -> str:
    """Return the items as one line. Replace unprintable characters, because a device may choose any name."""
    every = list(items)
    more = f" and {len(every) - _MAX_LISTED} more" if len(every) > _MAX_LISTED else ""
    return printable(", ".join(every[:_MAX_LISTED]), "?") + more


def _cause(error: BaseException) -> str:
    return " ".join(str(error).split()) or type(error).__name__
