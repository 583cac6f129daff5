"""A class: 40 tabs in 30 devices behind one address. All stay live, and the console takes little of a core.

`CLASS_S` makes it shorter.
"""

import json
import os
import threading
import time
from contextlib import ExitStack

import psutil
import pytest
from websockets.exceptions import ConnectionClosed
from websockets.sync.client import ClientConnection

from tests.fleet.console.test_server import ServerStage
from tests.support.network_client import NetworkDevice
from tests.support.processes import wait_for

pytestmark = [pytest.mark.soak, pytest.mark.timeout(1200)]

CLASS_S = float(os.environ.get("CLASS_S", "600"))
DEVICES = 30
TABS = 40
MAX_SHARE = 0.6
"""Maximum share of a core for the console."""
MAX_SILENCE_S = 1.5
"""Maximum time between two messages of a tab: after it, a page says that the console is lost."""


class Tab:
    """A page of a device that reads all messages, and echoes each tick as a page does whose button is held."""

    def __init__(self, page: ClientConnection) -> None:
        self.page = page
        self.messages = 0
        self.longest_s = 0.0
        """Longest time without a message."""
        self.closed = False
        self._thread = threading.Thread(target=self._read, daemon=True)
        self._thread.start()

    def _read(self) -> None:
        last_at = time.monotonic()
        try:
            while True:
                message, now = json.loads(self.page.recv()), time.monotonic()
                self.longest_s, last_at = max(self.longest_s, now - last_at), now
                self.messages += 1
                if message["t"] == "tick":
                    self.page.send(json.dumps({"t": "echo", "press": 1, "n": message["n"]}))
        except ConnectionClosed:
            self.closed = True


def load_page(device: NetworkDevice) -> None:
    """Load the page and its files, over one connection as a browser does."""
    connection = device.connection()
    for path in ("/", "/static/app.js", "/static/console.js", "/static/ui.js", "/static/style.css", "/hello"):
        connection.request("GET", path, headers={"Cookie": device.cookie})
        response = connection.getresponse()
        assert response.read()
        assert response.status == 200, path
    connection.close()


def test_forty_tabs_of_thirty_devices_behind_one_address_are_live(stage: ServerStage) -> None:
    devices = [stage.device(f"pupil{number}") for number in range(DEVICES)]
    server = psutil.Process(stage.console.process.pid)
    with ExitStack() as opened:
        tabs = []
        for number in range(TABS):
            device = devices[number % DEVICES]
            load_page(device)
            tabs.append(Tab(opened.enter_context(device.socket())))
        wait_for(lambda: all(tab.messages for tab in tabs), "all are live")
        for tab in tabs:
            tab.longest_s = 0.0
        began, used, before = time.monotonic(), sum(server.cpu_times()[:2]), [tab.messages for tab in tabs]
        time.sleep(CLASS_S)  # not a wait: the test is about this time
        passed_s = time.monotonic() - began
        share = (sum(server.cpu_times()[:2]) - used) / passed_s
        rates = [(tab.messages - count) / passed_s for tab, count in zip(tabs, before, strict=True)]
        silent_s = max(tab.longest_s for tab in tabs)
        print(
            f"\n{TABS} tabs in {DEVICES} devices for {passed_s:.0f} s: console {share:.0%} of a core, "
            f"{server.memory_info().rss / 1e6:.0f} MB; {min(rates):.1f} to {max(rates):.1f} messages a second, longest "
            f"silence {silent_s:.2f} s; load {os.getloadavg()[0]:.1f}"
        )
        assert not [tab for tab in tabs if tab.closed]
        assert stage.person.stop()
        stage.drive()
        tabs[-1].page.send(json.dumps({"t": "stop", "id": "class"}))
        wait_for(lambda: not stage.judge.driving, "red stands")
    stage.person.close()
    assert stage.console.process.end() == 0
    assert "Traceback" not in stage.log()
    assert silent_s <= MAX_SILENCE_S
    assert share <= MAX_SHARE
