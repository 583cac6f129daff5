"""Types of arguments: durations, cars, colors, sessions; and resolving the names of cars."""

import os
from pathlib import Path
from typing import Any

import click
import pytest
from click.testing import CliRunner

from fleet.commands.car_names import cars_argument
from fleet.commands.params import Color, Duration, Number, session_argument
from fleet.recording import session_dir
from fleet.recording.session_lookup import newest_first
from schemas.duration import format_duration, parse_duration


@pytest.mark.parametrize(
    ("text", "seconds"),
    [("500ms", 0.5), ("2s", 2.0), ("1m30s", 90.0), ("1h", 3600.0), ("1h2m3s4ms", 3723.004), ("2", 2.0), (".5", 0.5)],
)
def test_parse_duration_accepts_units_or_seconds(text: str, seconds: float) -> None:
    assert parse_duration(text) == pytest.approx(seconds)
    assert Duration(7200.0).convert(text, None, None) == pytest.approx(seconds)


@pytest.mark.parametrize("text", ["", "s", "1d", "-1s", "1s30", "1e3", "1 s", "nan", "inf", "\u0661s", "1..5s"])
def test_anything_else_is_not(text: str) -> None:
    with pytest.raises(ValueError, match="not a duration"):
        parse_duration(text)


@pytest.mark.parametrize(
    ("text", "likely"), [("2sec", "2s"), ("1.5 Minutes", "1.5m"), ("1hour", "1h"), ("200 msec", "200ms"), ("1 s", "1s")]
)
def test_wrong_duration_unit_has_suggestion(text: str, likely: str) -> None:
    with pytest.raises(ValueError, match=f"write {likely}$"):
        parse_duration(text)


def test_duration_out_of_range_names_range() -> None:
    with pytest.raises(click.BadParameter, match=r"2h .* 1h\."):
        Duration(3600.0).convert("2h", None, None)
    with pytest.raises(click.BadParameter, match=r"0\.1 .* 500ms\."):
        Duration(3600.0, 0.5).convert("0.1", None, None)
    assert [format_duration(each) for each in (0.5, 1.5, 90, 120, 86_400)] == ["500ms", "1.5s", "90s", "2m", "24h"]


def test_number_out_of_range_names_range() -> None:
    assert Number(int, 1).convert("3", None, None) == 3
    with pytest.raises(click.BadParameter, match=r"0 .* 1\."):
        Number(int, 1).convert("0", None, None)
    with pytest.raises(click.BadParameter, match="nan "):
        Number(float, 0.01, 1000.0).convert("nan", None, None)


def test_color_is_name_or_hex() -> None:
    assert Color().convert("cyan", None, None) == (0, 255, 255)
    assert Color().convert("#ff8000", None, None) == (255, 128, 0)


@pytest.mark.parametrize(
    ("arguments", "names"),
    [("red x", "red"), ("red,blue x", "red blue"), ("red blue x", "red blue"), ("red red,all @a x", "red all @a")],
)
def test_cars_are_separated_by_commas_or_blanks(arguments: str, names: str) -> None:
    @click.command(epilog="  fleet go red x")
    @cars_argument
    @click.argument("word")
    def go(cars: tuple[str, ...], word: str) -> None:
        click.echo(f"{' '.join(cars)}, {word}")

    result = CliRunner().invoke(go, arguments.split())
    assert result.output == f"{names}, x\n"
    assert ": fleet go red x" in CliRunner().invoke(go, ["red"]).output


@pytest.fixture
def place(tmp_path: Path) -> Path:
    for number, name in enumerate(("20260101T000000Z-fleet", "20260301T000000Z-lab", "20260201T000000Z-fleet", "cut")):
        session = tmp_path / "sessions" / name
        session.mkdir(parents=True)
        (session / "session.json").write_text("{}")
        os.utime(session, (1_000_000 + number, 1_000_000 + number))  # in 1970, a time that only `cut` uses
    (tmp_path / "sessions" / "empty").mkdir()
    return tmp_path / "sessions"


def test_newest_session_is_last_begun(place: Path) -> None:
    names = ["20260301T000000Z-lab", "20260201T000000Z-fleet", "20260101T000000Z-fleet", "cut"]
    assert [each.name for each in newest_first(place)] == names


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ("", "20260301T000000Z-lab"),
        ("latest", "20260301T000000Z-lab"),
        ("latest~1", "20260201T000000Z-fleet"),
        ("cut", "sessions/cut"),
        ("sessions/cut", "sessions/cut"),
        ("nothing", "nothing"),
        ("latest~4", "latest~4: there are only 4 recorded sessions in "),
        ("--sessions elsewhere", "No recordings here yet (in elsewhere)."),
        ("--sessions copies", "All sessions in copies are made of others"),
    ],
)
def test_session_argument_is_newest_or_named(
    place: Path, arguments: str, words: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    @click.command()
    @session_argument
    def show(session: Path) -> None:
        click.echo(session)

    monkeypatch.chdir(place.parent)
    made = Path("copies") / "cut"
    made.mkdir(parents=True)
    (made / "0001.mcap").touch()
    session_dir.SessionInfo("fleet", "", "", {}, origin={"by": "cut"}).write(made)
    result = CliRunner().invoke(show, arguments.split())
    assert words in result.output


def test_sessions_are_where_the_fleet_file_here_records(
    place: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "fleet.yaml").write_text("cars: {red: {link: /dev/ttyUSB0}}\nrecord: {to: elsewhere}\n")
    monkeypatch.chdir(tmp_path)
    seen: list[Any] = []
    command = click.command()(session_argument(lambda session: seen.append(session)))  # noqa: PLW0108 - click calls it by name
    CliRunner().invoke(command, ["latest~1"])
    assert seen == [Path("sessions/20260201T000000Z-fleet")], "nothing was recorded there yet"
    place.rename(tmp_path / "elsewhere")
    for remains in (False, True):
        if remains:
            (place / "20260401T000000Z-fleet").mkdir(parents=True)
            os.utime(place, (1, 1))
        CliRunner().invoke(command, ["latest~1"])
        assert (seen[-1].parent.name, seen[-1].name) == ("elsewhere", "20260201T000000Z-fleet")
    # With --sim, `fleet up` records in `sessions` all the same. Each session is found by its name.
    (place / "20260401T000000Z-fleet" / "0001.mcap").touch()
    os.utime(place, None)
    for name in ("latest", "20260201T000000Z-fleet"):
        CliRunner().invoke(command, [name])
    assert [each.parent.name for each in seen[-2:]] == ["sessions", "elsewhere"]
    assert len(seen) == 5
