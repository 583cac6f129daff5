"""What a user writes to describe a simulated car or a fault: words checked, one-line errors, nothing opened. Pure."""

import math
import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from enum import StrEnum
from typing import Final

from gateway.sim.core.cars import OPTIONS, PLATFORMS
from schemas import keys

_TCP: Final = re.compile(r"tcp(?:://(?P<host>\[[^\]]+\]|[^:/\[\]]+):(?P<port>\d{1,5}))?")
GARBAGE_LIMIT: Final = 100_000
FAULT_LIMIT_S: Final = 86_400.0


class BadSpec(ValueError):
    """A description that is not allowed; its text names what, where and what is."""


@dataclass(frozen=True, slots=True)
class PtyLink:
    """A pseudo terminal; `path`: a symlink to it that stays the same when the link comes back."""

    path: str | None = None


@dataclass(frozen=True, slots=True)
class TcpLink:
    """A listening TCP port; 0 lets the system choose."""

    host: str = "127.0.0.1"
    port: int = 0


@dataclass(frozen=True, slots=True)
class CarSpec:
    """One simulated car."""

    name: str
    platform: str
    options: frozenset[str]
    link: PtyLink | TcpLink

    @property
    def platform_words(self) -> str:
        """The platform with its options, as the user writes it."""
        return "+".join((self.platform, *sorted(self.options)))


def parse_car(text: str) -> CarSpec:
    """NAME:PLATFORM[+OPTION...]:LINK; raises BadSpec."""
    parts = text.split(":", 2)
    if len(parts) != 3:
        raise BadSpec(f"car {text!r} is not allowed: write NAME:PLATFORM:LINK, for example red:arduino:pty")
    name, platform_words, link = parts
    try:
        keys.check_name(name)
    except keys.BadKey as error:
        raise BadSpec(f"car {text!r}: {error}") from None
    platform, *options = platform_words.split("+")
    if platform not in PLATFORMS:
        raise BadSpec(f"car {text!r}: platform {platform!r} is not allowed: use {', '.join(PLATFORMS)}")
    for option in options:
        if option not in OPTIONS:
            allowed = ", ".join(f"+{word}" for word in OPTIONS)
            raise BadSpec(f"car {text!r}: option '+{option}' is not allowed: use {allowed} or none")
    return CarSpec(name, platform, frozenset(options), _parse_link(text, link))


def _parse_link(text: str, link: str) -> PtyLink | TcpLink:
    if link == "pty":
        return PtyLink()
    if link.startswith("pty:") and len(link) > 4:
        return PtyLink(link[4:])
    match = _TCP.fullmatch(link)
    if match and match["host"] is None:
        return TcpLink()
    if match and int(match["port"]) < 65536:
        return TcpLink(match["host"].strip("[]"), int(match["port"]))
    raise BadSpec(
        f"car {text!r}: link {link!r} is not allowed: use pty, pty:PATH (a symlink is made there) or "
        "tcp://HOST:PORT with port 0 to 65535 (0: any free one)"
    )


def parse_cars(texts: Sequence[str]) -> list[CarSpec]:
    """All cars of one simulator; raises BadSpec also for two cars of one name, port or path."""
    cars = [parse_car(text) for text in texts]
    _refuse_twins("name", [car.name for car in cars])
    _refuse_twins("path", [car.link.path for car in cars if isinstance(car.link, PtyLink) and car.link.path])
    tcp = [car.link for car in cars if isinstance(car.link, TcpLink)]
    _refuse_twins("port", [f"{link.host}:{link.port}" for link in tcp if link.port])
    return cars


def _refuse_twins(what: str, values: list[str]) -> None:
    for value in values:
        if values.count(value) > 1:
            raise BadSpec(f"two cars have the {what} {value}: give each its own")


class FaultKind(StrEnum):
    """What can be done to a car."""

    LINK_DROP = "link_drop"
    GARBAGE = "garbage"
    BROWNOUT = "brownout"


@dataclass(frozen=True, slots=True)
class Fault:
    """One fault; no `car` means every car."""

    kind: FaultKind
    car: str | None = None
    for_s: float | None = None
    """How long a dropped link stays away, s; None: until it is restored by `link_drop` with `for_s` 0."""
    bytes: int = 100
    """How many bytes of garbage."""
    to_car: bool = False
    """Garbage towards the car; otherwise towards the host."""


def check_hit(cars: Sequence[str], faults: Iterable[Fault]) -> None:
    """Raises BadSpec for a fault of a car that is not among `cars`."""
    for fault in faults:
        if fault.car is not None and fault.car not in cars:
            raise BadSpec(f"car {fault.car!r} is not simulated here: use {', '.join(cars)}")


_FIELDS: Final = {
    FaultKind.LINK_DROP: {"for_s"},
    FaultKind.GARBAGE: {"bytes", "to"},
    FaultKind.BROWNOUT: set[str](),
}


def fault_of(fields: object) -> Fault:
    """A fault from the JSON object of the control channel; raises BadSpec."""
    if not isinstance(fields, dict):
        raise BadSpec('write one JSON object a line, for example {"car": "red", "fault": "link_drop", "for_s": 2}')
    try:
        kind = FaultKind(str(fields.get("fault")))
    except ValueError:
        allowed = ", ".join(FaultKind)
        raise BadSpec(f"fault {fields.get('fault')!r} is not allowed: use {allowed}") from None
    for word in fields.keys() - {"fault", "car"} - _FIELDS[kind]:
        allowed = ", ".join(sorted({"car"} | _FIELDS[kind]))
        raise BadSpec(f"field {word!r} is not allowed in {kind}: use {allowed}")
    car = fields.get("car")
    if car is not None and not isinstance(car, str):
        raise BadSpec(f"car {car!r} is not allowed: write a car's name, or leave it out for all")
    for_s = fields.get("for_s")
    if for_s is not None:
        for_s = _number("for_s", for_s, 0.0, FAULT_LIMIT_S)
    count = int(_number("bytes", fields.get("bytes", 100), 1, GARBAGE_LIMIT))
    to = fields.get("to", "host")
    if to not in ("host", "car"):
        raise BadSpec(f"to {to!r} is not allowed: use host or car")
    return Fault(kind, car, for_s, count, to == "car")


def _number(what: str, value: object, low: float, high: float) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float) or not low <= value <= high:
        raise BadSpec(f"{what} {value!r} is not allowed: a number from {low:g} to {high:g}")
    return float(value)


@dataclass(frozen=True, slots=True)
class Scheduled:
    """A fault of the command line and when it comes, s after the start."""

    at_s: float
    fault: Fault


_SCHEDULED: Final = re.compile(
    r"(?:(?P<car>[^:@]+):)?(?P<kind>[a-z_]+)@(?P<at>\d+(?:\.\d+)?)(?:\+(?P<amount>\d+(?:\.\d+)?))?"
)


def parse_fault(text: str) -> Scheduled:
    """[CAR:]FAULT@SECONDS[+AMOUNT]: the amount is a link_drop's seconds or a garbage's bytes; raises BadSpec."""
    match = _SCHEDULED.fullmatch(text)
    if match is None:
        raise BadSpec(
            f"fault {text!r} is not allowed: write [CAR:]FAULT@SECONDS[+AMOUNT], for example red:link_drop@5+2 "
            "(gone for 2 s), red:garbage@3+200 (200 bytes), brownout@10"
        )
    fields: dict[str, object] = {"fault": match["kind"]}
    if match["car"]:
        fields["car"] = match["car"]
    if match["amount"]:
        amount = float(match["amount"])
        match match["kind"]:
            case FaultKind.LINK_DROP:
                fields["for_s"] = amount
            case FaultKind.GARBAGE:
                fields["bytes"] = amount
            case _:
                raise BadSpec(f"fault {text!r} is not allowed: {match['kind']} takes no amount")
    at = float(match["at"])
    if not math.isfinite(at) or at > FAULT_LIMIT_S:
        raise BadSpec(f"fault {text!r} is not allowed: at most {FAULT_LIMIT_S:g} s after the start")
    try:
        return Scheduled(at, fault_of(fields))
    except BadSpec as error:
        raise BadSpec(f"fault {text!r}: {error}") from None
