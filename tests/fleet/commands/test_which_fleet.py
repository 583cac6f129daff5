"""A stop in several fleets on one bus."""

from collections.abc import Iterator, Sequence

import click
import pytest
import zenoh

from fleet.cli import cli
from fleet.client.client import Fleet
from fleet.client.outcome import NO_ANSWER, Outcome
from fleet.commands.which_fleet import stop_in_all_fleets
from schemas import keys
from schemas.bus import reply_message, router_config
from schemas.gen import fleet_v1_pb2 as pb
from schemas.words import Phase
from tests.support.ports import free_endpoint


@pytest.fixture
def client() -> Iterator[Fleet]:
    """Return a client of the fleet `one`, which has red and blue, and white, whose gateway hangs.

    `two` has red and green.
    """
    endpoint = free_endpoint()
    with zenoh.open(router_config(endpoint)), Fleet(endpoint, "one", kind="person") as fleet:
        cars = (("one", "red"), ("one", "blue"), ("two", "red"), ("two", "green"))
        tokens = [fleet.bus.token(keys.car_token(name, car)) for name, car in cars]
        gateways = [pb.Supervised(name=name, kind="gateway") for name in ("red", "blue", "white")]
        status = pb.Supervision(processes=[pb.Supervised(name="@hub", kind="hub"), *gateways])

        def answer(query: zenoh.Query) -> bool:
            reply_message(query, "one/@supervisor/status", status, as_json=False)
            return True

        fleet.bus.queryable("one/@supervisor/status", answer)
        yield fleet
        assert tokens


@pytest.mark.parametrize(
    ("wanted", "silent", "told"),
    [
        (["red"], [], {"red": Phase.COMPLETE, "two/red": Phase.COMPLETE}),
        (["red"], ["two/red"], {"red": Phase.COMPLETE, "two/red": NO_ANSWER}),
        (["red"], ["one/red"], {"red": NO_ANSWER, "two/red": Phase.COMPLETE}),
        (["red"], ["one/red", "two/red"], {"red": NO_ANSWER, "two/red": NO_ANSWER}),
        (["green"], ["one/green"], {"two/green": Phase.COMPLETE}),
        (["white"], ["one/white"], {"white": NO_ANSWER, "two/white": Phase.COMPLETE}),
        (["blue", "green"], ["one/green", "two/blue"], {"blue": Phase.COMPLETE, "two/green": Phase.COMPLETE}),
        (["white"], ["one/white", "two/white"], {"white": NO_ANSWER, "two/white": NO_ANSWER}),
    ],
)
def test_silent_car_is_told_unless_only_another_fleet_has_it(
    wanted: list[str], silent: list[str], told: dict[str, str], client: Fleet
) -> None:
    def act(fleet: Fleet) -> Sequence[Outcome]:
        phases = {car: NO_ANSWER if f"{fleet.name}/{car}" in silent else Phase.COMPLETE for car in wanted}
        return [Outcome(car, ok=phase == Phase.COMPLETE, phase=phase) for car, phase in phases.items()]

    with click.Context(cli):
        outcomes = stop_in_all_fleets(client, client.bus.endpoint, act)
    assert {each.car: each.phase for each in outcomes} == told
