"""`fleet wait --ready`: waits until the cars of the fleet are ready, and names those that are not."""

import json
import time
from collections.abc import Sequence
from typing import Final

import click

from fleet.client.car_state import CarState
from fleet.client.reading import age_of_answer_s
from fleet.client.supervision import ask_status
from fleet.commands.exit_code import not_running
from fleet.supervisor.start_report import describe_start
from schemas import keys
from schemas.bus import Bus, BusError, messages_of
from schemas.messages import stamp_ns
from schemas.suggestion import nearest
from schemas.topics import Qos
from schemas.words import RunState

READY_WAIT_S: Final = 30.0
"""Default timeout of `fleet wait --ready`."""
_WAIT_POLL_S: Final = 0.2
_STATES: Final = ("state/link", "state/safety")


def wait_ready(connect: str | None, fleet: str, cars: Sequence[str], timeout_s: float, *, as_json: bool) -> None:
    """Wait until the cars are ready. If `cars` is empty: all cars and services. Exit with code 1 after the timeout."""
    deadline = time.monotonic() + timeout_s
    bus: Bus | None = None
    try:
        while True:
            found: tuple[list[str], dict[str, str]] | None = None
            try:
                bus = bus or Bus.open(connect)
                found = _find_missing(bus, fleet)
            except BusError:
                if time.monotonic() >= deadline:
                    raise
            known, missing = found or ([], {})
            wanted = list(cars or known)
            missing |= {car: _describe_unknown(car, known) for car in cars if car not in known}
            if cars:
                missing = {car: missing[car] for car in cars if car in missing}
            if wanted and not missing:
                break
            if time.monotonic() >= deadline:
                break
            time.sleep(_WAIT_POLL_S)
    finally:
        if bus is not None:
            bus.close()
    ok = bool(wanted) and not missing
    if as_json:
        click.echo(json.dumps({"ready": ok, "cars": wanted, "missing": missing}))
    elif not wanted:
        raise not_running(fleet, connect)
    else:
        click.echo(describe_start(wanted, missing, ""), err=not ok)
    raise SystemExit(0 if ok else 1)


def _find_missing(bus: Bus, fleet: str) -> tuple[list[str], dict[str, str]]:
    """Return the names of the cars, and by name the reason for each car and service that is not ready."""
    for status in ask_status(bus, fleet):
        cars = [process.name for process in status.processes if not process.name.startswith("@")]
        missing = dict(status.missing)
        cars += [name for name in missing if name not in cars and not name.startswith("@")]
        if status.state != RunState.RUNNING:
            return cars, dict.fromkeys(cars, f"the fleet is {status.state}")
        return cars, missing
    states = {car: CarState(car) for car in (key.rpartition("/")[2] for key in bus.tokens(keys.car_token(fleet, "*")))}
    now = time.time()
    for topic in _STATES:
        for message in messages_of(bus.query(f"{fleet}/*/{topic}", qos=Qos.STATE)):
            if message.car in states:
                states[message.car].take(topic, message, now - age_of_answer_s(stamp_ns(message.stamp) / 1e9, now))
    return sorted(states), {car: why for car, state in sorted(states.items()) if (why := state.why_missing(now))}


def _describe_unknown(car: str, known: Sequence[str]) -> str:
    near = nearest(car, known)
    return f"no such car{f', did you mean {near}?' if near else ''}"
