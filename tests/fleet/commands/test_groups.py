"""Groups of cars, where commands take cars: `@a`."""

import json
from collections.abc import Iterator
from pathlib import Path

import click
import pytest
import zenoh
from click.testing import CliRunner, Result

from fleet.cli import cli
from fleet.client.client import Fleet
from fleet.commands.params import resolve_cars
from schemas import keys
from schemas.bus import reply_message, router_config
from schemas.gen import fleet_v1_pb2 as pb
from tests.support.ports import free_endpoint

FILE = "groups: {lab: [blue, green]}\ncars: {red: {link: COM1}, blue: {link: COM2}, green: {link: COM3}}\n"


@pytest.fixture
def client(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Fleet]:
    monkeypatch.chdir(tmp_path)
    endpoint = free_endpoint()
    with zenoh.open(router_config(endpoint)), Fleet(endpoint, kind="person") as fleet:
        yield fleet


def test_without_a_supervisor_the_fleet_file_here_has_the_groups(client: Fleet) -> None:
    with pytest.raises(click.ClickException, match='There is no group "@lab"'):
        resolve_cars(client, ["@lab"])
    Path("fleet.yaml").write_text(FILE, encoding="utf-8")
    assert resolve_cars(client, ["red", "@lab", "blue"]) == ["red", "blue", "green"]
    with pytest.raises(click.ClickException, match="Did you mean @lab"):
        resolve_cars(client, ["@lap"])


def test_the_running_fleet_has_the_groups(client: Fleet) -> None:
    Path("fleet.yaml").write_text(FILE, encoding="utf-8")
    key = "fleet/@supervisor/status"
    groups = {"b": "green", "a": "red,blue"}

    def answer(query: zenoh.Query) -> bool:
        reply_message(query, key, pb.Supervision(groups=groups), as_json=False)
        return True

    client.bus.queryable(key, answer)
    assert resolve_cars(client, ["@a"]) == ["red", "blue"]
    with pytest.raises(click.ClickException, match="Groups: @a, @b"):
        resolve_cars(client, ["@lab"])
    groups.clear()
    with pytest.raises(click.ClickException, match="The running fleet has none"):
        resolve_cars(client, ["@lab"])


def test_lists_and_waits_take_groups(client: Fleet) -> None:
    Path("fleet.yaml").write_text(FILE, encoding="utf-8")
    tokens = [client.bus.token(keys.car_token("fleet", car)) for car in ("red", "green", "blue")]

    def run(*words: str) -> Result:
        return CliRunner().invoke(cli, [*words, "--connect", client.bus.endpoint])

    listed = run("list", "@lab", "--json")
    assert [json.loads(line)["car"] for line in listed.stdout.splitlines()] == ["blue", "green"]
    assert "rad: not connected. Did you mean red?" in run("list", "red,rad").stderr
    waited = run("wait", "--ready", "@lab", "--timeout", "0.1s", "--json")
    assert json.loads(waited.stdout)["cars"] == ["blue", "green"]
    assert 'There is no group "@lob". Did you mean @lab?' in run("wait", "--ready", "@lob").stderr
    assert len(tokens) == 3
