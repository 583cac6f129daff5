"""The `fleet` command: the table of its subcommands, and their common error handling.

Subcommands are imported when they are called, so that `fleet --help` is fast.
"""

import importlib
import os
import re
import sys
from typing import Final

import click

from schemas.process import startup, stdio

COMMANDS: Final = {
    "up": ("fleet.commands.up:up", "Start a fleet from its file, or simulated cars, and keep it running."),
    "down": ("fleet.commands.lifecycle:down", "End a fleet that is up: every car is stopped first."),
    "status": ("fleet.commands.lifecycle:status", "Show the processes of a fleet that is up."),
    "reload": ("fleet.commands.lifecycle:reload", "Read the fleet file of a fleet that is up again."),
    "logs": ("fleet.commands.lifecycle:logs", "Show the log of a car's gateway."),
    "list": ("fleet.commands.observe:list_cars", "List the cars on the bus with their states."),
    "get": ("fleet.commands.observe:get", "Print the latest value of every matching reading, or its history."),
    "watch": ("fleet.commands.observe:watch", "Print readings as they come, until Ctrl-C."),
    "wait": ("fleet.commands.observe:wait", "Wait until a condition holds of a reading."),
    "keys": ("fleet.commands.observe:list_keys", "List every key in use with type, unit, rate and age."),
    "drive": ("fleet.commands.drive:drive", "Hold a motion for a time, then stop."),
    "mode": ("fleet.commands.drive:mode", "Bring cars into a mode."),
    "stop": ("fleet.commands.drive:stop", "Stop cars (all, if none is named) and hold them against the coordinator."),
    "estop": ("fleet.commands.drive:estop", "Emergency stop of cars, or of the fleet."),
    "resume": ("fleet.commands.drive:resume", "End the hold or the e-stops of cars."),
    "led": ("fleet.commands.actuators:led", "Set the color LED."),
    "light": ("fleet.commands.actuators:light", "Set the light."),
    "servo": ("fleet.commands.actuators:servo", "Move a servo."),
    "arm": ("fleet.commands.actuators:arm", "Move the arm's six joints."),
    "whistle": ("fleet.commands.actuators:whistle", "Sound once."),
    "speed": ("fleet.commands.actuators:speed", "Change the speed by one step."),
    "fan": ("fleet.commands.actuators:fan", "Toggle the fan."),
    "find": ("fleet.commands.actuators:find", "Make cars blink and beep, without moving."),
    "coordinate": ("fleet.commands.coordinate:coordinate", "Keep a plan true: roles, rules, phases; until Ctrl-C."),
    "why": ("fleet.commands.plan:why", "Explain the coordinator's last decisions and what would change them."),
    "plan": ("fleet.commands.plan:plan", "Check a plan for parts that can never work, or restart the plan in force."),
    "init": ("fleet.commands.fleet_file:init", "Write a fleet file: look for cars, ask for their names."),
    "check": (
        "fleet.commands.fleet_file:check",
        "Check a fleet file and whether its cars' ports exist; opens none.",
    ),
    "bind": ("fleet.commands.bind:bind", "Find out which car is at which link: each blinks, you say which it was."),
    "schema": ("fleet.commands.fleet_file:print_schema", "Print the JSON Schema of fleet files, for editors."),
    "record": ("fleet.commands.record:record", "Record everything of the fleet to MCAP, until Ctrl-C."),
    "mark": ("fleet.commands.record:mark", "Write a mark into the running recording."),
    "sessions": ("fleet.commands.sessions:sessions", "List, verify, recover, cut and export recordings."),
    "replay": ("fleet.commands.replay:replay", "Open a recorded session in Rerun, or play it on the bus again."),
    "view": ("fleet.commands.view:view", "Show the fleet live in Rerun."),
    "replan": ("fleet.commands.replan:replan", "Replay a session through a plan and list decisions that differ."),
    "redecode": ("fleet.commands.redecode:redecode", "Decode a session's raw frames again and list differences."),
    "demo": ("fleet.demo:demo", "Run a job with three simulated cars, record and check it."),
}
"""Subcommands: function and line in `fleet --help`."""


_PACKAGES: Final = {"rerun": "rerun-sdk", "rerun_cli": "rerun-sdk", "yaml": "pyyaml", "zenoh": "eclipse-zenoh"}
"""Packages by module, where the names differ."""


class _Lazy(click.Group):
    """A group whose commands are imported when they are called."""

    def list_commands(self, ctx: click.Context) -> list[str]:  # noqa: ARG002 - click's signature
        return list(COMMANDS)

    def get_command(self, ctx: click.Context, cmd_name: str) -> click.Command | None:  # noqa: ARG002 - click's signature
        if cmd_name not in COMMANDS:
            return None
        module, _, name = COMMANDS[cmd_name][0].partition(":")
        command: click.Command = getattr(importlib.import_module(module), name)
        startup.interruptible()
        return command

    def format_commands(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:  # noqa: ARG002 - click's signature
        with formatter.section("Commands"):
            formatter.write_dl([(name, words) for name, (_, words) in COMMANDS.items()])


@click.group(
    cls=_Lazy,
    epilog="""\b
examples:
  fleet list
  fleet get red/sensor/range
  fleet drive red,blue forward --for 2s
  fleet stop

Exit codes: 0 carried out, 1 not carried out, 2 wrong use, 130 Ctrl-C.""",
)
def cli() -> None:
    """Drive, watch, record and replay a fleet of small robot cars."""


def main() -> None:
    """Entry point."""
    stdio.complete()
    try:
        code = cli.main(prog_name="fleet", standalone_mode=False)
    except click.exceptions.NoArgsIsHelpError as error:
        error.show()
        code = 2
    except click.UsageError as error:
        where = error.ctx.command_path if error.ctx is not None else "fleet"
        sys.stderr.write(f"fleet: {_one_line(error)} (see {where} --help)\n")
        code = error.exit_code
    except click.ClickException as error:
        several = "\n" in error.message  # the errors of a file, one per line
        sys.stderr.write(f"{error.message}\n" if several else f"fleet: {_one_line(error)}\n")
        code = error.exit_code
    except (click.Abort, KeyboardInterrupt):
        code = startup.INTERRUPTED
    except ModuleNotFoundError as error:
        sys.stderr.write(f"fleet: {_missing(error)}\n")
        code = 1
    except OSError as error:  # commands handle their own errors, so this one comes from the output
        code = _no_output(error)
    try:
        sys.stdout.flush()
    except OSError as error:
        code = _no_output(error)
    sys.exit(code)


def _missing(error: ModuleNotFoundError) -> str:
    """Return words about the missing package and how to install it. Raises the error again for a module of ours."""
    module = (error.name or "").partition(".")[0]
    if module in ("", "fleet", "gateway", "schemas"):
        raise error
    from importlib import metadata

    package = _PACKAGES.get(module, module)
    try:
        requirements = [each.partition(";")[0].strip() for each in metadata.requires("zenoh-car-fleet") or ()]
    except metadata.PackageNotFoundError:  # a clone that was never installed
        requirements = []
    exact = next((each for each in requirements if re.match(rf"{re.escape(package)}(?![\w.-])", each)), package)
    return f"{package} is not installed, and this command needs it: pip install '{exact}'"


def _no_output(error: OSError) -> int:
    """Print that the output cannot be written, unless the reader has closed the pipe. Return the exit code."""
    os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
    if not isinstance(error, BrokenPipeError):
        sys.stderr.write(f"fleet: the output cannot be written: {error.strerror}\n")
    return 1


def _one_line(error: click.ClickException) -> str:
    if isinstance(error, click.BadParameter) and isinstance(error.param, click.Argument) and not error.param.metavar:
        # Click would name the argument by its choices, which the message contains anyway.
        error.param_hint = f"'{(error.param.name or '').upper()}'"
    return " ".join(error.format_message().split())


if __name__ == "__main__":
    main()
