"""The claims about motors, mode and link: what, on which basis, since when, how old."""

import pytest

from fleet.client.car_state import LATE_MESSAGE_NS, GatewayStarts
from fleet.client.claims import (
    CarClaim,
    describe_stop,
    link_claim,
    may_still_move,
    mode_claim,
    motors_claim,
)
from schemas.gen import fleet_v1_pb2 as pb

SHOWN = pb.Safety(motors="off", motors_basis="shown", trust_evidence="2 gaps", trust_since_s=3.0)


def test_claim_has_its_basis_its_time_and_its_age() -> None:
    claim = motors_claim(SHOWN, 0.5)
    assert (claim.what, claim.basis, claim.since_s, claim.age_s) == ("off", "shown", 3.5, 0.5)
    assert claim.short == "off (shown)"
    assert claim.as_dict() == {
        "what": "off",
        "basis": "shown",
        "since_s": 3.5,
        "age_s": 0.5,
        "words": "off (shown) for 4 s: 2 gaps",
    }
    assert motors_claim(pb.Safety(motors="on")).short == "on"


def test_old_claim_tells_its_age() -> None:
    assert motors_claim(SHOWN, 60.0).short == "off (shown, 60 s old)"
    assert link_claim(pb.Link(state="online"), 300.0).short == "online (5 min old)"


def test_without_a_gateway_nothing_is_claimed_but_what_was() -> None:
    motors = motors_claim(SHOWN, 12.0, present=False)
    assert (motors.what, motors.basis) == ("unknown", "")
    assert motors.as_dict()["age_s"] == 12.0
    assert "off (shown" in motors.words
    assert link_claim(pb.Link(state="online"), 12.0, present=False).what == "no gateway"
    assert mode_claim(pb.Mode(asked="tracking", verdict="confirmed"), 12.0, present=False).what == "unknown"
    assert [each(None).what for each in (motors_claim, mode_claim, link_claim)] == ["unknown"] * 3


@pytest.mark.parametrize(
    ("claim", "begins", "bad"),
    [
        (CarClaim("off", "shown"), "stopped", False),
        (CarClaim("off", "sent", why="red sends no readings"), "stop sent, red sends no readings", False),
        (CarClaim("off", "sent"), "stop sent", False),
        (CarClaim("stopping"), "NOT CONFIRMED", True),
        (CarClaim("unknown"), "NOT CONFIRMED", True),
    ],
)
def test_stopped_is_said_only_of_what_was_shown(claim: CarClaim, begins: str, bad: bool) -> None:
    words = describe_stop(claim, "red")
    assert words.startswith(begins)
    assert may_still_move(words) is bad


def test_message_of_earlier_gateway_counts_only_if_it_runs() -> None:
    starts = GatewayStarts()
    assert starts.take("a", 10)
    assert starts.take("b", 20)
    assert not starts.take("a", 21), "late"
    assert starts.take("b", 30)
    starts.end()
    assert not starts.take("b", 31), "its last message, after its end"
    assert starts.take("a", 32 + LATE_MESSAGE_NS), "two ran, and b was the one that ended"
    assert starts.take("", 0), "not a gateway of ours"
