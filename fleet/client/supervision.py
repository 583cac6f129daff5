"""Queries the supervisor of a fleet for its status."""

from collections.abc import Sequence
from contextlib import suppress
from itertools import islice
from typing import Any, Final

from schemas import keys, topics
from schemas.bus import Bus, messages_of
from schemas.colors import Rgb, parse_color
from schemas.topics import Qos
from schemas.words import ProcessKind, RunState

SUPERVISOR_STATUS: Final = topics.TOPICS[f"{keys.SUPERVISOR}/status"]
MAX_GROUPS: Final = 64
"""Maximum number of groups that are used from a status. There is a limit because anybody may publish a status."""
BRIEF_TIMEOUT_S: Final = 0.5
"""Timeout for what is nice to know, such as the colors of the cars: a supervisor that hangs must not delay a table."""


def ask_status(bus: Bus, fleet: str, timeout_s: float = 2.0) -> list[Any]:
    """Return the fleet.v1.Supervision of every supervisor that answers."""
    answers = bus.query(f"{fleet}/{SUPERVISOR_STATUS.name}", timeout_s=timeout_s, qos=Qos.STATE)
    return list(messages_of(answers))


def ask_status_briefly(bus: Bus, fleet: str) -> list[Any]:
    """Return the statuses as `ask_status` does, but do without them if no supervisor answers soon."""
    return ask_status(bus, fleet, BRIEF_TIMEOUT_S)


def fleets_on(bus: Bus) -> dict[str, set[str]]:
    """Return the fleets that run on the bus, with their cars that have a gateway."""
    found: dict[str, set[str]] = {}
    for token in bus.tokens("*/*"):
        name, _, car = token.partition("/")
        found.setdefault(name, set()).add(car)
    for token in bus.tokens(f"*/{keys.SUPERVISOR}"):
        found.setdefault(token.partition("/")[0], set())
    return found


def ask_colors(bus: Bus, fleet: str) -> dict[str, Rgb]:
    """Return the colors of the cars of a running fleet. Empty if no supervisor answers."""
    return {car: color for status in ask_status_briefly(bus, fleet) for car, color in colors_of(status).items()}


def gateways_of(status: Any) -> dict[str, Any]:
    """Return the fleet.v1.Supervised of each gateway in a fleet.v1.Supervision, by car. Some may have ended."""
    return {each.name: each for each in status.processes if each.kind == ProcessKind.GATEWAY}


def services_of(status: Any) -> dict[str, str]:
    """Return the services in a fleet.v1.Supervision that have not ended, each with why it is not ready, or ""."""
    return {
        each.name: status.missing.get(each.name, "")
        for each in status.processes
        if each.kind != ProcessKind.GATEWAY and each.state != RunState.ENDED
    }


def describe_silent_coordinator(bus: Bus, fleet: str) -> str:
    """Return a text about a coordinator that exists and does not answer, as one that hangs. Empty if there is none.

    Its token on the bus ends after some 2 s of silence. But its process may go on commanding cars at any moment.
    """
    for status in ask_status(bus, fleet):
        for each in status.processes:
            if each.kind == ProcessKind.COORDINATOR and each.state != RunState.ENDED:
                why = f" ({each.words})" if each.words and each.state != RunState.RUNNING else ""
                words = f"The coordinator does not answer: its process is {each.state}{why}"
                return f"{words}. See `fleet logs coordinator`"
    if bus.tokens(keys.car_token(fleet, keys.COORDINATOR)):
        return "The coordinator is on the bus and does not answer"
    return ""


def colors_of(status: Any) -> dict[str, Rgb]:
    """Return the colors of the cars in a fleet.v1.Supervision. Skip values that are not colors."""
    colors: dict[str, Rgb] = {}
    for car, color in status.colors.items():
        with suppress(ValueError):  # anybody may answer
            colors[car] = parse_color(color)
    return colors


def groups_of(status: Any) -> dict[str, Sequence[str]]:
    """Return the cars of each group in a fleet.v1.Supervision, by name. Skip invalid names."""
    named = sorted(name for name in status.groups if keys.is_name(name))
    return {name: [*filter(keys.is_name, status.groups[name].split(","))] for name in islice(named, MAX_GROUPS)}
