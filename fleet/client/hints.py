"""Puts the options that select a fleet into the commands that messages propose. Pure.

Messages propose commands in backticks: `fleet stop red`. They come from gateways, services and this computer. Only the
command that prints them knows how its user reaches the fleet.
"""

import re
from typing import Final

from schemas.keys import DEFAULT_FLEET

WITHOUT_BUS: Final = frozenset(
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
"""Commands that take no --fleet."""
_PROPOSED: Final = re.compile(r"`(fleet [a-z][^`]*)`")


def fleet_options(connect: str | None, fleet: str, *, is_one_of_several: bool = False) -> str:
    """Return the options that select a fleet. connect: its bus; None: the one that is taken without an option.

    is_one_of_several: True to name the fleet also if it is the default.
    """
    bus = f"--connect {connect}" if connect else ""
    name = f"--fleet {fleet}" if is_one_of_several or fleet != DEFAULT_FLEET else ""
    return " ".join(filter(None, (bus, name)))


def complete_hints(words: str, options: str) -> str:
    """Add the options to each command in backticks that needs them. options: such as `--fleet two`; may be empty."""
    if not options or "`fleet " not in words:
        return words
    return _PROPOSED.sub(lambda found: f"`{complete_command(found[1], options)}`", words)


def complete_command(command: str, options: str) -> str:
    """Add the options to one command such as `fleet stop red`, unless it takes none or has one of them already."""
    _, verb, *more = command.split()
    is_without = verb in WITHOUT_BUS or f"{verb} {more[0] if more else ''}" in WITHOUT_BUS
    has_one = any(word.startswith("--") and word in more for word in options.split())
    return command if is_without or has_one or not options else f"{command} {options}"
