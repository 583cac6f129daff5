"""Groups of cars, where commands take cars: `@a`."""

import json
import re
from collections.abc import Iterator
from pathlib import Path

import click
import pytest
import zenoh
from click.testing import CliRunner, Result

from fleet.cli import cli
from fleet.client.client import Fleet
from fleet.commands.car_names import complete_cars, resolve_cars
from fleet.commands.fleet_file import prompt_name
from fleet.recording.reading.session import NoSession, Session
from schemas import keys
from schemas.bus import reply_message, router_config
from schemas.gen import fleet_v1_pb2 as pb
from schemas.suggestion import nearest
from tests.support.ports import free_endpoint

FILE = "groups: {lab: [blue, green]}\ncars: {red: {link: COM1}, blue: {link: COM2}, green: {link: COM3}}\n"


@pytest.fixture
def client(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Fleet]:
    monkeypatch.chdir(tmp_path)
    endpoint = free_endpoint()
    with zenoh.open(router_config(endpoint)), Fleet(endpoint, kind="person") as fleet:
        yield fleet


def test_without_a_supervisor_the_fleet_file_here_has_the_groups(client: Fleet) -> None:
    with pytest.raises(click.ClickException, match='"@lab"'):
        resolve_cars(client, ["@lab"])
    Path("fleet.yaml").write_text(FILE, encoding="utf-8")
    assert resolve_cars(client, ["red", "@lab", "blue"]) == ["red", "blue", "green"]
    with pytest.raises(click.ClickException, match="Did you mean @lab"):
        resolve_cars(client, ["@lap"])


def test_running_fleet_has_the_groups(client: Fleet) -> None:
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
    with pytest.raises(click.ClickException, match='"@lab"'):
        resolve_cars(client, ["@lab"])


def test_lists_and_waits_take_groups(client: Fleet) -> None:
    Path("fleet.yaml").write_text(FILE, encoding="utf-8")
    tokens = [client.bus.token(keys.car_token("fleet", car)) for car in ("red", "green", "blue")]

    def run(*words: str) -> Result:
        return CliRunner().invoke(cli, [*words, "--connect", client.bus.endpoint])

    listed = run("list", "@lab", "--json")
    assert [json.loads(line)["car"] for line in listed.stdout.splitlines()] == ["blue", "green"]
    assert "rad: not connected. " in run("list", "red,rad").stderr
    assert " mean red?" in run("list", "red,rad").stderr
    waited = run("wait", "--ready", "@lab", "--timeout", "0.1s", "--json")
    assert json.loads(waited.stdout)["cars"] == ["blue", "green"]
    assert "mean @lab?" in run("wait", "--ready", "@lob").stderr
    assert len(tokens) == 3


def test_wrong_key_or_fleet_names_the_likely_one(client: Fleet) -> None:
    tokens = [client.bus.token(keys.car_token("fleet", car)) for car in ("red", "blue")]

    def error(*words: str) -> str:
        done = CliRunner().invoke(cli, [*words, "--connect", client.bus.endpoint], standalone_mode=False)
        assert isinstance(done.exception, click.ClickException)
        return done.exception.message

    assert error("get", "rde").endswith(" mean red?")
    assert error("get", "battery").endswith(" mean '*/sensor/battery'?")
    assert error("get", "red/sensor/rang") == "No key red/sensor/rang. Did you mean red/sensor/range?"
    assert error("watch", "*/sensor/rang") == "No key */sensor/rang. Did you mean */sensor/range?"
    assert "not a group" in error("get", "@a")
    assert error("list", "@A").endswith(' mean "@a"?')
    Path("fleet.yaml").write_text(FILE.replace("blue, green]", "]", 1), encoding="utf-8")
    assert error("led", "@lab", "blue") == 'The group "@lab" has no cars.'
    Path("fleet.yaml").unlink()
    for command in ("list", "stop", "pause"):
        assert re.fullmatch(r'No fleet "flet" .*: fleet\.', error(command, "--fleet", "flet"))
    named = CliRunner().invoke(cli, ["stop", "red", "--fleet", "flet", "--connect", client.bus.endpoint])
    assert named.exit_code == 1
    assert named.output.startswith("red: NOT STOPPED")
    assert 'No fleet "flet" ' in named.output
    assert len(tokens) == 2


def test_shell_completes_groups_of_the_fleet_file(client: Fleet) -> None:
    Path("fleet.yaml").write_text(FILE, encoding="utf-8")
    context = click.Context(cli, info_name="fleet")
    context.params["connect"] = client.bus.endpoint
    assert complete_cars(context, click.Argument(["cars"]), "@") == ["@lab"]


def test_wrong_session_or_file_name_suggests_likely_one(tmp_path: Path, client: Fleet) -> None:
    assert client.bus.endpoint
    Path("plan.yaml").touch()
    Path("sessions/20260101T000000Z-demo").mkdir(parents=True)
    with pytest.raises(NoSession, match=r" mean latest\? `fleet sessions`"):
        Session("lates")
    with pytest.raises(NoSession, match=r"Did you mean 20260101T000000Z-demo\?"):
        Session("20260101T000000Z-dem")
    done = CliRunner().invoke(cli, ["plan", "set", "plan.yml"])
    assert "plan.yml: error: " in done.output
    assert done.output.endswith(" mean plan.yaml?\n")


def test_prompt_of_a_name_proposes_a_valid_one() -> None:
    @click.command()
    def ask() -> None:
        prompt_name("name", None, set())

    done = CliRunner().invoke(ask, input="Red Car\n")
    assert done.exit_code == 1
    assert 'fleet: "Red Car" ' in done.output
    assert "such as red-car.\n" in done.output
    assert "stdin" in done.output


@pytest.mark.parametrize(
    ("wrong", "near"), [("avoid", "obstacle_avoidance"), ("trakcing", "tracking"), ("xy", None), ("LIGHT", "light")]
)
def test_nearest_name_is_alike_or_contains_the_word(wrong: str, near: str | None) -> None:
    assert nearest(wrong, ["manual", "tracking", "obstacle_avoidance", "light"]) == near
