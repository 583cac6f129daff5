"""Queries the supervisor of a fleet for its status."""

from typing import Any, Final

from schemas import keys, topics
from schemas.bus import Bus, messages_of
from schemas.topics import Qos

SUPERVISOR_STATUS: Final = topics.TOPICS[f"{keys.SUPERVISOR}/status"]


def ask_status(bus: Bus, fleet: str, timeout_s: float = 2.0) -> list[Any]:
    """Return the fleet.v1.Supervision of every supervisor that answers."""
    answers = bus.query(f"{fleet}/{SUPERVISOR_STATUS.name}", timeout_s=timeout_s, qos=Qos.STATE)
    return list(messages_of(answers))
