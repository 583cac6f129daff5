"""The `fleet` command: the table of its subcommands, and their common error handling.

Subcommands are imported when they are called, so that `fleet --help` is fast.
"""

import importlib
import os
import sys
from typing import Final

import click
from click.shell_completion import BashComplete, FishComplete, add_completion_class

from fleet.commands.command_group import CommandGroup, as_option, connect_option, fleet_option
from fleet.usage_errors import command_path, describe_error, describe_missing_package
from schemas import commands
from schemas.printable import printable_lines
from schemas.process import startup, stdio


def _plain_commands(section: str) -> dict[str, tuple[str, str]]:
    """Return those subcommands of one heading that have a row in `schemas.commands`."""
    rows = [row for row in commands.COMMANDS.values() if row.section == section]
    return {row.subcommand: (f"fleet.commands.actuators:{row.subcommand}", row.summary) for row in rows}


COMMANDS: Final = {
    "Start here": {
        "demo": ("fleet.demo:demo", "Let three simulated cars do a job. No hardware is needed."),
        "scan": ("fleet.commands.gateway_tools:scan", "Look for cars on Bluetooth and serial ports."),
        "init": ("fleet.commands.fleet_file:init", "Create fleet.yaml: find the cars and name them."),
        "example": (
            "fleet.commands.example:example",
            "Show and copy fleet files, plans, worlds and programs to start from.",
        ),
        "check": ("fleet.commands.check:check", "Check fleet files, plans and worlds for mistakes."),
        "schema": ("fleet.commands.fleet_file:print_schema", "Print the JSON Schema of fleet files, plans or worlds."),
        "bind": (
            "fleet.commands.bind:bind",
            "Find out which car is which: each car blinks, you type its name.",
        ),
    },
    "Run a fleet": {
        "up": ("fleet.commands.up:up", "Connect all cars, record, run the plan. Ctrl-C stops every car."),
        "down": ("fleet.commands.lifecycle:down", "Stop every car and end `fleet up`."),
        "list": (
            "fleet.commands.observe:list_cars",
            "List the cars: link, mode, motion, who is in control, battery.",
        ),
        "console": ("fleet.commands.console:console", "Serve the fleet as a web page: watch, drive, STOP."),
        "status": ("fleet.commands.lifecycle:status", "Show the fleet, its session and cars, and what is not ready."),
        "doctor": ("fleet.commands.doctor:doctor", "Tell why a car or a session is odd, and what to type."),
        "reload": ("fleet.commands.lifecycle:reload", "Apply changes in fleet.yaml without a restart."),
        "logs": ("fleet.commands.lifecycle:logs", "Show what a car's gateway or a service has logged."),
        "exporter": (
            "fleet.commands.exporter:exporter",
            "Serve the fleet as metrics for Prometheus.",
        ),
        "foxglove": ("fleet.commands.foxglove_live:foxglove", "Show the fleet live in Foxglove."),
        "mqtt": ("fleet.commands.mqtt:mqtt", "Show the cars in Home Assistant, by MQTT."),
        "sim": (
            "fleet.commands.gateway_tools:sim",
            "Run simulated cars alone, with faults, to test your own programs.",
        ),
    },
    "Several computers": {
        "hub": ("fleet.commands.hub:hub", "Let other computers join, with certificates: invite, show, revoke."),
        "join": ("fleet.commands.hub:join_hub", "Join the hub on another computer, with its code."),
        "leave": ("fleet.commands.hub:leave", "Leave the hub that this computer has joined."),
    },
    "Drive": {
        "drive": (
            "fleet.commands.drive:drive",
            "Move for a time, then stop: fleet drive red forward --for 2s",
        ),
        "mode": (
            "fleet.commands.drive:mode",
            "Make cars act by themselves: tracking, obstacle_avoidance, ...",
        ),
        "stop": (
            "fleet.commands.drive:stop",
            "Stop now (no name: all cars). The plan leaves them alone until `resume`.",
        ),
        "estop": (
            "fleet.commands.drive:estop",
            "Emergency stop: cars refuse everything but stops until `resume --estops`.",
        ),
        "resume": ("fleet.commands.drive:resume", "Let the plan use stopped cars again."),
        "pause": ("fleet.commands.people:pause", "Stop all cars. Only a lead moves a car until `unpause`."),
        "unpause": ("fleet.commands.people:unpause", "End the pause. This does not move a car."),
        "lend": ("fleet.commands.people:lend", "Lend cars to a person for a time."),
        **_plain_commands("Drive"),
    },
    "Lights and parts": {
        "light": ("fleet.commands.actuators:light", "Light up in a color: fleet light red cyan"),
        "led": ("fleet.commands.actuators:led", "Set the color LED: fleet led red '#ff8000'"),
        **_plain_commands("Lights and parts"),
        "servo": ("fleet.commands.actuators:servo", "Move a servo."),
        "arm": ("fleet.commands.actuators:arm", "Move the six joints of the arm."),
        "fan": ("fleet.commands.actuators:fan", "Switch the fan."),
        "speed": ("fleet.commands.actuators:speed", "Go faster or slower by one step."),
    },
    "Sensors": {
        "get": ("fleet.commands.observe:get", "Print the latest value, or history (--last, --since, --csv)."),
        "watch": ("fleet.commands.observe:watch", "Print new values as they come (--when CONDITION)."),
        "wait": ("fleet.commands.observe:wait", "Wait until a condition is true."),
        "keys": (
            "fleet.commands.observe:list_keys",
            "List what cars, plan and recorder publish now, with rate and age.",
        ),
    },
    "Plans": {
        "plan": ("fleet.commands.plan:plan", "run | set | show | try | ...: what the cars do together."),
        "why": (
            "fleet.commands.plan:why",
            "Explain why a car does what it does, and what would change that.",
        ),
    },
    "Sessions": {
        "record": (
            "fleet.commands.record:record",
            "Record without `fleet up`, or start and stop a session.",
        ),
        "mark": ("fleet.commands.record:mark", "Add a note to the session, now."),
        "view": ("fleet.commands.view:view", "Show the fleet live in Rerun."),
        "replay": ("fleet.commands.replay:replay", "Show a session in Rerun."),
        "play": ("fleet.commands.play:play", "Publish a session again, for your own programs."),
        "sessions": ("fleet.commands.sessions:sessions", "List, verify, repair, cut and export."),
        "find": ("fleet.commands.find:find", "Find when a condition held, in all sessions."),
        "query": ("fleet.commands.query:query", "Ask the tables of all sessions with SQL."),
    },
}
"""Subcommands by heading, each with its function and its line in `fleet --help`."""

_FUNCTIONS: Final = {name: where for section in COMMANDS.values() for name, (where, _) in section.items()}

_EXTRAS: Final = {
    **dict.fromkeys(("rerun", "rerun_cli", "numpy", "PIL"), "view"),
    **dict.fromkeys(("duckdb", "pyarrow", "pandas", "matplotlib", "rosbags"), "analysis"),
    **dict.fromkeys(("starlette", "uvicorn"), "console"),
    **dict.fromkeys(("cryptography", "ifaddr", "segno", "zeroconf"), "secure"),
    "bleak": "ble",
    "prometheus_client": "metrics",
    "foxglove": "foxglove",
    **dict.fromkeys(("aiomqtt", "paho"), "mqtt"),
}
"""The extra that installs a module."""


@add_completion_class
class _BashCompletion(BashComplete):
    """Completion for bash.

    The second line of the template makes `@` a part of words, so that bash can complete the name of a group.
    """

    source_template = f"{BashComplete.source_template}\nCOMP_WORDBREAKS=${{COMP_WORDBREAKS//@/}}\n"


@add_completion_class
class _FishCompletion(FishComplete):
    """Completion for fish.

    A line of completions has a type, a comma and the word. Split it only at this comma, because the word may be a list
    such as `red,blue`.
    """

    source_template = FishComplete.source_template.replace('string split ","', 'string split -m 1 ","')


class _LazyGroup(CommandGroup):
    """A group whose commands are imported when they are called, with a heading for each section of the table."""

    def list_commands(self, ctx: click.Context) -> list[str]:  # noqa: ARG002 - click's signature
        return list(_FUNCTIONS)

    def get_command(self, ctx: click.Context, cmd_name: str) -> click.Command | None:  # noqa: ARG002 - click's signature
        if cmd_name not in _FUNCTIONS:
            return None
        module, _, name = _FUNCTIONS[cmd_name].partition(":")
        command: click.Command = getattr(importlib.import_module(module), name)
        startup.interruptible()
        return command

    def format_options(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        """Write the commands before the options, because most users look for a command."""
        self.format_commands(ctx, formatter)
        click.Command.format_options(self, ctx, formatter)

    def format_commands(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:  # noqa: ARG002 - click's signature
        width = max(map(len, _FUNCTIONS))
        for section, subcommands in COMMANDS.items():
            with formatter.section(section):
                formatter.write_dl([(name.ljust(width), words) for name, (_, words) in subcommands.items()])


@click.group(
    cls=_LazyGroup,
    context_settings={"help_option_names": ["-h", "--help"]},
    epilog="""`fleet COMMAND --help` shows examples.

Exit codes: 0 carried out, 1 not carried out, 2 wrong use, 130 Ctrl-C (0 for services such as `up`).""",
)
@click.version_option(
    package_name="zenoh-car-fleet", prog_name="fleet", message="%(prog)s %(version)s", help="Show the version."
)
@connect_option("The bus of the fleet. Also accepted after the command.")
@fleet_option()
@as_option()
def cli(connect: str | None, fleet: str) -> None:
    """Drive, watch and record small robot cars."""


def main() -> None:
    """Entry point."""
    stdio.complete()
    if os.environ.get("FLEET_LOG"):
        from schemas.process import json_log

        json_log.begin(" ".join(["fleet", *[word for word in sys.argv[1:] if word in _FUNCTIONS][:1]]))
    try:
        code = cli.main(prog_name="fleet", standalone_mode=False)
    except click.exceptions.NoArgsIsHelpError as error:
        error.show()
        code = 2
    except click.UsageError as error:
        words = printable_lines(describe_error(error, cli))
        sys.stderr.write(f"fleet: {words} (see {command_path(error, cli)} --help)\n")
        code = error.exit_code
    except click.ClickException as error:
        own_form = getattr(error, "own_form", False) or "\n" in error.message
        words = error.message if own_form else f"fleet: {printable_lines(describe_error(error, cli))}"
        sys.stderr.write(f"{words}\n")
        code = error.exit_code
    except (click.Abort, KeyboardInterrupt):
        code = startup.INTERRUPTED
    except ModuleNotFoundError as error:
        sys.stderr.write(f"fleet: {describe_missing_package(error, _EXTRAS)}\n")
        code = 1
    except RuntimeError as error:
        # Python's locks raise this error ("release unlocked lock") if Ctrl-C comes while a wait ends.
        if not isinstance(error.__context__, KeyboardInterrupt):
            raise
        code = startup.INTERRUPTED
    except OSError as error:  # commands handle their own errors, so this one comes from the output
        code = stdio.silence_broken(error, "fleet")
    try:
        sys.stdout.flush()
    except OSError as error:
        code = stdio.silence_broken(error, "fleet")
    sys.exit(code)


if __name__ == "__main__":
    main()
