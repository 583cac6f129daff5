"""What the coordinator hears becomes a picture: tokens and messages in, values of policy/picture.py out. No Zenoh."""

from collections.abc import Container, Iterable, Mapping
from dataclasses import dataclass, field, replace
from itertools import islice
from typing import Any, Final

from fleet.fleetfile.fleet_file import FleetFile
from fleet.policy.snapshot import CarSnapshot, FleetSnapshot, Observation, Refusal
from schemas import keys, messages, topics
from schemas.bus import Sample
from schemas.gen import fleet_v1_pb2 as pb

NEEDED: Final = ("state/link", "state/mode", "state/motion", "state/safety")
"""Only when all that could forbid a command is known, a car counts as heard."""
_HEALTH: Final = "state/health"
FORGOTTEN_S: Final = 60.0
"""A car is forgotten whose gateway has been away for so long, unless the fleet file or the plan names it."""
MOST_GONE: Final = 256
"""Maximum cars that are remembered while their gateways are away. The oldest are forgotten first."""
MOST_UNHEARD: Final = 256
"""Maximum names on the bus that count as cars before they publish a state, if no fleet file lists them."""


@dataclass(slots=True)
class FleetObserver:
    """The cars as they were last heard. `listed`: what the fleet file says of them, if there is one."""

    listed: Mapping[str, CarSnapshot] = field(default_factory=dict)
    cars: dict[str, CarSnapshot] = field(default_factory=dict)
    readings: dict[str, dict[str, Observation]] = field(default_factory=dict)
    _gone_since: dict[str, float] = field(default_factory=dict)
    """Cars without a gateway on the bus that no fleet file lists; who went first stands first."""
    _met: set[str] = field(default_factory=set)
    """Cars that have said all that could forbid a command, whatever has become of them."""

    def __post_init__(self) -> None:
        self.cars.update(self.listed)

    @property
    def present(self) -> frozenset[str]:
        """The cars whose gateways are on the bus."""
        return frozenset(car for car, known in self.cars.items() if known.present)

    @property
    def unheard(self) -> frozenset[str]:
        """Those of them of which not all that could forbid a command is known."""
        return frozenset(car for car in self.present if not _all_known(self.readings.get(car, {})))

    def picture(self, busy: Iterable[str]) -> FleetSnapshot:
        """What is known now; `busy`: the cars that something was asked of, with no outcome yet."""
        # A name that no file lists is a car once it has said how it is: until then few count, and only while there.
        cars = {car: known for car, known in self.cars.items() if known.listed or car in self._met}
        unheard = (each for each in self.cars.items() if each[1].present and each[0] not in cars)
        cars.update(list(islice(unheard, MOST_UNHEARD)))
        cars.update({car: replace(cars[car], busy=True) for car in busy if car in cars})
        return FleetSnapshot(cars, {car: dict(seen) for car, seen in self.readings.items() if car in cars})

    def token(self, car: str, now: float, *, alive: bool) -> None:
        """A gateway came or went: what was known of its car may no longer be so, a hold above all."""
        try:
            keys.check_name(car)
        except keys.BadKey:
            return  # no gateway of ours: nothing could be asked of it
        if alive:
            self._gone_since.pop(car, None)
        elif car not in self.listed:
            if car not in self._met:
                self._forget(car)
                return
            self._gone_since.setdefault(car, now)
        self.cars[car] = replace(self.listed.get(car, CarSnapshot()), present=alive)
        for topic in (*NEEDED, _HEALTH):
            self.readings.get(car, {}).pop(topic, None)

    def forget(self, now: float, needed: Container[str]) -> None:
        """Forget the cars that have been away for long, but for the `needed`."""
        for car, since in list(self._gone_since.items()):
            if now - since < FORGOTTEN_S and len(self._gone_since) <= MOST_GONE:
                return
            if car not in needed:
                self._forget(car)

    def _forget(self, car: str) -> None:
        self._met.discard(car)
        for each in (self.cars, self.readings, self._gone_since):
            each.pop(car, None)

    def refused(self, car: str, refusal: Refusal | None) -> None:
        """A command was not carried out, or (None) one was."""
        if car in self.cars:
            self.cars[car] = replace(self.cars[car], refused=refusal)

    def take(self, sample: Sample, now: float, wall_s: float | None) -> None:
        """A message of a car. `wall_s`: the wall clock, for an answer, which may be old; None: it came as published."""
        key = keys.parse(sample.key)
        topic = None if key is None else topics.TOPICS.get(key.topic)
        if key is None or topic is None:
            return
        try:
            value: Any = messages.parse(topic.message, sample.payload, sample.encoding)
        except messages.BadPayload:
            return  # not of this fleet's gateways: nothing to decide on
        if key.car not in self.listed and not self.cars.get(key.car, CarSnapshot()).present:
            self._gone_since.setdefault(key.car, now)
        at = now
        if wall_s is not None:
            at -= max(0.0, wall_s - value.stamp.seconds - value.stamp.nanos / 1e9)
        seen = self.readings.setdefault(key.car, {})
        if key.topic in seen and seen[key.topic].at > at:
            return  # an answer that was overtaken
        measured = {descriptor.name for descriptor, _ in value.ListFields()}
        fields = {
            each.name: getattr(value, each.name)
            for each in value.DESCRIPTOR.fields
            if not each.has_presence or each.name in measured
        }
        seen[key.topic] = Observation(fields, at)
        if key.topic in NEEDED or key.topic == _HEALTH:
            self._states(key.car, seen)

    def _states(self, car: str, seen: Mapping[str, Observation]) -> None:
        before = self.cars.get(car, CarSnapshot())
        health = seen.get(_HEALTH)
        if health is not None:
            capabilities: Any = health.fields["capabilities"]
            before = replace(
                before,
                platform=str(health.fields["platform"]),
                capabilities=before.capabilities if before.listed else frozenset(capabilities),
            )
            self.cars[car] = before
        if not before.present or not _all_known(seen):
            return
        self._met.add(car)
        link, mode, motion, safety = (seen[topic].fields for topic in NEEDED)
        hold, lease = safety.get("hold"), safety.get("lease")
        estops: Any = safety.get("estops") or ()
        driver = motion["owner"]
        if not driver and isinstance(lease, pb.Lease) and lease.kind != "coordinator":
            driver = lease.holder
        self.cars[car] = replace(
            before,
            link=str(link["state"]),
            mode=str(mode["asked"]),
            verdict=str(mode["verdict"]),
            evidence=str(mode["evidence"]),
            motors=str(safety["motors"]),
            held_by=hold.by if isinstance(hold, pb.Hold) else None,
            estopped_by=estops[0].by if estops else None,
            driven_by=str(driver) or None,
        )


def _all_known(seen: Mapping[str, Observation]) -> bool:
    return all(topic in seen for topic in NEEDED)


def listed_cars(file: FleetFile) -> Mapping[str, CarSnapshot]:
    """What a fleet file says of its cars."""
    return {
        name: CarSnapshot(
            platform="" if car.platform.startswith("auto") else car.platform,
            capabilities=car.capabilities,
            roles=None if car.roles is None else frozenset(car.roles),
            listed=True,
        )
        for name, car in {**file.cars, **file.unlinked}.items()
    }
