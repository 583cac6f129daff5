"""`gateway sim`: the arguments, one line of output per car, scheduled faults, a clean end.

`control_channel` obeys the commands on stdin.
"""

import argparse
import asyncio
import math
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Final

from gateway import capture
from gateway.sim.car_spec import BadSpec, CarSpec, ReplaySpec, parse_cars, parse_replay, refuse_twins
from gateway.sim.control_channel import print_json, serve_commands
from gateway.sim.endpoints import EndpointError, Taken
from gateway.sim.faults import Fault, Scheduled, parse_fault, parse_press, targets
from gateway.sim.model.capture_car import CaptureCar
from gateway.sim.model.world import World
from gateway.sim.simulation import SimCar, Simulation
from schemas import keys
from schemas.process import signals
from schemas.process.parent import has_ended, watched_pid

WORLDS: Final = {"room": World.room, "open": World.open_field}
PARENT_CHECK_INTERVAL_S: Final = 0.1
RATES: Final = (0.01, 100.0)

EPILOG: Final = """\
Prints one JSON line per car: {"car", "platform", "link"}; give the link to `gateway run --link`. A link that comes back
under another name is printed again: a plain pty after each link_drop; pty:PATH keeps its name.

options of a platform, for the cars that people have; several are joined (--car red:arduino+arm+interval=0.71:pty):
  +arm +imu                             an arm, a gyroscope
  +text                                 prints the line EXEC:F after each general frame
  +no_readings                          sends nothing at all
  +3s                                   three battery cells: up to 12.6 V
  +fan_level                            the fan digit is a level: 0 turns the fan off in every frame
  +ptz_direct                           the servo goes to the angle of the frame, not to 180 degrees minus it
  +head=WORD                            another first word than 4WD in the frames, 2 to 8 letters and digits
options of the simulator only:
  +interval=S +spread=S                 S seconds from report to report (0.1 to 10), each up to +-S longer (0 to 1)
  +timer                                reports come by a hardware timer: no frame delays them (arduino)
  +close=S                              MODEx0 blocks for S seconds (0 to 10; arduino)
  +last_frame                           of several frames in the buffer the last one counts (arduino)
  +silent=MODE                          prints nothing in this mode; may be repeated (arduino, stm32)
  +gray=MAX +constants                  the grayscale goes up to MAX; constants for line, obstacle, light and grayscale
                                        (arduino, stm32)
  +mission +no_encoder +quiet           its boot mission drives; the left encoder counts nothing; it repeats no line
  +arm +gimbal                          it reports an arm in the place of angles; it searches a gimbal that is not there
                                        (wave_rover, ugv01, ugv02, ugv_rover, ugv_beast; no other option)
an stm32 car reports by a timer, and no frame blocks it. A course car is a Raspberry Pi program that knows the frames of
the motions, dies at any other and sends nothing.
faults, on the command line (AMOUNT is seconds, for garbage bytes; --fault may be repeated):
  --fault red:link_drop@5+2             gone for 2 s; without +2 until you end it
  --fault red:rename@5+2                comes back as another device: pty:PATH points to a new one, a plain pty and TCP
                                        have a new link; ,path=/tmp/other: back at that path instead
  --fault red:cut_write@5+2,bytes=7     of the next frame to the car 7 bytes come through, then the link is gone for 2 s
  --fault red:slow@5+10,factor=0.1      both ways at a tenth of 960 bytes/s, byte by byte
  --fault red:lossy@5+10,share=0.2      a fifth of the bytes is lost; ,to=car or ,to=host: one way only
  --fault red:stuck@5+10                stops reading: writes block (pty), or pile up in the system's buffers (TCP)
  --fault red:deaf@5+10                 reads every byte and ignores it
  --fault red:mute@5+10                 obeys, and sends nothing
  --fault red:echo@5+10                 sends every byte back, and obeys it
  --fault red:firehose@5+10,rate=1e6    random bytes/s besides its readings; ,of=frame: a frame that never ends
  --fault red:garbage@5+200             200 random bytes to the host; ,to=car: the other way
  --fault brownout@10                   every car resets; only red with red: before it
  --fault red:empty@5+20                its battery runs empty within 20 s; then it is off, and its link is gone
faults on stdin, one JSON object a line, each answered by one line on stdout; "for_s": 0 ends a fault (rename and
cut_write end as link_drop does); without "for_s" a fault lasts until then:
  {"car": "red", "fault": "lossy", "for_s": 10, "share": 0.2, "to": "car"}
infrared remote, which only an Arduino or STM32 car in mode remote_control obeys (of the ugv cars: their web page);
buttons: forward, back, left, right, spin_left, spin_right, stop, whistle, faster, slower; it holds until the next:
  --ir red:forward@5                    or on stdin {"car": "red", "ir": "forward"}
worlds: lamps that light sensors see, things to bump into and to follow, cars that see each other and are in each
other's way come from a file; `fleet example copy follow` writes one with a comment for each field. On stdin:
  {"lamp": "beacon", "on": false}       or "brightness", "reach_m", "x_m", "y_m" (of a carried one: ahead, left)
  {"thing": "cart", "x_m": 1, "y_m": 0} stays there, off its path; or "speed_m_s" along it
the true state:
  {"car": "red", "ask": "truth"}        mode, motors, pose, ...; of a replay: bytes sent and ignored, rounds
  {"ask": "world"}                      every lamp and thing: where, whether it is on, how large, how fast
replay: a file of `gateway monitor --raw` plays as a car, with its timing. It ignores what you send to it. Over TCP it
begins when a host connects, over a pty at once:
  gateway sim --replay red.raw:red:tcp --loop --rate 2
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    parser.description = (
        "Simulated cars that behave as the real ones do, hazards included, in one world and one process."
    )
    parser.epilog = EPILOG
    parser.formatter_class = argparse.RawDescriptionHelpFormatter
    parser.add_argument(
        "--car",
        action="append",
        default=[],
        metavar="NAME:PLATFORM:LINK",
        help="PLATFORM: arduino, stm32, raspberry_pi, course, wave_rover, ugv01, ugv02, ugv_rover or ugv_beast, with "
        "options such as +arm, see below; LINK: pty, pty:PATH or tcp://HOST:PORT",
    )
    parser.add_argument("--seed", type=int, default=0, help="same seed and same bytes: same behavior (default: 0)")
    parser.add_argument(
        "--world",
        metavar="WORLD",
        default="room",
        help="room: walls and a line to track; open: nothing, so no ranging has an echo; or a file with lamps, things "
        "and cars that meet, as `fleet example show follow` prints (default: room)",
    )
    parser.add_argument("--check", action="store_true", help="only check the world, for these cars or (no --car) any")
    parser.add_argument(
        "--fault",
        action="append",
        default=[],
        metavar="[CAR:]FAULT@S[+AMOUNT][,FIELD=VALUE]",
        help="a fault S seconds after the start, see below",
    )
    parser.add_argument(
        "--ir", action="append", default=[], metavar="[CAR:]BUTTON@S", help="press a button of the infrared remote"
    )
    parser.add_argument(
        "--replay",
        action="append",
        default=[],
        metavar="FILE[:NAME[:LINK]]",
        help="a capture as a car (default: replay, on a pty)",
    )
    parser.add_argument("--loop", action="store_true", help="play captures over and over, 1 s between two rounds")
    parser.add_argument("--rate", type=float, metavar="FACTOR", help="speed of captures, as a factor (default: 1)")
    parser.add_argument(
        "--fleet", default=keys.DEFAULT_FLEET, help="fleet under which the cars publish their true state"
    )
    parser.add_argument(
        "--connect", metavar="ENDPOINT", help="hub for the true state (default: FLEET_ENDPOINT, else loopback)"
    )
    parser.add_argument("--no-truth", action="store_true", help="publish nothing, use no bus")
    parser.add_argument("--parent", metavar="PID", type=int, help=argparse.SUPPRESS)


def run(args: argparse.Namespace) -> int:
    """Run until SIGINT or SIGTERM; return the exit code."""
    try:
        if args.check:
            _world(args.world, [spec.name for spec in parse_cars(args.car)] or None)
            return 0
        specs = parse_cars(args.car)
        replays = [parse_replay(text) for text in args.replay]
        everyone: list[CarSpec | ReplaySpec] = [*specs, *replays]
        refuse_twins(everyone)
        scheduled = [*map(parse_fault, args.fault), *map(parse_press, args.ir)]
        for each in scheduled:
            targets(everyone, each.act)
        captures = _captures(replays, args)
        world = _world(args.world, [spec.name for spec in specs])
        keys.check_name(args.fleet, "fleet name")
        endpoint = None if args.no_truth else _endpoint(args.connect)
    except (BadSpec, keys.BadKey) as error:
        return _fail(str(error), 2)
    try:
        asyncio.run(_serve(specs, captures, world, scheduled, args, endpoint))
    except EndpointError as error:
        return _fail(str(error), 2 if isinstance(error, Taken) else 1)
    return 0


def _captures(replays: Sequence[ReplaySpec], args: argparse.Namespace) -> list[tuple[ReplaySpec, CaptureCar]]:
    """Read the captures whole, before any link opens; raise BadSpec."""
    if not replays and not args.car:
        raise BadSpec("nothing to simulate: give --car NAME:PLATFORM:LINK or --replay FILE")
    if not replays and (args.loop or args.rate is not None):
        raise BadSpec("--loop and --rate are for captures: give --replay FILE as well")
    rate = 1.0 if args.rate is None else args.rate
    if not math.isfinite(rate) or not RATES[0] <= rate <= RATES[1]:
        raise BadSpec(f"rate {rate!r} is not allowed: a number from {RATES[0]:g} to {RATES[1]:g}")
    found = []
    for spec in replays:
        try:
            pieces = [(piece.at, piece.data) for piece in capture.read(Path(spec.path))]
        except capture.BadCapture as error:
            raise BadSpec(str(error)) from None
        except OSError as error:
            raise BadSpec(f"{spec.path}: {error.strerror}: write FILE[:NAME[:LINK]]") from None
        except ValueError as error:  # a NUL in the path
            raise BadSpec(f"{spec.path!r} is no path: {error}") from None
        if not pieces:
            raise BadSpec(f"{spec.path}: the capture has no bytes to play")
        found.append((spec, CaptureCar(pieces, rate=rate, loop=args.loop)))
    return found


def _world(words: str, cars: list[str] | None) -> World:
    """Return a world by its name or from its file; raise BadSpec."""
    if words in WORLDS:
        return WORLDS[words]()
    # Imported only for a world file: the simulator starts faster without YAML.
    from gateway.sim.world_file import read_world
    from schemas.yaml_document.document import BadFile, read_text

    try:
        return read_world(read_text(Path(words), words), words, cars).world()
    except BadFile as error:
        hint = "" if error.problems[0].line else f" (worlds without a file: {', '.join(WORLDS)})"
        raise BadSpec(f"{error}{hint}") from None


def _print_error(words: str) -> None:
    sys.stderr.write(f"gateway sim: {words}\n")


def _fail(words: str, code: int) -> int:
    _print_error(words)
    return code


def _endpoint(argument: str | None) -> str:
    from schemas.bus import BadEndpoint, resolve_endpoint

    try:
        return resolve_endpoint(argument)
    except BadEndpoint as error:
        raise BadSpec(str(error)) from None


async def _serve(
    specs: Sequence[CarSpec],
    replays: Sequence[tuple[ReplaySpec, CaptureCar]],
    world: World,
    scheduled: Sequence[Scheduled],
    args: argparse.Namespace,
    endpoint: str | None,
) -> None:
    loop = asyncio.get_running_loop()
    parent = watched_pid(args.parent)
    ended = asyncio.Event()
    signals.calls_in(loop, lambda _: ended.set())
    simulation = Simulation(specs, seed=args.seed, world=world, replays=replays)
    for car in simulation.cars.values():
        car.on_failed = lambda failed, error: _print_error(f"car {failed.spec.name}: {error}")
    await simulation.start()
    tasks = [loop.create_task(_run_scheduled(simulation, each)) for each in scheduled]
    if endpoint is not None:
        from gateway.sim.truth_publisher import TruthPublisher

        tasks.append(loop.create_task(TruthPublisher(simulation, endpoint, args.fleet, _print_error).run()))
    if parent is not None:
        tasks.append(loop.create_task(_watch_parent(parent, ended)))

    def end(done: "asyncio.Task[None]") -> None:
        if not done.cancelled() and done.exception() is not None:
            ended.set()

    for task in tasks:
        task.add_done_callback(end)
    try:
        for car in simulation.cars.values():
            _print_link(car)
            car.on_renamed = _print_link
            car.on_ended = lambda car: print_json({"car": car.spec.name, "replay": "ended"})
        tasks.append(loop.create_task(serve_commands(simulation)))
        tasks[-1].add_done_callback(end)
        await ended.wait()
    finally:
        for task in tasks:
            task.cancel()
        results = await asyncio.gather(*tasks, return_exceptions=True)
        await simulation.stop()
    for failure in results:
        if isinstance(failure, Exception):
            raise failure


def _print_link(car: SimCar) -> None:
    if isinstance(car.spec, CarSpec):
        print_json({"car": car.spec.name, "platform": car.spec.platform_words, "link": car.url})
    else:
        print_json({"car": car.spec.name, "replay": car.spec.path, "link": car.url})


async def _run_scheduled(simulation: Simulation, scheduled: Scheduled) -> None:
    await asyncio.sleep(scheduled.at_s)
    if not isinstance(scheduled.act, Fault):
        simulation.press(scheduled.act)
        return
    try:
        await simulation.inflict(scheduled.act)
    except EndpointError as error:
        _print_error(str(error))


async def _watch_parent(parent: int, ended: asyncio.Event) -> None:
    while not has_ended(parent):  # noqa: ASYNC110 - no portable notification exists
        await asyncio.sleep(PARENT_CHECK_INTERVAL_S)
    ended.set()
