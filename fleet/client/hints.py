"""Completes the commands that messages propose: adds the options with which the user selects a fleet. Pure.

Messages propose commands in backticks, such as `fleet stop red`. The messages come from gateways, services and this
computer. Only the command that prints a message knows with which options its user reaches the fleet.
"""

import re
from typing import Final

from schemas.keys import DEFAULT_FLEET

WITHOUT_FLEET: Final = frozenset(
    (
        "bind",
        "check",
        "demo",
        "example",
        "find",
        "hub",
        "init",
        "join",
        "leave",
        "plan try",
        "play",
        "query",
        "replay",
        "scan",
        "schema",
        "sessions",
        "sim",
    )
)
"""Commands that do not accept --fleet."""
_PROPOSED: Final = re.compile(r"`(fleet [a-z][^`]*)`")


def fleet_options(connect: str | None, fleet: str, *, is_one_of_several: bool = False) -> str:
    """Return the options that select a fleet.

    `connect` is its bus, or None for the bus that commands use without an option. With `is_one_of_several`, the options
    name the fleet even if it is the default.
    """
    bus = f"--connect {connect}" if connect else ""
    name = f"--fleet {fleet}" if is_one_of_several or fleet != DEFAULT_FLEET else ""
    return " ".join(filter(None, (bus, name)))


def complete_hints(words: str, options: str) -> str:
    """Add options such as `--fleet two` to each command in backticks that needs them. `options` may be empty."""
    if not options or "`fleet " not in words:
        return words
    return _PROPOSED.sub(lambda found: f"`{complete_command(found[1], options)}`", words)


def complete_command(command: str, options: str) -> str:
    """Add the options to a command such as `fleet stop red`.

    A command that does not accept --fleet, or already has one of the options, is returned unchanged.
    """
    _, verb, *arguments = command.split()
    names_no_fleet = verb in WITHOUT_FLEET or f"{verb} {arguments[0] if arguments else ''}" in WITHOUT_FLEET
    has_one = any(word.startswith("--") and word in arguments for word in options.split())
    return command if names_no_fleet or has_one or not options else f"{command} {options}"
