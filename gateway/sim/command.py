"""`gateway sim`: arguments, the line per car, faults from stdin and from the command line, a clean end."""

import argparse
import asyncio
import contextlib
import json
import os
import signal
import sys
import threading
from collections.abc import Sequence
from typing import Final

from gateway.sim.core.world import World
from gateway.sim.links import LinkError
from gateway.sim.shell import SimCar, Simulation
from gateway.sim.spec import BadSpec, CarSpec, Scheduled, check_hit, fault_of, parse_cars, parse_fault
from schemas import keys

WORLDS: Final = {"room": World.room, "open": World.open_field}
PARENT_EVERY_S: Final = 0.1
LINE_LIMIT: Final = 65536

EPILOG: Final = """\
examples:
  gateway sim --car red:arduino:pty
  gateway sim --car red:arduino:pty --car blue:raspberry_pi:tcp://127.0.0.1:8888 --fault red:link_drop@5+2

Prints one JSON line per car: {"car", "platform", "link"}; give the link to `gateway run --link`. A plain pty that comes
back after a link_drop has another name, so its line is printed again; pty:PATH keeps its name.
Faults, one JSON object a line on stdin, each answered by one line on stdout:
  {"car": "red", "fault": "link_drop", "for_s": 2}   gone for 2 s; without for_s until one with for_s 0
  {"car": "red", "fault": "garbage", "bytes": 200}   noise to the host; "to": "car" for the other way
  {"car": "red", "fault": "brownout"}                the car resets; without "car" every car is hit
  {"car": "red", "ask": "truth"}                     what is so: mode, motors, pose, ...
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """The arguments of `gateway sim`."""
    parser.description = (
        "Simulated cars that behave as the real ones do, hazards included, in one world and one process."
    )
    parser.epilog = EPILOG
    parser.formatter_class = argparse.RawDescriptionHelpFormatter
    parser.add_argument(
        "--car",
        action="append",
        required=True,
        metavar="NAME:PLATFORM:LINK",
        help="PLATFORM: arduino, stm32 or raspberry_pi, with +arm, +imu; LINK: pty, pty:PATH or tcp://HOST:PORT",
    )
    parser.add_argument("--seed", type=int, default=0, help="same seed and same bytes: same behaviour (default: 0)")
    parser.add_argument(
        "--world",
        choices=sorted(WORLDS),
        default="room",
        help="room: walls and a line to track; open: nothing, so no ranging has an echo (default: room)",
    )
    parser.add_argument(
        "--fault",
        action="append",
        default=[],
        metavar="[CAR:]FAULT@S[+AMOUNT]",
        help="red:link_drop@5+2, red:garbage@3+200, brownout@10; seconds after the start",
    )
    parser.add_argument("--fleet", default=keys.DEFAULT_FLEET, help="fleet that the truth is published under")
    parser.add_argument(
        "--connect", metavar="ENDPOINT", help="hub for the truth (default: FLEET_ENDPOINT, else loopback)"
    )
    parser.add_argument("--no-truth", action="store_true", help="publish nothing, use no bus")
    parser.add_argument("--with-parent", action="store_true", help="end when the process that started this one ends")


def run(args: argparse.Namespace) -> int:
    """Run until SIGINT or SIGTERM; the exit code."""
    try:
        specs = parse_cars(args.car)
        faults = [parse_fault(text) for text in args.fault]
        check_hit([spec.name for spec in specs], [scheduled.fault for scheduled in faults])
        keys.check_name(args.fleet, "fleet name")
        endpoint = None if args.no_truth else _endpoint(args.connect)
    except (BadSpec, keys.BadKey) as error:
        return _fail(str(error), 2)
    try:
        asyncio.run(_serve(specs, faults, args, endpoint))
    except LinkError as error:
        return _fail(str(error), 1)
    return 0


def _fail(words: str, code: int) -> int:
    sys.stderr.write(f"gateway sim: {words}\n")
    return code


def _endpoint(argument: str | None) -> str:
    from schemas.bus import BadEndpoint, resolve_endpoint

    try:
        return resolve_endpoint(argument)
    except BadEndpoint as error:
        raise BadSpec(str(error)) from None


def _say(line: dict[str, object]) -> None:
    # Whoever reads may have gone; the cars go on.
    with contextlib.suppress(BrokenPipeError):
        sys.stdout.write(json.dumps(line) + "\n")
        sys.stdout.flush()


async def _serve(
    specs: Sequence[CarSpec], faults: Sequence[Scheduled], args: argparse.Namespace, endpoint: str | None
) -> None:
    loop = asyncio.get_running_loop()
    parent = os.getppid()
    ended = asyncio.Event()
    _on_signals(loop, ended)
    simulation = Simulation(specs, seed=args.seed, world=WORLDS[args.world]())
    await simulation.start()
    tasks = [loop.create_task(_strike(simulation, scheduled)) for scheduled in faults]
    if endpoint is not None:
        from gateway.sim.truth import TruthPublisher

        tasks.append(loop.create_task(TruthPublisher(simulation, endpoint, args.fleet).run()))
    if args.with_parent:
        tasks.append(loop.create_task(_watch_parent(parent, ended)))
    lines: asyncio.Queue[bytes] = asyncio.Queue()
    tasks.append(loop.create_task(_obey(simulation, lines)))
    for task in tasks:
        task.add_done_callback(lambda done: None if done.cancelled() or done.exception() is None else ended.set())
    try:
        for spec in specs:
            _introduce(simulation.cars[spec.name])
            simulation.cars[spec.name].moved = _introduce
        threading.Thread(target=_read_lines, args=(loop, lines), daemon=True).start()
        await ended.wait()
    finally:
        for task in tasks:
            task.cancel()
        results = await asyncio.gather(*tasks, return_exceptions=True)
        await simulation.stop()
    for failure in results:
        if isinstance(failure, Exception):
            raise failure


def _introduce(car: SimCar) -> None:
    _say({"car": car.spec.name, "platform": car.spec.platform_words, "link": car.url})


def _on_signals(loop: asyncio.AbstractEventLoop, ended: asyncio.Event) -> None:
    for number in (signal.SIGINT, signal.SIGTERM):
        try:
            loop.add_signal_handler(number, ended.set)
        except NotImplementedError:  # Windows
            signal.signal(number, lambda *_: loop.call_soon_threadsafe(ended.set))


async def _strike(simulation: Simulation, scheduled: Scheduled) -> None:
    await asyncio.sleep(scheduled.at_s)
    try:
        await simulation.inflict(scheduled.fault)
    except LinkError as error:
        _fail(str(error), 1)


async def _watch_parent(parent: int, ended: asyncio.Event) -> None:
    while os.getppid() == parent:  # noqa: ASYNC110 - the system tells of a dead parent in no other portable way
        await asyncio.sleep(PARENT_EVERY_S)
    ended.set()


def _read_lines(loop: asyncio.AbstractEventLoop, lines: "asyncio.Queue[bytes]") -> None:
    """Stdin may be a pipe, a terminal, a file or nothing, so a thread reads it; its end ends nothing.

    `os.read` instead of the buffered stdin: a daemon thread that holds that one's lock breaks the interpreter's end.
    """
    if hasattr(signal, "pthread_sigmask"):
        # Reading a terminal from the background would stop the whole process.
        signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGTTIN})
    rest = b""
    while True:
        try:
            data = os.read(0, 4096)
        except OSError:
            return
        if not data:
            return
        *whole, rest = (rest + data).split(b"\n")
        rest = rest[-LINE_LIMIT:]
        try:
            for line in whole:
                loop.call_soon_threadsafe(lines.put_nowait, line)
        except RuntimeError:  # the loop has ended
            return


async def _obey(simulation: Simulation, lines: "asyncio.Queue[bytes]") -> None:
    while True:
        line = await lines.get()
        if line.strip():
            _say(await _answer(simulation, line))


async def _answer(simulation: Simulation, line: bytes) -> dict[str, object]:
    try:
        fields = json.loads(line)
        if isinstance(fields, dict) and fields.get("ask") == "truth":
            return _truth(simulation, fields.get("car"))
        fault = fault_of(fields)
        return {"ok": True, "fault": fault.kind.value, "cars": await simulation.inflict(fault)}
    except ValueError as error:  # BadSpec, and whatever is no JSON
        words = str(error) if isinstance(error, BadSpec) else f"no JSON: {error}"
    except LinkError as error:
        words = str(error)
    return {"ok": False, "error": words}


def _truth(simulation: Simulation, name: object) -> dict[str, object]:
    car = simulation.cars.get(name) if isinstance(name, str) else None
    if car is None:
        raise BadSpec(f"car {name!r} is not simulated here: use {', '.join(simulation.cars)}")
    truth, pose = car.truth, car.pose
    return {
        "ok": True,
        "car": name,
        "mode": truth.mode.value,
        "motor_left": truth.motor_left,
        "motor_right": truth.motor_right,
        "blocked": truth.blocked,
        "fan": truth.fan,
        "led": truth.led,
        "servo": truth.servo,
        "speed": truth.speed,
        "alive": truth.alive,
        "x_m": pose.x_m,
        "y_m": pose.y_m,
        "heading_rad": pose.heading_rad,
    }
