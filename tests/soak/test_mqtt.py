"""`fleet mqtt` with a real mosquitto, a gateway and a bus with certificates. It needs mosquitto on the PATH."""

import contextlib
import json
import shutil
import signal
import subprocess
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import paho.mqtt.client as paho
import pytest
from paho.mqtt.enums import CallbackAPIVersion

from fleet.bridges.home_assistant import ENTITIES
from fleet.commands.mqtt import PASSWORD_VARIABLE
from schemas import keys
from schemas.commands import Verb
from schemas.identity import car, person
from schemas.words import Rank
from tests.support.ports import free_port
from tests.support.processes import PATIENCE_S, TAKEN, FleetProcesses, GatewayProcess, wait_for
from tests.support.secure import ask, client_of, secure_fleet, sender_of

pytestmark = [pytest.mark.soak, pytest.mark.timeout(600)]

ANN = person("ann")
RED = "car-fleet/fleet/red"
BRIDGE = "car-fleet/fleet/@mqtt/availability"
CONFIG = "homeassistant/device/car-fleet_fleet_red/config"
USER, PASSWORD = "cars", "correct horse"


class Mosquitto:
    """A broker that knows one user. It keeps nothing over a restart."""

    def __init__(self, directory: Path) -> None:
        assert shutil.which("mosquitto"), "mosquitto is not installed: apt install mosquitto"
        self.port = free_port()
        users = directory / "users"
        subprocess.run(["mosquitto_passwd", "-c", "-b", str(users), USER, PASSWORD], check=True, capture_output=True)
        self._config = directory / "mosquitto.conf"
        self._config.write_text(
            f"listener {self.port} 127.0.0.1\npassword_file {users}\nuser root\n"
            "allow_anonymous false\npersistence false\n"
        )
        self.start()

    def start(self) -> None:
        self.process = subprocess.Popen(["mosquitto", "-c", str(self._config)], stderr=subprocess.DEVNULL)

    def kill(self) -> None:
        self.process.kill()
        self.process.wait()

    def pause(self) -> None:
        self.process.send_signal(signal.SIGSTOP)

    def resume(self) -> None:
        self.process.send_signal(signal.SIGCONT)


class MqttReader:
    """A client that hears everything, as Home Assistant does."""

    def __init__(self, port: int) -> None:
        self.newest: dict[str, bytes] = {}
        self.retained: dict[str, bytes] = {}
        self._connected = threading.Event()
        self.client = paho.Client(CallbackAPIVersion.VERSION2)
        self.client.username_pw_set(USER, PASSWORD)
        self.client.reconnect_delay_set(1, 1)
        self.client.on_connect = lambda client, *_: client.subscribe("#", qos=1)
        self.client.on_subscribe = lambda *_: self._connected.set()
        self.client.on_message = self._on_message
        wait_for(lambda: self._connects(port), "the broker listens")
        self.client.loop_start()
        assert self._connected.wait(PATIENCE_S)

    def _connects(self, port: int) -> bool:
        with contextlib.suppress(OSError):
            return self.client.connect("127.0.0.1", port) == 0
        return False

    def _on_message(self, _client: Any, _data: Any, message: paho.MQTTMessage) -> None:
        self.newest[message.topic] = bytes(message.payload)
        if message.retain:
            self.retained[message.topic] = bytes(message.payload)

    def value(self, name: str) -> Any:
        return json.loads(self.newest.get(f"{RED}/state", b"{}")).get(name)

    def close(self) -> None:
        self.client.disconnect()
        self.client.loop_stop()


@pytest.fixture
def broker(tmp_path: Path) -> Iterator[Mosquitto]:
    made = Mosquitto(tmp_path)
    yield made
    made.resume()
    made.kill()


@pytest.fixture
def reader(broker: Mosquitto) -> Iterator[MqttReader]:
    made = MqttReader(broker.port)
    yield made
    made.close()


def bridge(fleet: FleetProcesses, broker: Mosquitto, password: str = PASSWORD) -> GatewayProcess:
    fleet.environment[PASSWORD_VARIABLE] = password
    url = f"mqtt://127.0.0.1:{broker.port}"
    return fleet.start("-m", "fleet.cli", "mqtt", "--broker", url, "--user", USER)


def told(process: GatewayProcess, words: str) -> None:
    """Wait until the bridge prints a line with these words."""
    wait_for(lambda: any(words in line for line in process.lines()), f"it says: {words}")


def kept(broker: Mosquitto) -> dict[str, bytes]:
    """Return what the broker keeps, as a new client gets it before a message of its own."""
    new = MqttReader(broker.port)
    try:
        new.client.publish("marker", "x", qos=1)
        wait_for(lambda: "marker" in new.newest, "the marker")
        return new.retained
    finally:
        new.close()


def test_car_comes_acts_and_goes(tmp_path: Path, broker: Mosquitto, reader: MqttReader) -> None:
    with secure_fleet(tmp_path, ANN, [car("red")]) as (fleet, store):
        refused = bridge(fleet, broker, "wrong")
        assert refused.wait() == 1
        assert PASSWORD_VARIABLE in refused.stderr
        _, (link,) = fleet.simulate("red:arduino:tcp")
        gateway = fleet.gateway(link)
        mqtt = bridge(fleet, broker)
        wait_for(lambda: reader.value("battery_v"), "its battery")
        wait_for(lambda: reader.value("moving") is False, "its motors are off")
        assert 6 < reader.value("battery_v") < 9
        assert reader.value("distance_m") > 0
        assert reader.newest[f"{RED}/availability"] == reader.newest[BRIDGE] == b"online"
        assert set(json.loads(reader.newest[CONFIG])["components"]) == {each.name for each in ENTITIES}
        # Whatever comes from the broker, even on its own topics, commands nothing and ends nothing.
        for topic in (f"{RED}/set", f"{RED}/availability", "homeassistant/status", CONFIG):
            reader.client.publish(topic, b"\xff\xfe{drive}", qos=1)
        with client_of(store.credentials, ANN) as ann:
            key = keys.command_key("fleet", "red", Verb.ESTOP, ANN)
            (answer,) = ask(ann, key, sender=sender_of(ANN), kind=Rank.PERSON)
            assert answer["status"] in TAKEN
        wait_for(lambda: reader.value("estopped"), "the e-stop is in force")
        # Home Assistant restarts, and reads everything again.
        del reader.newest[CONFIG]
        reader.client.publish("homeassistant/status", b"online", qos=1)
        wait_for(lambda: CONFIG in reader.newest, "it is announced again")
        gateway.kill()
        wait_for(lambda: reader.newest[f"{RED}/availability"] == b"offline", "its gateway is gone")
        wait_for(lambda: reader.value("connected") is False, "and its connection")
        assert reader.value("battery_v") is None
        fleet.gateway(link)
        wait_for(lambda: reader.newest[f"{RED}/availability"] == b"online", "it is back")
        assert set(kept(broker)) == {f"{RED}/availability", BRIDGE, CONFIG}
        assert mqtt.end() == 0
        assert kept(broker) == {}


def test_password_that_is_refused_after_an_outage_is_told(tmp_path: Path, broker: Mosquitto) -> None:
    with contextlib.closing(FleetProcesses(f"tcp/127.0.0.1:{free_port()}", tmp_path)) as fleet:
        broker.kill()
        mqtt = bridge(fleet, broker, "wrong")
        told(mqtt, "is away")
        broker.start()
        told(mqtt, "refuses")
        assert mqtt.end() == 0


def test_broker_outage_and_killed_bridge(tmp_path: Path, broker: Mosquitto, reader: MqttReader) -> None:
    with contextlib.closing(FleetProcesses(f"tcp/127.0.0.1:{free_port()}", tmp_path)) as fleet:
        _, (link,) = fleet.simulate("red:arduino:tcp")
        gateway = fleet.gateway(link)
        mqtt = bridge(fleet, broker)
        wait_for(lambda: reader.value("battery_v"), "its battery")
        broker.kill()
        told(mqtt, "is away")
        reader.newest.clear()
        broker.start()  # it knows nothing any more
        wait_for(lambda: CONFIG in reader.newest and reader.value("battery_v"), "all is said again")
        assert kept(broker).keys() == {f"{RED}/availability", BRIDGE, CONFIG}
        # The broker hangs. The cars do not notice, and the bridge ends in time.
        broker.pause()
        assert fleet.ask(Verb.STOP, sender="x@y-1", kind="person")["status"] in TAKEN
        assert mqtt.end() == 0
        broker.resume()
        # It reads what was taken back, or it sends the last will.
        wait_for(lambda: reader.newest[BRIDGE] != b"online", "it knows that the bridge is gone")
        mqtt = bridge(fleet, broker)
        wait_for(lambda: reader.newest[BRIDGE] == b"online", "another one is there")
        wait_for(lambda: reader.newest[f"{RED}/availability"] == b"online", "the car, too")
        mqtt.kill()
        wait_for(lambda: reader.newest[BRIDGE] == b"offline", "the last will")
        gateway.end()
        assert kept(broker)[f"{RED}/availability"] == b"online", "a killed bridge says nothing"
        mqtt = bridge(fleet, broker)
        wait_for(lambda: reader.newest[f"{RED}/availability"] == b"offline", "the next one takes it back")
        assert mqtt.end() == 0
        assert kept(broker) == {}
