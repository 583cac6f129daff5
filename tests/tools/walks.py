"""Counts the rooms of two walks through the product, as they run: `python -m tests.tools.walks`.

A room is a module. The first walk is `fleet stop red`, from the command line through a real gateway until the car's
readings show the stop. Two things are counted of it. The rooms that carry the command: a function takes one of its
forms as an argument, or returns it. And all rooms that run only because of it, such as who reckons a time for it. The
second walk is one report of a car in mode 0, from the bytes of the link until it is published and learned from. It is
counted in the same two ways.
"""

import asyncio
import inspect
import os
import sys
import tempfile
import threading
from collections.abc import Iterator
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from types import CodeType, FrameType
from typing import Any, Final, Self

from tests.support.gateway_here import served
from tests.support.in_process import fleet as run_fleet
from tests.support.ports import free_endpoint
from tests.support.processes import MODE00, FleetProcesses, TcpCar, wait_for

ROOT: Final = Path(__file__).parents[2]
PACKAGES: Final = tuple(f"{ROOT / name}{os.sep}" for name in ("fleet", "gateway", "schemas"))
FORMS: Final = (
    "fleet.client.commands.CommandRequest",
    "schemas.gen.fleet_v1_pb2.StopCommand",
    "builtins.Query",  # Zenoh's
    "gateway.bus.car_service.Request",
    "gateway.control.commands.Command",
    "gateway.control.command_records.Pending",
    "gateway.drivers.yahboom.stops.stop_in_progress.StopInProgress",
    "gateway.control.control_output.OutgoingFrame",
    "gateway.control.control_output.CommandRecord",
    "schemas.gen.fleet_v1_pb2.CommandEvent",
    "fleet.client.outcome.Progress",
    "fleet.client.outcome.Outcome",
)
"""The classes that are the command, in the order in which it takes these forms."""
REPORT_FORMS: Final = (
    "builtins.bytes",
    "gateway.drivers.yahboom.protocol.sensors.Sensors",
    "gateway.drivers.yahboom.stops.evidence.Finding",
    *(
        f"schemas.gen.fleet_v1_pb2.{name}"
        for name in ("Battery", "Grayscale", "Light", "Line", "Obstacle", "Range", "RxFrame")
    ),
)
"""The classes that are a report of mode 0, or what is learned of it."""
READING_ROOTS: Final = frozenset(("LinkLoop._read", "TcpLink.data_received"))
"""The functions of the gateway's loop in which the bytes of a car arrive."""
IDLE_S: Final = 11.0
"""Time in which a gateway without a command does everything that it does by itself, also every ten seconds."""

Function = tuple[str, str]
"""The module as a path from the root, and the function."""


@dataclass
class Walk:
    """The functions of the product that were called, and those that took or returned a form of the command."""

    called: set[Function] = field(default_factory=set)
    carried: set[Function] = field(default_factory=set)
    of_reading: set[Function] = field(default_factory=set)
    carried_report: set[Function] = field(default_factory=set)


class Tracer:
    """Notes the calls of all threads that begin after it, and of its own, in the walk of this moment."""

    def __init__(self, *, whole: bool) -> None:
        self._whole = whole
        """True to note also the functions that take no form of the command, which takes much longer."""
        self.walk: Walk | None = None

    def __enter__(self) -> Self:
        threading.setprofile(self._note)
        sys.setprofile(self._note)
        return self

    def __exit__(self, *_: object) -> None:
        sys.setprofile(None)
        threading.setprofile(None)

    def _note(self, frame: FrameType, event: str, value: Any) -> None:
        """Note a call or a return. Python calls it for each."""
        code, walk = frame.f_code, self.walk
        if walk is None or event not in ("call", "return") or not code.co_filename.startswith(PACKAGES):
            return
        function = code.co_filename.removeprefix(f"{ROOT}{os.sep}"), code.co_qualname
        values = [value] if event == "return" else [frame.f_locals.get(name) for name in _arguments(code)]
        if any(is_form(each, FORMS) for each in values):
            walk.carried.add(function)
        if self._whole and "<module>" not in (callers := set(_callers(frame))):  # else an import
            walk.called.add(function)
            if callers & READING_ROOTS:
                walk.of_reading.add(function)
                if any(is_form(each, REPORT_FORMS) for each in values):
                    walk.carried_report.add(function)


def is_form(value: Any, forms: tuple[str, ...]) -> bool:
    """Return True for one of these forms, or a few of them."""
    few = value if isinstance(value, list | tuple) and len(value) < 8 else (value,)
    return any(f"{type(each).__module__}.{type(each).__name__}" in forms for each in few)


def _arguments(code: CodeType) -> tuple[str, ...]:
    """Return the names of the arguments, with that of `*args`."""
    return code.co_varnames[: code.co_argcount + code.co_kwonlyargcount + bool(code.co_flags & inspect.CO_VARARGS)]


def _callers(frame: FrameType | None) -> Iterator[str]:
    """Yield the functions of the product on the stack, and this one."""
    while frame is not None:
        if frame.f_code.co_filename.startswith(PACKAGES):
            yield frame.f_code.co_qualname
        frame = frame.f_back


def rooms(functions: set[Function]) -> list[str]:
    """Return the modules of these functions."""
    return sorted({module for module, _ in functions})


def _stands(fleet: FleetProcesses) -> bool:
    safety = fleet.state("safety")
    return safety is not None and safety.motors_basis == "shown"


async def stop_walk(directory: Path, *, whole: bool = False) -> tuple[Walk, Walk]:
    """Return the walks of an idle gateway, and of `fleet stop red` until the car has shown it."""
    car, fleet = TcpCar(), FleetProcesses(free_endpoint(), directory)
    idle, stop = Walk(), Walk()

    def command() -> None:
        done = run_fleet("stop", "red", "--connect", fleet.endpoint)
        assert done.returncode == 0, done.stderr
        assert done.stdout.startswith("red: stopped ("), done.stdout

    try:
        with Tracer(whole=whole) as tracer:
            async with served(fleet, car.link, directory):
                await asyncio.to_thread(wait_for, partial(car.received.count, MODE00), "the gateway has begun its stop")
                car.obey()
                await asyncio.to_thread(wait_for, partial(_stands, fleet), "it stands")
                tracer.walk = idle
                await asyncio.sleep(IDLE_S if whole else 0.0)
                tracer.walk = stop
                await asyncio.to_thread(command)
                tracer.walk = None
    finally:
        car.close()
        fleet.close()
    return idle, stop


def main() -> None:
    """Print the rooms of the walks."""
    with tempfile.TemporaryDirectory() as directory:
        os.environ["FLEET_STATE_DIR"] = directory
        idle, stop = asyncio.run(stop_walk(Path(directory), whole=True))
    for what, found in (
        ("fleet stop red: rooms that carry the command", rooms(stop.carried)),
        ("fleet stop red: all rooms that run because of it", rooms(stop.called - idle.called)),
        ("a report, until it is published and learned from: rooms that carry it", rooms(idle.carried_report)),
        ("a report, until it is published and learned from: all rooms that run", rooms(idle.of_reading)),
    ):
        print(f"{what}: {len(found)}\n  " + "\n  ".join(found))
    print(f"forms of the command: {len(FORMS)}\n  " + "\n  ".join(FORMS))


if __name__ == "__main__":
    main()
