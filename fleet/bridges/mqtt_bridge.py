"""Publishes the cars of a fleet to an MQTT broker, for Home Assistant. No message from the broker is a command.

One loop reads the bus all the time, so that the bus never waits for a broker. Another loop keeps a connection to the
broker, and sends what has changed since the last time. Nothing is queued for a broker that is slow or away. When it is
back, it gets the state of that moment.
"""

import asyncio
import logging
import ssl
import time
from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from typing import Final

import aiomqtt
from msgspec import Struct

from fleet.bridges.home_assistant import OFFLINE, HomeAssistant, Publication
from fleet.client.car_state import CarState
from fleet.client.client import Fleet
from fleet.coordinator.inbox import Inbox
from fleet.coordinator.observer import FleetObserver
from schemas.backoff import backoff_s
from schemas.process import signals

PLAIN_PORT: Final = 1883
TLS_PORT: Final = 8883
_WAIT_S: Final = 0.25
"""Maximum time until a change is noticed."""
_TOPICS: Final = ("state/*", "sensor/battery", "sensor/range")
_BROKER_TIMEOUT_S: Final = 5.0
"""Timeout of each exchange with the broker. After it, the connection is opened again."""
_KEEPALIVE_S: Final = 10
"""After this silence, the bridge sends the broker a ping. After one and a half times this silence, the broker publishes
the bridge's last will: that the bridge is offline."""
_FAREWELL_TIMEOUT_S: Final = 1.0
"""Timeout for the broker's first answer when the bridge ends."""
_END_TIMEOUT_S: Final = 5.0
"""Timeout for removing all announcements at the end. There may be 256 of them (MAX_ANNOUNCED_CARS)."""
_FIRST_RETRY_S: Final = 0.5
_LONGEST_RETRY_S: Final = 10.0
_MAX_INCOMING: Final = 1024
"""Maximum number of unread messages from the broker. They say which cars have the availability `online` from an earlier
bridge, and when Home Assistant has started."""
_REFUSED: Final = frozenset({4, 5, 134, 135})
"""Codes with which a broker refuses the user or the password, in MQTT 3.1.1 and 5."""

_SILENT: Final = logging.getLogger(f"{__name__}.paho")
"""The logger of paho. It is silent, because `notify` tells a person the same."""
_SILENT.setLevel(logging.CRITICAL + 1)


class BrokerRefused(Exception):
    """The broker refuses this user or password. The message says so."""


class Broker(Struct, frozen=True):
    """The address of the broker, and the user under which we log in there."""

    host: str
    port: int
    user: str | None = None
    password: str | None = None
    tls: ssl.SSLContext | None = None

    @property
    def words(self) -> str:
        """Return the broker's address as a person writes it."""
        return f"{self.host}:{self.port}"


class MqttBridge:
    """Publishes one fleet to one broker.

    `notify` is called with news for a person: the broker is reached, or it is away.
    """

    def __init__(self, client: Fleet, broker: Broker, home: HomeAssistant, notify: Callable[[str], object]) -> None:
        self._inbox = Inbox.listening(client, _TOPICS)
        self._observer = FleetObserver()
        self._broker = broker
        self._home = home
        self._notify = notify

    async def run(self) -> None:
        """Publish until a signal ends the process.

        Raises BrokerRefused, but only at the first attempt to connect. After a later refusal, the bridge tries again.
        """
        ended = asyncio.Event()
        signals.calls_in(asyncio.get_running_loop(), lambda _: ended.set())
        with ThreadPoolExecutor(max_workers=4) as pool:
            hearing = asyncio.create_task(self._read_bus(pool))
            publishing = asyncio.create_task(self._connect(ended))
            waiting = asyncio.create_task(ended.wait())
            try:
                await asyncio.wait({hearing, publishing, waiting}, return_when=asyncio.FIRST_COMPLETED)
                if waiting.done() and not publishing.done():
                    await asyncio.wait({publishing}, timeout=_END_TIMEOUT_S)
            finally:
                for task in (hearing, publishing, waiting):
                    task.cancel()
                found = await asyncio.gather(hearing, publishing, waiting, return_exceptions=True)
        for each in found:
            if isinstance(each, Exception):
                raise each

    # ------------------------------------------------------------------ the bus

    async def _read_bus(self, pool: ThreadPoolExecutor) -> None:
        loop = asyncio.get_running_loop()
        while True:
            heard = await loop.run_in_executor(pool, self._inbox.hear, _WAIT_S, pool)
            for car, alive in heard.gateways.items():
                self._observer.on_token(car, heard.now, alive=alive)
            for sample, wall_s in heard.samples:
                self._observer.on_sample(sample, heard.now, wall_s)
            self._observer.forget(heard.now, ())

    # ------------------------------------------------------------------ the broker

    async def _connect(self, ended: asyncio.Event) -> None:
        """Connect, and connect again whenever the connection breaks, until the end."""
        failures = 0
        connected: bool | None = None  # None before the first attempt
        was_refused = False
        while not ended.is_set():
            try:
                async with self._client() as client:
                    if connected is not True:
                        self._notify(f"Publishing to {self._broker.words} (Ctrl-C ends it)")
                    connected, failures, was_refused = True, 0, False
                    await self._publish(client, ended)
            except aiomqtt.MqttError as error:
                refused = isinstance(error, aiomqtt.MqttCodeError) and _code(error) in _REFUSED
                if refused and connected is None:
                    raise BrokerRefused(f"{self._broker.words} refuses the user or the password") from None
                if refused and not was_refused:
                    self._notify(f"{self._broker.words} refuses the user or the password. The bridge tries again.")
                elif not refused and connected is not False:
                    self._notify(f"The broker at {self._broker.words} is away ({error}). The bridge tries again.")
                connected, failures, was_refused = False, failures + 1, refused
                with suppress(TimeoutError):
                    await asyncio.wait_for(ended.wait(), backoff_s(failures, _FIRST_RETRY_S, _LONGEST_RETRY_S))

    def _client(self) -> aiomqtt.Client:
        return aiomqtt.Client(
            self._broker.host,
            self._broker.port,
            username=self._broker.user,
            password=self._broker.password,
            tls_context=self._broker.tls,
            timeout=_BROKER_TIMEOUT_S,
            keepalive=_KEEPALIVE_S,
            max_queued_incoming_messages=_MAX_INCOMING,
            logger=_SILENT,
            will=aiomqtt.Will(self._home.bridge_availability, OFFLINE, qos=1, retain=True),
        )

    async def _publish(self, client: aiomqtt.Client, ended: asyncio.Event) -> None:
        """Publish news over one connection until it breaks, or until the end."""
        tasks = [asyncio.create_task(each) for each in (self._send_news(client), self._answer(client), ended.wait())]
        try:
            done, _ = await asyncio.wait(tasks, return_when=asyncio.FIRST_COMPLETED)
            for each in done:
                each.result()  # raises the error that ended the connection
        finally:
            for each in tasks:
                each.cancel()
            await asyncio.gather(*tasks, return_exceptions=True)
        # If there are unread bytes when we close the connection, it is reset, which looks like a crash to the broker.
        # So unsubscribe first. If the broker hangs, send the last messages without waiting for it (qos 0). Either it
        # reads them later, or it publishes our last will.
        qos = 1
        try:
            await client.unsubscribe([self._home.availabilities, self._home.birth], timeout=_FAREWELL_TIMEOUT_S)
        except aiomqtt.MqttError:
            qos = 0
        await _send(client, self._home.end(), qos)

    async def _send_news(self, client: aiomqtt.Client) -> None:
        await client.subscribe([(self._home.availabilities, 1), (self._home.birth, 1)])
        await _send(client, self._home.begin())
        while True:
            await _send(client, self._home.news(self._cars(), time.monotonic()))
            await asyncio.sleep(_WAIT_S)

    async def _answer(self, client: aiomqtt.Client) -> None:
        async for message in client.messages:
            topic, payload = str(message.topic), message.payload
            if topic == self._home.birth:
                if payload == b"online" and not message.retain:
                    await _send(client, self._home.begin())
            elif isinstance(payload, bytes):
                await _send(client, self._home.adopt(topic, payload))

    def _cars(self) -> dict[str, CarState]:
        """Return the cars that are known, with the newest messages about them."""
        return {
            car: state
            for car in self._observer.snapshot(()).cars
            if (state := self._observer.states.get(car)) is not None
        }


async def _send(client: aiomqtt.Client, publications: Iterable[Publication], qos: int = 1) -> None:
    # Compute all of them first, because the state of `_home` may change while one is sent.
    for each in list(publications):
        await client.publish(each.topic, each.payload, qos=qos, retain=each.retain)


def _code(error: aiomqtt.MqttCodeError) -> int | None:
    return error.rc if isinstance(error.rc, int) or error.rc is None else error.rc.value
