"""The `gateway` command: run one car's gateway, or simulated cars.

argparse, and everything else imported where it is used: `gateway run` is started a hundred times.
"""

import argparse
import os
import sys

from schemas.keys import DEFAULT_FLEET, BadKey, check_name

_RUN_EPILOG = """\
examples:
  gateway run --car red --link /dev/ttyUSB0 --platform arduino
  gateway run --car blue --link tcp://192.168.1.7:8888 --platform raspberry_pi

Ctrl-C stops the car before the process ends."""


def main() -> None:
    """Entry point; exit code 2 for wrong use, 1 for a failure."""
    parser = argparse.ArgumentParser(prog="gateway", description="One process per car: its bytes, keyed on the bus.")
    commands = parser.add_subparsers(dest="command", required=True, metavar="COMMAND")
    run = commands.add_parser(
        "run",
        help="connect one car to the bus",
        description="Connect one car to the bus: readings out, commands in.",
        epilog=_RUN_EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    run.add_argument("--car", required=True, help="its name: a-z, 0-9, _ and -, at most 32")
    run.add_argument("--link", required=True, help="serial:///dev/ttyUSB0, a bare device path, or tcp://host:8888")
    run.add_argument("--platform", default="unknown", help="arduino, stm32, raspberry_pi; +arm, +imu (default unknown)")
    run.add_argument("--fleet", default=DEFAULT_FLEET, help="fleet name, the first part of every key (default fleet)")
    run.add_argument(
        "--connect", metavar="ENDPOINT", help="the bus, tcp/HOST:PORT (default FLEET_ENDPOINT, or loopback)"
    )
    run.add_argument(
        "--state-dir", metavar="DIR", help="where e-stops and holds are kept (default: FLEET_STATE_DIR, or the user's)"
    )
    run.add_argument("--retry", action="store_true", help="keep trying when the link cannot be opened at the start")
    run.add_argument(
        "--with-parent", action="store_true", help="stop the car and end when the process that started this ends"
    )
    sim = commands.add_parser("sim", help="simulated cars that behave like the real ones, hazards included")
    if "sim" in sys.argv[1:2]:
        from gateway.sim import command as sim_command

        sim_command.add_arguments(sim)
    arguments = parser.parse_args()
    sys.exit(_run(arguments) if arguments.command == "run" else _sim(arguments))


def _sim(arguments: argparse.Namespace) -> int:
    from gateway.sim import command as sim_command

    return sim_command.run(arguments)


def _run(arguments: argparse.Namespace) -> int:
    parent = os.getppid() if arguments.with_parent else None
    from gateway.doors import AlreadyServed, Doors
    from gateway.link import BadUrl, LinkError, parse_url
    from gateway.protocol.profile import parse_platform
    from schemas.bus import BadEndpoint, Bus, BusError

    try:
        car, fleet = check_name(arguments.car), check_name(arguments.fleet, "fleet name")
        url, profile = parse_url(arguments.link), parse_platform(arguments.platform)
    except (BadKey, BadUrl, ValueError) as error:
        return _failed(str(error), 2)
    try:
        with Bus.open(arguments.connect, start_hub=True) as opened:
            doors = Doors(opened, fleet, car)
            # The car is on the bus; what follows takes as long again to import.
            import asyncio
            import logging
            from pathlib import Path

            from gateway.car import Settings, serve
            from gateway.store import default_directory

            logging.basicConfig(format="%(asctime)s %(levelname)s %(message)s", level=logging.INFO, stream=sys.stderr)
            state_dir = Path(arguments.state_dir) if arguments.state_dir else default_directory()
            settings = Settings(car, url, profile, fleet, state_dir, arguments.retry, parent)
            stopped = asyncio.run(serve(settings, opened, doors))
    except BadEndpoint as error:
        return _failed(str(error), 2)
    except (AlreadyServed, LinkError, BusError) as error:
        return _failed(str(error), 1)
    except KeyboardInterrupt:  # before the loop has taken the signals over: no link was open yet
        return 130
    return 0 if stopped else 1


def _failed(words: str, code: int) -> int:
    sys.stderr.write(f"gateway: {words}\n")
    return code


if __name__ == "__main__":
    main()
