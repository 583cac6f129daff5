"""What is to run: from a fleet file and the command line to the processes' arguments. Nothing is started here.

What fleet needs of links and simulators it starts as processes; it imports none of them.
"""

import json
import os
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from enum import StrEnum
from pathlib import Path
from typing import Final

from fleet.fleetfile.fleet_file import FleetCar, FleetFile, profile_capabilities
from fleet.supervisor.restart_policy import Patience
from schemas.keys import DEFAULT_FLEET

SIMULATED: Final = "sim"
"""The link of a car that the supervisor's simulator plays."""
NAMES: Final = ("red", "green", "blue", "yellow", "orange", "violet", "white", "black")
PLATFORMS: Final = ("arduino", "stm32", "arduino", "raspberry_pi")
"""Of simulated cars without a file, in turns."""
MOST_SIMULATED: Final = 200
RECORDINGS: Final = Path("sessions")

HUB: Final = "@hub"
SIMULATOR: Final = "@simulator"
RECORDER: Final = "@recorder"
COORDINATOR: Final = "@coordinator"
SELF: Final = "@supervisor"
"""Names of processes; all others are a car's gateway, and no car's name begins with @."""


class ProcessKind(StrEnum):
    """What a process is for."""

    HUB = "hub"
    SIMULATOR = "simulator"
    GATEWAY = "gateway"
    COORDINATOR = "coordinator"
    RECORDER = "recorder"


PATIENCE: Final[Mapping[ProcessKind, Patience]] = {
    # A client is linked again after half a second, a lease is 2 s. A hub that stood for 6 s need not be replaced.
    ProcessKind.HUB: Patience(start_s=10.0, silence_s=8.0),
    ProcessKind.SIMULATOR: Patience(start_s=20.0, silence_s=5.0),  # asked each second
    ProcessKind.GATEWAY: Patience(start_s=20.0, silence_s=4.0, to_the_end=True),  # state/health comes each second
    ProcessKind.COORDINATOR: Patience(start_s=20.0, silence_s=6.0),  # asked each second
    ProcessKind.RECORDER: Patience(start_s=20.0, silence_s=10.0),  # each second, from a thread that waits for the disk
}


@dataclass(frozen=True, slots=True)
class CarProcessSpec:
    """One car: its link, or SIMULATED, and what its gateway is told besides."""

    name: str
    link: str
    platform: str = "auto"
    arguments: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True)
class Listed:
    """What the coordinator is told of one car: what it may do with it."""

    platform: str
    capabilities: tuple[str, ...] | None = None
    """None: its platform's."""
    roles: tuple[str, ...] | None = None
    """None: any."""


@dataclass(frozen=True, slots=True)
class FleetSpec:
    """All that is to run."""

    fleet: str = DEFAULT_FLEET
    endpoint: str | None = None
    cars: Mapping[str, CarProcessSpec] = field(default_factory=dict)
    plan: Path | None = None
    plan_text: str = ""
    """As it was read and checked: a file that is changed counts when it is reloaded."""
    record: bool = True
    recordings: Path = RECORDINGS
    file: Path | None = None
    """The fleet file, of which a recording keeps a copy."""
    world: Path | None = None
    listed: Mapping[str, Listed] = field(default_factory=dict)
    """Every car, as the fleet file says; those that are only simulated, as their platform is."""
    insecure_lan: bool = False
    """A hub may listen where others than this machine reach it."""
    doubts: tuple[str, ...] = ()
    """What is hardly meant so, a line each."""

    @property
    def simulated(self) -> list[CarProcessSpec]:
        """The cars that the simulator plays."""
        return [car for car in self.cars.values() if car.link == SIMULATED]


@dataclass(frozen=True, slots=True)
class Asked:
    """What the command line says; None: as the file says."""

    simulated: int = 0
    plan: Path | None = None
    world: Path | None = None
    record: bool | None = None
    out: Path | None = None
    connect: str | None = None
    fleet: str | None = None
    insecure_lan: bool = False


def wanted(file: FleetFile | None, asked: Asked) -> FleetSpec:
    """Unite file and command line, which wins. Of `asked.simulated` cars the file's come first, whatever their link."""
    specs = {} if file is None else {**file.cars, **file.unlinked}
    cars = {name: _car(spec) for name, spec in specs.items()}
    names = _names(list(cars), asked.simulated)
    cars = {name: car for name, car in cars.items() if car.link or name in names}
    for index, name in enumerate(names):
        car = cars.get(name) or CarProcessSpec(name, SIMULATED, PLATFORMS[index % len(PLATFORMS)])
        # A simulated car must be of some platform, one of a real car may be found out.
        platform = "arduino" if car.platform in ("auto", "unknown") else car.platform
        cars[name] = CarProcessSpec(name, SIMULATED, platform, car.arguments)
    return FleetSpec(
        fleet=asked.fleet or (file.name if file else DEFAULT_FLEET),
        endpoint=asked.connect or (file.endpoint if file else None),
        cars=cars,
        plan=asked.plan or (file.plan if file else None),
        record=(file.record if file else True) if asked.record is None else asked.record,
        recordings=asked.out or (file.recordings if file else None) or RECORDINGS,
        file=file.path if file else None,
        world=asked.world or (file.world if file else None),
        insecure_lan=asked.insecure_lan,
        listed={name: _listed(specs.get(name), car.platform) for name, car in cars.items()},
    )


def _names(known: Sequence[str], count: int) -> list[str]:
    """So many names: those of the file, then ours."""
    more = (name for name in (*NAMES, *(f"car{number}" for number in range(len(NAMES) + 1, MOST_SIMULATED + 1))))
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
            *("--longest-drive", f"{limits.longest_drive_s:g}"),
            *("--speed-max", f"{limits.speed_max:g}"),
            *("--battery-low", limits.on_battery_low, "--battery-low-v", f"{limits.battery_low_v:g}"),
            *(
                "--battery-critical",
                limits.on_battery_critical,
                "--battery-critical-v",
                f"{limits.battery_critical_v:g}",
            ),
        ),
    )


def _listed(spec: FleetCar | None, platform: str) -> Listed:
    if spec is None:
        return Listed(platform)
    fewer = spec.capabilities != profile_capabilities(spec.platform)
    return Listed(spec.platform, tuple(sorted(spec.capabilities)) if fewer else None, spec.roles)


def listing(wish: FleetSpec) -> str:
    """A fleet file for the coordinator, of what was accepted.

    The user's own may be wrong, or gone, when the coordinator is started again.
    """
    cars = {
        name: {
            "platform": car.platform,
            **({} if car.capabilities is None else {"capabilities": car.capabilities}),
            **({} if car.roles is None else {"roles": car.roles}),
        }
        for name, car in wish.listed.items()
    }
    return json.dumps({"cars": cars}, indent=1)


def module(name: str, *arguments: str) -> tuple[str, ...]:
    """The command that runs a module with this interpreter."""
    return (sys.executable, "-m", name, *arguments)


def hub_command(wish: FleetSpec, endpoint: str) -> tuple[str, ...]:
    """The hub."""
    open_to_lan = ("--insecure-lan",) if wish.insecure_lan else ()
    return module("schemas.bus.hub", "--endpoint", endpoint, *open_to_lan)


def gateway_command(wish: FleetSpec, car: CarProcessSpec, link: str, endpoint: str) -> tuple[str, ...]:
    """The gateway of a car, which keeps trying when its car is off."""
    where = ("--fleet", wish.fleet, "--connect", endpoint, "--retry", "--with-parent")
    told = ("--car", car.name, "--link", link, "--platform", car.platform, *car.arguments)
    return module("gateway.cli", "run", *told, *where)


def simulator_command(wish: FleetSpec, directory: Path, endpoint: str) -> tuple[str, ...]:
    """One simulator for all simulated cars; a named terminal is found again by a gateway when it was away."""
    cars = [f"{car.name}:{car.platform}:{_terminal(directory, car.name)}" for car in wish.simulated]
    world = () if wish.world is None else ("--world", str(wish.world))
    told = [word for car in cars for word in ("--car", car)]
    return module("gateway.cli", "sim", *told, *world, "--fleet", wish.fleet, "--connect", endpoint, "--with-parent")


def _terminal(directory: Path, car: str) -> str:
    return f"pty:{directory / car}.tty" if os.name == "posix" else "tcp"


def recorder_command(wish: FleetSpec, endpoint: str) -> tuple[str, ...]:
    """The recorder."""
    where = ("--fleet", wish.fleet, "--connect", endpoint, "--with-parent")
    files = {"--fleet-file": wish.file, "--plan": wish.plan}
    kept = [word for option, path in files.items() if path is not None for word in (option, str(path))]
    return module("fleet.cli", "record", "--out", str(wish.recordings), "--json", *kept, *where)


def coordinator_command(wish: FleetSpec, plan: Path, listed: Path, endpoint: str) -> tuple[str, ...]:
    """The coordinator, with copies of the plan and of what is said of the cars, both in the directory of this run."""
    where = ("--fleet", wish.fleet, "--connect", endpoint, "--with-parent", "--run", plan.parent.name)
    return module("fleet.cli", "coordinate", "--plan", str(plan), "--fleet-file", str(listed), "--json", *where)
