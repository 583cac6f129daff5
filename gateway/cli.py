"""The `gateway` command: the table of its subcommands, and `gateway run`."""

# argparse and lazy imports keep the start short: a fleet starts `gateway run` a hundred times.

import argparse
import importlib
import os
import sys
from typing import TYPE_CHECKING, Any, Final, NoReturn

from schemas import identity
from schemas.battery_levels import CRITICAL_V, LOW_V
from schemas.duration import parse_duration
from schemas.keys import DEFAULT_FLEET, BadKey, check_name
from schemas.links import LINK_HELP, LINK_HELP_OPTIONS
from schemas.process import startup, stdio
from schemas.process.parent import watched_pid
from schemas.suggestion import did_you_mean
from schemas.words import BatteryAction, BatteryLevel

if TYPE_CHECKING:
    from pathlib import Path

    from _typeshed import SupportsWrite

    from schemas.bus import Bus
    from schemas.links import LinkUrl

COMMANDS: Final = {
    "sim": ("gateway.sim.cli", "run simulated cars that behave like real ones, with their hazards"),
    "scan": ("gateway.tools.scan", "list the serial ports and Bluetooth devices, and find the cars among them"),
    "monitor": ("gateway.tools.monitor", "show what a car sends: the decoded readings beside the raw bytes"),
    "send": ("gateway.tools.send", "check one frame, and send it to a car on the desk"),
}
"""For each subcommand except `run`, the module with its `add_arguments` and `run`, and its line in the help.

A module is imported only when its subcommand is called.
"""

_EPILOG: Final = "Exit codes: 0 done, 1 failed, 2 wrong use, 130 Ctrl-C."
_RUN_EPILOG: Final = """\
examples:
  gateway run --car red --link /dev/ttyUSB0 --platform arduino
  gateway run --car blue --link tcp://192.168.1.7:8888 --platform raspberry_pi

Ctrl-C stops the car before the process ends."""


def main() -> None:
    """Run the command line, and exit with 1 after a failure and with 2 after wrong use."""
    stdio.complete()
    called = sys.argv[1] if sys.argv[1:] else ""
    if os.environ.get("FLEET_LOG"):
        from schemas.process import json_log

        json_log.begin(f"gateway {called}" if called in COMMANDS else "gateway")
    parser = _GatewayParser(prog="gateway", description="Connects one robot car to the Zenoh bus.", epilog=_EPILOG)
    parser.add_argument("--version", action=_Version, nargs=0, help="show the version")
    commands = parser.add_subparsers(dest="command", required=True, metavar="COMMAND")
    _add_run(commands)
    subparsers = {name: commands.add_parser(name, help=words) for name, (_, words) in COMMANDS.items()}
    if called not in COMMANDS:
        near = did_you_mean(called, ["run", *COMMANDS])
        if called != "run" and near:
            sys.exit(_failed(f'There is no command "{called}". {near}', 2))
        sys.exit(_run(parser.parse_args()))
    command = importlib.import_module(COMMANDS[called][0])
    command.add_arguments(subparsers[called])
    sys.exit(command.run(parser.parse_args()))


class _GatewayParser(argparse.ArgumentParser):
    """A parser whose errors take one line. It exits with 1 if its help cannot be written."""

    def parse_known_args(self, args: Any = None, namespace: Any = None) -> Any:
        """Parse the words. The parser of a subcommand rejects unknown words itself, and names the likely option."""
        if self._subparsers is not None:
            return super().parse_known_args(args, namespace)
        for word in args:
            name = word.partition("=")[0]
            if name[:2] == "--" and name[2:] and not any(each.startswith(name) for each in self._option_string_actions):
                self.error(f"No such option '{name}'. {did_you_mean(name, self._option_string_actions)}".rstrip())
        parsed, unknown = super().parse_known_args(args, namespace)
        if unknown:
            self.error(f'{self.prog} does not accept "{unknown[0]}".')
        return parsed, unknown

    def _check_value(self, action: argparse.Action, value: Any) -> None:
        near = did_you_mean(str(value), map(str, action.choices or ()))
        if near and value not in (action.choices or ()):
            raise argparse.ArgumentError(action, f'"{value}" is not allowed. {near}')
        super()._check_value(action, value)

    def error(self, message: str) -> NoReturn:
        """Print the error and how to get the help, and exit with 2. Omit the usage, which has up to eight lines."""
        sys.exit(_failed(f"{message} (see {self.prog} --help)", 2))

    def print_help(self, file: "SupportsWrite[str] | None" = None) -> None:
        """Print the help to stdout, or to the file."""
        super().print_help(file) if file is not None else _print(self.format_help())


class _Version(argparse.Action):
    """Prints the version. It imports `importlib.metadata` only when called, so that a gateway starts faster."""

    def __call__(self, parser: argparse.ArgumentParser, *_: object) -> None:
        from importlib.metadata import version

        _print(f"gateway {version('zenoh-car-fleet')}\n")
        parser.exit()


def _print(text: str) -> None:
    """Print a text to stdout. If it cannot be written, exit with 1."""
    try:
        sys.stdout.write(text)
        sys.stdout.flush()
    except OSError as error:
        sys.exit(stdio.silence_broken(error, "gateway"))


def _add_run(commands: "argparse._SubParsersAction[Any]") -> None:
    run = commands.add_parser(
        "run",
        help="connect one car to the bus",
        description="Connect one car to the bus: publish its readings and carry out commands.",
        epilog=_RUN_EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    run.add_argument("--car", required=True, help="name of the car: at most 32 of the characters a-z, 0-9, _ and -")
    run.add_argument(
        "--link",
        required=True,
        help=f"where the car is: {LINK_HELP}{LINK_HELP_OPTIONS} (`fleet scan` lists the links)",
    )
    run.add_argument(
        "--platform",
        default="auto",
        help="what the car is: arduino, stm32, raspberry_pi or unknown, with options as in arduino+arm. With auto (the "
        "default) the gateway finds out. It does not recognize wave_rover, ugv01, ugv02, ugv_rover, ugv_beast and the "
        "platforms of installed drivers: name these",
    )
    run.add_argument(
        "--fleet", default=DEFAULT_FLEET, help="name of the fleet, the first part of every key (default: fleet)"
    )
    run.add_argument(
        "--connect", metavar="ENDPOINT", help="the bus, as tcp/HOST:PORT (default: FLEET_ENDPOINT, or loopback)"
    )
    run.add_argument(
        "--state-dir",
        metavar="DIR",
        help="directory for the e-stops and holds of each bus (default: FLEET_STATE_DIR, or the state directory of "
        "the user)",
    )
    run.add_argument(
        "--holds-of",
        metavar="TEXT",
        help="name under which the holds and loans of this car are kept (default: its link; `fleet up` uses the folder "
        "of a simulated car)",
    )
    run.add_argument(
        "--person",
        metavar="NAME",
        action="append",
        help="a person who may drive this car: NAME, or NAME:lead for a lead. NAME:other is a person who may drive "
        "only other cars. May be repeated. Everybody else may only watch and stop (default: everybody may drive, and "
        "nobody is a lead)",
    )
    run.add_argument(
        "--people-only",
        action="store_true",
        help="let only the people of --person drive this car. Without --person, nobody may",
    )
    run.add_argument(
        "--longest-drive",
        metavar="DURATION",
        default="10s",
        help="maximum duration of a drive command (default: 10s)",
    )
    run.add_argument(
        "--speed-max",
        metavar="SHARE",
        type=float,
        default=1.0,
        help="maximum speed as a share of full speed, more than 0 and at most 1 (default: 1)",
    )
    for level, default, volts in (
        (BatteryLevel.LOW, BatteryAction.WARN, LOW_V),
        (BatteryLevel.CRITICAL, BatteryAction.REFUSE, CRITICAL_V),
    ):
        run.add_argument(
            f"--on-battery-{level}",
            choices=tuple(map(str, BatteryAction)),
            default=default,
            help=f"what to do if the battery is {level}: warn, refuse new drives and modes, or stop "
            f"(default: {default})",
        )
        run.add_argument(
            f"--battery-{level}-v",
            metavar="V",
            type=float,
            default=volts,
            help=f"voltage below which the battery is {level} (default: {volts})",
        )
    run.add_argument("--retry", action="store_true", help="keep trying if the link cannot be opened at the start")
    run.add_argument(
        "--parent",
        metavar="PID",
        type=int,
        help=argparse.SUPPRESS,  # the process that started this one: the gateway ends with it
    )


def _run(arguments: argparse.Namespace) -> int:
    parent = watched_pid(arguments.parent)
    from gateway.bus.car_service import AlreadyServed, CarService
    from gateway.drivers import check_platform
    from gateway.link import BadUrl, LinkError, parse_url
    from schemas.bus import BadEndpoint, BusError

    try:
        car, fleet = check_name(arguments.car), check_name(arguments.fleet, "fleet name")
        url, platform = parse_url(arguments.link), check_platform(arguments.platform)
    except (BadKey, BadUrl, ValueError) as error:
        return _failed(str(error), 2)
    speed_max = arguments.speed_max
    low_v, critical_v = arguments.battery_low_v, arguments.battery_critical_v
    people = None
    if arguments.people_only or arguments.person:
        from schemas.rights import People  # without people, the rights are loaded when the car is on the bus

        try:
            people = People.parse(arguments.person or ())
        except ValueError as error:
            return _failed(f"--person: {error}", 2)
    try:
        longest_s = parse_duration(arguments.longest_drive, max_s=3600)
    except ValueError as error:
        return _failed(f"--longest-drive: {error}", 2)
    if not 0 < speed_max <= 1:
        return _failed(f"--speed-max {speed_max:g}: it must be more than 0 and at most 1 (full speed)", 2)
    if not 0 < critical_v <= low_v <= 30:
        message = (
            f"--battery-critical-v {critical_v:g}, --battery-low-v {low_v:g}: they must be 0 < critical <= low <= 30 V"
        )
        return _failed(message, 2)
    try:
        with _opened(arguments, car, url, platform, fleet) as opened:
            service = CarService(opened, fleet, car)
            # The car is on the bus now. The imports below take as long as the start up to here, so they come last.
            import asyncio

            from gateway.car_gateway import Settings, begin_logging, serve
            from gateway.control.battery import BatteryPolicy
            from schemas.rights import NO_PEOPLE

            begin_logging()
            settings = Settings(
                car,
                url,
                platform,
                fleet,
                _state_dir(arguments, opened.endpoint),
                arguments.retry,
                battery=BatteryPolicy(
                    BatteryAction(arguments.on_battery_low),
                    BatteryAction(arguments.on_battery_critical),
                    low_v,
                    critical_v,
                ),
                speed_max=speed_max,
                people=people or NO_PEOPLE,
                longest_drive_s=longest_s,
                parent=parent,
                holds_of=arguments.holds_of or "",
            )
            stopped = asyncio.run(serve(settings, opened, service))
    except BadEndpoint as error:
        return _failed(str(error), 2)
    except (AlreadyServed, LinkError, BusError) as error:
        return _failed(str(error), 1)
    except KeyboardInterrupt:  # a second Ctrl-C, after the car was stopped
        return startup.INTERRUPTED
    return 0 if stopped else 1


def _opened(arguments: argparse.Namespace, car: str, url: "LinkUrl", platform: str, fleet: str) -> "Bus":
    """Return the bus. If it cannot be reached, stop the car and raise BusError.

    Without the stop, the car might go on with its last command.
    """
    from schemas.bus import BadEndpoint, Bus, BusError, resolve_endpoint

    try:
        return Bus.open(arguments.connect, start_hub=True, identity=identity.car(car))
    except BadEndpoint:
        raise
    except BusError as error:
        from gateway.stop_without_hub import run_stop_alone

        state_dir = _state_dir(arguments, resolve_endpoint(arguments.connect))
        raise BusError(f"{error} {run_stop_alone(car, url, platform, fleet, state_dir)}") from error


def _state_dir(arguments: argparse.Namespace, endpoint: str) -> "Path":
    from pathlib import Path

    from schemas.state_dir import directory_of

    return directory_of(endpoint, Path(arguments.state_dir) if arguments.state_dir else None)


def _failed(message: str, code: int) -> int:
    sys.stderr.write(f"gateway: {message}\n")
    return code


if __name__ == "__main__":
    main()
