"""Tests which readings show a stop, as tables, and which never do, as properties. Each row of EVIDENCE has a test."""

from collections.abc import Callable

import pytest
from hypothesis import given
from hypothesis import strategies as st

from gateway.control.commands import Drive, Fan, Phase, SetMode, Stop
from gateway.control.estimate.trust import Basis
from gateway.control.stops.evidence import (
    BUNCHED_S,
    CLOSED_S,
    EVIDENCE,
    LATE_S,
    LEFT_S,
    MATCH_S,
    NORMAL_MAX_S,
    OPENING_SILENCE_S,
    PAUSE_MAX_S,
    PAUSE_MIN_S,
    PAUSES,
    RANGING_S,
    ROUND_TRIP_S,
    SETTLING_S,
    Finding,
    StopCase,
    StopEvidence,
)
from gateway.protocol.decoder import Decoder
from gateway.protocol.enums import Cause, Mode, Motion
from gateway.protocol.events import Rejected
from gateway.protocol.sensors import Sensors
from gateway.sim.model.world import World
from tests.gateway.control.workbench import Workbench
from tests.support.virtual import Pair

ECHO = b"$4WD,CSB57.24,PV7.91,GS5,LF0000,HW00,GM00#"
SILENT = b"$4WD,CSB0.00,PV7.91,GS5,LF0000,HW00,GM00#"
TRACKING = b"$4WD,CSB0,PV8,GS0,LF1001,HW00,GM00#"
NOTHING, REPORT, PAUSE, LOST = Finding.NOTHING, Finding.REPORT, Finding.PAUSE, Finding.LOST
SETTLING, SHOWN = Finding.SETTLING, Finding.SHOWN


def event(frame: bytes, at: float) -> Sensors:
    (found,) = Decoder().feed(frame, at)
    assert isinstance(found, Sensors)
    return found


class EvidenceWatch:
    """A `StopEvidence` that receives written frames and readings in the order of a test."""

    def __init__(self) -> None:
        self.evidence = StopEvidence()
        self.evidence.begin_link()

    def reports(self, *times: float, frame: bytes = ECHO) -> list[Finding]:
        """Feed reports of mode 0. Return the findings."""
        return [self.evidence.on_reading(event(frame, at)) for at in times]

    def closed(self, at: float, *, awake: bool = True) -> None:
        """Record that `MODE00` was written."""
        self.evidence.closed(at, awake=awake)

    def pause(self, at: float) -> Finding:
        """Feed a report at `at`, a `MODE00`, and the report after its pause. Return the finding."""
        self.reports(at)
        self.closed(at + 0.5)
        found = self.reports(at + 1.95)[-1]
        return SHOWN if found is Finding.SETTLING and self.evidence.settle(at + 1.95 + SETTLING_S) else found


# ---------------------------------------------------------------------- mode 0, with an echo


@pytest.mark.parametrize(
    ("reports", "found"),
    [
        ([9.5, 11.45], [PAUSE]),
        ([9.05, 11.0], [PAUSE]),
        ([9.5, 9.5 + PAUSE_MIN_S - 0.01], [REPORT]),
        ([9.5, 9.5 + PAUSE_MAX_S + 0.01], [REPORT]),
        ([9.5, 10.5, 11.5], [NOTHING, LOST]),
        ([9.98, 10.98], [LOST]),
        ([9.1, 10.1, 11.1], [NOTHING, LOST]),
        ([9.4, 10.4, 12.35], [NOTHING, PAUSE]),  # a slow link: the car sent the second one before MODE00 came
        ([9.4, 10.4, 11.95], [NOTHING, REPORT]),  # another block, of a servo, lies between
        ([9.1, 10.6, 11.1], [NOTHING, NOTHING]),  # the link delayed a report, so the next one is too close
        ([9.4, 10.4, 13.4], [NOTHING, REPORT]),  # a report was lost
        ([10.5, 11.5], [NOTHING, LOST]),
        ([11.5], [REPORT]),  # nothing is known about the time before this report
        ([], []),
    ],
)
def test_one_pause_around_a_mode00(reports: list[float], found: list[Finding]) -> None:
    watch = EvidenceWatch()
    before = [at for at in reports if at <= 10.0]
    watch.reports(*before)
    watch.closed(10.0)
    assert watch.reports(*(at for at in reports if at > 10.0)) == found
    assert (watch.evidence.obeyed_at is not None) == (PAUSE in found)


def test_two_pauses_show_a_stop_and_one_does_not() -> None:
    watch = EvidenceWatch()
    assert watch.pause(10.0) is PAUSE
    assert watch.pause(12.95) is SHOWN
    assert watch.evidence.words == "2 pauses in its reports, each after MODE00"
    assert PAUSES == 2


@pytest.mark.parametrize(
    ("reports", "acts", "found"),
    [
        ((9.0, 10.0, 12.0, 14.0), (), [PAUSE, SETTLING]),
        ((9.0, 10.0, 12.0, 14.0 + MATCH_S - 0.01), (), [PAUSE, SETTLING]),
        ((9.0, 10.0, 12.0, 14.0 + MATCH_S + 0.01, 16.2), (), [PAUSE, PAUSE, SETTLING]),
        ((9.0, 10.0, 12.0 + MATCH_S + 0.01, 14.2, 16.2), (), [PAUSE, PAUSE, SETTLING]),
        ((8.9, 10.0, 11.97, 14.0), (), [PAUSE, PAUSE]),
        ((10.0, 12.2, 14.4), (), [PAUSE, SETTLING]),  # no interval is known yet: the first pause is the measure
        ((10.0, 12.2, 14.2, 16.3), (), [PAUSE, PAUSE, SETTLING]),
        ((9.0, 10.3, 12.3, 14.3), (9.5,), [PAUSE, SETTLING]),  # an interval with a whistle is longer and does not count
        ((9.0, 10.0, 12.3, 14.3), (10.2,), [PAUSE, SETTLING]),
        ((9.0, 10.0, 12.3 + MATCH_S + 0.01, 14.4), (10.2,), [PAUSE, PAUSE]),
    ],
)
def test_three_pauses_are_needed_if_one_is_not_as_long_as_mode00_makes_it(
    reports: tuple[float, ...], acts: tuple[float, ...], found: list[Finding]
) -> None:
    """A link that delays a report, and a damaged frame that opens mode 0 for 2.3 s, make two gaps like pauses."""
    watch, results = EvidenceWatch(), []
    for at in sorted({*reports, *acts}):
        if at in acts:
            watch.evidence.blocked(0.3)
            continue
        results += watch.reports(at)
        if at >= 10.0:
            watch.closed(at + 0.1)
    assert results[-len(found) :] == found


def test_after_a_lost_mode00_the_interval_is_still_known() -> None:
    """After a lost `MODE00`, the link delays a report for 0.9 s, and a damaged frame opens mode 0 for 2.3 s."""
    watch = EvidenceWatch()
    watch.reports(9.0, 10.0)
    watch.closed(10.1)
    assert watch.reports(11.0, 12.0) == [NOTHING, LOST]
    watch.closed(12.05)
    assert watch.reports(13.92) == [PAUSE]
    watch.closed(13.93)
    assert watch.reports(16.33) == [PAUSE]


def test_two_pauses_are_needed_after_a_shown_stop_too() -> None:
    watch = EvidenceWatch()
    watch.pause(10.0)
    assert watch.pause(12.95) is SHOWN
    assert watch.pause(20.0) is PAUSE
    assert watch.pause(22.95) is SHOWN
    assert watch.pause(40.0) is PAUSE
    watch.evidence.sent_motion()
    assert watch.pause(42.95) is PAUSE, "the car may have moved since the first one"


def test_a_lost_report_makes_the_same_gap_as_a_pause_and_is_not_enough() -> None:
    """The link loses `MODE00`, the report after it, and the next `MODE00`."""
    watch = EvidenceWatch()
    watch.reports(10.0)
    watch.closed(10.5)
    assert watch.reports(12.0) == [PAUSE], "the report at 11.0 was lost"
    watch.closed(12.1)
    assert watch.reports(13.0, 14.0) == [NOTHING, LOST]
    assert watch.pause(15.0) is PAUSE, "the first one counts no more"


@given(
    st.lists(st.floats(0.97, 1.03), min_size=4, max_size=30),
    st.integers(0, 40),
    st.lists(st.tuples(st.integers(0, 29), st.floats(0.05, 0.95)), max_size=12),
)
def test_a_car_that_hears_nothing_shows_nothing_also_where_one_report_is_lost(
    gaps: list[float], lost: int, closings: list[tuple[int, float]]
) -> None:
    """The gateway writes `MODE00` at any times, and the car keeps reporting."""
    watch, at = EvidenceWatch(), 10.0
    for number, gap_s in enumerate(gaps):
        for _, after_s in sorted(each for each in closings if each[0] == number):
            watch.closed(at + after_s)
        at += gap_s
        if number != lost:
            assert watch.reports(at)[0] not in (SHOWN, Finding.SETTLING)


@given(st.lists(st.floats(0.01, BUNCHED_S - 0.02), min_size=1, max_size=10))
def test_bunched_reports_begin_anew(gaps: list[float]) -> None:
    """The times of reports that a stuck link delivers at once do not show when the car sent them."""
    watch = EvidenceWatch()
    assert watch.pause(10.0) is PAUSE
    at = 11.95
    for gap_s in gaps:
        at += gap_s
        assert watch.reports(at) == [NOTHING]
    watch.closed(at + 0.1)
    assert watch.reports(at + 1.95)[-1] not in (SHOWN, Finding.SETTLING)
    assert watch.pause(at + 2.95) is PAUSE


def test_a_report_that_follows_the_second_pause_at_once_was_held_by_the_link() -> None:
    """The link holds two reports for 2.0 s, and loses the second `MODE00`."""
    watch = EvidenceWatch()
    assert watch.pause(10.0) is PAUSE
    watch.closed(12.0)
    assert watch.reports(13.95, 14.05) == [Finding.SETTLING, NOTHING]
    assert not watch.evidence.settle(20.0)
    assert watch.pause(21.0) is PAUSE, "the first one counts no more"


@pytest.mark.parametrize("when", ["before", "within"])
def test_damaged_bytes_begin_anew(when: str) -> None:
    watch = EvidenceWatch()
    watch.reports(10.0)
    if when == "before":
        watch.evidence.on_noise(10.2)
    watch.closed(10.5)
    if when == "within":
        watch.evidence.on_noise(10.9)
    assert watch.reports(11.95)[-1] not in (PAUSE, SHOWN, Finding.SETTLING)


def test_what_is_written_behind_a_block_of_ours_shows_nothing() -> None:
    watch = EvidenceWatch()
    watch.reports(9.5)
    watch.closed(10.0, awake=False)
    assert watch.reports(10.5, 11.5) == [REPORT, REPORT]


def test_a_loop_that_slept_has_perhaps_taken_reports_late() -> None:
    watch = EvidenceWatch()
    assert watch.pause(10.0) is PAUSE
    watch.reports(12.95)
    watch.closed(13.4)
    watch.evidence.reset_times()
    assert watch.reports(14.9) == [REPORT]


def test_from_the_second_try_on_a_slow_link_has_more_time() -> None:
    watch = EvidenceWatch()
    watch.reports(9.5)
    watch.evidence.tried_again()
    watch.closed(10.0)
    assert watch.reports(10.5, 11.5) == [NOTHING, NOTHING]
    assert watch.reports(12.5, 13.5) == [NOTHING, LOST]
    assert 12.5 - 10.0 <= ROUND_TRIP_S < 13.5 - 10.0


@pytest.mark.parametrize("without", range(3))
def test_a_ranging_without_echo_takes_a_second_and_shows_nothing(without: int) -> None:
    watch = EvidenceWatch()
    found = watch.reports(9.5, frame=SILENT if without == 0 else ECHO)
    watch.closed(10.0)
    found += watch.reports(11.45, frame=SILENT if without == 1 else ECHO)
    found += watch.reports(13.4, frame=SILENT if without == 2 else ECHO)
    assert found[without] is Finding.NO_ECHO
    assert SHOWN not in found
    assert (PAUSE in found) == (without == 2)


# ---------------------------------------------------------------------- a mode that was left


def tracking(until: float) -> EvidenceWatch:
    """Return the evidence of a car that reports in tracking."""
    watch = EvidenceWatch()
    watch.evidence.opened(Mode.TRACKING, 0.0, silent=False, shown=True)
    for number in range(40):
        assert watch.evidence.on_reading(event(TRACKING, until - 2.0 + 0.05 * number)) is NOTHING
    return watch


def silent(*, shown: bool = True) -> EvidenceWatch:
    """Return the evidence of a car with color LED mode opened at 5.0."""
    watch = EvidenceWatch()
    watch.reports(4.9)
    watch.evidence.opened(Mode.COLOR_LED, 5.0, silent=True, shown=shown)
    return watch


@pytest.mark.parametrize(
    ("frame", "after_s", "shown"),
    [
        (ECHO, CLOSED_S - 0.01, False),
        (ECHO, CLOSED_S + 0.01, True),
        (ECHO, 1.95, True),
        (ECHO, LEFT_S, True),
        (ECHO, LEFT_S + 0.01, False),
        (SILENT, LEFT_S + RANGING_S - 0.01, True),
        (SILENT, LEFT_S + RANGING_S + 0.01, False),
        (ECHO, 3.31, False),
    ],
)
@pytest.mark.parametrize("mode", [Mode.TRACKING, Mode.COLOR_LED], ids=str)
def test_a_mode_0_report_soon_after_mode00_shows_that_a_mode_was_left(
    mode: Mode, frame: bytes, after_s: float, *, shown: bool
) -> None:
    watch = tracking(10.0) if mode is Mode.TRACKING else silent()
    watch.closed(10.0)
    watch.evidence.sent_other()  # the general stop of every full stop
    assert (watch.reports(10.0 + after_s, frame=frame)[-1] is SHOWN) == shown
    if shown:
        assert "a report of mode 0" in watch.evidence.words
        assert ("out of color_led" in watch.evidence.words) == (mode is Mode.COLOR_LED)


@pytest.mark.parametrize(
    ("late_s", "found"),
    [(0.01, [PAUSE, SETTLING]), (LATE_S - 0.01, [PAUSE, SETTLING]), (LATE_S + 0.01, [REPORT, PAUSE])],
)
@pytest.mark.parametrize("mode", [Mode.TRACKING, Mode.COLOR_LED], ids=str)
def test_such_a_report_on_a_slow_link_counts_as_a_pause(mode: Mode, late_s: float, found: list[Finding]) -> None:
    watch = tracking(10.0) if mode is Mode.TRACKING else silent()
    watch.closed(10.0)
    at = 10.0 + LEFT_S + late_s
    results = watch.reports(at)
    watch.closed(at + 0.02)
    assert [*results, *watch.reports(at + 1.95)] == found


@pytest.mark.parametrize("mode", [Mode.TRACKING, Mode.COLOR_LED], ids=str)
@pytest.mark.parametrize("first", ["other", "closed"])
def test_it_shows_nothing_if_mode00_was_not_the_first_frame(mode: Mode, first: str) -> None:
    watch = tracking(10.0) if mode is Mode.TRACKING else silent()
    if first == "other":
        watch.evidence.sent_other()
    else:
        watch.closed(9.0)
    watch.closed(10.0)
    assert watch.reports(11.95)[-1] is not SHOWN


def test_the_shape_of_the_mode_long_after_mode00_shows_the_opposite() -> None:
    watch = tracking(10.0)
    watch.closed(10.0)
    for number in range(30):
        watch.evidence.on_reading(event(TRACKING, 10.0 + 0.05 * number))
    assert watch.reports(12.3)[-1] is not SHOWN


def test_one_damaged_reading_is_no_mode_that_was_seen() -> None:
    watch = EvidenceWatch()
    watch.evidence.opened(Mode.TRACKING, 0.0, silent=False, shown=True)
    watch.evidence.on_reading(event(TRACKING, 9.0))
    watch.closed(10.0)
    assert watch.reports(11.95)[-1] is not SHOWN


def test_a_silent_mode_that_was_opened_from_a_rest_that_nothing_had_shown() -> None:
    watch = silent(shown=False)
    watch.closed(10.0)
    assert watch.reports(11.95)[-1] is not SHOWN


@given(st.floats(0.0, 4.0))
def test_older_reports_of_a_slow_link_do_not_show_that_a_silent_mode_was_left(delay_s: float) -> None:
    """The car sent these reports once a second before its mode opened at 5.0. They come until `delay_s` later."""
    watch = silent()
    closed_at = 5.0 + delay_s - 1.0
    times = [4.95 + number for number in range(1, 5) if 4.95 + number <= 5.0 + delay_s]
    found = watch.reports(*(at for at in times if at <= closed_at))
    watch.closed(closed_at)
    found += watch.reports(*(at for at in times if at > closed_at))
    assert SHOWN not in found


@given(st.floats(0.0, OPENING_SILENCE_S - 0.01))
def test_a_report_without_the_silence_of_opening_shows_nothing(quiet_s: float) -> None:
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
    pair.ask(SetMode(mode))
    pair.run(9.0)
    return pair


def driven(platform: str = "arduino", *, world: World | None = None, told: str | None = None) -> Pair:
    pair = Pair(platform, world=world, told=told, start_s=2.0).ready()
    pair.ask(Drive(Motion.FORWARD, 10.0))
    pair.run(2.0)
    return pair


def fan() -> Pair:
    pair = Pair(start_s=2.0).ready()
    pair.ask(Fan())
    pair.run(2.0)
    return pair


ROWS = [
    (StopCase.LEFT_SHAPE, lambda: in_mode(Mode.TRACKING), "out of the mode that it reported"),
    (StopCase.LEFT_SILENT, lambda: in_mode(Mode.REMOTE_CONTROL), "out of remote_control"),
    (StopCase.MANUAL, driven, "2 pauses in its reports"),
    (StopCase.NO_ECHO, lambda: driven(world=World.open_field()), "no sonar echo"),
    (StopCase.FAN, fan, "while its fan runs"),
    (StopCase.RASPBERRY_PI, lambda: driven("raspberry_pi"), "a Raspberry Pi car never confirms a stop"),
    (StopCase.UNKNOWN_PLATFORM, lambda: driven("raspberry_pi", told="unknown"), "keeps reporting in mode 0"),
]


@pytest.mark.parametrize(("case", "situation", "words"), ROWS, ids=[row[0] for row in ROWS])
def test_a_row_of_the_table(case: StopCase, situation: Callable[[], Pair], words: str) -> None:
    pair = situation()
    phase, basis, said = ended(pair)
    shown = case in (StopCase.LEFT_SHAPE, StopCase.LEFT_SILENT, StopCase.MANUAL)
    assert (phase, basis) == ((Phase.COMPLETE, Basis.SHOWN) if shown else (Phase.SENT, Basis.SENT))
    assert words in said
    assert (pair.control.model.motors, pair.control.model.basis) == ("off", basis)
    assert bool(EVIDENCE[case].shown_by) == shown or case is StopCase.UNKNOWN_PLATFORM
    assert not pair.car.truth.driving
    assert shown or pair.control.model.rest is case


def test_a_soft_stop_shows_nothing() -> None:
    """The row `soft`: the release of a drive, and the rest after it, are only sent."""
    pair = driven()
    assert ended(pair, Drive(Motion.STOP)) == (Phase.SENT, Basis.SENT, EVIDENCE[StopCase.SOFT].words.format(car="red"))
    assert (pair.control.model.motors, pair.control.model.basis) == ("off", Basis.SENT)
    assert pair.control.model.rest is StopCase.SOFT


def test_a_frame_at_a_rest_that_was_shown_leaves_it_only_sent() -> None:
    """The row `acted`."""
    pair = Pair(start_s=2.0).ready()
    assert pair.control.model.basis == Basis.SHOWN
    pair.ask(Fan())
    assert (pair.control.model.motors, pair.control.model.basis) == ("off", Basis.SENT)
    assert pair.control.model.rest is StopCase.ACTED


def test_every_row_is_played() -> None:
    assert {row[0] for row in ROWS} | {StopCase.SOFT, StopCase.ACTED} == set(EVIDENCE) == set(StopCase)


assert NORMAL_MAX_S < PAUSE_MIN_S


def test_line_ends_between_reports_hide_no_pause(monkeypatch: pytest.MonkeyPatch) -> None:
    """CR and LF may follow `#` (docs/reference/protocol.md#framing)."""
    desk = Workbench().ready()
    hear = desk.hear

    def hear_a_line(frame: bytes = b"") -> None:
        hear(frame)
        desk.control.on_event(Rejected(b"\r\n", desk.now, Cause.NO_START), desk.now)

    monkeypatch.setattr(desk, "hear", hear_a_line)
    desk.ask(Drive(Motion.FORWARD, 5.0))
    desk.run(2.0)
    desk.ask(Stop(), identity="stop")
    desk.run(9.0)
    assert desk.end("stop")[0] is Phase.COMPLETE
