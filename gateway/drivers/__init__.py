"""The families of cars: finds the driver and the profile of a platform by its name in the fleet file.

A family is a module with the names of `Family`, such as `PLATFORMS` and `driver_of`. Our own families are the rows of
`BUILT_IN`. Other packages add families with the entry point group `zenoh_car_fleet.drivers`, whose value names the
module (docs/how-to/write-a-driver.md). A family is only imported when one of its cars is named.
"""

from collections.abc import Callable, Iterator, Mapping
from functools import cache
from importlib import import_module
from typing import TYPE_CHECKING, Any, Final, Protocol, cast

from schemas.car_profile import CarProfile
from schemas.platform_name import AUTO, AUTO_PLATFORMS, kind_of, normalize_name, parse_option
from schemas.suggestion import did_you_mean
from schemas.words import Platform

if TYPE_CHECKING:
    from gateway.control.driver import Desk, Driver

YAHBOOM: Final = "yahboom"
BUILT_IN: Final = {
    YAHBOOM: "gateway.drivers.yahboom.family",
    "waveshare": "gateway.drivers.waveshare.family",
}
"""Module of each family that comes with the gateway."""
GROUP: Final = "zenoh_car_fleet.drivers"
_NAMES: Final = ("PLATFORMS", "profile_of", "profiles", "driver_of")
"""The names of `Family`."""
broken: Final[dict[str, str]] = {}
"""The drivers of other packages that could not be imported, with the reason."""


class Family(Protocol):
    """A family of cars: a module with these names."""

    PLATFORMS: tuple[str, ...]
    """The names, without options, with which `platform:` in the fleet file selects this family."""

    def profile_of(self, name: str) -> CarProfile:
        """Return the profile of a platform's name, which may have options. Raises ValueError for a wrong name."""

    def profiles(self) -> tuple[CarProfile, ...]:
        """Return the profile of each platform, with all parts that such a car may have."""

    def driver_of(self, name: str, kept: Mapping[str, Any]) -> "Callable[[Desk], Driver]":
        """Return a function that makes a car's driver. `kept` is the saved result of `Driver.kept`, or empty."""


def missing_names(module: object) -> list[str]:
    """Return the names of `Family` that a module does not have."""
    return [name for name in _NAMES if not hasattr(module, name)]


def check_platform(text: str) -> str:
    """Return the name of a platform in its usual spelling. Raises ValueError if there is no such platform."""
    name = normalize_name(text)
    try:
        if kind_of(name) in (AUTO, *Platform):
            parse_option(name)  # this needs no import of the family, so a gateway joins the bus 13 ms sooner
        else:
            profile_of(name)
    except ValueError as error:
        raise ValueError(f"{error} Without a platform, a gateway recognizes {', '.join(AUTO_PLATFORMS)}.") from None
    return name


def profile_of(name: str) -> CarProfile:
    """Return the profile of this platform. Raises ValueError for a wrong name, and for `auto`."""
    name = normalize_name(name)
    return _family_of(kind_of(name)).profile_of(name)


def profiles_of(name: str) -> tuple[CarProfile, ...]:
    """Return the possible profiles of a car: one, or for `auto` those of all platforms that a gateway can recognize."""
    name = normalize_name(name)
    kind, plus, options = name.partition("+")
    return tuple(profile_of(f"{each}{plus}{options}") for each in (AUTO_PLATFORMS if kind == AUTO else (kind,)))


def driver_of(name: str, kept: Mapping[str, Any]) -> "Callable[[Desk], Driver]":
    """Return a function that makes the driver of a platform, or of `auto`. Raises ValueError for a wrong name."""
    name = normalize_name(name)
    kind = kind_of(name)
    return _family_of(AUTO_PLATFORMS[0] if kind == AUTO else kind).driver_of(name, kept)


def platforms() -> tuple[str, ...]:
    """Return the names of all platforms, without options, ours first."""
    return tuple(name for _, family in _families() for name in family.PLATFORMS)


@cache
def built_in_platforms() -> tuple[str, ...]:
    """Return the names of the platforms that come with the gateway, without options."""
    return tuple(name for module in BUILT_IN.values() for name in _load(module).PLATFORMS)


@cache
def built_in_profiles() -> tuple[CarProfile, ...]:
    """Return the profile of each platform that comes with the gateway, with all parts that such a car may have."""
    return tuple(profile for module in BUILT_IN.values() for profile in _load(module).profiles())


@cache
def all_profiles() -> tuple[CarProfile, ...]:
    """Return the profile of each platform that is installed, with all parts that such a car may have."""
    found = list(built_in_profiles())
    for name, family in _installed():
        try:
            found += family.profiles()
        except Exception as error:  # noqa: BLE001 - as in `_installed`
            broken[name] = f"profiles() raises {type(error).__name__}: {error}"
    return tuple(found)


def hint(platform: str, odd: str) -> str:
    """Return the likely cause of something odd in cars of a platform (see `CarProfile.hint`).

    It is empty if the driver of the platform is not installed here. An empty platform counts as `unknown`.
    """
    try:
        return profile_of(platform or Platform.UNKNOWN).hint(odd)
    except ValueError:
        return ""


def why_not_simulated(platform: str) -> str:
    """Return why `gateway sim` has no cars of a platform. Empty if it has, or if there is no such platform."""
    kind = kind_of(normalize_name(platform))
    if kind in built_in_platforms() or kind not in platforms():
        return ""
    return f"{kind} comes with another package, and only our own platforms can be simulated"


def family_name(platform: str) -> str:
    """Return the name of the family of a platform, such as `yahboom`. Raises ValueError for a wrong name."""
    kind = kind_of(normalize_name(platform))
    if kind == AUTO:
        return YAHBOOM
    return _find(kind)[0]


def _family_of(kind: str) -> Family:
    return _find(kind)[1]


@cache
def _find(kind: str) -> tuple[str, Family]:
    found = next(((name, family) for name, family in _families() if kind in family.PLATFORMS), None)
    if found is None:
        hint = did_you_mean(kind, platforms()) or f"There are {', '.join(platforms())}."
        failed = "".join(f" The driver {name} is missing: {why}." for name, why in broken.items())
        raise ValueError(f'Unknown platform "{kind[:40]}". {hint}{failed}')
    return found


def _families() -> Iterator[tuple[str, Family]]:
    """Yield the families with their names: ours, then those of other packages."""
    for name, module in BUILT_IN.items():
        yield name, _load(module)
    yield from _installed()


def _load(module: str) -> Family:
    return cast("Family", import_module(module))


@cache
def _installed() -> tuple[tuple[str, Family], ...]:
    # Import this module only here: to read the metadata of all packages takes some 10 ms, and few cars need that.
    from importlib.metadata import entry_points

    found = []
    for each in entry_points(group=GROUP):
        try:
            family = cast("Family", each.load())
            missing = missing_names(family)
        except (Exception, SystemExit) as error:  # noqa: BLE001 - a mistake here must not keep other cars from running
            broken[each.name] = f"{each.value} cannot be imported: {type(error).__name__}: {error}"
            continue
        if missing:
            broken[each.name] = f"{each.value} has no {', '.join(missing)}"
        else:
            found.append((each.name, family))
    return tuple(found)
