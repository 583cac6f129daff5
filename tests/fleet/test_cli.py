"""The `fleet` command: exit codes, messages about mistakes, and Ctrl-C, with real processes if needed."""

import json
import os
import re
import signal
import subprocess
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from datetime import datetime
from pathlib import Path
from typing import Any

import click
import pytest
from click.testing import CliRunner, Result

from fleet import cli
from fleet.client.hints import complete_hints
from fleet.client.outcome import NO_ANSWER
from fleet.commands.observe import CAR_COLUMNS
from tests.fleet.conftest import Cars, running
from tests.support.message_length import too_long
from tests.support.ports import free_endpoint
from tests.support.processes import LONG_S, driving, wait_for
from tests.support.text_parts import has_parts

FLEET = [sys.executable, "-m", "fleet.cli"]
LONG = f"{LONG_S:g}s"
STALE = "[stale]"
"""Reason of a rejected drive that is half a second old at its arrival."""


def run(endpoint: str, *arguments: str) -> "subprocess.CompletedProcess[str]":
    command = [*FLEET, *arguments, "--connect", endpoint]
    return subprocess.run(command, capture_output=True, text=True, timeout=60, check=False)


@contextmanager
def driven(cars: Cars, *names: str) -> "Iterator[subprocess.Popen[str]]":
    """Run a long `fleet drive`. Yield it once all of these cars drive."""
    command = [*FLEET, "drive", ",".join(names), "forward", "--for", LONG, "--connect", cars.endpoint]
    events: list[Any] = []
    cars.bus.subscribe("fleet/*/event/command", lambda sample: events.append(sample.message()))

    def refused() -> bool:
        return any(each.reason == "stale" for each in events)

    while True:
        with running(command) as drive:
            wait_for(lambda: refused() or all(driving(cars.sim, car) for car in names), "they drive")
            if not refused():
                yield drive
                return
            drive.send_signal(signal.SIGINT)  # ends the drives of the other cars
            drive.communicate(timeout=60)
            events.clear()


def lines(done: "subprocess.CompletedProcess[str]") -> list[Any]:
    return [json.loads(line) for line in done.stdout.splitlines()]


@pytest.mark.parametrize(
    ("arguments", "told"),
    [
        ("frob", '"frob". (see fleet --help)'),
        ("drvie red forward", '"drvie". … mean drive? (see fleet --help)'),
        ("mark --json", "No such option '--json'. (see fleet mark --help)"),
        ("sessions info --josn", "'--josn'. … mean --json? (see fleet sessions info --help)"),
        ("sessions vrify", '"vrify". … mean verify? (see fleet sessions --help)'),
        ("sessions show latest", '"show". (see fleet sessions --help)'),
        (
            "drive",
            "fleet drive CAR... MOTION, … : fleet drive red … --for 2s (see fleet drive --help)",
        ),
        ("drive red", ": fleet drive CAR... MOTION, "),
        ("drive red up", '"up" … motion. … : forward, back, '),
        ("drive red blue foward", '"foward" … motion. … mean forward? (see fleet drive --help)'),
        ("drive red forward blue", '"blue" … motion last.'),
        ("drive red forward 2s", '"2s" … --for 2s'),
        ("drive red stop", '"stop" … : fleet stop red'),
        ("drive Red forward", 'fleet: No car "Red". … mean "red"?'),
        ("drive r!d forward", "'r!d' … : use 1 to 32 of a-z"),
        ("drive red,,blue forward", "car name '' is not allowed"),
        ("drive red forward --for 3601s", "fleet: --for: 3601s … 1h."),
        ("drive red forward --for 0", "--for: 0 … than 0."),
        ("drive red forward --for 1d", '--for: "1d" … duration: … 500ms, 2s, 1m30s or 1h.'),
        ("drive red forward --for 2sec", '--for: "2sec" … duration: write 2s.'),
        ("drive red forward --for nan", '"nan" … duration'),
        ("mode red fast", '"fast" … mode. … : manual, remote_control, '),
        ("schema plna", '"plna" … mean plan?'),
        ("mode red track", '"track" … mode. … mean tracking?'),
        ("led red blu", '"blu" … color. … mean blue?'),
        ("led red #ff00", '"#ff00" … color. … six of 0-9 and a-f'),
        ("light red pnik", '"pnik" … color. … mean pink?'),
        ("servo red middle left", '"middle" … servo. … : front, vertical, horizontal.'),
        ("servo red front 181", "deg 181 … 0 to 180"),
        ("servo red front \u0669", "'\u0669' … front: left, right, reset or 0 to 180"),
        ("servo red vertical left", "'left' … vertical: up, down, reset"),
        ("servo red horizontal 90", "'90' … servo horizontal "),
        ("servo red front", ": fleet servo CAR... SERVO ACTION, … : fleet servo red front 90"),
        ("servo red front -1", "'-1' … front: left, right, reset or 0 to 180"),
        ("arm red", "0 joints … 6 … 0 to 180 … : fleet arm red 90 90 45 120 90 30"),
        ("arm red 1 2 3", "3 joints … 6 … 0 to 180 … : fleet arm red 90 90 45 120 90 30"),
        ("arm red 1 2 3", "(see fleet arm --help)"),
        ("arm red 1 2 3 4 5 6 7", "7 joints given: 6 are needed, 0 to 180 degrees each"),
        ("arm red 1 2 3 4 5 181", 'joint 6 is "181": … 0 to 180 … : fleet arm'),
        ("arm red -1 2 3 4 5 6", 'joint 1 is "-1": 6 are needed, 0 to 180 degrees each'),
        ("arm red 1 2 3 4 x 6", 'joint 5 is "x": '),
        ("arm", ": fleet arm CAR... J1 J2 J3 J4 J5 J6, … : fleet arm red"),
        ("led red 300 0 0", '"0" … color. … one color'),
        ("led red", ": fleet led CAR... COLOR, … : fleet led red '#ff0010'"),
        ("speed red faster", '"faster" … speed step. … : up, down.'),
        ("fan", ": fleet fan CAR... [on|off], … : fleet fan red"),
        ("fan Red", 'No car "Red". … lower case'),
        ("stop !", "!: NOT STOPPED: use 1 to 32 of"),
        ("estop --why", "'--why' … (see fleet estop --help)"),
        ("get red -n 0", "--last: 0 … 1."),
        ("up --sim x", '--sim: "x" … whole number.'),
        ("play --rate 0", "--rate: 0 … 0.01."),
        ("get", "Missing argument 'KEY'"),
        ("get red//sensor", '"red//sensor" … key. … one / between'),
        ("get red/a*b", '"red/a*b" … key. * and ** '),
        ("get red?last=3", '"red?last=3" … key.'),
        ("watch red/$", "key expression 'fleet/red/$' is not allowed"),
        ("list --connect nowhere", "'nowhere' … tcp/HOST:PORT"),
        ("list --connect tcp/localhost", "endpoint 'tcp/localhost' is not allowed"),
        ("list --fleet A", "fleet name 'A' "),
        ("plan run", "Missing argument 'FILE'"),
        ("sessions export latest --csv", "'--csv' … (see fleet sessions export --help)"),
        ("pause red", '"red". (see fleet pause --help)'),
        ("plan run no/such.yaml", "no/such.yaml: error: … file"),
    ],
)
def test_wrong_use_is_one_line_and_exit_code_2(
    arguments: str, told: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(sys, "argv", ["fleet", *arguments.split(" ")])
    monkeypatch.setenv("FLEET_ENDPOINT", free_endpoint())  # no hub listens there, and the command queries none
    with pytest.raises(SystemExit) as ended:
        cli.main()
    said = capsys.readouterr()
    assert ended.value.code == 2
    assert has_parts(said.err, told)
    assert said.err.startswith(("fleet: ", "no/such.yaml: error: "))
    assert said.err.count("\n") == 1
    assert too_long(said.err) == []
    assert said.out == ""


@pytest.mark.parametrize(
    "arguments",
    ["check", "plan run", "plan set", "up", "up --sim 1 --plan", "up --sim 1 --world"],
)
def test_fifo_as_file_is_refused_without_waiting(
    arguments: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    os.mkfifo(tmp_path / "fifo")
    monkeypatch.setattr(sys, "argv", ["fleet", *arguments.split(" "), str(tmp_path / "fifo")])
    monkeypatch.setenv("FLEET_ENDPOINT", free_endpoint())
    with pytest.raises(SystemExit) as ended:
        cli.main()
    assert ended.value.code == 2
    assert f"{tmp_path / 'fifo'}:1:1: error: is a FIFO" in capsys.readouterr().err


NAMES = [name for section in cli.COMMANDS.values() for name in section]
WITHOUT_BUS = (
    "hub",
    "join",
    "leave",
    "scan",
    "sim",
    "init",
    "example",
    "check",
    "bind",
    "schema",
    "plan",
    "sessions",
    "replay",
    "play",
    "record",
    "find",
    "query",
)
"""Subcommands without a bus, with the bus of the file, or with options in their own subcommands."""


def contexts(command: click.Command, context: click.Context) -> Iterator[click.Context]:
    """Yield each command with the context of its help."""
    yield context
    if isinstance(command, click.Group):
        for name in command.list_commands(context):
            sub = command.get_command(context, name)
            assert sub is not None
            yield from contexts(sub, click.Context(sub, info_name=name, parent=context))


EVERY_COMMAND = list(contexts(cli.cli, click.Context(cli.cli, info_name="fleet", **cli.cli.context_settings)))


@pytest.mark.parametrize("context", EVERY_COMMAND[1:], ids=lambda context: context.command_path)
def test_help_has_example_and_words_for_options(context: click.Context) -> None:
    command, shown = context.command, context.get_help()
    assert context.help_option_names == ["-h", "--help"]
    assert f"  {context.command_path}" in shown[shown.index("example") :]
    for param in (each for each in command.params if not getattr(each, "hidden", False)):
        if isinstance(param, click.Option):
            assert param.help, param.opts
            assert param.help.endswith((".", ")")), param.opts
        words = " ".join(param.get_help_record(context) or (param.make_metavar(context),))
        assert not re.search(r"TEXT|INTEGER|FLOAT|RANGE|<=", words), words
    if len(context.command_path.split()) == 2 and context.info_name not in (*WITHOUT_BUS, "console", "demo", "record"):
        assert "--connect" in shown
        assert "--fleet" in shown


@pytest.mark.parametrize("context", EVERY_COMMAND, ids=lambda context: context.command_path)
def test_help_sentences_are_short(context: click.Context) -> None:
    command = context.command
    options = [param.help or "" for param in command.params if isinstance(param, click.Option)]
    without_examples = re.sub("\x08.*?(\n\n|$)", "", command.epilog or "", flags=re.DOTALL)
    for text in (command.help or "", without_examples, *options):
        for sentence in re.split(r"(?<=[.!?:])\s+|\n\n", text):
            assert len(sentence.split()) <= 25, sentence


@pytest.mark.parametrize(("before", "after"), [("-e", ""), ("--endpoint", ""), ("", "--connect"), ("--connect", "-e")])
def test_connect_option_works_before_and_after_command(before: str, after: str) -> None:
    nowhere, endpoint = free_endpoint(), free_endpoint()
    group = [before, nowhere if after else endpoint] if before else []
    result = CliRunner().invoke(cli.cli, [*group, "--fleet", "lab", "list", *([after, endpoint] if after else [])])
    assert result.exit_code == 1
    assert endpoint in result.output


def test_both_programs_tell_their_version_and_help() -> None:
    for program in ("fleet", "gateway"):
        for option, words in (("--version", f"{program} 0."), ("-h", "sage: ")):
            done = subprocess.run([sys.executable, "-m", program, option], capture_output=True, text=True, check=True)
            assert words in done.stdout


def test_help_imports_nothing_heavy() -> None:
    code = (
        "import sys; import fleet.cli; sys.argv = ['fleet', '--help']\n"
        "try: fleet.cli.main()\n"
        "except SystemExit: pass\n"
        "print(sorted({'zenoh', 'google', 'rerun', 'mcap', 'yaml', 'asyncio'} & set(sys.modules)), file=sys.stderr)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stderr == "[]\n"
    assert all(f"  {name} " in done.stdout for name in NAMES)
    assert all(f"{section}:\n" in done.stdout for section in cli.COMMANDS)


def test_no_running_fleet_is_failure_with_advice() -> None:
    endpoint = free_endpoint()
    done = run(endpoint, "list")
    assert done.returncode == 1
    assert f"`fleet up --connect {endpoint}`" in done.stderr
    assert done.stderr.count("\n") == 1


def test_misspelled_fan_state_toggles_nothing(cars: Cars) -> None:
    done = run(cars.endpoint, "fan", "blue", "onn")
    assert (done.returncode, done.stdout) == (2, "")
    assert done.stderr.startswith('fleet: "onn" ')
    assert " mean on?" in done.stderr


def test_commands_fail_in_fleet_without_cars(cars: Cars) -> None:
    for command in (["list"], ["stop"], ["get", "red"]):
        done = run(cars.endpoint, *command, "--fleet", "empty")
        assert done.returncode == 1
        assert '"empty"' in done.stderr or done.stderr == "fleet: No car is connected.\n"


def test_list_says_how_each_car_is(cars: Cars, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("COLUMNS", "250")

    def told() -> list[Any] | None:
        rows = lines(run(cars.endpoint, "list", "--json"))
        return rows if rows[2]["battery_v"] else None

    rows = wait_for(told, "red has told its battery")
    assert [(row["car"], row["mode"], row["motors"], row["ready"]) for row in rows] == [
        (car, "manual", "off", True) for car in ("blue", "green", "red")
    ]
    assert [row["motors_basis"] for row in rows[:2]] == ["sent", "sent"], "a Raspberry Pi car can show nothing"
    assert [row["shows_stops"] for row in rows[:2]] == ["no", "no"]
    assert 6 < rows[2]["battery_v"] < 9
    # A Raspberry Pi car does not measure this field.
    assert [(row["battery_v"] is None, row["battery_level"]) for row in rows] == [(True, None)] * 2 + [(False, "ok")]
    done = run(cars.endpoint, "list")
    table = [re.split("  +", line) for line in done.stdout.splitlines()]
    assert table[0] == [name.upper() for name in CAR_COLUMNS]
    assert [row[0] for row in table[1:]] == ["blue", "green", "red"]
    assert [row[1] for row in table[1:]] == ["raspberry_pi", "raspberry_pi", "arduino"]
    assert [row[-1] for row in table[1:3]] == ["-"] * 2
    assert table[3][-1].endswith(" V ok")


def test_hour_old_reading_is_not_shown_as_current(cars: Cars) -> None:
    """In tracking, only the line is measured, so the battery's last reading ages."""
    assert run(cars.endpoint, "mode", "red", "tracking").returncode == 0
    try:

        def old() -> dict[str, Any] | None:
            row: dict[str, Any] = lines(run(cars.endpoint, "list", "--json"))[2]
            return row if "sensor/battery" in row["stale"] else None

        row = wait_for(old, "red's battery has not been measured for 3 s")
        assert row["battery_age_s"] >= 3
        assert "state/link" not in row["stale"]
        assert run(cars.endpoint, "list").stdout.splitlines()[3].endswith(" s old")
        (battery,) = lines(run(cars.endpoint, "get", "red/sensor/battery", "--json"))
        assert battery["stale"] is True
        assert run(cars.endpoint, "get", "red/sensor/battery").stdout.endswith(" s ago (stale)\n")
    finally:
        run(cars.endpoint, "mode", "red", "manual")


def test_get_prints_one_line_or_one_object_for_each_reading(cars: Cars) -> None:
    done = run(cars.endpoint, "get", "red")
    assert done.returncode == 0
    battery = next(line for line in done.stdout.splitlines() if line.startswith("fleet/red/sensor/battery "))
    assert "voltage_v=7." in battery
    assert " V  " in battery

    def fresh() -> dict[str, Any] | None:
        (found,) = lines(run(cars.endpoint, "get", "red/sensor/range", "--json"))
        return None if found["stale"] else found

    # The test before may have left the car in a mode without range readings.
    reading = wait_for(fresh, "red's range is measured")
    assert list(reading) == ["key", "time", "age_s", "stale", "value"]
    assert 0 <= reading["age_s"] < 60
    assert reading["stale"] is False
    assert reading["key"] == "fleet/red/sensor/range"
    assert reading["time"].endswith("Z")
    assert datetime.fromisoformat(reading["time"]).year > 2000
    assert reading["value"]["car"] == "red"
    done = run(cars.endpoint, "get", "red/sensor/sonar")
    assert done.returncode == 2
    assert done.stderr.startswith("fleet: No key red/sensor/sonar.")
    done = run(cars.endpoint, "get", "purple")
    assert done.returncode == 1
    assert '"purple"' in done.stderr
    assert "blue, green, red" in done.stderr
    done = run(cars.endpoint, "get", "red/sim/truth")
    assert done.stderr.endswith(" fleet watch red/sim/truth\n")


def test_each_car_has_line_and_missing_car_exits_1(cars: Cars) -> None:
    done = run(cars.endpoint, "led", "red,purple,blue", "#0000ff")
    assert done.returncode == 1
    assert [line.split(":")[0] for line in done.stdout.splitlines()] == ["blue", "red"]
    assert done.stderr == 'purple: No car named "purple". Connected: blue, green, red. [no_answer]\n'
    outcomes = lines(run(cars.endpoint, "led", "red,purple", "#000000", "--json"))
    assert [(each["car"], each["ok"], each["phase"]) for each in outcomes] == [
        ("purple", False, "no_answer"),
        ("red", True, "sent"),
    ]


def test_refused_command_says_why(cars: Cars) -> None:
    done = run(cars.endpoint, "mode", "blue", "tracking")
    assert done.returncode == 1
    assert done.stderr.startswith("blue: refused: blue (raspberry_pi) has no mode tracking. It has: ")
    arguments = ["drive", "red", "forward", "--for", "1h", "--connect", cars.endpoint]
    too_long = CliRunner().invoke(cli.cli, arguments)
    assert (too_long.exit_code, too_long.output.split()[-1]) == (2, "[bad_value]")
    assert "3600 s" in too_long.output
    assert f"{LONG_S:g} s (longest_drive_s " in too_long.output


def test_drive_command_waits_until_drive_is_over(cars: Cars) -> None:
    while STALE in (done := run(cars.endpoint, "drive", "green", "forward", "--for", "700ms")).stderr:
        pass
    assert done.returncode == 0
    assert done.stdout.startswith("green: sent for "), done.stdout
    wait_for(lambda: not driving(cars.sim, "green"), "green stands")


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_interrupted_drive_command_stops_its_cars(cars: Cars, number: signal.Signals) -> None:
    with driven(cars, "green", "blue") as drive:
        drive.send_signal(number)
        out, err = drive.communicate(timeout=60)
    assert drive.returncode == 130
    assert "Traceback" not in err
    assert [line.partition(",")[0] for line in out.splitlines()] == ["blue: stop sent", "green: stop sent"]
    assert not driving(cars.sim, "green")
    assert not driving(cars.sim, "blue")


def test_stop_stops_all_and_is_complete_when_it_ends(cars: Cars) -> None:
    with driven(cars, "green") as drive:
        done = run(cars.endpoint, "stop")
        _, err = drive.communicate(timeout=60)
    assert done.returncode == 0
    assert [re.split(r"[,(]", line)[0].strip() for line in done.stdout.splitlines()] == [
        "blue: stop sent",
        "green: stop sent",
        "red: stopped",
    ]
    assert not driving(cars.sim, "green")
    assert drive.returncode == 1
    assert err.startswith("green: ended early: ")
    resumed = run(cars.endpoint, "resume", "red,green", "blue")
    assert resumed.returncode == 0


def test_wrong_name_beside_all_is_named_and_all_are_stopped(cars: Cars) -> None:
    done = run(cars.endpoint, "stop", "all", "gren")
    assert done.returncode == 1
    assert [line.split(":")[0] for line in done.stdout.splitlines()] == ["blue", "green", "red"]
    assert done.stderr.startswith("gren: NOT STOPPED: ")
    assert " mean green?" in done.stderr
    assert run(cars.endpoint, "resume").returncode == 0


def test_wrong_word_of_a_stop_is_named_and_all_others_are_stopped(cars: Cars) -> None:
    done = run(cars.endpoint, "stop", "BLUE,,!", "@nobody", "red", "--json")
    said = {each["car"]: each for each in map(json.loads, done.stdout.splitlines())}
    assert done.returncode == 1
    assert {car: each["phase"] != NO_ANSWER for car, each in said.items()} == {
        "blue": True,
        "red": True,
        "@nobody": False,
        "!": False,
    }
    assert said["@nobody"]["words"].startswith("NOT STOPPED: ")
    nobody = run(cars.endpoint, "stop", "@nobody")
    assert (nobody.returncode, nobody.stdout) == (1, "")
    assert nobody.stderr.startswith("@nobody: NOT STOPPED: "), "and no other car is stopped"
    assert run(cars.endpoint, "resume").returncode == 0


def test_ending_its_e_stops_does_not_end_a_cars_hold(cars: Cars) -> None:
    estopped = run(cars.endpoint, "estop", "blue", "--why", "wall")
    options = f"--connect {cars.endpoint}"
    release = complete_hints("`fleet resume blue --estops`", options)
    assert estopped.stdout.endswith(f"{release}\n")
    still = run(cars.endpoint, "resume", "blue")
    assert (still.returncode, still.stdout) == (1, "")
    assert re.fullmatch(rf'blue: .*"wall".*{re.escape(release)} \[estopped\]\n', still.stderr)
    run(cars.endpoint, "stop", "blue")
    ended = run(cars.endpoint, "resume", "blue", "--estops")
    assert ended.returncode == 0
    resume = re.escape(complete_hints("`fleet resume blue`", options))
    assert re.fullmatch(rf"blue: e-stop released; .*: {resume}\n", ended.stdout)
    again = run(cars.endpoint, "resume", "blue", "--estops")
    assert (again.returncode, again.stderr[:6]) == (0, "blue: ")
    nobody = run(cars.endpoint, "resume", "pink", "--estops")
    assert nobody.returncode == 1
    assert '"pink"' in nobody.stderr
    assert "blue: resumed: " in run(cars.endpoint, "resume", "blue").stdout


def test_fleet_estop_release_has_one_line_per_car(cars: Cars) -> None:
    def invoke(*arguments: str) -> Result:
        return CliRunner().invoke(cli.cli, [*arguments, "--connect", cars.endpoint], catch_exceptions=False)

    estopped = invoke("estop")
    release = complete_hints("`fleet resume --estops`", f"--connect {cars.endpoint}")
    assert [line.endswith(f": {release}") for line in estopped.output.splitlines()] == [True] * 3
    released = invoke("resume", "--estops")
    assert released.exit_code == 0, released.output
    assert [line.split(";")[0] for line in released.output.splitlines()] == [
        f"{car}: e-stop released" for car in ("blue", "green", "red")
    ]
    assert invoke("resume").exit_code == 0


def test_ctrl_c_during_lock_is_ctrl_c(monkeypatch: pytest.MonkeyPatch) -> None:
    def interrupted(**_: object) -> None:
        try:
            raise KeyboardInterrupt
        finally:
            threading.Lock().release()  # as `threading.Condition.wait` does

    monkeypatch.setattr(cli.cli, "main", interrupted)
    with pytest.raises(SystemExit) as ended:
        cli.main()
    assert ended.value.code == 130


def completed(words: str, endpoint: str) -> "subprocess.CompletedProcess[str]":
    settings = {"_FLEET_COMPLETE": "bash_complete", "COMP_WORDS": words, "COMP_CWORD": str(words.count(" "))}
    environment = {**os.environ, **settings, "FLEET_ENDPOINT": endpoint}
    return subprocess.run(FLEET, capture_output=True, text=True, check=True, env=environment)


def test_shell_completes_cars_and_words(cars: Cars) -> None:
    # On a busy machine the cars may not answer in time. Then the shell gets no name, but never an error.
    wait_for(lambda: completed("fleet drive re", cars.endpoint).stdout == "plain,red\n", "the shell completes red")
    assert completed("fleet drive red fo", cars.endpoint).stdout == "plain,forward\n"
    done = completed("fleet stop bl", free_endpoint())
    assert (done.stdout.strip(), done.stderr) == ("", "")


def test_watch_is_ended_by_ctrl_c_without_a_word(cars: Cars) -> None:
    command = [*FLEET, "watch", "red/state/health", "--json", "--connect", cars.endpoint]
    with running(command) as watch:
        assert watch.stdout is not None
        assert json.loads(watch.stdout.readline())["key"] == "fleet/red/state/health"
        watch.send_signal(signal.SIGINT)
        _, err = watch.communicate(timeout=60)
    assert watch.returncode == 130
    assert err.strip() == ""


def test_watch_tells_absent_car_and_ignores_broken_pipe(cars: Cars) -> None:
    command = [*FLEET, "watch", "*/state/*", "--json", "--connect", cars.endpoint]
    with running(command) as watch:
        assert watch.stdout is not None
        watch.stdout.readline()
        watch.stdout.close()
        assert watch.stderr is not None
        assert watch.stderr.read() == ""
        assert watch.wait(60) == 1
    command = [*FLEET, "watch", "purple", "--connect", cars.endpoint]
    with running(command) as watch:
        assert watch.stderr is not None
        said = watch.stderr.readline()
        watch.send_signal(signal.SIGINT)
        watch.communicate(timeout=60)
    assert said.startswith('fleet: No car "purple" ')
    assert "blue, green, red" in said
