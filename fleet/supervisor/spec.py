"""The specification of a fleet and the command lines of its processes, from a fleet file and the options of `fleet up`.

Gateways and the simulator belong to the gateway package. They run as processes, and are not imported here.
"""

import json
import os
import sys
from collections.abc import Mapping, Sequence
from decimal import Decimal
from pathlib import Path
from typing import Final

from msgspec import Struct, field
from msgspec.structs import replace

from fleet.fleetfile.fleet_file import FleetCar, FleetFile, FleetPerson, PinRule, default_color, profile_capabilities
from fleet.fleetfile.fleet_model import PersonRank
from fleet.quota import Quota
from fleet.supervisor.process_state import Patience
from gateway import drivers
from schemas.keys import DEFAULT_FLEET
from schemas.platform_name import AUTO
from schemas.process.parent import parent_option
from schemas.words import Platform, ProcessKind

SIMULATED: Final = "sim"
"""The link of a car that the supervisor's simulator simulates."""
SIMULATED_CAR_NAMES: Final = ("red", "green", "blue", "yellow", "orange", "violet", "white", "black")
PLATFORMS: Final = (Platform.ARDUINO, Platform.STM32, Platform.ARDUINO, Platform.RASPBERRY_PI)
"""Platforms that simulated cars get in turn if they are not in a fleet file."""
MAX_SIMULATED_CARS: Final = 200
RECORDINGS: Final = Path("sessions")

HUB: Final = "@hub"
SIMULATOR_PROCESS: Final = "@simulator"
RECORDER: Final = "@recorder"
COORDINATOR: Final = "@coordinator"
CONSOLE: Final = "@console"
SELF: Final = "@supervisor"
"""Names of processes. All other processes are gateways, and no car's name begins with @."""


PATIENCE: Final[Mapping[ProcessKind, Patience]] = {
    # A hub that stalls for 6 s need not be replaced: links to it break after Zenoh's lease of 2 s, but clients try to
    # reconnect each 0.5 s.
    ProcessKind.HUB: Patience(start_s=10.0, silence_s=8.0),
    ProcessKind.SIMULATOR: Patience(start_s=20.0, silence_s=5.0),  # queried each second
    ProcessKind.GATEWAY: Patience(start_s=20.0, silence_s=4.0, to_the_end=True),  # state/health each second
    ProcessKind.COORDINATOR: Patience(start_s=20.0, silence_s=6.0),  # queried each second
    ProcessKind.RECORDER: Patience(start_s=20.0, silence_s=10.0),  # each second, from a thread that waits for the disk
    ProcessKind.CONSOLE: Patience(start_s=20.0, silence_s=6.0),  # each second, from the loop that serves the pages
}


class CarProcessSpec(Struct, frozen=True):
    """One car: its link (or SIMULATED) and further options of its gateway."""

    name: str
    link: str
    platform: str = AUTO
    arguments: tuple[str, ...] = ()


class CoordinatorCar(Struct, frozen=True):
    """The coordinator's entry for one car in the fleet file."""

    platform: str
    without: tuple[str, ...] = ()
    """The modes and parts of its platform that the car does not use."""
    roles: tuple[str, ...] | None = None
    """None means any role."""


class FleetSpec(Struct, frozen=True):
    """Everything that `fleet up` runs."""

    fleet: str = DEFAULT_FLEET
    endpoint: str | None = None
    cars: Mapping[str, CarProcessSpec] = field(default_factory=dict)
    plan: Path | None = None
    plan_text: str = ""
    """The checked text of the plan. Later changes of the file take effect at a reload."""
    record: bool = True
    recordings: Path = RECORDINGS
    quota: Quota = field(default_factory=Quota)
    """The maximum size of recordings."""
    pins: tuple[PinRule, ...] = ()
    """The rules for pins in recordings. The recorder itself reads them from the file."""
    groups: Mapping[str, tuple[str, ...]] = field(default_factory=dict)
    """The cars of each group."""
    colors: Mapping[str, str] = field(default_factory=dict)
    """The color of each car, as #rrggbb."""
    file: Path | None = None
    """The fleet file. The recorder stores a copy of it."""
    world: Path | None = None
    listed: Mapping[str, CoordinatorCar] = field(default_factory=dict)
    """The coordinator's entries, by car."""
    people: Mapping[str, FleetPerson] | None = None
    """The people who may drive and change the plan, or None if everyone may."""
    console: bool = False
    console_port: int = 0
    """Port of the web page. 0: the default of `fleet console`."""
    insecure_lan: bool = False
    """True if the hub may listen on an address that other machines can reach."""
    warnings: tuple[str, ...] = ()
    """Warnings of the plan's checks, and of cars that are left out, one line each."""

    @property
    def simulated(self) -> list[CarProcessSpec]:
        """The simulated cars."""
        return [car for car in self.cars.values() if car.link == SIMULATED]


class UpOptions(Struct, frozen=True):
    """The options of `fleet up`. If one is None, the fleet file decides."""

    simulated: int = 0
    plan: Path | None = None
    world: Path | None = None
    record: bool | None = None
    out: Path | None = None
    connect: str | None = None
    fleet: str | None = None
    insecure_lan: bool = False
    console: bool = False
    console_port: int = 0
    secure: bool = False
    """True to make this computer a hub with certificates."""


def build_spec(file: FleetFile | None, options: UpOptions) -> FleetSpec:
    """Return the spec of a fleet file and the options, which take precedence.

    The first `options.simulated` cars of the file are simulated, whatever their link. Cars among them that cannot be
    simulated are left out with a warning. Raises ValueError if none can be simulated.
    """
    specs = {} if file is None else {**file.cars, **file.unlinked}
    cars = {name: _car(spec) for name, spec in specs.items()}
    names = _names(list(cars), options.simulated)
    not_simulated = {
        name: why for name in names if name in cars and (why := drivers.why_not_simulated(cars[name].platform))
    }
    warnings = tuple(f"{name} is left out, as it cannot be simulated: {why}." for name, why in not_simulated.items())
    names = [name for name in names if name not in not_simulated]
    if not_simulated and not names:
        raise ValueError("\n".join(warnings))
    cars = {name: car for name, car in cars.items() if name in names or (car.link and name not in not_simulated)}
    for index, name in enumerate(names):
        car = cars.get(name) or CarProcessSpec(name, SIMULATED, PLATFORMS[index % len(PLATFORMS)])
        # A simulated car needs a platform. The platform of a real car can be detected.
        kind, *words = car.platform.split("+")
        platform = "+".join((Platform.ARDUINO if kind in (AUTO, Platform.UNKNOWN) else kind, *words))
        cars[name] = CarProcessSpec(name, SIMULATED, platform, car.arguments)
    people = file.people if file else None
    if people is not None:
        cars = {name: replace(car, arguments=(*car.arguments, *_people(name, people))) for name, car in cars.items()}
    return FleetSpec(
        fleet=options.fleet or (file.name if file else DEFAULT_FLEET),
        endpoint=options.connect or (file.endpoint if file else None),
        cars=cars,
        plan=options.plan or (file.plan if file else None),
        record=(file.record if file else True) if options.record is None else options.record,
        recordings=options.out or (file.recordings if file else None) or RECORDINGS,
        quota=file.quota if file else Quota(),
        pins=file.pins if file else (),
        groups=file.groups if file else {},
        people=people,
        colors={
            name: specs[name].color if name in specs else default_color(name, index) for index, name in enumerate(cars)
        },
        file=file.path if file else None,
        world=options.world or (file.world if file else None),
        console=options.console or options.console_port > 0 or (file is not None and file.console),
        console_port=options.console_port or (file.console_port if file else 0),
        insecure_lan=options.insecure_lan,
        listed={name: _listed(specs.get(name), car.platform) for name, car in cars.items()},
        warnings=warnings,
    )


def _names(known: Sequence[str], count: int) -> list[str]:
    """Return `count` names: first those of the file, then default names."""
    more = (
        name
        for name in (
            *SIMULATED_CAR_NAMES,
            *(f"car{number}" for number in range(len(SIMULATED_CAR_NAMES) + 1, MAX_SIMULATED_CARS + 1)),
        )
    )
    names = list(known)[:count]
    for name in more:
        if len(names) >= count:
            break
        if name not in known:
            names.append(name)
    return names


def _car(spec: FleetCar) -> CarProcessSpec:
    limits = spec.limits
    return CarProcessSpec(
        spec.name,
        spec.link,
        spec.platform,
        (
            *("--longest-drive", _seconds(limits.longest_drive_s)),
            *("--speed-max", f"{limits.speed_max:g}"),
            *("--on-battery-low", limits.on_battery_low, "--battery-low-v", f"{limits.battery_low_v:g}"),
            *(
                "--on-battery-critical",
                limits.on_battery_critical,
                "--battery-critical-v",
                f"{limits.battery_critical_v:g}",
            ),
        ),
    )


def _seconds(value: float) -> str:
    """Return a number of seconds as an option takes it: with all its digits, and without an exponent."""
    return format(Decimal(repr(value)).normalize(), "f")


def _people(car: str, people: Mapping[str, FleetPerson]) -> tuple[str, ...]:
    """Return the options that tell a gateway who may drive its car, and who may drive only other cars."""
    named = [
        f"{name}:lead" if person.rank is PersonRank.LEAD else name if person.may_drive(car) else f"{name}:other"
        for name, person in people.items()
    ]
    return ("--people-only", *(word for name in named for word in ("--person", name)))


def _listed(spec: FleetCar | None, platform: str) -> CoordinatorCar:
    if spec is None:
        return CoordinatorCar(platform)
    return CoordinatorCar(
        spec.platform, tuple(sorted(profile_capabilities(spec.platform) - spec.capabilities)), spec.roles
    )


def coordinator_fleet_file(spec: FleetSpec) -> str:
    """Return the text of a fleet file for the coordinator, made from the accepted spec."""
    # The user's file may be invalid or missing when the coordinator is restarted.
    cars = {
        name: {
            "platform": car.platform,
            **({"without": car.without} if car.without else {}),
            **({} if car.roles is None else {"roles": car.roles}),
        }
        for name, car in spec.listed.items()
    }
    people = (
        {} if spec.people is None else {"people": {name: {"rank": each.rank} for name, each in spec.people.items()}}
    )
    return json.dumps({"cars": cars, **people}, indent=1)


def module(name: str, *arguments: str) -> tuple[str, ...]:
    """Return the command that runs a module with this interpreter."""
    return (sys.executable, "-m", name, *arguments)


def hub_command(spec: FleetSpec, endpoint: str) -> tuple[str, ...]:
    """Return the command of the hub."""
    open_to_lan = ("--insecure-lan",) if spec.insecure_lan else ()
    return module("schemas.bus.hub", "--endpoint", endpoint, *open_to_lan)


def gateway_command(spec: FleetSpec, car: CarProcessSpec, link: str, endpoint: str) -> tuple[str, ...]:
    """Return the command of a car's gateway."""
    where = ("--fleet", spec.fleet, "--connect", endpoint, "--retry", *parent_option())
    options = ("--car", car.name, "--link", link, "--platform", car.platform, *car.arguments)
    # A gateway keeps its car's holds (a stopped car stays stopped) under the car's link. The link of a simulated car
    # changes with each run, so its holds are kept under the fleet's folder: the next run in that folder has the same
    # car.
    folder = (Path.cwd() if spec.file is None else spec.file.parent).resolve()
    same = ("--holds-of", f"{SIMULATED} in {folder}") if car.link == SIMULATED else ()
    return module("gateway.cli", "run", *options, *same, *where)


def simulator_command(spec: FleetSpec, directory: Path, endpoint: str) -> tuple[str, ...]:
    """Return the command of the simulator, one for all simulated cars."""
    # Terminals have fixed names, so that gateways find them again after a restart of the simulator.
    cars = [f"{car.name}:{car.platform}:{_terminal(directory, car.name)}" for car in spec.simulated]
    world = () if spec.world is None else ("--world", str(spec.world))
    options = [word for car in cars for word in ("--car", car)]
    where = ("--fleet", spec.fleet, "--connect", endpoint, *parent_option())
    return module("gateway.cli", "sim", *options, *world, *where)


def _terminal(directory: Path, car: str) -> str:
    return f"pty:{directory / car}.tty" if os.name == "posix" else "tcp"


def recorder_command(spec: FleetSpec, endpoint: str) -> tuple[str, ...]:
    """Return the command of the recorder."""
    where = ("--fleet", spec.fleet, "--connect", endpoint, *parent_option())
    files = {"--fleet-file": spec.file, "--plan": spec.plan}
    copies = [word for option, path in files.items() if path is not None for word in (option, str(path))]
    words = ("--sessions", str(spec.recordings), "--json", *spec.quota.arguments)
    return module("fleet.cli", "record", "run", *words, *copies, *where)


def coordinator_command(spec: FleetSpec, plan: Path, listed: Path, endpoint: str) -> tuple[str, ...]:
    """Return the command of the coordinator, with its copies of the plan and the fleet file in the run directory."""
    where = ("--fleet", spec.fleet, "--connect", endpoint, *parent_option(), "--run", plan.parent.name)
    return module("fleet.cli", "plan", "run", str(plan), "--fleet-file", str(listed), "--json", *where)


def console_command(spec: FleetSpec, endpoint: str) -> tuple[str, ...]:
    """Return the command of the web page."""
    port = ("--port", str(spec.console_port)) if spec.console_port else ()
    where = ("--fleet", spec.fleet, "--connect", endpoint, "--sessions", str(spec.recordings), *parent_option())
    file = () if spec.file is None else ("--fleet-file", str(spec.file))
    return module("fleet.cli", "console", "serve", *port, *file, *where)
