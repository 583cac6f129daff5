"""One person floods a car with drives under a key of their own. The stop of another is as soon as without the flood."""

import json
import time
from pathlib import Path

import pytest

from fleet.client.client import Fleet
from schemas.commands import Verb
from schemas.identity import car, person
from schemas.keys import command_key
from tests.support.judge import Judge
from tests.support.processes import PATIENCE_S, FleetProcesses, GatewayProcess, wait_for
from tests.support.secure import plain_settings, secure_fleet

pytestmark = [pytest.mark.soak, pytest.mark.timeout(600)]

ANN, BOB = person("ann"), person("bob")
FLOOD = Path(__file__).parents[1] / "support" / "key_flood.py"
FLOOD_S = 10.0
MIN_FLOOD = 50_000
MAX_MORE_OFF_S = 0.3
"""Maximum time by which the motors are off later than without a flood. Before budgets it was up to 1.7 s."""
MAX_MORE_SHOWN_S = 3.0
"""Maximum time by which the stop is shown later. Runs without a flood differ by a second or two: reports block."""


def stop(ann: Fleet, judge: Judge) -> tuple[float, float]:
    """Let red drive, and stop it. Return after which time its motors were off, and after which it was shown, s."""
    ann.resume(["red"])
    wait_for(lambda: ann.car("red").drive("forward", 50.0, wait=False).ok, "it drives again")
    wait_for(lambda: judge.driving, "its motors are on")
    asked_ns, asked_at = time.time_ns(), time.monotonic()
    outcome = ann.car("red").stop()
    assert outcome.ok, outcome
    return judge.wait_off(asked_ns, watched_s=0.5), time.monotonic() - asked_at


def test_flood_under_one_key_delays_no_stop_of_another(tmp_path: Path) -> None:
    with secure_fleet(tmp_path, ANN, [BOB, car("red")]) as (fleet, store):
        _, (link,) = fleet.simulate("red:arduino:tcp", truth=True)
        fleet.gateway(link, "--longest-drive", "60s")
        with Fleet(fleet.endpoint, kind="person", person="ann") as ann:
            judge = Judge.follow(ann.bus)
            wait_for(lambda: [each.value.motors for each in ann.get("red/state/safety")] == ["off"], "red is ready")
            calm = [stop(ann, judge) for _ in range(2)]
            tls = store.credentials.of_client(BOB)["tls"]
            settings = json.dumps(plain_settings(store.credentials.endpoint, tls))
            payload = json.dumps({"sender": "bob@x-1", "kind": "person", "motion": "forward", "duration_s": 0.5})
            flooded = []
            for _ in range(2):
                bob = start(fleet, settings, payload)
                flooded.append(stop(ann, judge))
                assert bob.wait() == 0, bob.stderr
                (count,) = bob.lines()
                assert int(count) > MIN_FLOOD
            print(f"motors off, shown (s): calm {calm}, in a flood {flooded}")
            (health,) = (each.value for each in ann.get("red/state/health"))
            assert health.bus_drops > MIN_FLOOD, "what is dropped is counted"
            for index, more_s in enumerate((MAX_MORE_OFF_S, MAX_MORE_SHOWN_S)):
                assert max(each[index] for each in flooded) < max(each[index] for each in calm) + more_s


def start(fleet: FleetProcesses, settings: str, payload: str) -> GatewayProcess:
    """Let Bob flood, and return his process once the gateway gets it."""
    bob = fleet.start(str(FLOOD), settings, command_key("fleet", "red", Verb.DRIVE, BOB), payload, str(FLOOD_S))
    wait_for(bob.lines, "he begins", PATIENCE_S)
    time.sleep(1.0)  # queues fill
    return bob
