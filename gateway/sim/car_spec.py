"""Parses the description of a simulated or replayed car. An error is one line. Pure: it does not open any link."""

import re
from collections.abc import Sequence
from typing import Final

from msgspec import Struct

from gateway.sim.car_options import BadOption, parse_traits
from gateway.sim.model.factory import PLATFORMS
from gateway.sim.model.traits import CarTraits
from schemas import keys

_TCP: Final = re.compile(r"tcp(?:://(?P<host>\[[^\]]+\]|[^:/\[\]]+):(?P<port>\d{1,5}))?")
_REPLAY: Final = re.compile(r"(?P<file>.+?)(?::(?P<name>[a-z0-9_-]+)(?::(?P<link>(?:pty|tcp)(?::.*)?))?)?")


class BadSpec(ValueError):
    """A description that is not allowed. The message names the place and the value, and says what is allowed."""


class PtyPath(Struct, frozen=True):
    """A pseudo terminal.

    At `path`, the simulator makes a symlink to it. The symlink has the same name again when a lost link returns, while
    the terminal itself may have another one. If `path` is None, there is no symlink.
    """

    path: str | None = None


class TcpListen(Struct, frozen=True):
    """A listening TCP port. With port 0, the system chooses a free one."""

    host: str = "127.0.0.1"
    port: int = 0


class CarSpec(Struct, frozen=True):
    """One simulated car."""

    name: str
    platform: str
    options: frozenset[str]
    """The options as the user writes them, each with its value."""
    link: PtyPath | TcpListen
    traits: CarTraits | None = None
    """The traits of this car, or None if it has the traits of its platform."""

    @property
    def platform_words(self) -> str:
        """The platform with its options, as the user writes it."""
        return "+".join((self.platform, *sorted(self.options)))


class ReplaySpec(Struct, frozen=True):
    """A capture of `gateway monitor --raw` that is played as a car."""

    name: str
    path: str
    link: PtyPath | TcpListen


def parse_car(text: str) -> CarSpec:
    """Parse NAME:PLATFORM[+OPTION...]:LINK. Raises BadSpec if a part is not allowed."""
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
    try:
        traits = parse_traits(platform, options)
    except BadOption as error:
        raise BadSpec(f"car {text!r}: {error}") from None
    return CarSpec(name, platform, frozenset(options), _parse_link(f"car {text!r}", link), traits)


def parse_replay(text: str) -> ReplaySpec:
    """Parse FILE[:NAME[:LINK]]. The defaults are `replay` and a pty. Raises BadSpec if a part is not allowed."""
    match = _REPLAY.fullmatch(text)
    if match is None:
        raise BadSpec(f"replay {text!r} is not allowed: write FILE[:NAME[:LINK]], for example red.raw:red:tcp")
    name = match["name"] or "replay"
    try:
        keys.check_name(name)
    except keys.BadKey as error:
        raise BadSpec(f"replay {text!r}: {error}") from None
    return ReplaySpec(name, match["file"], _parse_link(f"replay {text!r}", match["link"] or "pty"))


def _parse_link(what: str, link: str) -> PtyPath | TcpListen:
    if link == "pty":
        return PtyPath()
    if link.startswith("pty:") and len(link) > 4:
        return PtyPath(link[4:])
    match = _TCP.fullmatch(link)
    if match and match["host"] is None:
        return TcpListen()
    if match and int(match["port"]) < 65536:
        return TcpListen(match["host"].strip("[]"), int(match["port"]))
    raise BadSpec(
        f"{what}: link {link!r} is not allowed: use pty, pty:PATH (for a symlink at PATH), tcp or "
        "tcp://HOST:PORT with port 0 to 65535 (0 and tcp: any free port)"
    )


def parse_cars(texts: Sequence[str]) -> list[CarSpec]:
    """Parse several cars. Raises BadSpec if a part is not allowed, or if two cars share a name, port or path."""
    cars = [parse_car(text) for text in texts]
    refuse_twins(cars)
    return cars


def refuse_twins(cars: Sequence[CarSpec | ReplaySpec]) -> None:
    """Raise BadSpec if two cars have the same name, port or path."""
    _refuse_duplicates("name", [car.name for car in cars])
    _refuse_duplicates("path", [car.link.path for car in cars if isinstance(car.link, PtyPath) and car.link.path])
    tcp = [car.link for car in cars if isinstance(car.link, TcpListen)]
    _refuse_duplicates("port", [f"{link.host}:{link.port}" for link in tcp if link.port])


def _refuse_duplicates(what: str, values: list[str]) -> None:
    for value in values:
        if values.count(value) > 1:
            raise BadSpec(f"two cars have the {what} {value}: give each its own")
