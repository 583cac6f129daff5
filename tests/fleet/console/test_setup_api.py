"""The routes of the set-up page without a browser, and the files that they write."""

import json
from pathlib import Path
from typing import Any

import pytest

from tests.fleet.console.test_sessions_api import answer, cookie_of
from tests.support.console import ConsoleProcess
from tests.support.ports import free_endpoint
from tests.support.processes import FleetProcesses

OLD = "# my cars\ncars:\n  red: {link: /dev/ttyUSB0}  # the old one\n  blue: {}\n"


def test_links_are_inserted_and_nothing_is_replaced_without_a_yes(
    tmp_path: Path, tmp_path_factory: pytest.TempPathFactory
) -> None:
    fleet = FleetProcesses(free_endpoint(), tmp_path_factory.mktemp("setup"))
    file = tmp_path / "fleet.yaml"
    try:
        console = ConsoleProcess(fleet, "--fleet-file", str(file))
        own = {"Origin": console.address, "Cookie": cookie_of(console.port)}

        def ask(step: str, text: str = "{}", **fields: Any) -> Any:
            body = json.dumps(fields) if fields else text
            status, data = answer(console.port, "POST", f"/setup/{step}", body, **own)
            assert status == 200, data
            return json.loads(data)

        def write(name: str, url: str, **more: Any) -> Any:
            return ask("write", cars=[{"name": name, "url": url, "platform": "auto"}], **more)

        assert ask("file") == {"ok": True, "file": str(file), "exists": False, "cars": [], "words": ""}
        assert write("green", "tcp://127.0.0.1:8888")["ok"]
        assert "link: tcp://127.0.0.1:8888" in file.read_text()
        assert write("green", "tcp://127.0.0.1:8888")["ok"], "the same link again"

        file.write_text(OLD)
        assert ask("file")["cars"] == [["red", "/dev/ttyUSB0"], ["blue", ""]]
        assert write("blue", "/dev/ttyUSB1")["ok"]
        other = write("red", "/dev/ttyUSB7")
        assert (other["ok"], other["confirm"]) == (False, True)
        assert "red is at /dev/ttyUSB0" in other["words"]
        assert "ttyUSB7" not in file.read_text()
        assert write("red", "/dev/ttyUSB7", replace=True)["ok"]
        text = file.read_text()
        assert text.startswith("# my cars\n")
        assert "# the old one" in text
        assert "/dev/ttyUSB7" in text
        assert "/dev/ttyUSB0" not in text

        for bad in ("[]", "{", '{"cars": []}', '{"cars": [1]}', '{"cars": [{"name": "R!", "url": "x"}]}'):
            assert not ask("write", bad)["ok"], bad
        assert not write("two", "/dev/ttyUSB7")["ok"], "two cars at one link"
        many = ask("write", cars=[{"name": f"car{n}", "url": f"/dev/ttyUSB{n}"} for n in range(65)])
        assert not many["ok"]
        assert {"65", "64"} <= set(many["words"].split()), "too many is another error than none"
        assert not ask("scan", links=["nonsense"])["ok"]
        assert not ask("blink", url="sim://x")["ok"]
        assert file.read_text() == text
        file.write_text("cars: [")
        assert "error" in ask("file")["words"]
        assert answer(console.port, "POST", "/setup/file", "{}", **(own | {"Cookie": ""}))[0] == 403
        assert console.process.end() == 0
    finally:
        fleet.close()
