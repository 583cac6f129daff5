"""Observes the fleet for the coordinator: tokens and messages in, snapshots (policy/snapshot.py) out. No Zenoh."""

from collections.abc import Container, Iterable, Mapping
from itertools import islice
from typing import Any, Final

from msgspec import Struct, field
from msgspec.structs import replace

from fleet.client.car_state import CarState
from fleet.client.reading import age_of_answer_s
from fleet.fleetfile.fleet_file import FleetFile
from fleet.policy.snapshot import CarSnapshot, FleetSnapshot, Refusal
from schemas import keys, messages, topics
from schemas.bus import Sample
from schemas.platform_name import AUTO
from schemas.rights import People, binding_pause

REQUIRED_TOPICS: Final = ("state/link", "state/mode", "state/motion", "state/safety")
"""The states that could forbid a command. A car is confirmed when all of them are known."""
FORGET_AFTER_S: Final = 60.0
"""Time after which a car without a gateway is forgotten, unless the fleet file or the plan names it."""
MAX_ABSENT_CARS: Final = 256
"""Maximum number of remembered cars without a gateway. The car that left first is forgotten first."""
MAX_UNCONFIRMED_CARS: Final = 256
"""Maximum number of unlisted names on the bus that count as cars before they publish their states."""


class FleetObserver(Struct):
    """The cars as last observed. `listed` has the cars in the fleet file, and is empty if there is no file."""

    listed: Mapping[str, CarSnapshot] = field(default_factory=dict)
    cars: dict[str, CarSnapshot] = field(default_factory=dict)
    states: dict[str, CarState] = field(default_factory=dict)
    """State of each car by name, as heard on the bus."""
    _absent_since: dict[str, float] = field(default_factory=dict)
    """Time since which unlisted cars have had no gateway on the bus, in the order in which they left."""
    _confirmed: set[str] = field(default_factory=set)
    """Cars that have published all REQUIRED_TOPICS once, present or not."""

    def __post_init__(self) -> None:
        self.cars.update(self.listed)

    @property
    def present(self) -> frozenset[str]:
        """The cars whose gateways are on the bus."""
        return frozenset(car for car, known in self.cars.items() if known.present)

    @property
    def unconfirmed(self) -> frozenset[str]:
        """The present cars with an unknown state among REQUIRED_TOPICS."""
        return frozenset(car for car in self.present if car not in self.states or not _all_known(self.states[car]))

    @property
    def people(self) -> People:
        """The people of the fleet, as far as the gateways know them."""
        return People.merged(state.authority.people for state in self.states.values())

    def snapshot(self, busy: Iterable[str]) -> FleetSnapshot:
        """Return a snapshot. `busy` are the cars with a pending mode command."""
        # An unlisted name counts as a car once it has published its states. Before that, only a limited number of
        # such names count, and only while they are present.
        cars = {car: known for car, known in self.cars.items() if known.listed or car in self._confirmed}
        unconfirmed = (each for each in self.cars.items() if each[1].present and each[0] not in cars)
        cars.update(list(islice(unconfirmed, MAX_UNCONFIRMED_CARS)))
        cars.update({car: replace(cars[car], busy=True) for car in busy if car in cars})
        return FleetSnapshot(
            cars, {car: dict(state.newest_by_topic) for car, state in self.states.items() if car in cars}
        )

    def on_token(self, car: str, now: float, *, alive: bool) -> None:
        """Note that a gateway came or went. Drop its car's states: a hold may have changed in the meantime."""
        try:
            keys.check_name(car)
        except keys.BadKey:
            return  # no gateway has such a name, so no command could reach it
        if alive:
            self._absent_since.pop(car, None)
        elif car not in self.listed:
            if car not in self._confirmed:
                self._forget(car)
                return
            self._absent_since.setdefault(car, now)
        self.cars[car] = replace(self.listed.get(car, CarSnapshot()), present=alive)
        if (state := self.states.get(car)) is not None:
            # A gateway that comes back counts as new, even if its `boot_id` is that of before, as when a recording is
            # played in a loop.
            readings = {topic: each for topic, each in state.newest_by_topic.items() if topic.startswith("sensor/")}
            self.states[car] = CarState(car, alive, readings)

    def forget(self, now: float, needed: Container[str]) -> None:
        """Forget cars that have been absent for FORGET_AFTER_S, except the `needed`."""
        for car, since in list(self._absent_since.items()):
            if now - since < FORGET_AFTER_S and len(self._absent_since) <= MAX_ABSENT_CARS:
                return
            if car not in needed:
                self._forget(car)

    def _forget(self, car: str) -> None:
        self._confirmed.discard(car)
        for each in (self.cars, self.states, self._absent_since):
            each.pop(car, None)

    def on_sleep(self, slept_s: float) -> None:
        """Add a sleep of the computer to the age of all readings, because the clock of their times stood still."""
        for state in self.states.values():
            state.on_sleep(slept_s)

    def on_outcome(self, car: str, mode: str, refusal: Refusal | None) -> None:
        """Note the outcome of a command for a mode. `refusal` is None if the command succeeded."""
        if car in self.cars:
            self.cars[car] = self.cars[car].with_outcome(mode, refusal)

    def on_sample(self, sample: Sample, now: float, wall_s: float | None) -> None:
        """Add a message.

        If the message is the answer to a query, it may be old. Then `wall_s` is our wall clock, otherwise None.
        """
        key = keys.parse(sample.key)
        topic = None if key is None else topics.TOPICS.get(key.topic)
        if key is None or topic is None:
            return
        try:
            value: Any = messages.parse(topic.message, sample.payload, sample.encoding)
        except messages.BadPayload:
            return  # not from a gateway of this version
        if key.car not in self.listed and not self.cars.get(key.car, CarSnapshot()).present:
            self._absent_since.setdefault(key.car, now)
        state = self.states.get(key.car)
        if state is None:
            state = self.states[key.car] = CarState(key.car, self.cars.get(key.car, CarSnapshot()).present)
        at = now if wall_s is None else now - age_of_answer_s(messages.stamp_ns(value.stamp) / 1e9, wall_s)
        if state.take(key.topic, value, at) and key.topic.startswith("state/"):
            self._update(state)

    def _update(self, state: CarState) -> None:
        before = self.cars.get(state.car, CarSnapshot())
        health = state.newest("state/health")
        if health is not None:
            capabilities = before.capabilities if before.listed else frozenset(health.capabilities)
            before = replace(before, platform=health.platform, capabilities=capabilities)
            self.cars[state.car] = before
        if not before.present or not _all_known(state):
            return
        self._confirmed.add(state.car)
        authority, pause = state.authority, binding_pause(state.safety.pauses)
        self.cars[state.car] = replace(
            before,
            link=state.link.state,
            mode=state.mode.asked,
            verdict=state.mode.verdict,
            evidence=state.mode.evidence,
            motors=state.safety.motors,
            doubted=state.health.doubted,
            held_by=authority.hold.by if authority.hold else None,
            estopped_by=authority.estops[0].by if authority.estops else None,
            paused_by=pause.by if pause else None,
            lent_to=authority.loan.to if authority.loan else None,
            driven_by=state.driver or None,
        )


def _all_known(state: CarState) -> bool:
    return all(topic in state.newest_by_topic for topic in REQUIRED_TOPICS)


def listed_cars(file: FleetFile) -> Mapping[str, CarSnapshot]:
    """Return the cars in a fleet file as the policy knows them before their gateways are on the bus."""
    return {
        name: CarSnapshot(
            platform="" if car.platform.startswith(AUTO) else car.platform,
            capabilities=car.capabilities,
            roles=None if car.roles is None else frozenset(car.roles),
            listed=True,
        )
        for name, car in {**file.cars, **file.unlinked}.items()
    }
