"""`gateway sim`: the arguments, one line of output per car, scheduled faults, a clean end.

`control_channel` carries out the commands on stdin.
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
The command prints one JSON line per car: {"car", "platform", "link"}. Give the link to `gateway run --link`. After a
link_drop, a plain pty often has another name. Then the line is printed again. With pty:PATH the name stays the same.

options of a platform that real cars have, too; join several with + (--car red:arduino+arm+interval=0.71:pty):
  +arm +imu                             the car has an arm; the car has a gyroscope
  +text                                 the car prints the line EXEC:F after each general frame
  +no_readings                          the car sends nothing at all
  +3s                                   the battery has three cells: up to 12.6 V
  +fan_level                            the fan digit is a level: 0 turns the fan off in every frame
  +ptz_direct                           the servo goes to the angle in the frame, not to 180 degrees minus the angle
  +head=WORD                            readings and named frames begin with WORD instead of 4WD: 2 to 8 letters and
                                        digits
options of the simulator only:
  +interval=S                           the time from report to report is S seconds (0.1 to 10)
  +spread=S                             each time from report to report is up to S seconds longer or shorter (0 to 1)
  +timer                                a hardware timer sends the reports, so no frame delays them (arduino)
  +close=S                              MODEx0 blocks the car for S seconds (0 to 10; arduino)
  +last_frame                           if several frames are in the buffer, only the last one counts (arduino)
  +silent=MODE                          the car prints nothing in this mode; may be repeated (arduino, stm32)
  +gray=MAX                             the grayscale values go up to MAX (arduino, stm32)
  +constants                            the values of line, obstacle, light and grayscale never change (arduino, stm32)
options of wave_rover, ugv01, ugv02, ugv_rover and ugv_beast, which have no others:
  +mission                              after each reset, the car plays a mission: a wave_rover, ugv01 or ugv02 drives
                                        for 2 s, and the others obey nothing for as long
  +no_encoder                           the left encoder counts nothing
  +quiet                                the car does not send back the lines that it gets
  +arm                                  the car reports an arm in place of its yaw (ugv_rover, ugv_beast: in place of
                                        its accelerations), until T:900 says that there is no arm
  +gimbal                               the car searches for a gimbal that is not there
An stm32 car reports by a timer, and no frame blocks it. A course car runs a Raspberry Pi program that knows only the
frames for motions, the whistle and the lights. The program sends nothing, and ends with an error at any other frame.
faults on the command line (AMOUNT is seconds, but bytes for garbage; --fault may be repeated):
  --fault red:link_drop@5+2             the link is gone for 2 s; without +2 until you end the fault
  --fault red:rename@5+2                the link is gone for 2 s (without +2 for 1 s), and comes back as another device:
                                        pty:PATH points to it, a plain pty and TCP have a new link; with
                                        ,path=/tmp/other it comes back at that path
  --fault red:cut_write@5+2,bytes=7     only 7 bytes of the next frame reach the car, and then the link is gone for 2 s
  --fault red:slow@5+10,factor=0.1      both directions run at a tenth of 960 bytes/s, byte by byte
  --fault red:lossy@5+10,share=0.2      a fifth of the bytes is lost; ,to=car or ,to=host: only in this direction
  --fault red:stuck@5+10                the car stops reading: writes block (pty), or fill the system's buffers (TCP)
  --fault red:deaf@5+10                 the car reads every byte and ignores it
  --fault red:mute@5+10                 the car obeys, but sends nothing
  --fault red:echo@5+10                 the car obeys, and sends every byte back
  --fault red:firehose@5+10,rate=1e6    the car sends a million random bytes/s besides its readings; with ,of=frame
                                        these bytes are a frame that never ends
  --fault red:garbage@5+200             200 random bytes reach the host; with ,to=car they reach the car
  --fault brownout@10                   every car resets; with red: before brownout, only red does
  --fault red:empty@5+20                the battery runs empty within 20 s; then the car is off, and its link is gone
Faults on stdin are one JSON object per line. One line on stdout answers each. "for_s": 0 ends a fault. A
link_drop with 0 also brings back a link that a rename or a cut_write has cut. Without "for_s", a fault lasts until you
end it, but a rename cuts the link for 1 s, and empty takes 20 s:
  {"car": "red", "fault": "lossy", "for_s": 10, "share": 0.2, "to": "car"}
The infrared remote: only an Arduino or STM32 car in mode remote_control obeys it. A ugv car has no remote, so a button
here is a button of its web page, which has no whistle, faster and slower. A motion lasts until the next button, or
until the mode is closed. The buttons are forward, back, left, right, spin_left, spin_right, stop, whistle, faster and
slower.
  --ir red:forward@5                    on stdin {"car": "red", "ir": "forward"}
A world from a file can have lamps that light sensors see, things to bump into and to follow, and cars that see each
other and block each other's way. `fleet example copy follow` writes such a file with comments. On stdin:
  {"lamp": "beacon", "on": false}       or "brightness", "reach_m", "x_m", "y_m" (for a lamp on a car: ahead, left)
  {"thing": "cart", "x_m": 1, "y_m": 0} puts it there, off its path; or "speed_m_s": its speed along its path
The true state, on stdin:
  {"car": "red", "ask": "truth"}        mode, motors, pose, ...; for a replay: bytes sent and ignored, rounds
  {"ask": "world"}                      every lamp and thing: where it is, whether it is on, its size and speed
Replays: a file of `gateway monitor --raw` is played as a car, with its timing. It ignores what you send to it. Over TCP
it begins when the first host connects, over a pty at once:
  gateway sim --replay red.raw:red:tcp --loop --rate 2
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    parser.description = (
        "Run simulated cars that behave like real ones, with their hazards, in one world and one process."
    )
    parser.epilog = EPILOG
    parser.formatter_class = argparse.RawDescriptionHelpFormatter
    parser.add_argument(
        "--car",
        action="append",
        default=[],
        metavar="NAME:PLATFORM:LINK",
        help="a simulated car; may be repeated. PLATFORM is arduino, stm32, raspberry_pi, course, wave_rover, ugv01, "
        "ugv02, ugv_rover or ugv_beast, with options such as +arm (see below). LINK is pty, pty:PATH, tcp or "
        "tcp://HOST:PORT",
    )
    parser.add_argument(
        "--seed",
        type=int,
        default=0,
        help="seed of everything random: with the same seed, and the same bytes at the same times, cars behave the "
        "same (default: 0)",
    )
    parser.add_argument(
        "--world",
        metavar="WORLD",
        default="room",
        help="room has walls and a line to track. open has nothing, so no ranging has an echo. Or give a file with "
        "lamps, things, and cars that can bump into each other, such as `fleet example show follow` prints (default: "
        "room)",
    )
    parser.add_argument(
        "--check",
        action="store_true",
        help="only check the world, and end. With --car, the world may name only these cars, otherwise any",
    )
    parser.add_argument(
        "--fault",
        action="append",
        default=[],
        metavar="[CAR:]FAULT@S[+AMOUNT][,FIELD=VALUE]",
        help="cause a fault S seconds after the start (see below)",
    )
    parser.add_argument(
        "--ir",
        action="append",
        default=[],
        metavar="[CAR:]BUTTON@S",
        help="press a button of the infrared remote S seconds after the start (see below)",
    )
    parser.add_argument(
        "--replay",
        action="append",
        default=[],
        metavar="FILE[:NAME[:LINK]]",
        help="play a capture as a car. NAME is replay and LINK is pty unless you give others",
    )
    parser.add_argument(
        "--loop",
        action="store_true",
        help="play captures again and again, with a pause between two rounds: 1 s at --rate 1",
    )
    parser.add_argument("--rate", type=float, metavar="FACTOR", help="speed of captures, as a factor (default: 1)")
    parser.add_argument(
        "--fleet",
        default=keys.DEFAULT_FLEET,
        help="name of the fleet under which the cars publish their true state (default: fleet)",
    )
    parser.add_argument(
        "--connect", metavar="ENDPOINT", help="hub for the true state (default: FLEET_ENDPOINT, or loopback)"
    )
    parser.add_argument("--no-truth", action="store_true", help="do not publish the true state, and do not use a bus")
    parser.add_argument("--parent", metavar="PID", type=int, help=argparse.SUPPRESS)


def run(args: argparse.Namespace) -> int:
    """Run until SIGINT or SIGTERM, and return the exit code."""
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
    """Read all captures, before any link opens. Raises BadSpec if one cannot be read or played."""
    if not replays and not args.car:
        raise BadSpec("nothing to simulate: give --car NAME:PLATFORM:LINK or --replay FILE")
    if not replays and (args.loop or args.rate is not None):
        raise BadSpec("--loop and --rate need a capture: give --replay FILE as well")
    rate = 1.0 if args.rate is None else args.rate
    if not math.isfinite(rate) or not RATES[0] <= rate <= RATES[1]:
        raise BadSpec(f"rate {rate!r} is not allowed: use a number from {RATES[0]:g} to {RATES[1]:g}")
    found = []
    for spec in replays:
        try:
            pieces = [(piece.at, piece.data) for piece in capture.read(Path(spec.path))]
        except capture.BadCapture as error:
            raise BadSpec(str(error)) from None
        except OSError as error:
            raise BadSpec(f"{spec.path}: {error.strerror}: write FILE[:NAME[:LINK]]") from None
        except ValueError as error:  # a NUL in the path
            raise BadSpec(f"{spec.path!r} is not a path: {error}") from None
        if not pieces:
            raise BadSpec(f"{spec.path}: the capture has no bytes to play")
        found.append((spec, CaptureCar(pieces, rate=rate, loop=args.loop)))
    return found


def _world(words: str, cars: list[str] | None) -> World:
    """Return a world by its name or from its file. Raises BadSpec if the file is wrong."""
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
