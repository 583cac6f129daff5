"""The console on the network: HTTPS, and which devices are connected. `pairing` pairs them, pure modules decide."""

import asyncio
import logging
import socket
import ssl
import time
from asyncio import sslproto
from collections.abc import Callable, Hashable, Iterator
from contextlib import contextmanager
from typing import Any, Final

from msgspec.structs import replace

from fleet.console.certificate import Certificate, ensure_certificate
from fleet.console.connection_limit import ConnectionLimit, LogLimit
from fleet.console.pairing import Pairing
from fleet.console.people_book import COOKIE_LIFETIME_S, COOKIE_MEMORY_S, CookieState, PagePerson, PairedDevice
from fleet.console.people_file import PeopleFile
from fleet.console.request_filter import DEVICE, Scope
from fleet.hub.addresses import own_addresses, own_names
from schemas.rights import NO_PEOPLE, People

REVOCATION_INTERVAL_S: Final = 0.25
"""Interval at which the people file is read for revoked devices."""
TLS_BUFFER_BYTES: Final = 16 * 1024
"""Size of the buffer of a TLS connection, and of one read: one TLS record. asyncio's own buffers have 256 KiB, which is
160 MB for 640 connections."""
BACKLOG: Final = 1024
"""Maximum number of connections that wait in the kernel to be accepted: half a second at the highest rate."""
ADDRESS_INTERVAL_S: Final = 60.0
"""Interval at which this computer's addresses are read."""

log = logging.getLogger("fleet")


class LimitedListener(socket.socket):
    """A listening socket, and its connections that have begun TLS. `tls_entrance` accepts them."""

    limit: ConnectionLimit
    _accepted: dict[Hashable, socket.socket]

    @classmethod
    def on_port(cls, port: int) -> "LimitedListener":
        """Listen on all IPv4 addresses. Raises OSError if the port is in use."""
        made = cls(socket.AF_INET, socket.SOCK_STREAM, socket.IPPROTO_TCP)  # for TCP_NODELAY, as in `listen`
        made.limit, made._accepted = ConnectionLimit(), {}
        made.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            made.bind(("0.0.0.0", port))  # noqa: S104 - `--lan` asks for it
            made.listen(BACKLOG)
        except OSError:
            made.close()
            raise
        return made

    def admit(self, connection: socket.socket, address: tuple[str, int]) -> bool:
        """Keep a connection that begins TLS. Another one may have to end for it. Return False if there are too many."""
        self._forget_closed()
        admitted, ended = self.limit.admit(address, address[0], time.monotonic())
        if ended is not None:
            self._end(ended)
        if admitted:
            self._accepted[address] = connection
        return admitted

    def on_paired(self, key: Hashable, device: str) -> None:
        """Keep the connection of a paired device, or end it if the device has too many."""
        if not self.limit.on_paired(key, device):
            self._end(key)

    def expire(self) -> None:
        """End connections of strangers that have lasted too long."""
        self._forget_closed()
        for key in self.limit.expire(time.monotonic()):
            self._end(key)

    def _forget_closed(self) -> None:
        for key in [key for key, each in self._accepted.items() if each.fileno() == -1]:
            del self._accepted[key]
            self.limit.on_closed(key)

    def _end(self, key: Hashable) -> None:
        """End a connection that belongs to a transport of asyncio.

        The transport notices the end and closes the connection.
        """
        connection = self._accepted.pop(key, None)
        if connection is not None:
            try:
                connection.shutdown(socket.SHUT_RDWR)
            except OSError:  # the connection has just closed
                return


class Lan:
    """The part that all pages on the network share. The constructor raises OSError if no certificate can be made."""

    # The people file is changed in threads, because waiting for its lock on the loop would delay a STOP.

    def __init__(self, listener: LimitedListener, people: PeopleFile, listed: People = NO_PEOPLE) -> None:
        """Begin. `listed` are the people of the fleet, as far as they are known. Its gateways name them later."""
        self.listener = listener
        self.people = people
        self.port: int = listener.getsockname()[1]
        self.cookie = f"__Host-fleet_console_{self.port}"
        self.pairing = Pairing(people, listener.on_paired)
        self.addresses = own_addresses()
        self.names = frozenset(own_names())
        self.certificate: Certificate = ensure_certificate((*self.addresses, *own_names()))
        # asyncio has no parameter for the size of the buffer, which each TLS connection of this process has.
        sslproto.SSLProtocol.max_size = TLS_BUFFER_BYTES
        self.context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
        self.context.minimum_version = ssl.TLSVersion.TLSv1_2
        self.certificate.load_into(self.context)
        self._refusals = LogLimit()
        self._failures = LogLimit()
        self._shared_cookies = LogLimit()
        self._connected: dict[int, tuple[str, str, Callable[[], object], Callable[[], object]]] = {}
        """By number of the socket: its device, its address, and two functions. The first one closes the socket for
        good, the second one lets the page connect again."""
        self._last_socket = 0
        self.people.serve()
        self._write(listed)

    @property
    def address(self) -> str:
        """The address to open on a phone."""
        return f"https://{self.addresses[0] if self.addresses else '127.0.0.1'}:{self.port}"

    # ------------------------------------------------------------------ devices

    async def assign(self, device_id: str, person: PagePerson) -> None:
        """Make a guest a person. Its pages connect again as that person. Raises ValueError or OSError."""
        await asyncio.to_thread(self.people.change, lambda book: (book.assign(device_id, person, time.time()), None))
        log.warning("%s was assigned to %s", device_id, person.name)
        for device, _, _, renew in list(self._connected.values()):
            if device == device_id:
                renew()

    def set_cookie(self, cookie: str) -> str:
        """Return the header that gives a browser its cookie."""
        # The browser keeps the cookie for longer than the cookie opens the console, because an expired one still stops
        # the cars.
        age = int(COOKIE_LIFETIME_S + COOKIE_MEMORY_S)
        return f"{self.cookie}={cookie}; Path=/; Max-Age={age}; Secure; HttpOnly; SameSite=Strict"

    def device_of(self, cookie: str) -> tuple[PairedDevice | None, CookieState]:
        """Return the device of a cookie, and what the cookie may do."""
        return self.people.read().device_of(cookie, time.time())

    def _open_devices(self, now: float) -> list[PairedDevice]:
        return self.people.read().open_devices(now)

    def on_device(self, client: tuple[str, int], device: PairedDevice) -> None:
        """Keep a connection that has shown a cookie. Warn if two computers use the same cookie."""
        self.listener.on_paired(client, device.id)
        others = {address for id_, address, *_ in self._connected.values() if id_ == device.id} - {client[0]}
        if others and (words := self._shared_cookies.words("", time.monotonic())) is not None:
            places = ", ".join([client[0], *sorted(others)])
            log.warning(
                "the cookie of %s is in use at %s%s. If that is not one device, type: fleet console people --revoke %s",
                device.person.name, places, words, device.id,
            )  # fmt: skip

    def on_refusal(self, words: str) -> None:
        """Log a refused request. In a flood of refused requests, log only some."""
        if (shown := self._refusals.words(words, time.monotonic())) is not None:
            log.warning("%s", shown)

    def is_current(self, scope: Scope) -> bool:
        """Return True if the device of an open socket may still send."""
        return any(each.id == scope[DEVICE] for each in self._open_devices(time.time()))

    @contextmanager
    def connected(self, scope: Scope, close: Callable[[], object], renew: Callable[[], object]) -> Iterator[None]:
        """Keep a socket in the list of sockets that a revocation closes. `renew` lets the page connect again."""
        self._last_socket += 1
        number = self._last_socket
        self._connected[number] = scope[DEVICE], scope["client"][0], close, renew
        try:
            yield
        finally:
            self._connected.pop(number, None)

    def close_revoked(self) -> None:
        """Close the sockets of devices that were revoked or whose cookie has expired."""
        current = {each.id for each in self._open_devices(time.time())}
        for device, address, close, _ in list(self._connected.values()):
            if device not in current:
                log.warning("closed the page of %s at %s: revoked or expired", device, address)
                close()

    async def revoke(self, names: list[str]) -> list[PairedDevice]:
        """Revoke devices by id or person, and close their pages at once."""
        gone: list[PairedDevice] = await asyncio.to_thread(self.people.change, lambda book: book.revoke(names))
        self.close_revoked()
        return gone

    async def run(self, people: Callable[[], People | None]) -> None:
        """Close pages of revoked devices and renew the certificate until the task is cancelled.

        `people` returns the people of the fleet, or None if no gateway has named them yet.
        """
        next_look = time.monotonic() + ADDRESS_INTERVAL_S
        while True:
            await asyncio.sleep(REVOCATION_INTERVAL_S)
            self.listener.expire()
            self.close_revoked()
            try:
                await asyncio.to_thread(self._update_people, people())
            except OSError as error:
                if (words := self._failures.words(str(error), time.monotonic())) is not None:
                    log.error("the list of people cannot be written: %s", words)
            if time.monotonic() >= next_look:
                next_look = time.monotonic() + ADDRESS_INTERVAL_S
                try:
                    await asyncio.to_thread(self._renew)
                except OSError as error:
                    log.error("the certificate cannot be renewed: %s", error)

    def _renew(self) -> None:
        addresses, before = own_addresses(), self.address
        renewed = ensure_certificate((*addresses, *own_names()))
        self.addresses = addresses
        if self.address != before:
            self.people.change(lambda book: (replace(book, address=self.address), None))
        if renewed.fingerprint != self.certificate.fingerprint:
            renewed.load_into(self.context)
            self.certificate = renewed
            log.warning("the network is now %s, with a new certificate: SHA-256 %s", self.address, renewed.fingerprint)

    def _update_people(self, people: People | None) -> None:
        self.people.serve()
        book = self.people.read()
        if people is not None and (book.people, book.leads) != _names_of(people):
            self._write(people)

    def _write(self, listed: People) -> None:
        """Write address and people to the people file, where `fleet console pair` reads them."""
        people, leads = _names_of(listed)
        self.people.change(lambda book: (replace(book, address=self.address, people=people, leads=leads), None))

    def as_dict(self) -> dict[str, Any]:
        """Return what the page of the paired devices shows, as JSON values."""
        now = time.time()
        devices = [
            {
                "id": each.id,
                "name": each.person.name,
                "rank": each.person.rank,
                "device": each.device,
                "paired_s": int(each.paired_s),
                "days_left": int((each.expires_s - now) // 86_400),
                "addresses": sorted({address for id_, address, *_ in self._connected.values() if id_ == each.id}),
            }
            for each in self._open_devices(now)
        ]
        return {
            "address": self.address,
            "people": self.people.read().people or (),
            "fingerprint": self.certificate.fingerprint,
            "wrong_codes": self.pairing.guesses.wrong,
            "devices": devices,
        }


def _names_of(listed: People) -> tuple[tuple[str, ...] | None, tuple[str, ...] | None]:
    """Return the people and the leads for the people file, or None if the fleet lists nobody."""
    return (None, None) if listed.roles is None else (tuple(sorted(listed.roles)), listed.leads)
