"""Tests of the `gateway` command as a whole: help, wrong use, and the imports of `gateway run`."""

import io
import json
import subprocess
import sys
from pathlib import Path

import pytest

from gateway.cli import COMMANDS, main
from tests.gateway.conftest import Command


def test_help_names_every_command(command: Command) -> None:
    done = command("--help")
    assert done.returncode == 0
    for name, (_, words) in COMMANDS.items():
        assert f"    {name:<10}{words}" in done.stdout


@pytest.mark.parametrize("unbuffered", [False, True])
@pytest.mark.parametrize("words", ["--help", "run --help", "scan --help", "--version"])
def test_help_that_cannot_be_written_fails(
    words: str, unbuffered: bool, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """A buffered write fails at the end. An unbuffered write (`python -u`) fails at once, with only one error."""
    with (
        Path("/dev/full").open("wb", buffering=0 if unbuffered else -1) as raw,
        io.TextIOWrapper(raw, write_through=unbuffered) as full,
    ):
        monkeypatch.setattr(sys, "stdout", full)
        monkeypatch.setattr(sys, "argv", ["gateway", *words.split()])
        with pytest.raises(SystemExit) as ended:
            main()
    assert ended.value.code == 1
    assert capsys.readouterr().err == "gateway: the output cannot be written: No space left on device\n"


@pytest.mark.parametrize("name", ["run", *COMMANDS])
def test_every_command_has_examples(command: Command, name: str) -> None:
    done = command(name, "--help")
    assert done.returncode == 0
    assert f"gateway {name} --" in done.stdout
    assert done.stderr == ""


@pytest.mark.parametrize("arguments", [[], ["fly"], ["--car", "red"], ["run"], ["send"], ["monitor", "--fast"]])
def test_wrong_use_is_told(command: Command, arguments: list[str]) -> None:
    done = command(*arguments)
    assert done.returncode == 2
    (line,) = done.stderr.splitlines()
    assert line.startswith("gateway: ")
    assert line.endswith(" --help)")
    assert done.stdout == ""


@pytest.mark.parametrize(
    "arguments",
    ["run --car red --link foo", "run --car red --lnk x", "monitor --link foo", "run --car red --link /dev/nope"],
)
def test_failures_are_json_lines_if_logs_are(command: Command, monkeypatch: pytest.MonkeyPatch, arguments: str) -> None:
    monkeypatch.setenv("FLEET_LOG", "json")
    done = command(*arguments.split())
    assert done.returncode in (1, 2)
    lines = [json.loads(line) for line in done.stderr.splitlines()]
    process = "gateway monitor" if arguments.startswith("monitor") else "gateway"
    assert {line["process"] for line in lines} == {process}
    assert lines[-1]["message"].startswith("gateway")


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ("run --cra red", "No such option '--cra'. Did you mean --car? (see gateway run --help)"),
        ("scan --proeb", "No such option '--proeb'. Did you mean --probe? (see gateway scan --help)"),
        ("sim 3", '"3". (see gateway sim --help)'),
        ("run --on-battery-low wran", '"wran" is not allowed. Did you mean warn? (see gateway run --help)'),
    ],
)
def test_wrong_words_name_the_likely_one(command: Command, arguments: str, words: str) -> None:
    done = command(*arguments.split(" "))
    assert (done.returncode, len(done.stderr.splitlines())) == (2, 1)
    assert words in done.stderr


@pytest.mark.parametrize(
    ("option", "value", "allowed"),
    [
        ("--longest-drive", "0", "0 is too short: more than 0"),
        ("--speed-max", "1.2", "more than 0 and at most 1"),
        ("--battery-critical-v", "7.5", "0 < critical <= low <= 30 V"),
        ("--battery-low-v", "nan", "0 < critical <= low <= 30 V"),
    ],
)
def test_limit_out_of_range_is_told_with_the_range(command: Command, option: str, value: str, allowed: str) -> None:
    done = command("run", "--car", "red", "--link", "tcp://127.0.0.1:9", option, value)
    assert done.returncode == 2
    assert option in done.stderr
    assert allowed in done.stderr
    assert len(done.stderr.splitlines()) == 1


def test_run_imports_little_before_it_joins_the_bus() -> None:
    """A fleet starts `gateway run` up to a hundred times. The wrong limit ends it after all its checks."""
    program = (
        "import sys\n"
        "sys.argv = ['gateway', 'run', '--car', 'red', '--link', 'tcp://h:9', '--person', 'ann', '--speed-max', '2']\n"
        "import gateway.cli\n"
        "try: gateway.cli.main()\n"
        "finally: print(*sys.modules)\n"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=False, timeout=60)
    assert (done.returncode, len(done.stderr.splitlines())) == (2, 1)
    imported = set(done.stdout.split())
    assert {"gateway.bus.car_service", "gateway.link", "schemas.rights"} <= imported
    assert not [name for name in imported if name.startswith(("gateway.sim", "gateway.capture", "gateway.tools"))]
    assert not imported & {"asyncio", "bleak", "serial"}
    assert not imported & {"logging", "gateway.control.commands", "gateway.drivers.yahboom.protocol.platforms"}, (
        "13 ms of a start"
    )
