"""A car as the bus shows it: how old a message is, whose word it is, and that all views of a car agree."""

import time
from dataclasses import dataclass, field
from datetime import UTC, datetime
from math import inf
from typing import Any

import pytest
from google.protobuf.timestamp_pb2 import Timestamp

from fleet.client.car_state import NEVER_HEARD, NO_ANSWER, CarState
from fleet.client.diagnosis import CHECKS, CarEvidence, diagnose
from fleet.client.reading import MAX_STAMP_AHEAD_S, Reading
from fleet.commands.observe import row_of
from fleet.console.car_view import CarView
from fleet.coordinator.observer import FleetObserver
from fleet.supervisor.car_status import CarStatus
from schemas import topics
from schemas.bus import Sample
from schemas.gen import fleet_v1_pb2 as pb

NOW = 1_800_000_000.0
ONLINE = pb.Link(state="online", last_rx_s=0.1)
OFF = pb.Safety(motors="off", motors_basis="shown", trust="stopped")
MANUAL = pb.Mode(asked="manual", verdict="confirmed")
STILL = pb.Motion(motion="stop")


@dataclass(frozen=True)
class SeenCase:
    """A car: what its gateway says, how long ago, and what each view makes of it."""

    missing: str = ""
    silent: bool = False
    unheard: bool = False
    motors: str = "off"
    link: pb.Link = field(default_factory=lambda: ONLINE)
    safety: pb.Safety = field(default_factory=lambda: OFF)
    age_s: float = 0.5
    present: bool = True

    @property
    def states(self) -> dict[str, Any]:
        return {"state/link": self.link, "state/mode": MANUAL, "state/motion": STILL, "state/safety": self.safety}


CASES = {
    "ready": SeenCase(),
    "driving": SeenCase(motors="on", safety=pb.Safety(motors="on", trust="driving")),
    "sends nothing, its stop is sent": SeenCase(unheard=True, link=pb.Link(state="online")),
    "waits": SeenCase(
        "waits for its first stop", motors="stopping", safety=pb.Safety(motors="stopping", waits_for="its first stop")
    ),
    "in doubt": SeenCase(motors="unknown", safety=pb.Safety(motors="unknown", trust="unproven")),
    "not heard yet": SeenCase(
        NEVER_HEARD,
        unheard=True,
        motors="unknown",
        link=pb.Link(state="online"),
        safety=pb.Safety(motors="unknown"),
    ),
    "quiet": SeenCase(link=pb.Link(state="quiet", last_rx_s=40)),
    "unheard in a quiet mode": SeenCase(
        silent=True,
        unheard=True,
        motors="unknown",
        link=pb.Link(state="quiet", last_rx_s=40),
        safety=pb.Safety(motors="unknown", trust="unheard"),
    ),
    "silent": SeenCase(
        "silent: is it switched on?", silent=True, unheard=True, link=pb.Link(state="stale", last_rx_s=12)
    ),
    "lost": SeenCase("link lost: no such port", link=pb.Link(state="lost", reason="no such port")),
    "its gateway hangs": SeenCase(NO_ANSWER, age_s=60.0),
    "its gateway has ended": SeenCase("its gateway is starting", motors="unknown", present=False),
}


@pytest.mark.parametrize("name", CASES)
def test_all_views_of_a_car_agree(name: str) -> None:
    """A list, a start, the doctor, a page and the plan say the same of one car at one time."""
    case, now = CASES[name], time.time()
    said_at = now - case.age_s
    stamped = datetime.fromtimestamp(said_at, UTC)
    readings = {topic: Reading(f"fleet/red/{topic}", stamped, message) for topic, message in case.states.items()}
    row, card = CarStatus("red"), CarView("red", "")
    card.on_presence(said_at, present=True)
    for topic, message in case.states.items():
        row.take(topic, message, said_at)
        card.on_message(topic, message, said_at)
    if not case.present:
        row.reset()
    card.on_presence(now, present=case.present)
    observer = FleetObserver()
    observer.on_token("red", said_at, alive=True)
    for topic, message in case.states.items():
        payload, encoding = message.SerializeToString(), topics.TOPICS[topic].encoding
        observer.on_sample(Sample(f"fleet/red/{topic}", payload, encoding, 0, 1), said_at, None)
    if not case.present:
        observer.on_token("red", now, alive=False)
    asked = CarState.of_answers("red", readings.items(), now, present=case.present)
    for state in (asked, row.state, card.state, observer.states["red"]):
        assert state.why_missing(now) == case.missing
        assert (state.why_not_ready(now) is None) is (case.missing == "")
        assert (state.is_silent, state.is_unheard) == (case.silent, case.unheard)
        assert state.claims(now).motors.what == case.motors
    assert observer.cars["red"].motors == (case.motors if case.present else "")

    listed, page = row_of("red", readings, present=case.present), card.as_dict(now)
    assert (listed["ready"], listed["unheard"], listed["motors"]) == (not case.missing, case.unheard, case.motors)
    is_old = case.age_s > 3.0
    assert ("state/safety" in listed["stale"]) is is_old
    assert page["motors"]["state"] == ("unknown" if is_old else case.motors)
    found = {each.code for each in diagnose(CarEvidence(asked, now, asked=True))}
    assert ("silent" in found, "link_down" in found) == (case.silent, case.link.state == "lost")
    assert ("no_gateway" in found) is not case.present
    hangs = next(check.cause(CarEvidence(CarState("red"), now)) for check in CHECKS if check.code == "gateway_hung")
    assert any(hangs in each for each in card.diagnose(now)["findings"]) is is_old


@pytest.mark.parametrize("old", ["state/link", "state/safety"])
def test_with_one_stale_state_a_car_is_not_ready(old: str) -> None:
    state = CarState("red")
    for topic, message in (("state/link", ONLINE), ("state/safety", OFF)):
        state.take(topic, message, 0.0 if topic == old else 10.0)
    assert (state.why_not_ready(10.0), state.why_missing(10.0)) == ("", NO_ANSWER)
    assert state.stale_topics(10.0) == [old]


def test_answer_age_counts_from_stamp_and_publication_from_arrival() -> None:
    def answered(ahead_s: float) -> CarState:
        reading = Reading.of("fleet/red/state/link", pb.Link(state="online", stamp=_stamp(NOW + ahead_s)), 0)
        return CarState.of_answers("red", [("state/link", reading)], NOW, present=True)

    assert answered(-60.0).age_s("state/link", NOW) == 60.0
    assert answered(MAX_STAMP_AHEAD_S - 1.0).age_s("state/link", NOW) == 0.0, "the clocks of two computers"
    odd = answered(MAX_STAMP_AHEAD_S + 1.0)
    assert (odd.age_s("state/link", NOW), odd.is_stale("state/link", NOW)) == (inf, True)
    assert (odd.claims(NOW).link.age_s, odd.claims(NOW).link.short) == (None, "online"), "no age is told"
    published = CarState("red")
    published.take("state/link", pb.Link(state="online", stamp=_stamp(NOW - 60.0)), NOW)
    assert not published.is_stale("state/link", NOW + 1.0)
    assert published.is_stale("state/link", NOW + 3.1)


def test_newer_gateway_wins_over_older_answers() -> None:
    said = {
        "state/link": (2.0, pb.Link(state="online", boot_id="b")),
        "state/mode": (1.0, pb.Mode(asked="tracking", boot_id="a")),
        "state/safety": (2.0, pb.Safety(motors="off", boot_id="b")),
    }
    answers = [(topic, Reading("", datetime.fromtimestamp(NOW + at, UTC), each)) for topic, (at, each) in said.items()]
    state = CarState.of_answers("red", answers, NOW + 2.0, present=True)
    assert (state.link.state, state.mode.asked, state.safety.motors) == ("online", "", "off")


def test_overtaken_answer_and_earlier_gateway_do_not_count() -> None:
    state = CarState("red")
    assert state.take("state/link", pb.Link(state="online", boot_id="a"), 10.0)
    assert state.take("state/safety", pb.Safety(motors="off", boot_id="a"), 10.0)
    assert not state.take("state/link", pb.Link(state="lost", boot_id="a"), 9.0)
    assert state.take("state/link", pb.Link(state="quiet", boot_id="b"), 11.0)
    assert state.current("state/safety") is None, "b has not said it"
    assert not state.take("state/safety", pb.Safety(motors="off", boot_id="a"), 11.0)
    state.on_gateway_end()
    assert (state.current("state/link"), state.newest("state/link").state) == (None, "quiet")
    assert not state.take("state/safety", pb.Safety(motors="on", boot_id="b"), 12.0)
    assert state.newest("state/safety").motors == "on", "its last words"
    assert state.claims(12.0).motors.past is not None
    state.on_presence(present=True)
    assert state.newest("state/safety") is None, "who has come back says again what is so"


def _stamp(seconds: float) -> Timestamp:
    return Timestamp(seconds=int(seconds))
