"""The console leaves out messages of the bus with numbers that are not finite."""

import math

import pytest

from fleet.console.bus_message import is_finite
from schemas.gen import fleet_v1_pb2 as pb

ODD = (math.nan, math.inf, -math.inf)


@pytest.mark.parametrize("number", ODD)
def test_a_message_with_a_number_that_no_page_can_read_is_left_out(number: float) -> None:
    assert not is_finite(pb.Battery(voltage_v=number))
    assert not is_finite(pb.Safety(loan=pb.Loan(to="mia", expires_in_s=number))), "also deep inside"


def test_all_others_are_taken() -> None:
    assert is_finite(pb.Battery(voltage_v=7.4))
    assert is_finite(pb.Health(capabilities=["drive"], platform="arduino"))
    assert is_finite(pb.Supervision(colors={"red": "#010203"}))
