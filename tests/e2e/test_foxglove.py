"""`fleet foxglove` as a process, read by a plain client of Foxglove's protocol, on a bus with certificates."""

import asyncio
import base64
import json
import struct
import threading
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Any, NamedTuple

import foxglove
import websockets
from google.protobuf.descriptor_pb2 import FileDescriptorSet

from fleet.bridges.foxglove_server import FoxgloveServer
from fleet.client.client import Fleet as Client
from schemas import keys, messages
from schemas.commands import Verb
from schemas.gen import fleet_v1_pb2 as pb
from schemas.identity import car, person
from schemas.topics import TOPICS, Qos
from schemas.words import Rank
from tests.support.processes import PATIENCE_S, TAKEN, FleetProcesses, GatewayProcess, wait_for
from tests.support.secure import ask, client_of, secure_fleet, sender_of

ANN = person("ann")
MESSAGE_DATA = 1
"""First byte of a frame with a message: then the id of the subscription, and the time."""


class Channel(NamedTuple):
    id: int
    kind: str
    schema: str


class FoxgloveClient:
    """A client of the subprotocol foxglove.sdk.v1. As Foxglove, it subscribes to each new channel of a wanted topic."""

    def __init__(self, socket: websockets.ClientConnection) -> None:
        self.socket = socket
        self.info: dict[str, Any] = {}
        self.channels: dict[str, Channel] = {}
        self.came: dict[str, list[bytes]] = {}
        self.statuses: list[dict[str, Any]] = []
        self._wanted: set[str] = set()
        self._topics: dict[int, str] = {}

    async def until(self, so: Callable[[], Any], what: str) -> None:
        async with asyncio.timeout(PATIENCE_S):
            while not so():
                await self._take(await self.socket.recv())
        assert so(), what

    async def subscribe(self, topic: str) -> None:
        await self.until(lambda: topic in self.channels, f"{topic} is advertised")
        self._wanted.add(topic)
        await self._subscribe_to_channel(topic)

    async def _subscribe_to_channel(self, topic: str) -> None:
        channel = self.channels[topic].id
        self._topics[channel] = topic
        wanted = {"op": "subscribe", "subscriptions": [{"id": channel, "channelId": channel}]}
        await self.socket.send(json.dumps(wanted))

    async def _take(self, frame: str | bytes) -> None:
        if isinstance(frame, bytes):
            kind, subscription, _ = struct.unpack_from("<BIQ", frame)
            assert kind == MESSAGE_DATA
            self.came.setdefault(self._topics[subscription], []).append(frame[13:])
            return
        said = json.loads(frame)
        match said["op"]:
            case "serverInfo":
                self.info = said
            case "advertise":
                for each in said["channels"]:
                    assert (each["encoding"], each["schemaEncoding"]) == ("protobuf", "protobuf")
                    self.channels[each["topic"]] = Channel(each["id"], each["schemaName"], each["schema"])
                    if each["topic"] in self._wanted:
                        await self._subscribe_to_channel(each["topic"])
            case "status":
                self.statuses.append(said)


@asynccontextmanager
async def foxglove_client(address: str) -> AsyncIterator[FoxgloveClient]:
    async with websockets.connect(address, subprotocols=[websockets.Subprotocol("foxglove.sdk.v1")]) as socket:
        yield FoxgloveClient(socket)


def serve(fleet: FleetProcesses) -> tuple[GatewayProcess, str]:
    server = fleet.start("-m", "fleet.cli", "foxglove", "--port", "0")
    return server, str(wait_for(server.lines, "it serves")[0].split()[1])


def test_client_reads_a_car_live_with_its_schemas(tmp_path: Path) -> None:
    async def look(address: str, fleet: FleetProcesses) -> None:
        async with foxglove_client(address) as client:
            battery = keys.topic_key("fleet", "red", "sensor/battery")
            await client.subscribe(battery)
            await client.until(lambda: client.came.get(battery), "a battery")
            assert 6 < pb.Battery.FromString(client.came[battery][0]).voltage_v < 9
            # It can do nothing but look.
            assert client.info["capabilities"] == []
            command = {"id": 1, "topic": "fleet/red/@cmd/drive", "encoding": "json", "schemaName": ""}
            await client.socket.send(json.dumps({"op": "advertise", "channels": [command]}))
            await client.until(lambda: client.statuses, "it is refused")
            # The first command of a car is shown, too, although nobody could subscribe to it before.
            async with asyncio.timeout(PATIENCE_S):
                await asyncio.to_thread(estop)
            await client.subscribe("fleet/red/event/command")
            found = client.came.setdefault("fleet/red/event/command", [])
            await client.until(lambda: found, "the command is shown")
            assert pb.CommandEvent.FromString(found[0]).verb == "estop"
        for topic, channel in client.channels.items():
            known = TOPICS[topic.removeprefix("fleet/").removeprefix("red/")]
            assert channel.kind == known.message
            schema = FileDescriptorSet.FromString(base64.b64decode(channel.schema))
            assert schema.SerializeToString() == messages.descriptor_set(known.message)

    with secure_fleet(tmp_path, ANN, [car("red")]) as (fleet, store):
        _, (link,) = fleet.simulate("red:arduino:tcp")
        fleet.gateway(link)

        def estop() -> None:
            with client_of(store.credentials, ANN) as ann:
                (answer,) = ask(
                    ann, keys.command_key("fleet", "red", Verb.ESTOP, ANN), sender=sender_of(ANN), kind=Rank.PERSON
                )
            assert answer["status"] in TAKEN

        server, address = serve(fleet)
        asyncio.run(look(address, fleet))
        port = address.rpartition(":")[2]
        taken = fleet.start("-m", "fleet.cli", "foxglove", "--port", port)
        assert taken.wait() == 1
        assert "fleet foxglove --port 0" in taken.stderr
        layout = fleet.start("-m", "fleet.cli", "foxglove", "--layout")
        assert layout.wait() == 0
        assert "fleet/red/sensor/range.range_m" in "\n".join(layout.lines())
        assert server.end() == 0
        assert server.stderr == ""


def test_refused_client_gets_new_channel(fleet: FleetProcesses) -> None:
    """The SDK refuses a client that is too fast. Here it subscribes before there is a channel, so that it surely is."""
    with Client(fleet.endpoint) as viewer:
        server = FoxgloveServer(viewer, "127.0.0.1", 0)
        number = foxglove.Channel("before", message_encoding="json", context=foxglove.Context()).id() + 1
        battery = keys.topic_key("fleet", "red", "sensor/battery")
        ended = threading.Event()

        def serve_and_publish() -> None:
            while not ended.wait(0.02):
                payload = pb.Battery(voltage_v=7.4).SerializeToString()
                fleet.bus.put_again(battery, payload, TOPICS["sensor/battery"].encoding, 0, Qos.READING)
                server.step()

        async def look() -> None:
            async with foxglove_client(f"ws://127.0.0.1:{server.port}") as client:
                wanted = {"op": "subscribe", "subscriptions": [{"id": number, "channelId": number}]}
                await client.socket.send(json.dumps(wanted))
                await client.until(lambda: client.statuses, "it is refused")
                stepping = asyncio.create_task(asyncio.to_thread(serve_and_publish))
                try:
                    await client.until(lambda: battery in client.channels, "the channel is there")
                    assert client.channels[battery].id == number
                    await client.until(lambda: client.channels[battery].id != number, "there is a new one")
                    await client.subscribe(battery)
                    await client.until(lambda: client.came.get(battery), "a battery")
                finally:
                    ended.set()
                    await stepping

        try:
            asyncio.run(look())
        finally:
            server.close()


def test_odd_messages_and_stalled_client_disturb_nobody(tmp_path: Path, fleet: FleetProcesses) -> None:
    count, payload = 20_000, pb.Range(range_m=1.5, car="x" * 1000).SerializeToString()
    range_key, plan_key, own = "fleet/red/sensor/range", "fleet/@coordinator/plan", "fleet/red/sensor/battery"

    async def look(address: str) -> None:
        async with foxglove_client(address) as stalled, foxglove_client(address) as client:
            put("fleet/red/odd", b"\xff\xfe", "application/protobuf;fleet.v1.Range")
            for kind in ("fleet.v1.Nothing", "x" * 200):
                put("fleet/red/none", b"", f"application/protobuf;{kind}")
            put("fleet/red/text", b"hello\x1b[31m", "text/plain")
            put(own, payload, "application/protobuf;fleet.v1.Range")
            plan = pb.Plan(car="@coordinator").SerializeToString()
            put(plan_key, plan, TOPICS["@coordinator/plan"].encoding)
            await client.until(lambda: plan_key in client.channels, "the plan is advertised")
            assert set(client.channels) == {f"stray/{own}/fleet.v1.Range", plan_key}
            # Who subscribes late has the plan that was published before.
            await client.subscribe(plan_key)
            await client.until(lambda: client.came.get(plan_key), "the plan")
            assert plan_key not in stalled.came
            put(range_key, payload, TOPICS["sensor/range"].encoding)
            for each in (stalled, client):
                await each.subscribe(range_key)
            stalled.socket.transport.pause_reading()
            rss_mb = server.rss_mb()
            done = asyncio.create_task(asyncio.to_thread(flood))
            last = pb.Range(range_m=2.5).SerializeToString()

            async def say_the_last() -> None:
                await done
                while last not in client.came.get(range_key, []):
                    put(range_key, last, TOPICS["sensor/range"].encoding)
                    await asyncio.sleep(0.1)

            saying = asyncio.create_task(say_the_last())
            await client.until(lambda: last in client.came.get(range_key, []), "the last message")
            await saying
            stalled.socket.transport.abort()
            assert server.rss_mb() < rss_mb + 60
            assert server.popen.poll() is None

    def put(key: str, payload: bytes, encoding: str) -> None:
        fleet.bus.put_again(key, payload, encoding, 0, Qos.READING)

    def flood() -> None:
        for _ in range(count):
            put(range_key, payload, TOPICS["sensor/range"].encoding)

    server, address = serve(fleet)
    asyncio.run(look(address))
    assert server.end() == 0
    lines = server.stderr.splitlines()
    assert [line.split(":")[1].split()[-1] for line in lines] == [
        "fleet/red/none", "fleet/red/odd", "fleet/red/text"
    ]  # fmt: skip
    assert "\x1b" not in server.stderr
