"""The outcome of a command, by its answer and events in any order."""

import time
from collections.abc import Callable

import pytest

from fleet.client import command_tracker, outcome
from fleet.client.command_tracker import PendingCommand, PresenceChange, QueryEnded
from fleet.client.commands import mode_request, resume_request
from fleet.client.outcome import Progress, Until
from fleet.client.outcome_words import EFFECTS, STOP_VERBS
from schemas.commands import COMMANDS
from schemas.gen import fleet_v1_pb2 as pb
from schemas.limits import MAX_EVIDENCE_TIMEOUT_S, MAX_QUEUE_TIME_S
from tests.support.message_length import MAX_LINES, count_lines
from tests.support.text_parts import has_parts

# Each step: ("answer" | "event", phase, worst case), at 1, 2, 3 ... s after the request at 100.
Steps = list[tuple[str, str, float]]


def told(until: Until, steps: Steps, lasts_s: float = 0.0) -> Progress:
    progress = Progress("red", until, 100.0, lasts_s)
    for number, (how, phase, worst_s) in enumerate(steps, start=1):
        take = progress.on_answer if how == "answer" else progress.on_event
        take(phase, "held" if phase == "rejected" else "", "", worst_s, 100.0 + number)
    return progress


@pytest.mark.parametrize(
    ("until", "steps", "phase", "ok"),
    [
        (Until.SENT, [("answer", "sent", 0.0)], "sent", True),
        (Until.SENT, [("answer", "rejected", 0.0)], "rejected", False),
        (Until.SENT, [("answer", "queued", 0.0), ("event", "sent", 0.0)], "sent", True),
        (Until.SENT, [("event", "asked", 0.0), ("event", "queued", 0.0), ("event", "expired", 0.0)], "expired", False),
        (Until.SENT, [("event", "sent", 0.0), ("answer", "queued", 0.0)], "sent", True),
        (Until.SENT, [("answer", "queued", 0.0), ("event", "superseded", 0.0)], "superseded", False),
        (Until.STOPPED, [("answer", "sent", 0.0)], "sent", True),  # the car was at rest
        (Until.STOPPED, [("answer", "sent", 1.0), ("event", "complete", 0.0)], "complete", True),
        (Until.STOPPED, [("answer", "queued", 1.0), ("event", "sent", 0.0), ("event", "failed", 0.0)], "failed", False),
        (Until.OVER, [("answer", "queued", 0.0), ("event", "sent", 0.0), ("event", "complete", 0.0)], "complete", True),
        (Until.OVER, [("answer", "sent", 0.0), ("event", "superseded", 0.0)], "superseded", False),
    ],
)
def test_last_word(until: Until, steps: Steps, phase: str, ok: bool) -> None:
    outcome = told(until, steps, 2.0).outcome
    assert outcome is not None
    assert (outcome.phase, outcome.ok) == (phase, ok)


@pytest.mark.parametrize(
    ("until", "steps"),
    [
        (Until.SENT, [("answer", "queued", 0.0)]),
        (Until.STOPPED, [("answer", "sent", 1.0), ("event", "sent", 0.0)]),
        (Until.OVER, [("answer", "queued", 0.0), ("event", "sent", 0.0)]),
        (Until.SENT, []),
    ],
)
def test_not_known_yet(until: Until, steps: Steps) -> None:
    assert told(until, steps, 2.0).outcome is None


@pytest.mark.parametrize("verb", sorted({*COMMANDS, *EFFECTS} - {"*"}))
@pytest.mark.parametrize("until", Until)
@pytest.mark.parametrize("phase", ["sent", "complete", "superseded", "expired", "failed", "rejected"])
def test_outcome_has_words_also_where_the_gateway_said_none(verb: str, until: Until, phase: str) -> None:
    progress = Progress("red", until, 100.0, verb=verb)
    progress.on_answer("sent", "", "", 0.0, 101.0)
    progress.on_event(phase, "", "", 0.0, 102.0)
    outcome = progress.outcome
    if outcome is None:  # a drive that goes on
        progress.give_up(200.0)
        outcome = progress.outcome
    assert outcome is not None
    assert outcome.words
    if outcome.ok and outcome.effect:
        assert outcome.words == outcome.effect


def test_answer_overtaken_by_last_event_keeps_worst_case() -> None:
    outcome = told(Until.STOPPED, [("event", "complete", 0.0), ("answer", "sent", 0.5)]).outcome
    assert outcome is not None
    assert (outcome.phase, outcome.ok, outcome.worst_case_s) == ("complete", True, 0.5)


def test_stop_timeout_is_announced_worst_case_plus_margin() -> None:
    assert told(Until.STOPPED, [("answer", "queued", 7.3)]).deadline == pytest.approx(
        100 + 7.3 + MAX_EVIDENCE_TIMEOUT_S + 5.0
    )


def test_timeouts_count_from_late_answer() -> None:
    progress = Progress("red", Until.STOPPED, 100.0)
    assert progress.deadline > 110.0, "the query is over before it"
    progress.on_answer("queued", "", "", 0.5, 108.0)
    assert progress.deadline == pytest.approx(108.0 + 0.5 + MAX_EVIDENCE_TIMEOUT_S + 5.0)


@pytest.mark.parametrize(
    ("alive", "words"),
    [
        (True, "It is unknown what red does: its gateway is overloaded or hangs"),
        (False, "red may be moving: its gateway is gone"),
    ],
)
def test_no_answer_says_whether_there_is_a_gateway(alive: bool, words: str) -> None:
    progress = Progress("red", Until.STOPPED, 100.0)
    progress.on_presence(109.5, alive=alive)
    progress.on_query_timeout(110.0)
    assert progress.outcome is not None
    assert progress.outcome.phase == "no_answer"
    assert progress.outcome.words.startswith(words)
    assert "after 10 s" in progress.outcome.words
    assert str(progress.outcome).startswith("red may" if words.startswith("red") else f"red: {words}")


def test_query_timeout_is_ignored_while_records_come() -> None:
    progress = told(Until.STOPPED, [("event", "asked", 0.0), ("event", "sent", 0.5)])
    progress.on_query_timeout(110.0)
    assert progress.outcome is None
    progress.on_event("complete", "", "", 0.0, 111.0)
    assert progress.outcome is not None
    assert progress.outcome.ok


def test_giving_up_says_what_was_heard_last() -> None:
    progress = told(Until.SENT, [("answer", "queued", 0.0)])
    progress.give_up(115.0)
    assert progress.outcome is not None
    assert not progress.outcome.ok
    assert "15.0 s (last event: queued, 14.0 s ago)" in progress.outcome.words


def test_lost_gateway_is_reported_after_grace_second() -> None:
    progress = told(Until.OVER, [("answer", "sent", 0.0), ("event", "sent", 0.0)], 9.0)
    progress.on_presence(102.0, alive=False)
    assert progress.deadline == 103.0
    progress.on_presence(102.4, alive=True)
    assert progress.deadline == 100.0 + 9.0 + 5.0
    progress.on_presence(103.0, alive=False)
    progress.on_presence(103.4, alive=False)
    assert progress.deadline == 104.0
    progress.give_up(104.0)
    assert progress.outcome is not None
    assert (progress.outcome.ok, progress.outcome.phase) == (False, "sent")
    assert progress.outcome.words.startswith("red may be moving")


@pytest.mark.parametrize(
    ("verb", "detail", "event", "text"),
    [
        ("stop", "", ("complete", "", "", "shown"), "stopped (1.0 s)"),
        (
            "stop",
            "",
            ("sent", "", "no sonar echo", "sent"),
            "stop sent, no sonar echo; motors off within 0.5 s if the frames arrived",
        ),
        ("stop", "", ("failed", "not_shown", "NOT CONFIRMED: x", ""), "stop sent, NOT CONFIRMED: x [not_shown]"),
        ("stop", "", ("failed", "not_shown", "is silent", ""), "stop sent, NOT CONFIRMED: red is silent [not_shown]"),
        ("stop", "", ("rejected", "link_down", "NOT STOPPED: x", ""), "NOT STOPPED: x [link_down]"),
        (
            "estop",
            "",
            ("complete", "", "", "shown"),
            "emergency-stopped (1.0 s). Release it with `fleet resume red --estops`",
        ),
        (
            "estop_fleet",
            "",
            ("complete", "", "", "shown"),
            "emergency-stopped (1.0 s). One release frees all cars: `fleet resume --estops`",
        ),
        (
            "estop",
            "",
            ("failed", "not_shown", "is silent", ""),
            "stop sent, NOT CONFIRMED: red is silent. Release it with `fleet resume red --estops` [not_shown]",
        ),
        ("resume", "", ("sent", "estopped", "still e-stopped", ""), "still e-stopped [estopped]"),
        ("release", "", ("sent", "", "red is at rest", ""), "nothing to stop (red is at rest)"),
        ("drive", "1.0 s", ("sent", "", "sent for 1.0 s", "sent"), "sent for 1.0 s"),
        ("drive", "1.0 s", ("sent", "", "sent for 1.0 s; it is deaf", "sent"), "sent for 1.0 s; it is deaf"),
        ("drive", "1.0 s", ("sent", "", "sent for 1.0 s; it moved", "sent"), "sent for 1.0 s; it moved"),
        ("drive", "1.0 s", ("complete", "", "", ""), "drive over 1.0 s"),
        ("drive", "1.0 s", ("superseded", "superseded", "stop by mia", ""), "ended early: stop by mia [superseded]"),
        ("drive", "1.0 s", ("rejected", "held", "", ""), "refused [held]"),
        ("drive", "1.0 s", ("expired", "expired", "red was busy", ""), "not done: red was busy [expired]"),
        ("mode", "tracking", ("sent", "", "", ""), "switching to mode tracking"),
        ("mode", "tracking", ("sent", "", "in mode tracking already", ""), "in mode tracking already"),
        ("led", "", ("sent", "", "", ""), "LED color sent"),
        ("light", "cyan", ("sent", "", "", ""), "light cyan sent"),
        ("servo", "", ("sent", "", "", ""), "servo movement sent"),
        ("arm", "", ("sent", "", "", ""), "arm joints sent"),
        ("whistle", "", ("sent", "", "", ""), "whistle sent"),
        ("speed", "up", ("sent", "", "", ""), "speed step up sent"),
        ("fan", "toggle", ("sent", "", "", ""), "fan toggle sent"),
        ("fan", "off", ("sent", "", "the fan is off already", ""), "the fan is off already"),
        ("fan", "on", ("failed", "write_failed", "cable", ""), "failed: cable [write_failed]"),
        ("find", "", ("sent", "", "", ""), "blinking sent"),
        ("resume", "", ("sent", "", "resumed: the hold has ended", ""), "resumed: the hold has ended"),
        ("lease", "", ("sent", "", "", ""), "done"),
    ],
)
def test_outcome_text_by_verb_and_reason(verb: str, detail: str, event: tuple[str, str, str, str], text: str) -> None:
    until = {"drive": Until.OVER, **dict.fromkeys(STOP_VERBS, Until.STOPPED)}
    progress = Progress("red", until.get(verb, Until.SENT), 100.0, 1.0, verb=verb, detail=detail)
    phase, reason, words, basis = event
    progress.on_event(phase, reason, words, 0.5, 101.0, basis)
    if progress.outcome is None:  # the car is at rest: only an answer without a worst case ends it
        progress = Progress("red", Until.STOPPED, 100.0, verb=verb)
        progress.on_answer(phase, reason, words, 0.0, 101.0)
    assert str(progress.outcome) == f"red: {text}"
    assert count_lines(str(progress.outcome)) <= MAX_LINES


def test_reason_of_waiting_is_known_until_frame_is_sent() -> None:
    progress = Progress("red", Until.SENT, 100.0, verb="mode")
    progress.on_event("asked", "", "", 0.0, 100.1)
    progress.on_event("queued", "", "opens in 3.6 s at most", 0.0, 100.1)
    progress.on_answer("queued", "", "", 0.0, 100.2)
    assert progress.why_waiting == "opens in 3.6 s at most"
    progress.on_event("sent", "", "", 0.0, 103.0)
    assert progress.why_waiting == ""


def test_waiting_command_is_explained_once(monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture) -> None:
    monkeypatch.setattr(command_tracker, "WAIT_SAID_S", 0.0)
    pending = PendingCommand("it", mode_request("tracking"), ["red"], ["red"], str, lambda car: None)
    for phase, words in (("queued", "opens later"), ("queued", "opens later"), ("sent", "")):
        event = pb.CommandEvent(car="red", phase=phase, words=words)
        pending.inbox.put((time.monotonic(), event))
    pending.inbox.put((time.monotonic(), QueryEnded("red", "")))
    pending.wait()
    assert [record.getMessage() for record in caplog.records] == ["red: opens later"]


def test_gateway_that_is_gone_is_not_excused_by_an_earlier_loss_of_our_link(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(outcome, "GATEWAY_RETURN_TIMEOUT_S", 0.05)
    links = iter(["first", *["second"] * 1000])
    pending = PendingCommand("it", mode_request("tracking"), ["red"], ["red"], lambda: next(links), lambda car: None)
    for item in (
        pb.CommandEvent(car="red", phase="queued"),
        PresenceChange("red", alive=False),
        QueryEnded("red", ""),
    ):
        pending.inbox.put((time.monotonic(), item))
    pending.wait()
    (found,) = pending.outcomes()
    assert (found.ok, has_parts(found.words, "its gateway is gone")) == (False, True)


def test_car_that_was_not_asked_has_no_outcome() -> None:
    """Its gateway got the command from that of the named car, which forwards the end of an e-stop of the fleet."""
    pending = PendingCommand("it", resume_request(["x"]), ["red", "blue"], ["red"], str, lambda car: None)
    for car, phase in (("blue", "rejected"), ("red", "sent")):
        pending.inbox.put((time.monotonic(), pb.CommandEvent(car=car, phase=phase)))
    pending.inbox.put((time.monotonic(), QueryEnded("red", "")))
    pending.wait()
    assert [(each.car, each.ok) for each in pending.outcomes()] == [("red", True)]


def test_verbs_have_effect_texts() -> None:
    assert set(EFFECTS) == {*COMMANDS, "release", "estop_fleet", "*"}


def test_command_without_result_has_own_code() -> None:
    progress = told(Until.SENT, [("answer", "queued", 0.0)])
    progress.give_up(115.0)
    assert str(progress.outcome).endswith(" [no_result]")
    progress = Progress("red", Until.STOPPED, 100.0, verb="stop")
    progress.on_missing(["blue"], 100.0)
    assert str(progress.outcome).startswith("red: NOT STOPPED: ")
    assert str(progress.outcome).endswith(" [no_answer]")


def test_drive_of_lost_sender_is_not_called_not_done() -> None:
    progress = Progress("red", Until.OVER, 100.0, 9.0, verb="drive", detail="9.0 s")
    for phase in ("queued", "sent"):
        progress.on_event(phase, "", "", 0.0, 100.1)
    progress.on_event("expired", "expired", "its sender mia disconnected", 0.0, 103.0)
    assert str(progress.outcome) == "red: ended early: its sender mia disconnected [expired]"


def test_extended_drive_needs_no_event_of_its_end() -> None:
    progress = told(Until.OVER, [("answer", "sent", 0.0), ("event", "sent", 0.0)], 2.0)
    assert progress.deadline == 100.0 + 2.0 + 5.0
    progress.give_up(107.0)
    assert progress.outcome is not None
    assert progress.outcome.ok


def test_late_events_of_drive_are_no_extension() -> None:
    progress = told(Until.OVER, [("answer", "sent", 0.0)], 2.0)
    assert progress.deadline == 100.0 + 2.0 + MAX_QUEUE_TIME_S + 5.0, "it may wait for a stop"
    for at, phase in enumerate(("queued", "sent"), start=104):
        progress.on_event(phase, "", "", 0.0, at)
    assert progress.deadline == 112.0, "its duration counts from its frame"
    progress.on_event("complete", "", "", 0.0, 106.0)
    assert progress.outcome is not None
    assert (progress.outcome.ok, progress.outcome.phase) == (True, "complete")


def test_first_final_answer_stays() -> None:
    progress = told(Until.SENT, [("answer", "rejected", 0.0), ("event", "sent", 0.0)])
    progress.on_query_failed("nothing", 105.0)
    assert progress.outcome is not None
    assert (progress.outcome.phase, progress.outcome.reason) == ("rejected", "held")


def test_foreign_answer_does_not_replace_gateway_answer() -> None:
    progress = Progress("red", Until.STOPPED, 100.0)
    progress.on_foreign_answer("another program answered for red: no result")
    assert progress.outcome is None
    progress.on_answer("queued", "", "", 1.0, 101.0)
    progress.on_query_failed("its gateway ended without an answer", 101.1)
    progress.on_event("complete", "", "", 0.0, 103.0, "shown")
    assert progress.outcome is not None
    assert (progress.outcome.phase, progress.outcome.ok) == ("complete", True)


@pytest.mark.parametrize(
    "ends",
    [lambda p: p.on_query_failed("It ended. Look at the car.", 101.0), lambda p: p.on_query_timeout(110.0)],
)
def test_foreign_answer_explains_missing_answer(ends: Callable[[Progress], None]) -> None:
    progress = Progress("red", Until.STOPPED, 100.0)
    progress.on_foreign_answer("another program answered for red: no result")
    ends(progress)
    assert progress.outcome is not None
    assert progress.outcome.code == "no_answer"
    assert "for red: no result." in progress.outcome.words


@pytest.mark.parametrize(
    ("last", "ok", "basis"),
    [
        (("sent", "", "sent for 3.0 s", "sent"), True, "sent"),
        (("sent", "", "sent for 3.0 s; its distance changed from 1.20 m to 0.80 m", "sent"), True, "sent"),
        (("superseded", "superseded", "stop by mia", ""), False, ""),
        (("rejected", "held", "", ""), False, ""),
        (("expired", "expired", "red was busy", ""), False, ""),
    ],
)
def test_drive_outcome_is_ok_if_sent_whole(last: tuple[str, str, str, str], ok: bool, basis: str) -> None:
    progress = Progress("red", Until.OVER, 100.0, 3.0, verb="drive", detail="3.0 s")
    progress.on_event("sent", "", "", 0.0, 100.1)
    assert progress.outcome is None, "the motion was sent, and the drive goes on"
    phase, reason, words, last_basis = last
    progress.on_event(phase, reason, words, 0.0, 103.2, last_basis)
    assert progress.outcome is not None
    assert (progress.outcome.ok, progress.outcome.basis, progress.outcome.phase) == (ok, basis, phase)
