"""The console on a real bus, without its pages: it shows the colors of the running fleet, and what it says."""

import asyncio
import json
import time
from contextlib import suppress
from pathlib import Path

import pytest
import zenoh

from fleet.aio import Fleet
from fleet.client import supervision
from fleet.console.console import Console
from schemas import keys
from schemas.bus import reply_message
from schemas.gen import fleet_v1_pb2 as pb
from schemas.topics import TOPICS
from tests.support.ports import free_endpoint
from tests.support.processes import PATIENCE_S, FleetProcesses, wait_for

KEY = "fleet/@supervisor/status"


async def test_car_keeps_fleet_color_after_early_event_and_reload(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(supervision, "BRIEF_TIMEOUT_S", PATIENCE_S)
    hub = FleetProcesses(free_endpoint(), tmp_path)
    asked: list[zenoh.Query] = []
    hub.bus.queryable(KEY, asked.append)
    statuses = hub.bus.publisher(KEY, supervision.SUPERVISOR_STATUS, keys.SUPERVISOR)
    events = hub.bus.publisher("fleet/red/event/command", TOPICS["event/command"], "red")
    try:
        async with Fleet(hub.endpoint, person="teacher", kind="person") as fleet:
            console = Console(fleet, tmp_path, tmp_path / "fleet.yaml")

            def reaches_the_supervisor() -> bool:
                list(fleet.sync.bus.query(KEY, timeout_s=0.1))
                return bool(asked)

            def colors() -> list[str]:
                events.put(pb.CommandEvent(id="1", verb="led", phase="sent", sender="ann"), time.time_ns())
                return [each["color"] for each in console._view.as_list(0.0)]

            def reloaded() -> bool:
                groups = {"left": "red,blue", "a b": "red", "right": "<b>,green"}
                status = pb.Supervision(colors={"red": "#040506"}, unrecorded="0.1 MB are left", groups=groups)
                statuses.put(status, time.time_ns())
                return colors() == ["#040506"]

            await asyncio.to_thread(wait_for, reaches_the_supervisor, "the hub knows who has the status")
            while asked:
                asked.pop().drop()  # type: ignore[no-untyped-call]
            running = asyncio.ensure_future(console.run())
            query = await asyncio.to_thread(wait_for, lambda: asked and asked[-1], "the console asks")
            with suppress(AssertionError):  # a console that subscribed before shows red now
                await asyncio.to_thread(wait_for, colors, "red is there too early", 1.0)
            with query:
                reply_message(query, KEY, pb.Supervision(colors={"red": "#010203"}), as_json=False)
            assert await asyncio.to_thread(wait_for, colors, "red is there") == ["#010203"]
            assert await asyncio.to_thread(wait_for, reloaded, "the color changes")
            assert json.loads(console._state(0.0))["unrecorded"] == "0.1 MB are left"
            assert console.groups == {"left": ["red", "blue"], "right": ["green"]}
            running.cancel()
            await asyncio.gather(running, return_exceptions=True)
            await console.close()
    finally:
        hub.close()
