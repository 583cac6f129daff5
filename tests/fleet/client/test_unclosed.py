"""A script that does not close its Fleet ends with a ResourceWarning, and its token ends with it."""

import os
import subprocess
import sys
from collections.abc import Iterator

import pytest
import zenoh

from schemas.bus import Bus, router_config
from tests.support.ports import free_endpoint
from tests.support.processes import PATIENCE_S, wait_for

OPEN = (
    "from fleet import Fleet\nfleet = Fleet(sender='mia')\nwatch = fleet.watch('*/sensor/range')\nprint(fleet.cars())\n"
)
ASYNC = (
    "import asyncio\nfrom fleet.aio import Fleet\n"
    "async def main():\n"
    "    fleet = await Fleet(sender='mia').__aenter__()\n"
    "    watch = fleet.watch('*/sensor/range')\n"
    "    print(await fleet.cars())\n"
    "    {}\n"
    "asyncio.run(main())\n"
)
WORKER = (
    "import threading\nthreading.Thread(target=lambda: threading.main_thread().join() or print(fleet.cars())).start()\n"
)


FORK = (
    "import os, signal\nfrom fleet import Fleet\nfrom schemas.bus import BusError\n"
    "with Fleet(sender='mia') as fleet, fleet.watch('*/sensor/range'):\n"
    "    if child := os.fork():\n"
    "        print(os.waitpid(child, 0)[1], fleet.cars())\n"
    "    else:\n"
    f"        signal.alarm({PATIENCE_S / 2:.0f})\n"
    "        for use in (fleet.cars, fleet.stop, fleet.car('red').lease().__enter__):\n"
    "            try:\n"
    "                use()\n"
    "            except BusError as error:\n"
    "                print(error, flush=True)\n"
)
"""The forked process uses the Fleet, and leaves its block."""


def run(endpoint: str, *arguments: str, script: str = "") -> "subprocess.CompletedProcess[str]":
    command = [sys.executable, *arguments]
    env = os.environ | {"FLEET_ENDPOINT": endpoint}
    return subprocess.run(
        command, env=env, input=script, capture_output=True, text=True, timeout=PATIENCE_S, check=False
    )


@pytest.fixture
def endpoint() -> Iterator[str]:
    where = free_endpoint()
    with zenoh.open(router_config(where)):
        yield where


@pytest.mark.parametrize(
    ("arguments", "script", "code", "words"),
    [
        (["-c", OPEN], "", 0, ""),
        (["-c", f"{OPEN}1 / 0"], "", 1, "ZeroDivisionError"),
        (["-i", "-q"], f"{OPEN}1 / 0\n", 0, "ZeroDivisionError"),
        (["-c", ASYNC.format("pass")], "", 0, ""),
        (["-c", ASYNC.format("1 / 0")], "", 1, "ZeroDivisionError"),
        (["-c", OPEN + WORKER], "", 0, ""),
    ],
    ids=["script", "exception", "interactive", "asyncio", "exception in asyncio", "a thread goes on"],
)
def test_script_with_unclosed_fleet_ends_with_resource_warning(
    endpoint: str, arguments: list[str], script: str, code: int, words: str
) -> None:
    with Bus.open(endpoint) as bus:
        done = run(endpoint, "-W", "always::ResourceWarning", *arguments, script=script)
        assert done.returncode == code, done.stderr
        assert set(done.stdout.splitlines()) == {"[]"}
        assert words in done.stderr
        assert f"ResourceWarning: the session at {endpoint} was not closed" in done.stderr
        wait_for(lambda: not bus.tokens("fleet/@operator/*"), "its token is gone")


def test_closed_one_is_not_complained_about(endpoint: str) -> None:
    done = run(endpoint, "-W", "error::ResourceWarning", "-c", f"{OPEN}fleet.close()")
    assert (done.returncode, done.stderr) == (0, "")


def test_forked_process_is_told_to_open_its_own_and_ends(endpoint: str) -> None:
    done = run(endpoint, "-W", "error::ResourceWarning", "-c", FORK)
    assert (done.returncode, done.stderr) == (0, "")
    *told, parent = done.stdout.splitlines()
    assert ["forked" in each for each in told] == [True] * 3, told
    assert parent == "0 []", "its own Fleet is still open"
