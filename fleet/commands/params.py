"""What is asked for: key expressions and spans of time as they are typed, checked before anyone is asked."""

import re
from collections.abc import Sequence
from typing import Any, Final

import click

from fleet.client.client import Fleet
from fleet.client.condition import topics_under
from schemas import keys
from schemas.bus import canon

_UNITS: Final = {"ms": 0.001, "": 1.0, "s": 1.0, "m": 60.0, "h": 3600.0}


class DurationType(click.ParamType[float]):
    """A time: `30s`, `500ms`, `5m`, `1h`, or a number of seconds; more than 0."""

    name = "TIME"

    def __init__(self, longest_s: float) -> None:
        self._longest_s = longest_s

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> float:
        """Seconds; fails outside the range."""
        match = re.fullmatch(r"([0-9]+(?:\.[0-9]+)?|\.[0-9]+)(ms|s|m|h|)", str(value))
        seconds = float(match[1]) * _UNITS[match[2]] if match else 0.0
        if not 0 < seconds <= self._longest_s:
            self.fail(
                f"{value!r} is not allowed: more than 0 and at most {self._longest_s:g} s, as 30s, 500ms or 5m",
                param,
                ctx,
            )
        return seconds


def written_out(keyexpr: str, fleet: str) -> str:
    """The key expression in full; raises keys.BadKey."""
    return canon(keys.expand(keyexpr, keys.check_name(fleet, "fleet name")))


def what_there_is(client: Fleet, written: str) -> str:
    """The readings of the car that was meant, or else the cars."""
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
    """Whoever waits for a car that is not there waits for it; a misspelt name should not go unnoticed."""
    key = keys.parse(written)
    if key is not None and not set(key.car) & set("*$@") and key.car not in cars:
        there = f"there are: {', '.join(cars)}" if cars else "there is none"
        click.echo(f"fleet: no car {key.car} on the bus yet ({there}); waiting", err=True)
