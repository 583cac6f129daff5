"""Another process can return the readings and errors of the SDK."""

import pickle
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context

import pytest

from fleet.client.outcome import LeaseLost, NotCarriedOut, Outcome
from fleet.client.reading import Reading
from fleet.client.wait import NotInTime
from fleet.conditions.condition_parser import BadExpression
from fleet.recording.tools.table_formats import FormatMissing
from schemas.bus import NoFleet
from schemas.gen import fleet_v1_pb2 as pb
from schemas.yaml_document.document import BadFile, Problem

READING = Reading.of("fleet/red/sensor/range", pb.Range(car="red", range_m=1.5), 10**18)
ERRORS = (
    NotCarriedOut(Outcome("red", ok=False, phase="failed"), "it failed"),
    LeaseLost(Outcome("red", ok=False, phase="rejected", reason="leased")),
    NotInTime("the condition did not hold in time", READING),
    BadExpression("range_m <", 9, "a number is missing"),
    FormatMissing("pyarrow"),
    NoFleet("nothing answers", "tcp/127.0.0.1:7447"),
    BadFile("fleet.yaml", [Problem(1, 2, "cars", "is missing")]),
)


def test_reading() -> None:
    assert pickle.loads(pickle.dumps(READING)) == READING


@pytest.mark.parametrize("error", ERRORS, ids=lambda error: type(error).__name__)
def test_error(error: Exception) -> None:
    again = pickle.loads(pickle.dumps(error))
    assert type(again) is type(error)
    assert (str(again), vars(again)) == (str(error), vars(error))


def fail() -> None:
    raise ERRORS[2]


def test_error_of_worker_process() -> None:
    """A pool whose worker raises an error that cannot be made again is broken for all its jobs."""
    with ProcessPoolExecutor(1, mp_context=get_context("spawn")) as pool, pytest.raises(NotInTime):
        pool.submit(fail).result(60)
