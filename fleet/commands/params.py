"""Arguments that several subcommands take: durations and key expressions."""

import re
from collections.abc import Sequence
from typing import Any, Final

import click

from fleet.client.client import Fleet
from fleet.client.condition import topics_under
from schemas import keys
from schemas.bus import canon

_DURATION_UNITS: Final = {"ms": 0.001, "": 1.0, "s": 1.0, "m": 60.0, "h": 3600.0}


class DurationType(click.ParamType[float]):
    """A duration: `30s`, `500ms`, `5m`, `1h`, or a number of seconds."""

    name = "TIME"

    def __init__(self, max_s: float) -> None:
        self._max_s = max_s

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> float:
        """Return the duration in seconds. Fail outside the range."""
        match = re.fullmatch(r"([0-9]+(?:\.[0-9]+)?|\.[0-9]+)(ms|s|m|h|)", str(value))
        seconds = float(match[1]) * _DURATION_UNITS[match[2]] if match else 0.0
        if not 0 < seconds <= self._max_s:
            self.fail(
                f"{value!r} is not allowed: more than 0 and at most {self._max_s:g} s, as 2s, 500ms or 5m", param, ctx
            )
        return seconds


def written_out(keyexpr: str, fleet: str) -> str:
    """Expand a key expression. Raises keys.BadKey."""
    return canon(keys.expand(keyexpr, keys.check_name(fleet, "fleet name")))


def describe_available(client: Fleet, written: str) -> str:
    """Describe the readings of the named car, or else the cars on the bus."""
    under = topics_under(written)
    if under and all(topic.family == "sim" for topic in under):
        return f"what is true of a simulated car is only published: fleet watch {written.partition('/')[2]}"
    cars = client.cars()
    key = keys.parse(written)
    if key is not None and key.car in cars:
        begin = len(f"{client.name}/{key.car}/")
        found = [reading.key[begin:] for reading in client.get(f"{client.name}/{key.car}/*/*")]
        return f"{key.car} has {', '.join(found)}" if found else f"{key.car} says nothing"
    return f"the cars on the bus are: {', '.join(cars)}" if cars else "there is no car on the bus"


def warn_if_missing(written: str, cars: Sequence[str]) -> None:
    """Warn if the named car is not on the bus: the name may be misspelled."""
    key = keys.parse(written)
    if key is not None and not set(key.car) & set("*$@") and key.car not in cars:
        there = f"there are: {', '.join(cars)}" if cars else "there is none"
        click.echo(f"fleet: no car {key.car} on the bus yet ({there}); waiting", err=True)
