"""Decides which MQTT messages about a fleet Home Assistant gets, and when. Pure: time is an argument.

Each car is a device with a few entities. One retained message, which the broker keeps for later clients, announces the
car (device discovery, Home Assistant 2024.11 and later). Then there are two topics for each car: `state`, one JSON
object with a value for each entity, and `availability`.

**A number is never older than it looks.** A value that was not measured, or is stale, is null, which Home Assistant
shows as unknown. States are not retained: a client that connects gets the next state, at most REPEAT_S later, and never
yesterday's. An entity expires after EXPIRE_S without a state, so a bridge that hangs leaves no old value on the screen.
Availability is retained, because Home Assistant reads it when it starts. It is `offline` for a car whose gateway has
gone or is silent, or whose link is lost. The bridge has an availability of its own, which the broker sets to `offline`
if the bridge's connection breaks (the bridge's last will). An entity is available only if the car and the bridge are;
for the connection, the bridge is enough.

**After a crash,** the broker still has what the bridge had retained: the announcements, and `online` for its cars. The
next bridge reads what is kept as availability when it begins (`adopt`), and publishes `offline` for cars that are not
on the bus. A bridge that ends normally removes all these messages, so Home Assistant forgets the devices.
"""

import json
from collections.abc import Callable, Iterable, Iterator, Mapping
from typing import Any, Final, NamedTuple

from msgspec import Struct

from fleet.client.car_state import CarState
from schemas import keys
from schemas.words import UNKNOWN, BatteryLevel, LinkState, Mode, Motors

BASE: Final = "car-fleet"
"""First part of our topics, but for those that Home Assistant defines: announcements, and its birth message."""
DISCOVERY_PREFIX: Final = "homeassistant"
"""Home Assistant's own default."""
ONLINE: Final = "online"
OFFLINE: Final = "offline"
STATE_INTERVAL_S: Final = 1.0
"""Minimum interval of the states of a car."""
REPEAT_S: Final = 10.0
"""Maximum interval of the states of a car that is available."""
EXPIRE_S: Final = 30
"""After this time without a state, Home Assistant shows no value."""
MAX_ANNOUNCED_CARS: Final = 256
"""Maximum number of devices, the same as that of the exporter. Without it, anybody on an open bus could invent cars
without end."""
_DIGITS: Final = 3
_AVAILABILITY_PARTS: Final = 4
"""Number of parts of the topic of a car's availability."""


class Publication(NamedTuple):
    """One MQTT message. A retained message without content removes the message that the broker keeps."""

    topic: str
    payload: str
    retain: bool = False


class Entity(Struct, frozen=True):
    """One value of a car."""

    name: str
    """The field of the value in the state, and the last part of the entity's id."""
    title: str
    value: Callable[[CarState, float], Any]
    """The value at a time. None means that it was not measured, or is stale."""
    config: Mapping[str, Any]
    """The entity's settings for Home Assistant. In a template, {0} stands for `name`."""
    of_absent: bool = False
    """True if the entity has a value even while the car is not available."""

    def component(self, car_id: str) -> dict[str, Any]:
        """Return the part of a car's announcement that describes this entity, without its availability."""
        template = self.config.get("value_template", "{{{{ value_json.{0} }}}}").format(self.name)
        return {
            **self.config,
            "name": self.title,
            "unique_id": f"{car_id}_{self.name}",
            "value_template": template,
            "expire_after": EXPIRE_S,
        }


def is_available(state: CarState, now: float) -> bool:
    """Return True if the car's gateway is on the bus and publishes, and the car's link is not lost."""
    link = state.fresh("state/link", now) if state.present else None
    return link is not None and link.state != LinkState.LOST


def _of(topic: str, read: Callable[[Any], Any]) -> Callable[[CarState, float], Any]:
    """Return a function that reads a value from a topic's newest message. It returns None if the message is stale."""
    return lambda state, now: None if (found := state.fresh(topic, now)) is None else read(found)


def _known(words: Iterable[str], word: str) -> str | None:
    return word if word in words and word != UNKNOWN else None


def _number(value: float) -> float:
    return round(value, _DIGITS)


def _sensor(device_class: str, unit: str) -> dict[str, Any]:
    return {
        "platform": "sensor",
        "device_class": device_class,
        "unit_of_measurement": unit,
        "state_class": "measurement",
    }


def _words(*words: str) -> dict[str, Any]:
    # Home Assistant rejects a value that is not an option, and null is not an option.
    return {
        "platform": "sensor",
        "device_class": "enum",
        "options": [*words, UNKNOWN],
        "value_template": "{{{{ value_json.{0} if value_json.{0} is not none else '" + UNKNOWN + "' }}}}",
    }


def _flag(device_class: str | None = None) -> dict[str, Any]:
    # A template prints True and False as these texts.
    config = {"platform": "binary_sensor", "payload_on": "True", "payload_off": "False"}
    return {**config, "device_class": device_class} if device_class else config


ENTITIES: Final = (
    Entity(
        "connected",
        "Connection",
        # In some modes, some cars send nothing: their links are quiet, and open.
        lambda state, now: is_available(state, now) and state.link.state in (LinkState.ONLINE, LinkState.QUIET),
        {**_flag("connectivity"), "entity_category": "diagnostic"},
        of_absent=True,
    ),
    Entity(
        "battery_v",
        "Battery voltage",
        _of("sensor/battery", lambda battery: _number(battery.voltage_v)),
        _sensor("voltage", "V"),
    ),
    Entity(
        "battery_level",
        "Battery level",
        _of("sensor/battery", lambda battery: _known(tuple(BatteryLevel), battery.level)),
        _words(*BatteryLevel),
    ),
    Entity(
        "distance_m",
        "Distance",
        _of("sensor/range", lambda each: _number(each.range_m) if each.HasField("range_m") else None),
        _sensor("distance", "m"),
    ),
    Entity(
        "mode",
        "Mode asked",
        _of("state/mode", lambda mode: _known(tuple(Mode), mode.asked)),
        _words(*Mode),
    ),
    Entity(
        "mode_inferred",
        "Mode by its readings",
        _of("state/mode", lambda mode: _known(tuple(Mode), mode.inferred)),
        _words(*Mode),
    ),
    Entity(
        "moving",
        "Motors",
        _of("state/safety", lambda safety: {Motors.ON: True, Motors.OFF: False}.get(safety.motors)),
        _flag("moving"),
    ),
    Entity(
        "estopped",
        "Emergency stop",
        _of("state/safety", lambda safety: bool(safety.estops)),
        _flag(),
    ),
)
"""All entities of a car."""


class HomeAssistant:
    """Decides what is published about one fleet. Times are in s, of one clock that the caller chooses."""

    def __init__(self, fleet: str, prefix: str = DISCOVERY_PREFIX, version: str = "") -> None:
        self._fleet = fleet
        self._prefix = prefix
        self._version = version
        self._said: dict[str, bool] = {}
        """The last published availability of each announced car. The car that has not changed for the longest time
        comes first."""
        self._states: dict[str, tuple[str, float]] = {}
        """The last published state of each car, and its time."""

    @property
    def bridge_availability(self) -> str:
        """Return the topic of the bridge's own availability. Its last will is published there, too."""
        return f"{BASE}/{self._fleet}/@mqtt/availability"

    @property
    def availabilities(self) -> str:
        """Return the topic filter of the availability of all cars."""
        return f"{BASE}/{self._fleet}/+/availability"

    @property
    def birth(self) -> str:
        """Return the topic on which Home Assistant publishes that it has started."""
        return f"{self._prefix}/status"

    def adopt(self, topic: str, payload: bytes) -> Iterator[Publication]:
        """Handle an availability that the broker has kept from an earlier bridge.

        If it says that a car is online, yield the message that corrects it.
        """
        parts = topic.split("/")
        if len(parts) != _AVAILABILITY_PARTS or topic == self.bridge_availability or not payload:
            return
        car = parts[2]
        if not keys.is_name(car) or self._said.get(car):
            return
        if car not in self._said and len(self._said) < MAX_ANNOUNCED_CARS:
            self._said[car] = False
        if payload != OFFLINE.encode():
            yield Publication(self._topic(car, "availability"), OFFLINE, retain=True)

    def begin(self) -> Iterator[Publication]:
        """Yield all that is known, for a broker that may have forgotten it, or a Home Assistant that has started."""
        yield Publication(self.bridge_availability, ONLINE, retain=True)
        self._states.clear()
        for car, available in self._said.items():
            yield from self._announcement(car, available=available)

    def news(self, states: Mapping[str, CarState], now: float) -> Iterator[Publication]:
        """Yield what has changed since the last call. `states` has the state of each car that was seen on the bus."""
        for car, state in sorted(states.items()):
            available = is_available(state, now)
            if car not in self._said:
                if not available:
                    continue
                yield from self._room()
                if len(self._said) >= MAX_ANNOUNCED_CARS:
                    continue
                self._said[car] = True
                yield from self._announcement(car, available=True)
            elif self._said[car] != available:
                yield self._availability(car, available=available)
            yield from self._state(car, state, now, available=available)
        for car in [each for each, available in self._said.items() if available and each not in states]:
            yield self._availability(car, available=False)

    def end(self) -> Iterator[Publication]:
        """Yield the messages that remove all announcements, so that Home Assistant forgets the cars."""
        for car in list(self._said):
            yield from self._removal(car)
        yield Publication(self.bridge_availability, "", retain=True)

    # ------------------------------------------------------------------ messages

    def _topic(self, car: str, name: str) -> str:
        return f"{BASE}/{self._fleet}/{car}/{name}"

    def _id(self, car: str) -> str:
        return f"{BASE}_{self._fleet}_{car}"

    def _config_topic(self, car: str) -> str:
        return f"{self._prefix}/device/{self._id(car)}/config"

    def _availability(self, car: str, *, available: bool) -> Publication:
        self._said.pop(car, None)
        self._said[car] = available  # at the end, because it has changed last
        return Publication(self._topic(car, "availability"), ONLINE if available else OFFLINE, retain=True)

    def _announcement(self, car: str, *, available: bool) -> Iterator[Publication]:
        yield Publication(self._topic(car, "availability"), ONLINE if available else OFFLINE, retain=True)
        yield Publication(self._config_topic(car), json.dumps(self._config(car)), retain=True)

    def _config(self, car: str) -> dict[str, Any]:
        """Return the announcement of a car."""
        title = car if self._fleet == keys.DEFAULT_FLEET else f"{self._fleet} {car}"
        bridge = {"topic": self.bridge_availability}
        both = [bridge, {"topic": self._topic(car, "availability")}]
        components = {
            each.name: {
                **each.component(self._id(car)),
                "availability": [bridge] if each.of_absent else both,
                "availability_mode": "all",
            }
            for each in ENTITIES
        }
        return {
            "device": {"identifiers": [self._id(car)], "name": title, "model": "robot car"},
            "origin": {"name": "zenoh-car-fleet", "sw_version": self._version},
            "components": components,
            "state_topic": self._topic(car, "state"),
            "qos": 1,
        }

    def _state(self, car: str, state: CarState, now: float, *, available: bool) -> Iterator[Publication]:
        values = {each.name: each.value(state, now) if available or each.of_absent else None for each in ENTITIES}
        text = json.dumps(values)
        before, at = self._states.get(car, ("", -REPEAT_S))
        if now - at >= (STATE_INTERVAL_S if text != before else REPEAT_S):
            self._states[car] = text, now
            yield Publication(self._topic(car, "state"), text)

    def _removal(self, car: str) -> Iterator[Publication]:
        self._said.pop(car, None)
        self._states.pop(car, None)
        yield Publication(self._config_topic(car), "", retain=True)
        yield Publication(self._topic(car, "availability"), "", retain=True)

    def _room(self) -> Iterator[Publication]:
        """Make room for another car: forget the car that has been away the longest."""
        if len(self._said) >= MAX_ANNOUNCED_CARS:
            away = next((car for car, available in self._said.items() if not available), None)
            if away is not None:
                yield from self._removal(away)
