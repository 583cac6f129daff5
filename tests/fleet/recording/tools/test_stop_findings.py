"""Which stops of a session were not shown: car, time and cause, each once."""

from collections.abc import Iterator

import pytest
from foxglove_schemas_protobuf.Log_pb2 import Log

from fleet.recording.tools.moment import Known
from fleet.recording.tools.recorder_clock import WINDOW_NS, RecorderClock
from fleet.recording.tools.stop_findings import StopFindings
from schemas import keys
from schemas.gen import fleet_v1_pb2 as pb
from tests.support.zones import zone

SECOND_NS = 1_000_000_000
NOON_NS = 1_795_608_000 * SECOND_NS  # 2026-11-25 12:00 UTC
NOT_REACTED = "NOT CONFIRMED: red has not reacted to the stop yet. Look at the car. The gateway keeps stopping it."


@pytest.fixture(autouse=True)
def _in_berlin() -> Iterator[None]:
    with zone("CET-1"):
        yield


def failed(verb: str = "stop", reason: str = "not_shown", words: str = NOT_REACTED) -> pb.CommandEvent:
    return pb.CommandEvent(car="red", verb=verb, sender="mia", phase="failed", reason=reason, words=words)


def logged(code: str, words: str = NOT_REACTED) -> Log:
    return Log(name=f"red {code}", message=words)


def test_stop_finding_has_car_time_person_cause_once() -> None:
    found = StopFindings()
    health = pb.Health(shows_stops="yes", doubted=True, shows_stops_words="red is in doubt")
    for at_s, topic, message in (
        (0, "state/link", pb.Link(state="lost", reason="unplugged")),
        (0, "state/health", health),
        (0, "event/command", failed()),
        (1, "event/log", logged("not_shown")),
        (1, "event/command", pb.CommandEvent(verb="drive", phase="failed", reason="link_down")),
    ):
        found.add("red", topic, message, NOON_NS + at_s * SECOND_NS)
    (stop,) = found.stops
    assert (stop.car, stop.code, stop.asked) == ("red", "not_shown", "stop by mia")
    assert stop.cause == "its link was lost (unplugged), red is in doubt"
    assert stop.as_dict()["at"] == "13:00:00 CET"
    assert "red at 13:00:00 CET" in stop.describe()


def test_log_alone_is_enough_and_not_stopped_weighs_more() -> None:
    found = StopFindings()
    words = "red may still be moving: red has not reacted to the stop."
    found.add("red", "event/log", logged("not_stopped", words), NOON_NS)
    found.add("red", "event/command", failed(words="has not reacted to the stop"), NOON_NS)
    (stop,) = found.stops
    assert (stop.code, stop.asked, stop.cause) == ("not_stopped", "stop by mia", "")


def test_two_stops_are_two() -> None:
    found = StopFindings()
    unreachable = failed(verb="estop", reason="link_down", words="red is unreachable")
    for car, at_s, event in (
        ("red", 0, failed()),
        ("red", 60, failed()),
        ("blue", 60, failed()),
        ("red", 61, unreachable),
    ):
        found.add(car, "event/command", event, NOON_NS + at_s * SECOND_NS)
    assert [(each.car, each.code) for each in found.stops] == [
        ("red", "not_shown"),
        ("red", "not_shown"),
        ("blue", "not_shown"),
        ("red", "not_stopped"),
    ]
    assert len(found.of("not_stopped")) == 1


def test_stop_that_ended_as_sent_is_no_finding() -> None:
    found = StopFindings()
    found.add("red", "event/command", pb.CommandEvent(verb="stop", phase="sent", basis="sent"), NOON_NS)
    found.add("red", "event/command", pb.CommandEvent(verb="stop", phase="complete", basis="shown"), NOON_NS)
    assert found.stops == []


SHORT_NS = SECOND_NS // 100


def test_stamps_of_a_wrong_clock_become_times_of_the_recorder() -> None:
    recorder_clock, wrong_ns = RecorderClock(), 2 * 3600 * SECOND_NS
    for second in range(100):
        at_ns = NOON_NS + second * SECOND_NS
        assert recorder_clock.at_ns("red", at_ns - wrong_ns, at_ns + SHORT_NS) == at_ns + SHORT_NS
    # A backfilled message comes 20 s late, and is still of its own time.
    late_ns = NOON_NS + 100 * SECOND_NS
    assert recorder_clock.at_ns("red", late_ns - wrong_ns, late_ns + 20 * SECOND_NS) == late_ns + SHORT_NS
    assert recorder_clock.at_ns("blue", late_ns, late_ns) == late_ns


def test_clock_that_is_set_back_puts_nothing_before_its_past() -> None:
    """For a minute, everything after the step seemed to have happened an hour before, and stood before the rest."""
    recorder_clock, found, key = RecorderClock(), list[int](), keys.parse("fleet/red/state/mode")
    assert key is not None
    for second in range(100):
        at_ns = NOON_NS + second * SECOND_NS
        stamp_ns = at_ns - (3600 * SECOND_NS if second >= 50 else 0)
        mode = pb.Mode(boot_id="a start", seq=second + 1)
        mode.stamp.seconds, mode.stamp.nanos = divmod(stamp_ns, SECOND_NS)
        late_ns = 5 * SECOND_NS if second in (20, 80) else SHORT_NS
        known = Known(key, mode, at_ns + late_ns, stamp_ns)
        found.append(recorder_clock.time_ns(known) - at_ns)
    assert found == [SHORT_NS] * 100


def test_step_of_the_recorders_clock_counts_after_two_windows() -> None:
    recorder_clock, step_ns = RecorderClock(), 3600 * SECOND_NS
    recorder_clock.at_ns("red", NOON_NS, NOON_NS)
    for second in range(3 * WINDOW_NS // SECOND_NS):
        at_ns = NOON_NS + second * SECOND_NS
        found_ns = recorder_clock.at_ns("red", at_ns, at_ns + step_ns)
    assert found_ns == at_ns + step_ns
