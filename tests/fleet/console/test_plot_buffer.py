"""The values that a page plots."""

import json

import pytest

from fleet.console.page_requests import BadPageMessage, PageMessage
from fleet.console.plot_buffer import MAX_BUFFERED_VALUES, PlotBuffer, Series, plottable, series_of
from schemas.gen import fleet_v1_pb2 as pb


def test_values_come_once_by_the_number_of_their_series() -> None:
    buffer = PlotBuffer([Series("red", "sensor/range", "range_m"), Series("red", "sensor/line", "left_inner")])
    message = pb.Range(range_m=1.5)
    message.stamp.FromMilliseconds(1234)
    buffer.add("red", "sensor/range", message)
    buffer.add("red", "sensor/range", pb.Range(no_echo=True))
    buffer.add("blue", "sensor/range", message)
    buffer.add("red", "sensor/line", pb.Line(left_inner=True))
    assert buffer.take() == {0: [(1234, 1.5)], 1: [(0, 1.0)]}
    assert buffer.take() == {}


def test_page_that_reads_nothing_costs_no_more_memory() -> None:
    buffer = PlotBuffer([Series("red", "sensor/line", "left_inner")])
    for _ in range(MAX_BUFFERED_VALUES + 10):
        buffer.add("red", "sensor/line", pb.Line())
    assert len(buffer.take()[0]) == MAX_BUFFERED_VALUES


def test_only_numbers_and_lamps_can_be_plotted() -> None:
    offered = {(topic, field) for topic, field, _ in plottable()}
    assert ("sensor/range", "range_m") in offered
    assert ("sensor/line", "left_inner") in offered
    assert ("state/link", "reason") not in offered


@pytest.mark.parametrize(
    "series",
    [
        None,
        "x",
        [["red"]],
        [["red", "sensor/range", "car"]],
        [["*", "sensor/range", "range_m"]],
        [[1, 2, 3]],
        [["red", "sensor/range", "range_m"]] * 81,
    ],
)
def test_bad_series_are_refused(series: object) -> None:
    with pytest.raises(BadPageMessage):
        series_of(PageMessage.of(json.dumps({"series": series})))
