"""`fleet list` with a silent car, and with a car of another platform than configured."""

import sys
from dataclasses import replace
from datetime import UTC, datetime, timedelta
from typing import Any

import pytest

from fleet.client.reading import Reading
from fleet.commands.observe import CAR_COLUMNS, OPTIONAL_CAR_COLUMNS, cell_text, row_of
from fleet.commands.output import show_table
from schemas.gen import fleet_v1_pb2 as pb


def row(**messages: Any) -> dict[str, Any]:
    now = datetime.now(UTC)
    readings = {f"state/{name}": Reading(f"fleet/red/state/{name}", now, value) for name, value in messages.items()}
    return row_of("red", readings)


@pytest.mark.parametrize(
    ("link", "motors", "unheard", "cell"),
    [
        (pb.Link(state="online", last_rx_s=0.04), "off", False, "online"),
        (pb.Link(state="quiet", last_rx_s=40), "on", False, "quiet"),
        (pb.Link(state="lost", last_rx_s=40), "unknown", False, "lost"),
        (pb.Link(state="stale", last_rx_s=12.2), "off", True, "stale (silent for 12 s)"),
        (pb.Link(state="stale"), "unknown", True, "stale (no reading yet)"),
        (pb.Link(state="stale", since_s=9, last_rx_s=0.4), "unknown", True, "stale (bytes, no reading)"),
        (pb.Link(state="stale", since_s=9, last_rx_s=8.6), "unknown", True, "stale (silent for 9 s)"),
        (pb.Link(state="online", last_rx_s=24), "unknown", True, "online (silent for 24 s)"),
        (pb.Link(state="online", last_rx_s=1), "unknown", False, "online"),
    ],
)
def test_unheard_car_is_shown_as_one(link: pb.Link, motors: str, unheard: bool, cell: str) -> None:
    told = row(link=link, safety=pb.Safety(motors=motors))
    assert (told["unheard"], cell_text("link", told)) == (unheard, cell)
    assert told["last_rx_s"] == (round(link.last_rx_s, 3) if link.HasField("last_rx_s") else None)


def test_contradicted_platform_is_shown() -> None:
    words = "a voltage of 7.91 V, which no raspberry_pi car sends"
    told = row(health=pb.Health(platform="raspberry_pi", platform_contradictions=[words]))
    assert (told["platform"], told["platform_contradictions"]) == ("raspberry_pi", [words])
    assert cell_text("platform", told) == "raspberry_pi (contradicted)"
    assert cell_text("platform", row(health=pb.Health(platform="arduino"))) == "arduino"
    assert cell_text("platform", row()) == "-", "an older gateway, or none that answers"


@pytest.mark.parametrize(("columns", "left_out"), [("80", {"PLATFORM", "VERDICT"}), ("200", set())])
def test_table_of_cars_fits_a_terminal(
    columns: str, left_out: set[str], monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("COLUMNS", columns)
    told = row(
        link=pb.Link(state="stale", last_rx_s=12.2),
        mode=pb.Mode(asked="obstacle_avoidance", verdict="contradicted"),
        motion=pb.Motion(motion="spin_left"),
        safety=pb.Safety(hold=pb.Hold(by="ann@laboratory-desk-4711"), lease=pb.Lease(holder="bob", kind="person")),
        health=pb.Health(platform="raspberry_pi"),
        battery=pb.Battery(voltage_v=7.4, level="ok"),
    )
    show_table(CAR_COLUMNS, [{name: cell_text(name, told) for name in CAR_COLUMNS}], optional=OPTIONAL_CAR_COLUMNS)
    header, line = capsys.readouterr().out.splitlines()
    assert max(len(header), len(line)) <= int(columns)
    assert {name.upper() for name in CAR_COLUMNS} - set(header.split()) >= left_out
    assert "stale (silent for" in line


@pytest.mark.parametrize(("no_color", "dot"), [("", "\x1b[38;5;16m●\x1b[0m "), ("1", "")])
def test_car_row_has_color_on_terminal(
    no_color: str, dot: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("NO_COLOR", no_color)
    monkeypatch.setenv("TERM", "xterm")
    monkeypatch.setenv("COLUMNS", "80")
    show_table(("car",), [{"car": "red"}], colors=["#010203"])
    assert capsys.readouterr().out.splitlines()[1] == "red", "a pipe gets no color"
    monkeypatch.setattr(sys.stdout, "isatty", lambda: True)
    show_table(("car",), [{"car": "red"}], colors=["#010203"])
    assert capsys.readouterr().out.splitlines()[1] == f"{dot}red"


WHY_SILENT = "silent: is it switched on?"


def states(**fields: Any) -> dict[str, Reading]:
    now = datetime.now(UTC)
    return {
        "state/link": Reading("fleet/red/state/link", now, pb.Link(state="online", last_rx_s=0.1)),
        "state/mode": Reading("fleet/red/state/mode", now, pb.Mode(asked="manual", verdict="confirmed")),
        "state/safety": Reading("fleet/red/state/safety", now, pb.Safety(motors="off", motors_basis="sent", **fields)),
        "state/health": Reading("fleet/red/state/health", now, pb.Health(platform="arduino", shows_stops="no")),
    }


def test_row_shows_motors_with_basis_and_ready_or_waiting() -> None:
    row = row_of("red", states())
    assert (row["motors"], row["motors_basis"], row["ready"], row["shows_stops"]) == ("off", "sent", True, "no")
    assert row["claims"]["motors"]["age_s"] is not None
    assert [cell_text(name, row) for name in ("ready", "motors", "shows stops")] == ["ready", "off (sent)", "no"]
    waiting = row_of("red", states(waits_for="its first stop, for 1.2 s at most"))
    assert (waiting["ready"], cell_text("ready", waiting)) == (False, "waits for its first stop, for 1.2 s at most")

    silent = states() | {"state/link": replace(states()["state/link"], value=pb.Link(state="stale"))}
    row = row_of("red", silent)
    assert (row["ready"], row["why_not_ready"], cell_text("ready", row)) == (False, WHY_SILENT, WHY_SILENT)


def test_of_old_states_no_car_is_ready() -> None:
    old = {topic: replace(each, time=each.time - timedelta(seconds=60)) for topic, each in states().items()}
    row = row_of("red", old)
    assert (row["ready"], cell_text("ready", row), cell_text("motors", row)) == (False, "-", "off (sent, stale)")


def test_without_gateway_no_link_online_and_no_motors_off() -> None:
    row = row_of("red", states(), present=False)
    assert (row["link"], row["ready"], row["motors"], row["motors_basis"]) == ("no gateway", False, "unknown", None)
    assert (row["mode"], row["verdict"]) == ("unknown", None)
