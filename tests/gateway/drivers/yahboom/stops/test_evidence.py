"""Tests which readings show a stop, as tables, and which never do, as properties. Each case has a test.

The cars of the tables report every `INTERVAL_S`, and `MODE00` blocks them for `BLOCK_S`. Both were learned.
"""

from collections.abc import Callable

import pytest
from hypothesis import given
from hypothesis import strategies as st

from gateway.control.commands import Drive, Fan, SetMode, Stop
from gateway.control.driver import Rejected
from gateway.drivers.yahboom.estimate.learned import AGREEING_DELAYS, UNREACTED, Learned
from gateway.drivers.yahboom.protocol.frame_splitter import FrameSplitter
from gateway.drivers.yahboom.protocol.platforms import parse_platform
from gateway.drivers.yahboom.protocol.sensors import Sensors
from gateway.drivers.yahboom.stops import cases
from gateway.drivers.yahboom.stops.cases import StopCase
from gateway.drivers.yahboom.stops.evidence import (
    BLOCK_GAPS,
    EARLY_S,
    LATE_S,
    LONGER_S,
    ROUND_TRIP_S,
    WIRE_S,
    Finding,
    StopEvidence,
)
from gateway.sim.model.traits import CarTraits
from gateway.sim.model.world import World
from schemas.words import Basis, Blocking, Cause, Mode, Motion, Phase, Shows
from tests.gateway.control.workbench import Workbench
from tests.support.virtual import Pair

ECHO = b"$4WD,CSB57.24,PV7.91,GS5,LF0000,HW00,GM00#"
SILENT = b"$4WD,CSB0.00,PV7.91,GS5,LF0000,HW00,GM00#"
TRACKING = b"$4WD,CSB0,PV8,GS0,LF1001,HW00,GM00#"
NOTHING, REPORT, BLOCK_GAP, LOST = Finding.NOTHING, Finding.REPORT, Finding.BLOCK_GAP, Finding.LOST
SETTLING, SHOWN, CONTROL, UNJUDGED = Finding.SETTLING, Finding.SHOWN, Finding.CONTROL, Finding.UNJUDGED
ARDUINO = parse_platform("arduino")
INTERVAL_S, BLOCK_S = 1.25, 1.0
TOLERANCE_S = 0.05


def event(frame: bytes, at: float) -> Sensors:
    (found,) = FrameSplitter().feed(frame, at)
    assert isinstance(found, Sensors)
    return found


def known(interval_s: float = INTERVAL_S, *, shows: Shows = Shows.YES, spread_s: float = 0.0) -> Learned:
    """Return what was learned of a car that reports so often."""
    learned = Learned(shows=shows)
    for number in range(5):
        learned.echo.add(interval_s + spread_s * (number % 2 - 0.5))
    return learned


class EvidenceWatch:
    """A `StopEvidence` that receives written frames and readings in the order of a test."""

    def __init__(self, learned: Learned | None = None) -> None:
        self.learned = known() if learned is None else learned
        self.evidence = StopEvidence(ARDUINO, self.learned)
        self.evidence.begin_link()
        self.interval_s = self.learned.echo.median_s

    def reports(self, *times: float, frame: bytes = ECHO) -> list[Finding]:
        """Feed reports of mode 0. Return the findings."""
        return [self.evidence.on_reading(event(frame, at)) for at in times]

    def closed(self, at: float, *, awake: bool = True) -> None:
        """Record that `MODE00` was written."""
        self.evidence.on_mode_00(at, awake=awake)

    def gap(self, at: float, block_s: float = BLOCK_S) -> Finding:
        """Feed a report at `at`, a `MODE00`, and the report after its block gap. Return the finding."""
        self.reports(at)
        self.closed(at + 0.2)
        end = at + self.interval_s + block_s
        found = self.reports(end)[-1]
        settled = found is SETTLING and self.evidence.settle(end + self.evidence.settling_s)
        return SHOWN if settled else found


# ---------------------------------------------------------------------- mode 0, with an echo


@pytest.mark.parametrize(
    ("reports", "found"),
    [
        ([9.5, 11.75], [BLOCK_GAP]),
        ([8.8, 11.05], [BLOCK_GAP]),
        ([9.5, 11.75 - TOLERANCE_S - 0.01], [REPORT]),
        ([9.5, 11.75 + LONGER_S - 0.01], [BLOCK_GAP]),  # in doubt: one more is needed
        ([9.5, 11.75 + LONGER_S + 0.01], [REPORT]),
        ([9.5, 10.75, 12.0], [NOTHING, LOST]),
        ([9.98, 11.23], [LOST]),
        ([9.4, 10.65, 12.9], [NOTHING, BLOCK_GAP]),  # the car sent the second one before it read MODE00
        ([9.4, 10.65, 12.5], [NOTHING, REPORT]),  # another block, of a servo, lies between
        ([9.1, 10.9, 11.3], [NOTHING, NOTHING]),  # the link delayed a report, so the next one is too close
        ([11.5], [REPORT]),  # nothing is known about the time before this report
        ([], []),
    ],
)
def test_block_gap_around_mode00_is_found_once(reports: list[float], found: list[Finding]) -> None:
    watch = EvidenceWatch()
    before = [at for at in reports if at <= 10.0]
    watch.reports(*before)
    watch.closed(10.0)
    assert watch.reports(*(at for at in reports if at > 10.0)) == found
    assert (watch.evidence.reacted_at is not None) == (BLOCK_GAP in found)


@pytest.mark.parametrize("interval_s", [0.32, 0.71, 1.254, 1.493, 2.2, 3.0])
def test_two_block_gaps_show_a_stop_and_one_does_not(interval_s: float) -> None:
    watch = EvidenceWatch(known(interval_s))
    each_s = interval_s + BLOCK_S
    first = watch.gap(10.0)
    assert first is (CONTROL if watch.learned.is_confusable(BLOCK_S) else BLOCK_GAP)
    if first is CONTROL:
        watch.evidence.on_other_frame()
        assert watch.reports(10.0 + each_s + interval_s) == [REPORT]
        assert watch.gap(10.0 + each_s + 2 * interval_s) is SHOWN
    else:
        assert watch.gap(10.0 + each_s + interval_s) is SHOWN
    assert watch.evidence.words == "2 gaps in its reports, each after MODE00"
    assert BLOCK_GAPS == 2


def test_three_block_gaps_are_needed_if_one_exceeds_block() -> None:
    """A link that delays a report, and a damaged frame that opens mode 0 for 2.3 s, make two gaps like block gaps."""
    watch = EvidenceWatch()
    assert watch.gap(10.0, 1.4) is BLOCK_GAP
    assert watch.gap(10.0 + 2 * INTERVAL_S + 1.4) is BLOCK_GAP
    assert watch.gap(10.0 + 4 * INTERVAL_S + 1.4 + BLOCK_S) is SHOWN
    assert watch.evidence.words == "3 gaps in its reports, each after MODE00"


def test_block_gap_with_second_block_may_be_longer() -> None:
    watch = EvidenceWatch()
    watch.reports(10.0)
    watch.evidence.on_block(Blocking.WHISTLE, 0.3, 10.1)
    watch.closed(10.5)
    assert watch.reports(12.35) == [BLOCK_GAP]
    watch.closed(12.4)
    assert watch.reports(14.6) == [SETTLING], "neither was in doubt"


def test_only_last_stop_frame_is_judged() -> None:
    """A general stop after `MODE00` could become a motion on its way, and nothing would show it."""
    watch = EvidenceWatch()
    assert watch.gap(10.0) is BLOCK_GAP
    watch.closed(12.3)
    watch.evidence.on_other_frame()
    assert watch.reports(14.5) == [BLOCK_GAP]
    watch.closed(14.6)
    assert watch.reports(16.75) == [SETTLING]


def unlike(watch: EvidenceWatch, at: float, delay_s: float, *, closed_s: float = 0.5) -> list[Finding]:
    """Send `MODE00` so long after a report. The next report comes late by `delay_s`, the one after it on time."""
    watch.reports(at)
    watch.closed(at + closed_s)
    return watch.reports(at + INTERVAL_S + delay_s, at + 2 * INTERVAL_S + delay_s)


def test_delays_of_a_stop_before_show_no_other_stop() -> None:
    watch = EvidenceWatch()
    assert SETTLING in [found for number in range(3) for found in unlike(watch, 10.0 + 6 * number, 0.6)]
    watch.evidence.on_motion()
    watch.evidence.begin_stop()
    watch.learned.forget_reactions()
    for _ in range(2):
        watch.learned.add_delay(Blocking.MODE_CLOSE, 0.6, 10.0, controlled=False)
    assert SETTLING not in unlike(watch, 40.0, 0.6)


def test_delay_longer_than_time_since_mode_00_is_not_its_own() -> None:
    watch = EvidenceWatch()
    found = [each for number in range(4) for each in unlike(watch, 10.0 + 6 * number, 0.6, closed_s=INTERVAL_S + 0.4)]
    assert SETTLING not in found
    assert watch.learned.blocks == {}


def test_block_gaps_before_a_motion_do_not_count() -> None:
    watch = EvidenceWatch()
    assert watch.gap(40.0) is BLOCK_GAP
    watch.evidence.on_motion()
    assert watch.gap(43.5) is BLOCK_GAP, "the car may have moved since the first one"


def test_lost_report_differs_from_block_gap_by_length() -> None:
    """The link loses `MODE00` and the report after it, three times: 2.50 s, where a block gap is 2.25 s."""
    watch = EvidenceWatch()
    for number in range(3):
        assert watch.gap(10.0 + 5 * number, INTERVAL_S) not in (SETTLING, SHOWN)
    assert watch.learned.blocks == {}


@pytest.mark.parametrize("interval_s", [0.5, 1.0, 1.02])
def test_non_blocking_frame_is_control_where_ambiguous(interval_s: float) -> None:
    """A half-duplex link loses the report after each of our frames, and the car hears none of them."""
    watch, at = EvidenceWatch(known(interval_s)), 10.0
    watch.reports(at)
    for _ in range(20):
        found = None
        for number in range(1, 4):  # the link loses the reports of a second
            if number * interval_s > 1.0:
                found = watch.reports(at + number * interval_s)[-1]
                at += number * interval_s
                break
        assert found not in (SETTLING, SHOWN)
        if found is CONTROL:
            watch.evidence.on_other_frame()
        else:
            watch.closed(at + 0.01)
    assert watch.learned.shows is Shows.YES, "only a car that was never seen to react cannot show a stop"


@given(
    st.floats(0.3, 3.0),
    st.lists(st.floats(-0.02, 0.02), min_size=4, max_size=30),
    st.integers(0, 40),
    st.lists(st.tuples(st.integers(0, 29), st.floats(0.05, 0.95)), max_size=12),
)
def test_deaf_car_shows_nothing_even_with_lost_report(
    interval_s: float, spreads: list[float], lost: int, closings: list[tuple[int, float]]
) -> None:
    """The gateway writes `MODE00` at any times, and the car keeps reporting."""
    watch, at = EvidenceWatch(known(interval_s, spread_s=0.04)), 10.0
    for number, spread_s in enumerate(spreads):
        for _, after in sorted(each for each in closings if each[0] == number):
            watch.closed(at + after * interval_s)
        at += interval_s + spread_s
        if number != lost:
            assert watch.reports(at)[0] not in (SHOWN, SETTLING)


@given(st.lists(st.floats(0.01, 0.17), min_size=1, max_size=10))
def test_bunched_reports_begin_anew(gaps: list[float]) -> None:
    """The times of reports that a stuck link delivers at once do not show when the car sent them."""
    watch = EvidenceWatch()
    assert watch.gap(10.0) is BLOCK_GAP
    at = 12.25
    for gap_s in gaps:
        at += gap_s
        assert watch.reports(at) == [NOTHING]
    watch.closed(at + 0.1)
    assert watch.reports(at + 2.25)[-1] not in (SHOWN, SETTLING)


@pytest.mark.parametrize("interval_s", [0.3, 0.9, 1.25, 2.2])
def test_report_too_early_after_last_block_gap_was_held_by_link(interval_s: float) -> None:
    """The link holds a report for a second. The next one comes an interval after it was due."""
    watch = EvidenceWatch(known(interval_s))
    each_s = interval_s + BLOCK_S
    if watch.gap(10.0) is CONTROL:
        watch.evidence.on_other_frame()
    else:
        watch.evidence.on_other_frame()  # in both cases one interval without a MODE00
    at = 10.0 + each_s + interval_s
    watch.reports(at)
    watch.closed(at + 0.05)
    held_at = at + each_s
    assert watch.reports(held_at) == [SETTLING]
    assert SHOWN not in watch.reports(held_at + max(0.01, interval_s - BLOCK_S))
    assert not watch.evidence.settle(held_at + 20.0)


@pytest.mark.parametrize("when", ["before", "within"])
def test_damaged_bytes_begin_anew(when: str) -> None:
    watch = EvidenceWatch()
    watch.reports(10.0)
    if when == "before":
        watch.evidence.on_noise(10.2)
    watch.closed(10.5)
    if when == "within":
        watch.evidence.on_noise(10.9)
    assert watch.reports(12.25)[-1] not in (BLOCK_GAP, SHOWN, SETTLING)


def test_stop_frame_behind_own_block_shows_nothing() -> None:
    watch = EvidenceWatch()
    watch.reports(9.5)
    watch.closed(10.0, awake=False)
    assert watch.reports(10.75, 12.0) == [REPORT, REPORT]
    assert list(watch.learned.echo.intervals) == [INTERVAL_S] * 6, "the interval of that frame is no measure"


def test_reset_times_forgets_block_gap_after_loop_slept() -> None:
    watch = EvidenceWatch()
    assert watch.gap(10.0) is BLOCK_GAP
    watch.reports(13.5)
    watch.closed(13.9)
    watch.evidence.reset_times()
    assert watch.reports(15.75) == [REPORT]


def test_slow_link_has_more_time_from_second_try() -> None:
    watch = EvidenceWatch()
    watch.reports(9.5)
    watch.evidence.on_retry()
    watch.closed(10.0)
    assert watch.reports(10.75, 12.0) == [NOTHING, NOTHING]
    assert watch.reports(13.25) == [LOST]
    assert 12.0 - 10.0 <= ROUND_TRIP_S < 13.25 - 10.0


@pytest.mark.parametrize("without", range(3))
def test_report_without_echo_shows_no_stop(without: int) -> None:
    watch = EvidenceWatch()
    found = watch.reports(9.5, frame=SILENT if without == 0 else ECHO)
    watch.closed(10.0)
    found += watch.reports(11.75, frame=SILENT if without == 1 else ECHO)
    found += watch.reports(14.0, frame=SILENT if without == 2 else ECHO)
    assert found[without] is Finding.NO_ECHO
    assert SHOWN not in found
    assert (BLOCK_GAP in found) == (without == 2)


# ---------------------------------------------------------------------- what is learned


def test_block_gap_is_unjudged_before_rhythm_is_known() -> None:
    watch = EvidenceWatch(Learned())
    watch.closed(9.9)
    assert watch.reports(11.0) == [UNJUDGED]
    watch.closed(11.1)
    assert watch.reports(13.25) == [UNJUDGED]
    assert watch.reports(14.5) == [REPORT], "an undisturbed interval: 1.25 s"
    assert watch.learned.echo.median_s == pytest.approx(INTERVAL_S)
    watch.closed(14.6)
    assert watch.reports(16.75) == [BLOCK_GAP]


@pytest.mark.parametrize("block_s", [0.2, 0.5, 1.3, 1.8])
def test_three_delays_that_agree_are_the_block_of_this_car(block_s: float) -> None:
    watch = EvidenceWatch(known(shows=Shows.UNKNOWN))
    found = []
    for number in range(6):
        at = 10.0 + number * (3 * INTERVAL_S + block_s)
        found.append(watch.gap(at, block_s))
        watch.evidence.on_other_frame()
        watch.reports(at + 2 * INTERVAL_S + block_s)  # the control: on time
    assert SHOWN in found
    assert found.index(SHOWN) + 1 >= AGREEING_DELAYS
    assert watch.evidence.close_s == pytest.approx(block_s)
    assert watch.learned.shows is Shows.YES


def test_car_that_never_reacts_cannot_show_stop() -> None:
    watch = EvidenceWatch(known(shows=Shows.UNKNOWN))
    found_out = []
    for number in range(UNREACTED):
        assert watch.gap(10.0 + 5 * number, 0.0) is LOST
        found_out.append(watch.evidence.changed_expectation)
    assert found_out == [False] * (UNREACTED - 1) + [True]
    assert watch.learned.shows is Shows.NO


def test_car_that_showed_stop_stays_able_to_show() -> None:
    watch = EvidenceWatch()
    for number in range(3 * UNREACTED):
        assert watch.gap(10.0 + 5 * number, 0.0) is LOST
    assert watch.learned.shows is Shows.YES


def test_whistle_that_delays_report_counts_as_reaction() -> None:
    watch = EvidenceWatch(known(shows=Shows.UNKNOWN))
    for number in range(UNREACTED - 1):
        watch.gap(10.0 + 5 * number, 0.0)
    watch.reports(40.0)
    watch.evidence.on_block(Blocking.WHISTLE, 0.3, 40.1)
    watch.reports(40.0 + INTERVAL_S + 0.304)
    assert watch.gap(50.0, 0.0) is LOST
    assert watch.learned.shows is Shows.UNKNOWN, "the count began anew"


@pytest.mark.parametrize("interval_s", [0.5, 2.0])
def test_changed_report_interval_resets_shown_evidence(interval_s: float) -> None:
    watch, at = EvidenceWatch(), 10.0
    for _ in range(5):
        watch.reports(at)
        at += interval_s
    assert watch.learned.echo.median_s == pytest.approx(interval_s)
    assert watch.learned.shows is Shows.UNKNOWN


# ---------------------------------------------------------------------- a mode that was left


def tracking(until: float, learned: Learned | None = None) -> EvidenceWatch:
    """Return the evidence of a car that reports in tracking."""
    watch = EvidenceWatch(learned)
    watch.evidence.on_mode_opened(Mode.TRACKING, 0.0, silent=False, shown=True)
    for number in range(40):
        assert watch.evidence.on_reading(event(TRACKING, until - 2.0 + 0.05 * number)) is NOTHING
    return watch


def silent(*, shown: bool = True) -> EvidenceWatch:
    """Return the evidence of a car with color LED mode opened at 5.0."""
    watch = EvidenceWatch()
    watch.reports(4.9)
    watch.evidence.on_mode_opened(Mode.COLOR_LED, 5.0, silent=True, shown=shown)
    return watch


LEFT_S = ARDUINO.reopened_s + WIRE_S
"""The latest report that shows the end of a mode of a car that reports every `INTERVAL_S`."""


@pytest.mark.parametrize(
    ("frame", "after_s", "shown"),
    [
        (ECHO, BLOCK_S - EARLY_S - 0.01, False),
        (ECHO, BLOCK_S - EARLY_S + 0.01, True),
        (ECHO, 1.95, True),
        (ECHO, LEFT_S - 0.001, True),
        (ECHO, LEFT_S + 0.01, False),
        (SILENT, LEFT_S + ARDUINO.ranging_s - 0.01, True),
        (SILENT, LEFT_S + ARDUINO.ranging_s + 0.01, False),
        (ECHO, 3.31, False),
    ],
)
@pytest.mark.parametrize("mode", [Mode.TRACKING, Mode.COLOR_LED], ids=str)
def test_mode_0_report_after_mode00_shows_left_mode(mode: Mode, frame: bytes, after_s: float, *, shown: bool) -> None:
    watch = tracking(10.0) if mode is Mode.TRACKING else silent()
    watch.closed(10.0)
    assert (watch.reports(10.0 + after_s, frame=frame)[-1] is SHOWN) == shown
    if shown:
        assert "a report of mode 0" in watch.evidence.words
        assert ("out of color_led" in watch.evidence.words) == (mode is Mode.COLOR_LED)


@pytest.mark.parametrize("shows", [Shows.UNKNOWN, Shows.NO])
def test_only_blocking_car_shows_left_mode_by_one_report(shows: Shows) -> None:
    """A car that reports by a timer does so in the middle of a block, with the motors on."""
    watch = tracking(10.0, known(shows=shows))
    watch.closed(10.0)
    assert watch.reports(11.5) == [BLOCK_GAP]


def test_general_stop_after_mode00_leaves_left_mode_unshown() -> None:
    watch = tracking(10.0)
    watch.closed(10.0)
    watch.evidence.on_other_frame()
    assert watch.reports(11.5) == [BLOCK_GAP]


@pytest.mark.parametrize(
    ("late_s", "found"),
    [(0.01, [BLOCK_GAP, SETTLING]), (LATE_S - 0.01, [BLOCK_GAP, SETTLING]), (LATE_S + 0.01, [REPORT, BLOCK_GAP])],
)
@pytest.mark.parametrize("mode", [Mode.TRACKING, Mode.COLOR_LED], ids=str)
def test_single_report_on_slow_link_counts_as_block_gap(mode: Mode, late_s: float, found: list[Finding]) -> None:
    watch = tracking(10.0) if mode is Mode.TRACKING else silent()
    watch.closed(10.0)
    at = 10.0 + LEFT_S + late_s
    results = watch.reports(at)
    watch.closed(at + 0.02)
    assert [*results, *watch.reports(at + INTERVAL_S + BLOCK_S)] == found


@pytest.mark.parametrize("mode", [Mode.TRACKING, Mode.COLOR_LED], ids=str)
@pytest.mark.parametrize("first", ["other", "closed"])
def test_stop_is_not_shown_if_mode00_was_not_first_frame(mode: Mode, first: str) -> None:
    watch = tracking(10.0) if mode is Mode.TRACKING else silent()
    if first == "other":
        watch.evidence.on_other_frame()
    else:
        watch.closed(9.0)
    watch.closed(10.0)
    assert watch.reports(11.95)[-1] is not SHOWN


def test_mode_shape_long_after_mode00_shows_the_opposite() -> None:
    watch = tracking(10.0)
    watch.closed(10.0)
    for number in range(30):
        watch.evidence.on_reading(event(TRACKING, 10.0 + 0.05 * number))
    assert watch.reports(12.3)[-1] is not SHOWN


def test_single_reading_confirms_no_mode() -> None:
    watch = EvidenceWatch()
    watch.evidence.on_mode_opened(Mode.TRACKING, 0.0, silent=False, shown=True)
    watch.evidence.on_reading(event(TRACKING, 9.0))
    watch.closed(10.0)
    assert watch.reports(11.95)[-1] is not SHOWN


def test_silent_mode_opened_from_unshown_rest() -> None:
    watch = silent(shown=False)
    watch.closed(10.0)
    assert watch.reports(11.95)[-1] is not SHOWN


@given(st.floats(0.0, 4.0))
def test_old_reports_of_slow_link_do_not_show_left_mode(delay_s: float) -> None:
    """The car sent these reports once a second before its mode opened at 5.0. They come until `delay_s` later."""
    watch = silent()
    closed_at = 5.0 + delay_s - 1.0
    times = [4.95 + number for number in range(1, 5) if 4.95 + number <= 5.0 + delay_s]
    found = watch.reports(*(at for at in times if at <= closed_at))
    watch.closed(closed_at)
    found += watch.reports(*(at for at in times if at > closed_at))
    assert SHOWN not in found


@given(st.floats(0.0, ARDUINO.shortest_opening_s - LATE_S - 0.01))
def test_report_without_silence_of_opening_shows_no_stop(quiet_s: float) -> None:
    watch = silent()
    watch.reports(12.0 - quiet_s if quiet_s else 12.0)
    watch.closed(10.5)
    assert watch.reports(12.0)[-1] is not SHOWN


# ---------------------------------------------------------------------- each row of the table, with a car


def ended(pair: Pair, what: Stop | Drive = Stop()) -> tuple[Phase, str, str]:  # noqa: B008 - a value
    pair.ask(what, identity="it")
    pair.until(lambda: pair.last_of("it") is not None, 20.0)
    last = pair.last_of("it")
    assert last is not None
    return last.phase, last.basis, last.words or " ".join(last.evidence)


def in_mode(mode: Mode) -> Pair:
    pair = Pair(start_s=2.0).ready()
    pair.until(lambda: pair.control.driver.model.trust.shown, 9.0)
    pair.ask(SetMode(mode))
    pair.run(9.0)
    return pair


def driven(
    platform: str = "arduino",
    *,
    world: World | None = None,
    told: str | None = None,
    traits: CarTraits | None = None,
) -> Pair:
    pair = Pair(platform, world=world, told=told, start_s=2.0, traits=traits)
    pair.connect()
    pair.run(15.0)
    pair.ask(Drive(Motion.FORWARD, 10.0))
    pair.run(2.0)
    return pair


def fan() -> Pair:
    pair = Pair(start_s=2.0).ready()
    pair.ask(Fan())
    pair.run(2.0)
    return pair


ROWS = [
    (cases.LEFT_SHAPE, lambda: in_mode(Mode.TRACKING), "out of the mode that it reported"),
    (cases.LEFT_SILENT, lambda: in_mode(Mode.REMOTE_CONTROL), "out of remote_control"),
    (cases.MANUAL, driven, "2 gaps in its reports"),
    (cases.NO_ECHO, lambda: driven(world=World.open_field()), "no sonar echo"),
    (cases.FAN, fan, "while its fan runs"),
    (cases.RASPBERRY_PI, lambda: driven("raspberry_pi"), "a Raspberry Pi car never confirms a stop"),
    (cases.UNKNOWN_PLATFORM, lambda: driven("raspberry_pi", told="unknown"), "is not known"),
    (cases.NO_REACTION, lambda: driven("stm32"), "do not react to frames"),
    (cases.NO_READINGS, lambda: driven(told="arduino+no_readings", traits=CarTraits(readings=False)), "no readings"),
]


@pytest.mark.parametrize(("case", "situation", "words"), ROWS, ids=[row[0].name for row in ROWS])
def test_stop_case_decides_phase_and_basis(case: StopCase, situation: Callable[[], Pair], words: str) -> None:
    pair = situation()
    phase, basis, said = ended(pair)
    shown = case in (cases.LEFT_SHAPE, cases.LEFT_SILENT, cases.MANUAL)
    assert (phase, basis) == ((Phase.COMPLETE, Basis.SHOWN) if shown else (Phase.SENT, Basis.SENT))
    assert words in said
    assert (pair.control.driver.model.motors, pair.control.driver.model.basis) == ("off", basis)
    assert bool(case.shown_by) == shown
    assert not pair.car.truth.driving
    assert shown or pair.control.driver.model.rest_case is case


def test_soft_stop_is_only_sent() -> None:
    """The row `soft`: the release of a drive, and the rest after it, are only sent."""
    pair = driven()
    assert ended(pair, Drive(Motion.STOP)) == (Phase.SENT, Basis.SENT, cases.SOFT.why("red"))
    assert (pair.control.driver.model.motors, pair.control.driver.model.basis) == ("off", Basis.SENT)
    assert pair.control.driver.model.rest_case is cases.SOFT


def test_frame_at_shown_rest_leaves_it_sent() -> None:
    """The row `acted`."""
    pair = Pair(start_s=2.0).ready()
    pair.until(lambda: pair.control.driver.model.basis == Basis.SHOWN, 9.0)
    pair.ask(Fan())
    assert (pair.control.driver.model.motors, pair.control.driver.model.basis) == ("off", Basis.SENT)
    assert pair.control.driver.model.rest_case is cases.ACTED


def test_stop_cases_are_all_tested() -> None:
    elsewhere = {cases.SOFT, cases.ACTED, cases.WRONG_PLATFORM, cases.NOT_KNOWN}  # test_wrong_platform.py
    assert {row[0] for row in ROWS} | elsewhere == set(cases.CASES)


def test_line_ends_between_reports_hide_no_block_gap(monkeypatch: pytest.MonkeyPatch) -> None:
    """CR and LF may follow `#` (docs/reference/protocol.md#framing)."""
    desk = Workbench().ready()
    hear = desk.hear

    def hear_a_line(frame: bytes = b"") -> None:
        hear(frame)
        desk.control.driver.on_event(Rejected(b"\r\n", desk.now, Cause.NO_START), desk.now)

    monkeypatch.setattr(desk, "hear", hear_a_line)
    desk.ask(Drive(Motion.FORWARD, 5.0))
    desk.run(2.0)
    desk.ask(Stop(), identity="stop")
    desk.run(9.0)
    assert desk.end("stop")[0] is Phase.COMPLETE
