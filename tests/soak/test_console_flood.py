"""Three pupils flood the console of six cars. Another person's STOP and drive, and the recorder, do not notice.

`FLOOD_S` and `FLOOD_PRESSES` make it shorter.
"""

import os
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from http.client import HTTPException, HTTPSConnection
from pathlib import Path
from statistics import median
from typing import Any

import psutil
import pytest

from schemas.bus import Sample
from schemas.keys import person_of
from tests.fleet.console.test_server import ServerStage, press_until_closed
from tests.support.network_client import NetworkDevice
from tests.support.page_flood import start_flood
from tests.support.processes import wait_for
from tests.support.recording import Recording

pytestmark = [pytest.mark.soak, pytest.mark.timeout(1200)]

FLOOD_S = float(os.environ.get("FLOOD_S", "300"))
PRESSES = int(os.environ.get("FLOOD_PRESSES", "300"))
DRIVE_S = min(60.0, FLOOD_S)
"""Time for which a car is driven in a flood without stops: each STOP would end the drive, as it has to."""
CALM_PRESSES = min(60, PRESSES)
SETTLED_NS = 1_000_000_000
PUPILS = 3
MAX_STOP_S = 0.15
"""Maximum time from the press to the first byte on the wire, of 99 in 100."""
MAX_GROWTH_MB = 30.0
QUIET_S = 60.0


class PersonStops:
    """The stops of one person at red's gateway: when it recorded that each one's frame is written."""

    def __init__(self, stage: ServerStage, person: str) -> None:
        self.sent_at: list[float] = []
        """Times, s, monotonic. A stop that joins a running one has no frame of its own: its frames are written."""
        self._person = person
        stage.fleet.bus.subscribe("fleet/red/event/command", self._on_event)

    def _on_event(self, sample: Sample) -> None:
        event: Any = sample.message()
        if (event.verb, event.phase, person_of(event.sender)) == ("stop", "sent", self._person):
            self.sent_at.append(time.monotonic())


def press(connection: HTTPSConnection, teacher: NetworkDevice) -> bool:
    """Press STOP. Return False if the connection was closed: the next request opens another one."""
    try:
        connection.request("POST", "/stop", headers={"Origin": teacher.origin, "Cookie": teacher.cookie})
        response = connection.getresponse()
        response.read()
    except (OSError, HTTPException):
        connection.close()
        return False
    assert response.status == 204
    return True


def stop_times(teacher: NetworkDevice, stops: PersonStops, presses: int) -> list[float]:
    """Press STOP so many times, at the pace of the flood. Return how long each took, s, the shortest first."""
    connection, took_s, began = teacher.connection(), [], time.monotonic()
    for number in range(presses):
        time.sleep(max(0.0, began + number * FLOOD_S / PRESSES - time.monotonic()))  # the pace of the presses
        count, pressed = len(stops.sent_at), time.monotonic()
        while not press(connection, teacher):  # a browser opens another connection, too
            pass
        wait_for(lambda count=count: len(stops.sent_at) > count, "the teacher's stop is on the wire")
        took_s.append(stops.sent_at[count] - pressed)
    connection.close()
    return sorted(took_s)


def describe(took_s: list[float]) -> str:
    """Describe sorted times."""
    p50, p99, most = (round(1e3 * each) for each in (median(took_s), took_s[int(0.99 * len(took_s))], took_s[-1]))
    return f"{len(took_s)} presses, p50 {p50} ms, p99 {p99} ms, max {most} ms"


@contextmanager
def flood(stage: ServerStage, pupils: list[NetworkDevice], *kinds: str) -> Iterator[None]:
    """Let the pupils flood. Print what they got."""
    processes = [start_flood(stage.fleet, pupil, *kinds) for pupil in pupils]
    began = time.monotonic()
    yield
    for process in processes:
        assert process.end() == 0, process.stderr
        print(f"\na pupil in {time.monotonic() - began:.0f} s: {process.line()}", end="")


def pauses_of_a_drive(stage: ServerStage, teacher: NetworkDevice) -> int:
    """Let the teacher hold a button. Return how often the true motors went off meanwhile: never, on a free machine."""
    with teacher.socket() as page:
        driving = threading.Thread(target=press_until_closed, args=(page,))
        driving.start()
        wait_for(lambda: stage.judge.driving, "red drives")
        began_ns = time.time_ns()
        # The first press may follow a stop, and is refused then.
        wait_for(lambda: stage.judge.driving and time.time_ns() > began_ns + SETTLED_NS, "red drives on")
        began_ns = time.time_ns()
        time.sleep(DRIVE_S)  # not a wait: the drive lasts this long
        pauses = sum(at > began_ns and not on for at, on in stage.judge.motors)
    driving.join()
    wait_for(lambda: not stage.judge.driving, "red stands")
    return pauses


def test_flood_of_three_pupils_delays_no_stop_drive_or_recording(stage: ServerStage, tmp_path: Path) -> None:
    recording = Recording(stage.fleet, tmp_path / "sessions")
    teacher = stage.device("teacher", "--rank", "lead")
    pupils = [stage.device(f"pupil{number}", source=f"127.0.0.{10 + number}") for number in range(PUPILS)]
    server, stops = psutil.Process(stage.console.process.pid), PersonStops(stage, "teacher")
    calm_pauses = pauses_of_a_drive(stage, teacher)
    before_mb = server.memory_info().rss / 1e6
    calm_s = stop_times(teacher, stops, CALM_PRESSES)
    began, used = time.monotonic(), sum(server.cpu_times()[:2])
    with flood(stage, pupils, "stops", "posts", "halves"):
        took_s = stop_times(teacher, stops, PRESSES)
        most_mb = server.memory_info().rss / 1e6
        share = (sum(server.cpu_times()[:2]) - used) / (time.monotonic() - began)
        load = os.getloadavg()[0]
    with flood(stage, pupils, "messages", "plans", "halves"):
        pauses = pauses_of_a_drive(stage, teacher)
    recorded = recording.end()
    time.sleep(QUIET_S)  # memory comes back by itself
    after_mb = server.memory_info().rss / 1e6
    print(
        f"\nSTOP, from the press to the record of its frame: {describe(took_s)}; without a flood {describe(calm_s)}; "
        f"console {share:.0%} of a core; MB before {before_mb:.0f}, in the flood {most_mb:.0f}, later {after_mb:.0f}; "
        f"{server.num_threads()} threads; driven for {DRIVE_S:.0f} s, {pauses} pauses, {calm_pauses} without a flood; "
        f"{recorded['messages']} recorded, missed {recorded['missed']}, dropped {recorded['drops']}; load {load:.1f}"
    )
    stage.person.close()
    assert stage.console.process.end() == 0
    assert "Traceback" not in stage.log()
    assert after_mb < before_mb + MAX_GROWTH_MB
    assert pauses <= calm_pauses
    assert sum(recorded["missed"].values()) == 0
    assert recorded["drops"] == {}
    assert took_s[int(0.99 * len(took_s))] <= MAX_STOP_S
