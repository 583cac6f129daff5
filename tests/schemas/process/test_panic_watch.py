"""A panic of Zenoh is noticed by its message on stderr, and a hub begins again after it."""

import subprocess
import sys

import pytest

from schemas.bus import Bus
from schemas.bus.endpoint import accepts
from tests.support.ports import free_endpoint
from tests.support.processes import wait_for

WATCH = """
import os, sys, zenoh
from schemas.bus.endpoint import client_config, router_config
from schemas.process.panic_watch import PanicWatch
with PanicWatch() as watch, zenoh.open(router_config(sys.argv[1])):
    with zenoh.open(client_config(sys.argv[1], 5.0)) as session:
        os.write(2, b"a line\\n")
        assert not watch.panicked.is_set()
        try: session.put("a", "b", encoding="x" * 5000)
        except BaseException: pass
        print(watch.panicked.wait(10.0))
"""
HUB = """
import os, sys, threading
from schemas.bus import hub
def panic(): os.write(2, b"thread 'rx-0' panicked at resource.rs:491:27:\\n")
if "AGAIN" not in os.environ:
    os.environ["AGAIN"] = "1"
    threading.Thread(target=lambda: (sys.stdin.readline(), panic()), daemon=True).start()
else:
    os.write(2, b"said by the second\\n")
sys.exit(hub.main())
"""


def test_panic_of_zenoh_is_noticed_and_stderr_passed_on() -> None:
    command = [sys.executable, "-c", WATCH, free_endpoint()]
    done = subprocess.run(command, capture_output=True, text=True, check=False, timeout=60)
    assert done.stdout == "True\n"
    lines = done.stderr.splitlines()
    assert lines[0] == "a line"
    assert any("panicked at" in line for line in lines)


@pytest.mark.timeout(60)
def test_hub_begins_again_after_panic() -> None:
    endpoint = free_endpoint()
    command = [sys.executable, "-c", HUB, "--endpoint", endpoint]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as hub:
        try:
            wait_for(lambda: accepts(endpoint), "it listens")
            with Bus.open(endpoint) as bus:
                first = bus.link
                assert first
                assert hub.stdin is not None
                hub.stdin.write("\n")
                hub.stdin.flush()
                wait_for(lambda: bus.link not in ("", first), "a link to another hub")
            assert hub.poll() is None, "it is the same process"
            hub.terminate()
            assert hub.wait(20.0) == 0
            assert hub.stderr is not None
            told = hub.stderr.read()
            assert "restarts" in told
            assert "said by the second" in told, "its stderr is that of the first"
        finally:
            hub.kill()
