"""A fake BlueZ on a private D-Bus system bus, for bleak's own backend: Bluetooth on a computer without a radio.

Its users set DBUS_SYSTEM_BUS_ADDRESS to `address`. This program is also the bus: it answers Hello, takes match rules,
passes calls to org.bluez, and passes signals to their subscribers. No dbus-daemon need be installed. The fake has
the calls of bleak's backend, and the limits measured on the real BlueZ. BlueZ refuses a piece longer than the MTU
allows. A connected module does not advertise. A connection outlives the program that made it. An adapter makes one
connection at a time, refuses another meanwhile (InProgress), and has a number of slots.
"""

import asyncio
import contextlib
import io
import itertools
import os
import struct
import threading
import tty
from collections.abc import Callable, Coroutine, Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any, TypeVar

from dbus_fast import Message, MessageType, Variant
from dbus_fast._private.unmarshaller import Unmarshaller

T = TypeVar("T")

DBUS = "org.freedesktop.DBus"
PROPERTIES = f"{DBUS}.Properties"
OBJECTS = f"{DBUS}.ObjectManager"
BLUEZ = "org.bluez"
ADAPTER, DEVICE = f"{BLUEZ}.Adapter1", f"{BLUEZ}.Device1"
SERVICE, CHARACTERISTIC = f"{BLUEZ}.GattService1", f"{BLUEZ}.GattCharacteristic1"
ROOT = "/org/bluez"
PATIENCE_S = 20.0

_names = itertools.count()


def uuid(short: int) -> str:
    """Return the 128 bits of a 16 bit UUID."""
    return f"0000{short:04x}-0000-1000-8000-00805f9b34fb"


FFE0 = ((uuid(0xFFE0), ((uuid(0xFFE1), ("notify", "write-without-response")),)),)
SEPARATE = ((uuid(0xFFE0), ((uuid(0xFFE2), ("write",)), (uuid(0xFFE1), ("notify",)))),)
TWO_SERVICES = (
    (uuid(0xFFE5), ((uuid(0xFFE9), ("write-without-response",)),)),
    (uuid(0xFFE0), ((uuid(0xFFE4), ("notify",)),)),
)
NORDIC = (
    (
        "6e400001-b5a3-f393-e0a9-e50e24dcca9e",
        (
            ("6e400003-b5a3-f393-e0a9-e50e24dcca9e", ("notify",)),
            ("6e400002-b5a3-f393-e0a9-e50e24dcca9e", ("write", "write-without-response")),
        ),
    ),
)
FFF0 = (
    (
        uuid(0xFFF0),
        ((uuid(0xFFF1), ("notify", "write-without-response")), (uuid(0xFFF2), ("write", "write-without-response"))),
    ),
)
BATTERY = ((uuid(0x180F), ((uuid(0x2A19), ("read", "notify")),)),)


def free_address() -> str:
    """Return an address that no other test on this computer has. A link claims its address from all programs."""
    number = os.getpid() << 16 | next(_names) & 0xFFFF
    return ":".join(f"{byte:02X}" for byte in number.to_bytes(6, "big"))


class Refused(Exception):
    """A D-Bus error: its name and text."""


@dataclass(eq=False)
class Adapter:
    """A Bluetooth adapter of the computer."""

    name: str = "hci0"
    slots: int = 5
    """Maximum of connections."""
    connect_s: float = 0.0
    """How long a connect takes."""
    busy: bool = False
    """True while a connect goes on."""
    refused: list[str] = field(default_factory=list)
    """The addresses whose connect was refused, because another one was going on."""
    accepted: list[str] = field(default_factory=list)
    """The addresses whose connect was tried, in order."""
    scanners: set["_Caller"] = field(default_factory=set)

    @property
    def path(self) -> str:
        return f"{ROOT}/{self.name}"


@dataclass(eq=False)
class Module:
    """A Bluetooth LE module and its faults."""

    address: str
    name: str
    gatt: tuple[tuple[str, tuple[tuple[str, tuple[str, ...]], ...]], ...] = FFE0
    mtu: int = 23
    on: bool = True
    connects: bool = True
    notifies: bool = True
    leaves: bool = True
    """False if BlueZ never answers a call of Disconnect."""
    takes: int | None = None
    """Number of pieces that the module still takes (None: all). BlueZ never answers a later write."""
    refuses: int | None = None
    """Number of pieces that the module still takes (None: all). BlueZ refuses a later write."""
    known: set[str] = field(default_factory=set)
    """The adapters that have seen it."""
    adapter: Adapter | None = None
    """The adapter that is connected to it."""
    seen_by: frozenset[str] | None = None
    """The adapters in whose range it is; None for all."""
    found_after_list: bool = False
    """True if another program's scan finds it just after BlueZ has listed its objects to a program that listens."""
    notified: set[tuple["_Caller", str]] = field(default_factory=set)
    """The subscribers of notifications, each with its characteristic."""
    pieces: list[bytes] = field(default_factory=list)
    """The written pieces in order."""
    waiting: list[tuple["_Caller", Message]] = field(default_factory=list)
    """Pending calls of Connect."""
    uart: int | None = None
    """Descriptor of a car's serial port, to which the module passes written bytes."""
    written_to: set[str] = field(default_factory=set)
    """The UUIDs of the characteristics that were written."""

    @property
    def connected(self) -> bool:
        return self.adapter is not None

    @property
    def path(self) -> str:
        """The path of the connected device."""
        assert self.adapter is not None
        return self.path_at(self.adapter.name)

    def path_at(self, adapter: str) -> str:
        return f"{ROOT}/{adapter}/dev_{self.address.replace(':', '_')}"

    def characteristics(self) -> Iterator[tuple[str, str, tuple[str, ...], str, str]]:
        """Yield each characteristic of a connected module: path, UUID, flags, and path and UUID of the service."""
        if not self.connected:
            return
        number = 0x000C
        for service, inside in self.gatt:
            above = f"{self.path}/service{number:04x}"
            for each, flags in inside:
                number += 1
                yield f"{above}/char{number:04x}", each, flags, above, service
            number += 1


class FakeBluez:
    """The bus and BlueZ, in a thread of their own. Any other thread may call the methods that change them."""

    def __init__(self, *modules: Module, adapters: Sequence[Adapter] = ()) -> None:
        name = f"car-fleet-bluez-{os.getpid()}-{next(_names)}"
        self.address = f"unix:abstract={name}"
        self.modules = list(modules)
        self.adapters = list(adapters) or [Adapter()]
        self.powered = True
        self.alive = True
        """True while bluetoothd runs."""
        self._callers: set[_Caller] = set()
        self._wires: list[asyncio.Task[None]] = []
        self._changed = threading.Condition()
        self._loop = asyncio.new_event_loop()
        self._thread = threading.Thread(target=self._loop.run_forever, name="bluez", daemon=True)
        self._thread.start()
        self._server = self._do(asyncio.start_unix_server(self._serve, path=f"\0{name}"))

    def _do(self, work: Coroutine[Any, Any, T]) -> T:
        return asyncio.run_coroutine_threadsafe(work, self._loop).result(PATIENCE_S)

    # ------------------------------------------------------------------ calls of a test

    def notify(self, module: Module, data: bytes) -> None:
        """Send data from the module to the computer, in pieces as radio does. Wait until the computer has it."""
        self._do(self._notify(module, data))

    def written(self, module: Module, size: int) -> bytes:
        """Wait until this many bytes were written to the module. Remove and return them."""
        with self._changed:
            assert self._changed.wait_for(lambda: sum(map(len, module.pieces)) >= size, PATIENCE_S), module.pieces
            data = b"".join(module.pieces)
            module.pieces[:] = [data[size:]] if data[size:] else []
            return data[:size]

    def switch(self, module: Module, *, on: bool) -> None:
        """Switch a module off, which ends its connection, or on again."""

        async def work() -> None:
            module.on = on
            if not on and module.connected:
                await self._hung_up(module)
            await self._advertise()

        self._do(work())

    def wire(self, module: Module, port: str) -> None:
        """Connect a module to the serial port of a simulated car, in both directions."""

        async def work() -> None:
            uart = module.uart = os.open(port, os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK)
            tty.setraw(uart)
            said = asyncio.Queue[bytes]()
            self._loop.add_reader(uart, lambda: said.put_nowait(os.read(uart, 4096)))
            self._wires.append(asyncio.ensure_future(self._hand_on(module, said)))

        self._do(work())

    async def _hand_on(self, module: Module, said: asyncio.Queue[bytes]) -> None:
        while True:
            await self._notify(module, await said.get())

    def kill(self) -> None:
        """Kill bluetoothd. Its connections are lost, and no signal reports that."""

        async def work() -> None:
            self.alive = False

        self._do(work())

    def restart(self) -> None:
        """Restart bluetoothd. It knows no device."""

        async def work() -> None:
            self.alive = True
            for module in self.modules:
                module.known.clear()
                module.adapter = None
                module.notified.clear()
            for each in self.adapters:
                await self._signal("/", OBJECTS, "InterfacesAdded", "oa{sa{sv}}", [each.path, self._adapter(each)])

        self._do(work())

    def close(self) -> None:
        """Close the bus and all connections to it."""

        async def work() -> None:
            for wire in self._wires:
                wire.cancel()
            for module in self.modules:
                if module.uart is not None:
                    self._loop.remove_reader(module.uart)
                    os.close(module.uart)
            self._server.close()
            for caller in list(self._callers):
                caller.writer.close()
            await asyncio.gather(*(caller.task for caller in self._callers))

        self._do(work())
        self._loop.call_soon_threadsafe(self._loop.stop)
        self._thread.join(PATIENCE_S)
        self._loop.close()

    # ------------------------------------------------------------------ the bus

    async def _serve(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        task = asyncio.current_task()
        assert task is not None
        caller = _Caller(f":1.{next(_names) + 1}", writer, task)
        self._callers.add(caller)
        try:
            await _authenticate(reader, writer)
            while True:
                await self._called(caller, await _received(reader))
        except (asyncio.IncompleteReadError, ConnectionError):
            pass
        finally:
            self._callers.discard(caller)
            for module in self.modules:
                module.notified = {asked for asked in module.notified if asked[0] is not caller}
                # the module stays connected
                module.waiting = [each for each in module.waiting if each[0] is not caller]
            for adapter in self.adapters:
                adapter.scanners.discard(caller)
            writer.close()
            with contextlib.suppress(ConnectionError):
                await writer.wait_closed()

    async def _called(self, caller: "_Caller", message: Message) -> None:
        try:
            if message.destination == DBUS:
                signature, body = self._bus_call(caller, message)
            elif message.destination == BLUEZ and self.alive:
                answer = await self._bluez_call(caller, message)
                if answer is None:
                    return
                signature, body = answer
            else:
                raise Refused(f"{DBUS}.Error.ServiceUnknown", f"The name {message.destination} was not provided")  # noqa: TRY301 - answered below
        except Refused as error:
            await caller.send(_error(message, *error.args))
        else:
            listed = message.member == "GetManagedObjects" and caller.rules
            await caller.send(Message.new_method_return(message, signature, body), *(self._found() if listed else ()))

    def _bus_call(self, caller: "_Caller", message: Message) -> tuple[str, list[Any]]:
        if message.member == "Hello":
            return "s", [caller.name]
        if message.member == "AddMatch":
            rule = dict(part.split("=", 1) for part in message.body[0].split(","))
            caller.rules.append({name: value.strip("'") for name, value in rule.items()})
            return "", []
        raise Refused(f"{DBUS}.Error.UnknownMethod", str(message.member))

    async def _signal(self, path: str, interface: str, member: str, signature: str, body: list[Any]) -> None:
        if not self.alive:
            return
        for caller in list(self._callers):
            if caller.wants(path, interface, member, body):
                await caller.send(_new_signal(path, interface, member, signature, body))

    # ------------------------------------------------------------------ BlueZ

    async def _bluez_call(self, caller: "_Caller", message: Message) -> tuple[str, list[Any]] | None:
        if message.member == "GetManagedObjects":
            return "a{oa{sa{sv}}}", [self._managed()]
        for adapter in self.adapters:
            if message.path == adapter.path:
                return await self._adapter_call(caller, message, adapter)
            for module in self.modules:
                if adapter.name in module.known and message.path == module.path_at(adapter.name):
                    return await self._device_call(caller, message, module, adapter)
        for module in self.modules:
            for path, each, flags, _, _ in module.characteristics():
                if message.path == path:
                    module.written_to |= {each} if message.member == "WriteValue" else set()
                    return await self._characteristic_call(caller, message, module, flags)
        raise Refused(f"{DBUS}.Error.UnknownObject", f"Method {message.member} with {message.path} doesn't exist")

    async def _adapter_call(self, caller: "_Caller", message: Message, adapter: Adapter) -> tuple[str, list[Any]]:
        if message.member == "StartDiscovery":
            adapter.scanners.add(caller)
            await self._advertise()
        elif message.member == "StopDiscovery":
            adapter.scanners.discard(caller)
        elif message.member != "SetDiscoveryFilter":
            raise Refused(f"{DBUS}.Error.UnknownMethod", str(message.member))
        return "", []

    async def _device_call(
        self, caller: "_Caller", message: Message, module: Module, adapter: Adapter
    ) -> tuple[str, list[Any]] | None:
        if message.member == "Connect":
            pending = [str(what.path) for each in self.modules for _, what in each.waiting]
            if adapter.busy or any(path.startswith(f"{adapter.path}/") for path in pending):
                adapter.refused.append(module.address)
                raise Refused(f"{BLUEZ}.Error.InProgress", "Operation already in progress")
            if sum(each.adapter is adapter for each in self.modules) >= adapter.slots:
                raise Refused(f"{BLUEZ}.Error.Failed", "le-connection-concurrent-connection-limit")
            if not (module.on and module.connects):
                module.waiting.append((caller, message))  # BlueZ tries for a very long time
                return None
            adapter.accepted.append(module.address)
            adapter.busy = True
            try:
                await asyncio.sleep(adapter.connect_s)
            finally:
                adapter.busy = False
            module.adapter = adapter
            await self._change(module.path, DEVICE, {"Connected": Variant("b", True)})
            for path, interfaces in self._gatt(module).items():
                await self._signal("/", OBJECTS, "InterfacesAdded", "oa{sa{sv}}", [path, interfaces])
            await self._change(module.path, DEVICE, {"ServicesResolved": Variant("b", True)})
        elif message.member == "Disconnect":
            if not module.leaves:
                return None
            waiting, module.waiting = module.waiting, []
            for who, what in waiting:
                await who.send(_error(what, f"{BLUEZ}.Error.Failed", "Software caused connection abort"))
            if module.connected:
                await self._hung_up(module)
        else:
            raise Refused(f"{DBUS}.Error.UnknownMethod", str(message.member))
        return "", []

    async def _characteristic_call(
        self, caller: "_Caller", message: Message, module: Module, flags: tuple[str, ...]
    ) -> tuple[str, list[Any]] | None:
        if message.member == "StartNotify":
            if "notify" not in flags:
                raise Refused(f"{BLUEZ}.Error.NotSupported", "Operation is not supported")
            if not module.notifies:
                return None
            module.notified.add((caller, str(message.path)))
        elif message.member == "WriteValue":
            value, options = message.body
            if {"command": "write-without-response", "request": "write"}[options["type"].value] not in flags:
                raise Refused(f"{BLUEZ}.Error.NotSupported", "Operation is not supported")
            if len(value) > module.mtu - 3:
                raise Refused(f"{BLUEZ}.Error.Failed", "Failed to initiate write")
            if module.refuses is not None:
                if module.refuses == 0:
                    raise Refused(f"{BLUEZ}.Error.Failed", "Operation failed with ATT error: 0x0e")
                module.refuses -= 1
            if module.takes is not None:
                if module.takes == 0:
                    return None
                module.takes -= 1
            if module.uart is not None:
                os.write(module.uart, value)
                return "", []
            with self._changed:
                module.pieces.append(bytes(value))
                self._changed.notify_all()
        else:
            raise Refused(f"{DBUS}.Error.UnknownMethod", str(message.member))
        return "", []

    async def _notify(self, module: Module, data: bytes) -> None:
        """Send each piece as one signal for all subscribers of a characteristic. Without a subscriber, send none."""
        for path in {path for _, path in module.notified}:
            for start in range(0, len(data), module.mtu - 3):
                piece = data[start : start + module.mtu - 3]
                await self._change(path, CHARACTERISTIC, {"Value": Variant("ay", piece)})

    async def _advertise(self) -> None:
        """Report each module that is on and not connected to the callers that scan."""
        for adapter in self.adapters:
            for module in self.modules if adapter.scanners else ():
                if not module.on or module.connected or adapter.name not in (module.seen_by or {adapter.name}):
                    continue
                path = module.path_at(adapter.name)
                if adapter.name not in module.known:
                    module.known.add(adapter.name)
                    body = [path, self._device(module, adapter)]
                    await self._signal("/", OBJECTS, "InterfacesAdded", "oa{sa{sv}}", body)
                else:
                    await self._change(path, DEVICE, {"RSSI": Variant("n", -50)})

    def _found(self) -> Iterator[Message]:
        """Let all adapters see the modules that are found after a list. Yield the signals of that."""
        for module in (each for each in self.modules if each.found_after_list):
            for adapter in self.adapters:
                module.known.add(adapter.name)
                body = [module.path_at(adapter.name), self._device(module, adapter)]
                yield _new_signal("/", OBJECTS, "InterfacesAdded", "oa{sa{sv}}", body)

    async def _hung_up(self, module: Module) -> None:
        path, gone = module.path, list(self._gatt(module))
        module.adapter = None
        module.notified.clear()
        off = {"ServicesResolved": Variant("b", False), "Connected": Variant("b", False)}
        await self._change(path, DEVICE, off)
        for path in reversed(gone):
            await self._signal("/", OBJECTS, "InterfacesRemoved", "oas", [path, [SERVICE, CHARACTERISTIC]])

    async def _change(self, path: str, interface: str, changed: dict[str, Variant]) -> None:
        await self._signal(path, PROPERTIES, "PropertiesChanged", "sa{sv}as", [interface, changed, []])

    def _managed(self) -> dict[str, Any]:
        found: dict[str, Any] = {}
        for number, adapter in enumerate(self.adapters):
            found[adapter.path] = self._adapter(adapter, number)
            for module in self.modules:
                if adapter.name in module.known:
                    found[module.path_at(adapter.name)] = self._device(module, adapter)
        for module in self.modules:
            if module.connected:
                found |= self._gatt(module)
        return found

    def _adapter(self, adapter: Adapter, number: int = 0) -> dict[str, Any]:
        return {
            ADAPTER: {
                "Address": Variant("s", f"00:00:00:00:00:{number + 1:02X}"),
                "Name": Variant("s", adapter.name),
                "Roles": Variant("as", ["central"]),
                "Powered": Variant("b", self.powered),
            }
        }

    def _device(self, module: Module, adapter: Adapter) -> dict[str, Any]:
        connected = module.adapter is adapter
        return {
            DEVICE: {
                "Address": Variant("s", module.address),
                "Name": Variant("s", module.name),
                "Alias": Variant("s", module.name),
                "Adapter": Variant("o", adapter.path),
                "Paired": Variant("b", False),
                "Connected": Variant("b", connected),
                "ServicesResolved": Variant("b", connected),
                "UUIDs": Variant("as", [service for service, _ in module.gatt]),
                "RSSI": Variant("n", -50),
            }
        }

    def _gatt(self, module: Module) -> dict[str, Any]:
        found: dict[str, Any] = {}
        for path, each, flags, above, service in module.characteristics():
            found[above] = {
                SERVICE: {
                    "UUID": Variant("s", service),
                    "Device": Variant("o", module.path),
                    "Primary": Variant("b", True),
                }
            }
            found[path] = {
                CHARACTERISTIC: {
                    "UUID": Variant("s", each),
                    "Service": Variant("o", above),
                    "Flags": Variant("as", list(flags)),
                    "Notifying": Variant("b", any(path == asked for _, asked in module.notified)),
                    "MTU": Variant("q", module.mtu),
                }
            }
        return found


@dataclass(eq=False)
class _Caller:
    """One connection to the bus."""

    name: str
    writer: asyncio.StreamWriter
    task: asyncio.Task[None]
    rules: list[dict[str, str]] = field(default_factory=list)
    serials: Callable[[], int] = field(default_factory=lambda: itertools.count(1).__next__)

    def wants(self, path: str, interface: str, member: str, body: list[Any]) -> bool:
        def fits(rule: dict[str, str]) -> bool:
            under = rule.get("path_namespace", path)
            return (
                rule.get("interface", interface) == interface
                and rule.get("member", member) == member
                and (path == under or path.startswith(under + "/"))
                and str(body[0]).startswith(rule.get("arg0path", ""))
            )

        return any(fits(rule) for rule in self.rules)

    async def send(self, *messages: Message) -> None:
        """Send messages, which arrive at once."""
        for message in messages:
            message.serial, message.sender = self.serials(), BLUEZ
        self.writer.write(b"".join(bytes(message._marshall(False)) for message in messages))
        with contextlib.suppress(ConnectionError):
            await self.writer.drain()


async def _authenticate(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
    await reader.readexactly(1)
    while True:
        line = (await reader.readuntil(b"\r\n")).strip()
        if line == b"BEGIN":
            return
        answer = {b"AUTH": b"OK 0123456789abcdef0123456789abcdef", b"NEGOTIATE_UNIX_FD": b"AGREE_UNIX_FD"}
        writer.write(answer.get(line.split()[0], b"ERROR") + b"\r\n")


async def _received(reader: asyncio.StreamReader) -> Message:
    """Return one message, by the lengths in its header (D-Bus specification, message format)."""
    head = await reader.readexactly(16)
    body, fields = struct.unpack("<4xI4xI" if head[:1] == b"l" else ">4xI4xI", head)
    rest = await reader.readexactly(fields + -fields % 8 + body)
    message = Unmarshaller(io.BytesIO(head + rest)).unmarshall()  # type: ignore[arg-type]  # any reader will do
    assert message is not None
    return message


def _new_signal(path: str, interface: str, member: str, signature: str, body: list[Any]) -> Message:
    return Message(
        message_type=MessageType.SIGNAL, path=path, interface=interface, member=member, signature=signature, body=body
    )


def _error(call: Message, name: str, words: str) -> Message:
    return Message.new_error(call, name, words)
