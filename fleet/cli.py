"""The `fleet` command: the table of its subcommands, and what every one of them does with a mistake.

A subcommand is imported when it is called, so that `fleet --help` takes no longer than click does.
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
    "status": ("fleet.commands.lifecycle:status", "The processes of a fleet that is up."),
    "reload": ("fleet.commands.lifecycle:reload", "Have the fleet file of a fleet that is up read again."),
    "logs": ("fleet.commands.lifecycle:logs", "What a car's gateway has said."),
    "list": ("fleet.commands.observe:list_cars", "The cars on the bus, and how each is."),
    "get": ("fleet.commands.observe:get", "The latest value of every matching reading, or its history."),
    "watch": ("fleet.commands.observe:watch", "Readings as they come, until Ctrl-C."),
    "wait": ("fleet.commands.survey:wait", "Wait until a condition holds of a reading."),
    "keys": ("fleet.commands.survey:list_keys", "Every key now alive: type, unit, rate, age."),
    "drive": ("fleet.commands.drive:drive", "Hold a motion for a time, then stop."),
    "mode": ("fleet.commands.drive:mode", "Bring cars into a mode."),
    "stop": ("fleet.commands.drive:stop", "Stop cars (all, if none is named) and hold them against the coordinator."),
    "estop": ("fleet.commands.drive:estop", "Emergency stop of cars, or of the fleet."),
    "resume": ("fleet.commands.drive:resume", "End the hold or the e-stops of cars."),
    "led": ("fleet.commands.actuators:led", "Set the colour LED."),
    "light": ("fleet.commands.actuators:light", "Set the light."),
    "servo": ("fleet.commands.actuators:servo", "Move a servo."),
    "arm": ("fleet.commands.actuators:arm", "Move the arm's six joints."),
    "whistle": ("fleet.commands.actuators:whistle", "Sound once."),
    "speed": ("fleet.commands.actuators:speed", "One step faster or slower."),
    "fan": ("fleet.commands.actuators:fan", "Toggle the fan."),
    "find": ("fleet.commands.actuators:find", "Make cars blink and beep, without moving."),
    "coordinate": ("fleet.commands.coordinate:coordinate", "Keep a plan true: roles, rules, phases; until Ctrl-C."),
    "why": ("fleet.commands.plan:why", "What the coordinator decided last, why, and what would change it."),
    "plan": ("fleet.commands.plan:plan", "`fleet plan check FILE`: what can never work in a plan."),
    "init": ("fleet.commands.fleet_file:init", "Write a fleet file: look for cars, ask for their names."),
    "check": (
        "fleet.commands.fleet_file:check",
        "Check a fleet file and whether its cars' ports exist; opens none.",
    ),
    "bind": ("fleet.commands.bind:bind", "Find out which car is at which link: each blinks, you say which it was."),
    "schema": ("fleet.commands.fleet_file:print_schema", "Print the JSON Schema of fleet files, for editors."),
    "record": ("fleet.commands.record:record", "Record everything of the fleet to MCAP, until Ctrl-C."),
    "mark": ("fleet.commands.record_control:mark", "Write a mark into what is being recorded."),
    "sessions": ("fleet.commands.sessions:sessions", "List, verify, recover, cut and export recordings."),
    "replay": ("fleet.commands.replay:replay", "Open a recorded session in Rerun, or play it on the bus again."),
    "view": ("fleet.commands.view:view", "See the fleet live in Rerun."),
    "replan": ("fleet.commands.replan:replan", "A plan on a recorded session: where it decides otherwise."),
    "redecode": (
        "fleet.commands.redecode:redecode",
        "Recorded raw frames through today's decoder: what is otherwise.",
    ),
    "demo": ("fleet.demo:demo", "Three simulated cars do a job, recorded and checked."),
}
"""Subcommand: where it lives, and its line in `fleet --help`."""


_PACKAGES: Final = {"rerun": "rerun-sdk", "rerun_cli": "rerun-sdk", "yaml": "pyyaml", "zenoh": "eclipse-zenoh"}
"""Packages by the modules they bring, where the names differ."""


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
        several = "\n" in error.message  # the faults of a file, one a line
        sys.stderr.write(f"{error.message}\n" if several else f"fleet: {_one_line(error)}\n")
        code = error.exit_code
    except (click.Abort, KeyboardInterrupt):
        code = startup.INTERRUPTED
    except ModuleNotFoundError as error:
        sys.stderr.write(f"fleet: {_missing(error)}\n")
        code = 1
    except OSError as error:  # what the commands raise of their own, they explain: this is the output's
        code = _no_output(error)
    try:
        sys.stdout.flush()
    except OSError as error:
        code = _no_output(error)
    sys.exit(code)


def _missing(error: ModuleNotFoundError) -> str:
    """Return what is not installed, and what to type; raises the error again if it is a module of ours."""
    module = (error.name or "").partition(".")[0]
    if module in ("", "fleet", "gateway", "schemas"):
        raise error
    from importlib import metadata

    package = _PACKAGES.get(module, module)
    try:
        wanted = [each.partition(";")[0].strip() for each in metadata.requires("zenoh-car-fleet") or ()]
    except metadata.PackageNotFoundError:  # a clone that was never installed
        wanted = []
    exact = next((each for each in wanted if re.match(rf"{re.escape(package)}(?![\w.-])", each)), package)
    return f"{package} is not installed, and this command needs it: pip install '{exact}'"


def _no_output(error: OSError) -> int:
    """Say that the output cannot be written; whoever closed a pipe has seen enough, and is told nothing."""
    os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
    if not isinstance(error, BrokenPipeError):
        sys.stderr.write(f"fleet: the output cannot be written: {error.strerror}\n")
    return 1


def _one_line(error: click.ClickException) -> str:
    if isinstance(error, click.BadParameter) and isinstance(error.param, click.Argument) and not error.param.metavar:
        # What click would call it is the list of its choices, which the message has anyway.
        error.param_hint = f"'{(error.param.name or '').upper()}'"
    return " ".join(error.format_message().split())


if __name__ == "__main__":
    main()
