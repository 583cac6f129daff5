"""Finds other coordinators of a fleet, because a fleet may have only one."""

from typing import Final

from fleet.client.client import Fleet
from schemas import keys

SENDER: Final = "coordinator-"
"""Prefix of every coordinator's sender name, so that a second coordinator can name the first."""


class AnotherCoordinator(Exception):
    """The fleet already has a coordinator. The text names it."""


def declare_alone(client: Fleet) -> None:
    """Declare the coordinator's token. Raises AnotherCoordinator if there is one already."""
    token = f"{client.name}/{keys.COORDINATOR}"
    if client.bus.tokens(token):
        raise _another(client, _others(client))
    client.bus.token(token)


def yield_to_another(client: Fleet) -> None:
    """Raise AnotherCoordinator if another coordinator started at the same moment, and its name sorts before ours."""
    if others := [name for name in _others(client) if name < client.sender]:
        raise _another(client, others)


def _others(client: Fleet) -> list[str]:
    operators = client.bus.tokens(f"{client.name}/{keys.OPERATOR}/*")
    names = [token.rpartition("/")[2] for token in operators]
    return sorted(name for name in names if name.startswith(SENDER) and name != client.sender)


def _another(client: Fleet, others: list[str]) -> AnotherCoordinator:
    who = ", ".join(others) or "without a name"
    fleet = keys.describe_fleet(client.name).capitalize()
    return AnotherCoordinator(f"{fleet} already has a coordinator ({who}). Stop that one first.")
