"""The judge of the soak finds all false claims, and only these. Each row: published values, and the findings."""

from typing import Any

import pytest
from google.protobuf.timestamp_pb2 import Timestamp

from schemas import messages
from schemas.bus import Sample
from schemas.gen import fleet_v1_pb2 as pb
from tests.support.claims import MOTORS, RESULT, SENT, VERDICT, Claims

BEGIN_S = 1_000
TENTHS = 200


def sample(message: Any, at_s: float) -> Sample:
    message.stamp.CopyFrom(Timestamp(seconds=int(at_s), nanos=round(at_s % 1 * 1e9)))
    message.car = "red"
    encoding = messages.encoding_of(message.DESCRIPTOR.full_name)
    return Sample("fleet/red/any", message.SerializeToString(), encoding, 0, 1)


def judged(
    on_s: tuple[float, float], safety: pb.Safety, confirmed: str = "", complete_s: float = 0.0
) -> dict[str, int]:
    """Play 20 s: the motors of a tracking car are on between two times, and the claim stays the same all the time."""
    claims = Claims()
    for tenth in range(TENTHS):
        at_s = tenth / 10
        on = on_s[0] <= at_s < on_s[1]
        claims._truth(sample(pb.Truth(mode="tracking", motor_left=200 if on else 0), BEGIN_S + at_s))
        if tenth % 10 == 0:
            claims._safety(sample(pb.Safety.FromString(safety.SerializeToString()), BEGIN_S + at_s))
            verdict = "confirmed" if confirmed else "assumed"
            claims._mode(sample(pb.Mode(asked=confirmed, verdict=verdict), BEGIN_S + at_s))
    if complete_s:
        claims._command(sample(pb.CommandEvent(verb="stop", phase="complete", id="a"), BEGIN_S + complete_s))
    return {kind: len(found) for kind, found in claims.false().items() if found}


SHOWN, WRITTEN = pb.Safety(motors="off", motors_basis="shown"), pb.Safety(motors="off", motors_basis="sent")
STOPPING = pb.Safety(motors="stopping")


@pytest.mark.parametrize(
    ("found", "expected"),
    [
        (judged((5.0, 8.0), SHOWN), {MOTORS: 1}),
        (judged((5.0, 5.2), SHOWN), {}),
        (judged((5.0, 8.0), WRITTEN), {SENT: 1}),
        (judged((5.0, 8.0), STOPPING), {}),
        (judged((0.0, 0.0), SHOWN, confirmed="manual"), {VERDICT: 1}),
        (judged((0.0, 0.0), SHOWN, confirmed="tracking"), {}),
        (judged((5.0, 8.0), STOPPING, complete_s=6.0), {RESULT: 1}),
        (judged((5.0, 8.0), STOPPING, complete_s=7.9), {}),
        (judged((5.0, 8.0), STOPPING, complete_s=3.0), {}),
    ],
)
def test_false_claim_is_found(found: dict[str, int], expected: dict[str, int]) -> None:
    assert found == expected
