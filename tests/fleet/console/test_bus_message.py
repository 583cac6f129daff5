"""The console leaves out messages of the bus with numbers that are not finite, and names that no car may have."""

import math
import time

import pytest

from fleet.console.bus_message import is_finite, is_shown, message_in
from schemas import messages
from schemas.bus import Sample
from schemas.gen import fleet_v1_pb2 as pb

RANGE = messages.encoding_of("fleet.v1.Range")
ODD = (math.nan, math.inf, -math.inf)


@pytest.mark.parametrize("number", ODD)
def test_message_with_unreadable_number_is_left_out(number: float) -> None:
    assert not is_finite(pb.Battery(voltage_v=number))
    assert not is_finite(pb.Safety(loan=pb.Loan(to="mia", expires_in_s=number))), "also deep inside"


@pytest.mark.parametrize("name", ["", "Red", "red\u200b", "\u202eder", "<b>red</b>", "r\u0435d", "red ", "r" * 33])
def test_console_ignores_messages_under_invalid_car_names(name: str) -> None:
    assert is_shown("red")
    assert is_shown("@coordinator")
    assert not is_shown(name)
    sample = Sample(f"fleet/{name}/sensor/range", pb.Range(range_m=1.0).SerializeToString(), RANGE, time.time_ns(), 0)
    assert message_in(sample) is None


def test_all_others_are_taken() -> None:
    assert is_finite(pb.Battery(voltage_v=7.4))
    assert is_finite(pb.Health(capabilities=["drive"], platform="arduino"))
    assert is_finite(pb.Supervision(colors={"red": "#010203"}))
