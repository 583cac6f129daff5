"""Tests of permissions: what is refused for each rank, action and state, and pauses and loans through control."""

import itertools
from collections.abc import Callable

import pytest
from msgspec.structs import replace

from gateway.control.commands import (
    Action,
    Command,
    Drive,
    EmergencyStop,
    EndLoan,
    Find,
    Led,
    Lend,
    Pause,
    Resume,
    SetMode,
    Stop,
    TakeLease,
    Unpause,
)
from gateway.control.refusals import CommandContext, refuse
from gateway.control.safety_state import PersistedSafety
from schemas.rights import NO_PEOPLE, Authority, Estop, FleetPause, Hold, LeaseState, Loan, People, Sender
from schemas.words import Mode, Motion, Phase, Rank, Reason
from tests.gateway.control.workbench import RUN, SHOWN_STOP, Workbench
from tests.support.message_length import MAX_LINES, count_lines

LEAD, PERSON, SCRIPT, COORDINATOR = Rank
NOW = 100.0
PEOPLE = People.parse(["teacher:lead", "ann", "bob", "cid:other"])
ACTIONS: dict[str, Action] = {
    "stop": Stop(),
    "e-stop": EmergencyStop(),
    "drive": Drive(Motion.FORWARD),
    "release": Drive(Motion.STOP),
    "mode": SetMode(Mode.TRACKING),
    "manual": SetMode(Mode.MANUAL),
    "led": Led(1, 2, 3),
    "find": Find(),
    "lease": TakeLease(),
    "free": TakeLease(release=True),
    "resume": Resume(),
    "resume id": Resume(("e1",)),
    "resume all": Resume(all=True),
    "pause": Pause(),
    "unpause": Unpause(),
    "lend": Lend("cid", 60.0),
    "lend stranger": Lend("dan", 60.0),
    "end loan": EndLoan(),
}
SENDERS = {
    "lead": Sender("teacher@lab-1", LEAD),
    "person": Sender("ann@lab-2", PERSON),
    "script": Sender("ann@lab-3", SCRIPT),
    "plan": Sender("plan@lab-4", COORDINATOR),
    "other": Sender("cid@lab-5", PERSON),
    "nobody": Sender("dan@lab-6", PERSON),
}
"""A lead, a person who drives the car, her script, the coordinator, a person of other cars, an unlisted person."""


def names(kind: Rank) -> str:
    """Return the name of another sender of this rank."""
    return {LEAD: "head", PERSON: "bob", SCRIPT: "bob", COORDINATOR: "plan2"}[kind] + "@lab-9"


FREE = CommandContext(
    car="red",
    now=NOW,
    link_open=True,
    link_reason="",
    closing=False,
    asked=Mode.MANUAL,
    authority=Authority(PEOPLE),
    ended=(),
    battery="",
    queued=0,
)
ESTOPS: list[tuple[Estop, ...]] = [
    (),
    *(
        (Estop("e1", by, "", 1, wide, rank),)
        for by, rank, wide in [
            *((names(kind), kind, False) for kind in Rank),
            ("ann@x", PERSON, False),
            ("cid@x", PERSON, False),
            ("eve@x", PERSON, True),
        ]
    ),
]
HOLDS = [None, *(Hold(names(kind), 1, kind) for kind in Rank)]
PAUSES: list[tuple[FleetPause, ...]] = [(), *((FleetPause("p", names(kind), "", 1, kind),) for kind in Rank)]
LEASES = [None, *(LeaseState(Sender(names(kind), kind), NOW + 1) for kind in Rank)]
LOANS = [None, *(Loan(to, "teacher", LEAD, 1, 60.0) for to in ("ann", "bob", "cid", "dan"))]
TABLES: dict[str, dict[str, str] | None] = {
    "no people": None,
    "no leads": {"teacher": "", "ann": "", "cid": "other"},
    "leads": {"teacher": "lead", "ann": "", "cid": "other"},
}
"""Without leads, teacher is a person like any other."""


def refused(what: Action, sender: Sender, at: CommandContext) -> tuple[Reason | None, str]:
    return refuse(Command("c", "verb", sender, what), at) or (None, "")


@pytest.mark.parametrize("table", TABLES)
@pytest.mark.parametrize("who", SENDERS)
def test_every_rank_every_action_every_state(who: str, table: str) -> None:
    """The car is free, or leased, held, e-stopped or paused by each rank, or lent to the sender or to others.

    Some senders may not drive it.
    """
    listed = TABLES[table]
    people = NO_PEOPLE if listed is None else People.parse(":".join(filter(None, each)) for each in listed.items())
    sender = people.ranked(SENDERS[who])
    seen: set[Reason | None] = set()
    texts: set[str] = set()
    for estops, hold, pauses, lease, loan in itertools.product(ESTOPS, HOLDS, PAUSES, LEASES, LOANS):
        if sum(map(bool, (estops, hold, pauses, lease, loan))) > 3:
            continue
        at = replace(FREE, authority=Authority(people, estops, pauses, hold, loan, lease), loan_until=NOW + 60)
        for action, what in ACTIONS.items():
            reason, words = refused(what, sender, at)
            assert reason == expected(action, sender, listed, at.authority), (action, sender, at)
            assert reason in (None, Reason.BAD_VALUE, Reason.LEASED) or words[-1] == "."
            seen.add(reason)
            texts.add(words)
    assert seen >= {None, Reason.ESTOPPED, Reason.HELD if who == "plan" else None}
    printed = [f"fleet: red: refused: {each} [{Reason.NOT_ALLOWED}]" for each in texts]
    assert [text for text in printed if count_lines(text) > MAX_LINES] == []


def expected(action: str, sender: Sender, listed: dict[str, str] | None, state: Authority) -> Reason | None:
    """Return the expected reason, by the rules of docs/explanation/who-may-drive.md."""
    person, lead, plan = sender.person, sender.kind is LEAD, sender.kind is COORDINATOR
    leads = listed is not None and "lead" in listed.values()
    borrows = state.loan is not None and state.loan.to == person
    drives = listed is None or listed.get(person) in ("", "lead") or borrows
    directs = lead or (not leads and sender.kind is PERSON and (listed is None or person in listed))
    lent = state.loan is not None and not borrows and not lead and not (leads and person == "teacher")

    def is_protected(rank: Rank) -> bool:
        # Without a table none of these senders is a lead, and none of them began anything as a lead.
        return rank is LEAD and not lead and (leads or listed is None)

    if action in ("stop", "e-stop", "free"):
        return None
    if action == "lend stranger":
        known = expected("lend", sender, listed, state)
        return known if known is not None or listed is None else Reason.BAD_VALUE
    if action in ("pause", "unpause", "lend") or (action == "end loan" and state.loan is not None and not borrows):
        if not directs:
            return Reason.NOT_ALLOWED
        if action == "lend" and not lead:
            return Reason.LENT if lent else None if drives else Reason.NOT_ALLOWED
        if action == "unpause" and any(is_protected(pause.rank) for pause in state.pauses):
            return Reason.PAUSED
        return None
    if action == "end loan":
        return None
    if action.startswith("resume"):
        return resumed(action, sender, listed, state, drives=drives, is_protected=is_protected)
    if state.estops:
        return Reason.ESTOPPED
    if lent:
        return Reason.LENT
    if not (drives or plan):
        return Reason.NOT_ALLOWED
    if state.pauses and not lead:
        return Reason.PAUSED
    if state.hold is not None and (plan or is_protected(state.hold.rank)):
        return Reason.HELD
    ranks = [COORDINATOR, SCRIPT, PERSON, LEAD]
    needs_lease = action in ("drive", "release", "mode", "manual", "lease")
    if needs_lease and state.lease is not None and ranks.index(state.lease.holder.kind) >= ranks.index(sender.kind):
        return Reason.LEASED
    return None


def resumed(
    action: str,
    sender: Sender,
    listed: dict[str, str] | None,
    state: Authority,
    *,
    drives: bool,
    is_protected: Callable[[Rank], bool],
) -> Reason | None:
    if sender.kind is COORDINATOR:
        return Reason.HELD
    hold = None if drives else Reason.NOT_ALLOWED
    if state.hold is not None and is_protected(state.hold.rank):
        hold = Reason.HELD
    if action == "resume" or (action == "resume all" and not state.estops):
        return hold
    if not state.estops:
        return Reason.BAD_VALUE
    (estop,) = state.estops
    own, fleet = estop.by.startswith(sender.person + "@"), estop.fleet_wide and sender.person in (listed or ())
    estopped = Reason.ESTOPPED if is_protected(estop.rank) else None if own or fleet or drives else Reason.NOT_ALLOWED
    if action == "resume all" and state.hold is not None and hold is None:
        return None
    return estopped


@pytest.mark.parametrize(
    ("people", "ranks", "who"),
    [
        (PEOPLE, (PERSON,), "A lead"),
        (NO_PEOPLE, (PERSON,), "A person"),
        (NO_PEOPLE, (LEAD, PERSON), "A lead"),
        (People.parse(["ann"]), (LEAD,), "A person"),  # the table has no lead
    ],
)
def test_paused_car_says_who_ends_the_pause(people: People, ranks: tuple[Rank, ...], who: str) -> None:
    pauses = tuple(FleetPause(f"p{at_ns}", "teacher@lab", "", at_ns, rank) for at_ns, rank in enumerate(ranks))
    at = replace(FREE, authority=Authority(people, pauses=pauses))
    reason, words = refused(Drive(Motion.FORWARD), SENDERS["person"], at)
    assert reason is Reason.PAUSED
    assert who in words
    assert words.endswith(" `fleet unpause`.")
    may_end = refused(Unpause(), SENDERS["person"], at)[0] is None
    assert may_end is (who == "A person")


# ---------------------------------------------------------------------- through control

FORWARD = Drive(Motion.FORWARD, 10.0)
TEACHER, ANN, BOB, CID = (Sender(f"{name}@lab", PERSON) for name in ("teacher", "ann", "bob", "cid"))
PLAN = Sender("plan@lab", COORDINATOR)


@pytest.fixture
def desk() -> Workbench:
    return Workbench(people=PEOPLE).ready()


def test_pause_stops_like_a_stop_and_only_leads_drive(desk: Workbench) -> None:
    desk.ask(FORWARD, ANN, identity="d")
    answer = desk.ask(Pause("listen"), TEACHER, identity="p")
    assert answer.status is Phase.QUEUED
    assert "`fleet unpause`" in answer.words
    assert answer.worst_case_s > 0
    desk.run(5.0)
    assert desk.frames == [RUN, *SHOWN_STOP]
    assert desk.life("p") == [Phase.ASKED, Phase.QUEUED, Phase.SENT, Phase.COMPLETE]
    assert desk.end("d") == (Phase.SUPERSEDED, Reason.SUPERSEDED)
    assert desk.control.safety.hold is None
    for sender in (ANN, Sender("ann@lab", SCRIPT), PLAN):
        refused = desk.ask(SetMode(Mode.TRACKING), sender)
        assert refused.reason is Reason.PAUSED
        assert refused.words == (
            'red is paused with the whole fleet (teacher: "listen"). A lead ends it with `fleet unpause`.'
        )
    ended = desk.ask(Unpause(), ANN)
    assert ended.reason is Reason.NOT_ALLOWED
    assert "(teacher)" in ended.words
    assert desk.ask(Resume(all=True), ANN).words.endswith("paused by teacher: `fleet unpause`")
    assert desk.ask(FORWARD, TEACHER).status is Phase.QUEUED
    desk.ask(Stop(), ANN)
    desk.run(5.0)
    desk.sent.clear()
    assert desk.ask(Unpause(), TEACHER).status is Phase.SENT
    desk.run(5.0)
    assert desk.frames == []
    assert desk.ask(Unpause(), TEACHER).words == "was not paused"
    assert desk.ask(FORWARD, ANN).status is Phase.QUEUED
    assert [log.code for log in desk.logs] == ["paused", "unpaused", "hold_ended"]


def test_unpause_with_ids_ends_only_those(desk: Workbench) -> None:
    """A gateway names what its unpause has ended, so that the copy ends no pause that somebody begins meanwhile."""
    desk.ask(Pause("listen"), TEACHER)
    desk.ask(Pause("lunch"), TEACHER)
    first, second = desk.control.safety.pauses
    assert desk.ask(Unpause((first.id, "unknown")), TEACHER).status is Phase.SENT
    assert desk.control.safety.pauses == (second,)
    assert desk.control.safety.ended_pauses == (first.id,)
    assert desk.ask(Unpause(), TEACHER).status is Phase.SENT
    assert desk.control.safety.pauses == ()


def test_pause_that_a_gateway_does_not_know_is_not_ended_by_its_id(desk: Workbench) -> None:
    """A gateway that has just started knows no pause. Asked to end that of a lead, it told all others that it ended."""
    pause = FleetPause("p1", "teacher@lab", "listen", 7, LEAD)
    started = Workbench().ready()
    desk.control.merge_pauses([pause], [], "blue", desk.now)
    assert started.ask(Unpause(("p1",)), ANN).words == "was not paused"
    desk.control.merge_pauses(started.control.safety.pauses, started.control.safety.ended_pauses, "new", desk.now)
    assert desk.control.safety.pauses == (pause,)
    started.control.merge_pauses(desk.control.safety.pauses, (), "red", started.now)
    assert started.control.safety.pauses == (pause,)


def test_refused_pause_stops_nothing(desk: Workbench) -> None:
    desk.ask(FORWARD, ANN)
    assert desk.ask(Pause(), BOB).reason is Reason.NOT_ALLOWED
    desk.run(1.0)
    assert desk.frames == [RUN]


def test_without_leads_each_person_may_pause_and_then_nobody_moves() -> None:
    desk = Workbench().ready()
    assert desk.ask(Pause(), Sender("bob", SCRIPT)).reason is Reason.NOT_ALLOWED
    desk.ask(Pause(), BOB)
    claimed = replace(BOB, kind=LEAD)
    assert [desk.ask(FORWARD, each).reason for each in (BOB, ANN, claimed)] == [Reason.PAUSED] * 3
    assert desk.ask(Unpause(), ANN).status is Phase.SENT


def test_pause_of_unreachable_car_is_in_force(desk: Workbench) -> None:
    desk.control.driver.link_down("unplugged", desk.now)
    answer = desk.ask(Pause(), TEACHER)
    assert (answer.status, answer.reason) == (Phase.REJECTED, Reason.LINK_DOWN)
    assert answer.words.startswith("NOT STOPPED: red ")
    desk.control.link_up(desk.now)
    desk.run(10.0)
    assert desk.ask(FORWARD, ANN).reason is Reason.PAUSED


def test_pause_from_another_gateway_stops_and_ended_one_stays_ended(desk: Workbench) -> None:
    desk.ask(FORWARD, ANN)
    pause = FleetPause("p1", "teacher@lab", "listen", 7, LEAD)
    desk.control.merge_pauses([pause], [], "blue", desk.now)
    desk.run(5.0)
    assert desk.frames == [RUN, *SHOWN_STOP]
    assert desk.logs[0].code == "paused"
    assert "by teacher: listen (seen from blue)" in desk.logs[0].words
    desk.control.merge_pauses([pause], ["p1"], "green", desk.now)
    assert desk.ask(FORWARD, ANN).status is Phase.QUEUED
    desk.control.merge_pauses([pause], [], "blue", desk.now)
    desk.run(1.0)
    assert desk.frames[-1] == RUN
    answer = desk.ask(Pause("listen"), TEACHER, identity="p1")
    assert answer.status is Phase.QUEUED
    assert "ended already" in answer.words
    assert desk.control.safety.pauses == ()


def test_only_lead_ends_hold_of_lead(desk: Workbench) -> None:
    desk.ask(Stop(), ANN)
    desk.ask(Stop(), TEACHER)
    desk.ask(Stop(), ANN)
    assert desk.control.safety.hold is not None
    assert desk.control.safety.hold.by == "teacher@lab"
    words = "red is on hold: teacher stopped it, and only a lead may end what a lead began (teacher)."
    for what in (FORWARD, Resume(), Resume(all=True), SetMode(Mode.MANUAL)):
        answer = desk.ask(what, ANN)
        assert (answer.reason, answer.words) == (Reason.HELD, words)
    desk.ask(EmergencyStop("wall"), TEACHER, identity="e1")
    desk.ask(EmergencyStop("door"), ANN, identity="e2")
    answer = desk.ask(Resume(("e1",)), ANN)
    assert answer.reason is Reason.ESTOPPED
    assert ': "wall", ' in answer.words
    assert answer.words.endswith("(teacher).")
    some = desk.ask(Resume(all=True), ANN)
    assert (some.status, some.reason) == (Phase.SENT, Reason.ESTOPPED)
    assert some.words.startswith("e-stop released; ")
    assert 'teacher ("wall")' in some.words
    assert desk.ask(Resume(all=True), TEACHER).words.startswith("e-stop released; resumed: ")
    desk.run(5.0)
    desk.ask(Stop(), TEACHER)
    desk.run(5.0)
    assert desk.ask(FORWARD, TEACHER).status is Phase.QUEUED
    assert desk.control.safety.hold is None


def test_table_without_leads_keeps_no_car_stopped_for_ever() -> None:
    kept = PersistedSafety(Hold("teacher@lab", 1, LEAD), (Estop("e1", "teacher@lab", "", 1, True, LEAD),))
    desk = Workbench(kept=kept, people=People.parse(["ann"])).ready()
    assert desk.ask(Resume(all=True), ANN).reason is None
    assert desk.ask(FORWARD, ANN).status is Phase.QUEUED


def test_gateway_without_people_frees_nothing_of_a_lead() -> None:
    kept = PersistedSafety(Hold("teacher@lab", 1, LEAD), (Estop("e1", "teacher@lab", "", 1, True, LEAD),))
    desk = Workbench(kept=kept).ready()
    desk.control.merge_pauses([FleetPause("p1", "teacher@lab", "listen", 7, LEAD)], [], "blue", desk.now)
    rule = "only a lead may end what a lead began. The gateway of red knows no leads: "
    for sender in (ANN, replace(ANN, kind=LEAD), Sender("teacher@lab", SCRIPT)):
        answers = [desk.ask(what, sender) for what in (Resume(), Resume(("e1",)), Resume(all=True))]
        assert [each.reason for each in answers] == [Reason.HELD, Reason.ESTOPPED, Reason.ESTOPPED]
        assert all(rule in each.words for each in answers)
        assert desk.ask(Unpause(), sender).reason in (Reason.PAUSED, Reason.NOT_ALLOWED)
    assert rule in desk.ask(Unpause(), ANN).words
    assert [pause.id for pause in desk.control.safety.pauses] == ["p1"]
    assert desk.control.safety.ended_pauses == (), "no other gateway would follow"
    # The state names one lead: the person who began the hold, the e-stop and the pause.
    teacher = Sender("teacher@phone", PERSON)
    assert desk.ask(Unpause(), teacher).status is Phase.SENT
    assert desk.ask(Resume(all=True), teacher).reason is None
    assert desk.ask(FORWARD, ANN).status is Phase.QUEUED


def test_lent_car_is_borrowers_until_end_which_stops_it(desk: Workbench) -> None:
    desk.ask(FORWARD, ANN, identity="d")
    assert "cid for 60 s" in desk.ask(Lend("cid", 60.0), TEACHER).words
    desk.run(5.0)
    assert desk.frames == [RUN, *SHOWN_STOP], "lending stops who drives"
    words = "red is lent to cid for another 55 s. teacher ends that with `fleet lend red --end`."
    for sender in (ANN, PLAN, Sender("ann@lab", SCRIPT)):
        answer = desk.ask(FORWARD, sender)
        assert (answer.reason, answer.words) == (Reason.LENT, words)
    desk.sent.clear()
    desk.run(50.0)
    desk.ask(FORWARD, CID)
    desk.run(8.0)
    assert desk.frames[-4:] == [RUN, *SHOWN_STOP]
    assert desk.control.safety.lease is None
    assert desk.control.safety.loan is None
    assert desk.ask(FORWARD, CID).reason is Reason.NOT_ALLOWED
    assert desk.ask(FORWARD, ANN).status is Phase.QUEUED
    assert [log.code for log in desk.logs] == ["lent", "loan_ended"]


def test_early_end_of_loan_stops_mode_of_borrower_only(desk: Workbench) -> None:
    desk.ask(Lend("cid", 60.0), TEACHER)
    desk.ask(SetMode(Mode.TRACKING), CID)
    desk.run(5.0)
    assert desk.control.asked is Mode.TRACKING
    assert desk.ask(EndLoan(), ANN).reason is Reason.NOT_ALLOWED
    assert desk.ask(EndLoan(), CID).status is Phase.SENT
    desk.run(5.0)
    assert desk.control.asked is Mode.MANUAL
    assert desk.control.driver.model.at_rest
    desk.ask(Lend("cid", 60.0), TEACHER)
    desk.ask(FORWARD, TEACHER)
    desk.sent.clear()
    assert desk.ask(EndLoan(), TEACHER).status is Phase.SENT
    desk.run(2.0)
    assert set(desk.frames) == {RUN}, "the lead drives on"
    assert desk.ask(EndLoan(), TEACHER).words == "was not lent"


def test_loan_continues_after_restart_for_remaining_time() -> None:
    loan = Loan("cid", "teacher@lab", LEAD, int(60.0 * 1e9), 100.0)
    desk = Workbench(kept=PersistedSafety(loan=loan), people=PEOPLE).ready()  # the workbench begins at 100 s
    assert desk.ask(FORWARD, ANN).reason is Reason.LENT
    desk.run(161.0 - desk.now)
    assert desk.ask(FORWARD, ANN).status is Phase.QUEUED
    assert desk.control.safety.persisted.loan is None


def test_refusal_for_foreign_car_names_who_decides(desk: Workbench) -> None:
    refused = desk.ask(FORWARD, CID)
    assert refused.reason is Reason.NOT_ALLOWED
    assert "`people:`" in refused.words
    assert "`fleet lend red --to cid --for 10m`" in refused.words
    refused = desk.ask(FORWARD, Sender("root@lab", PERSON))
    assert refused.reason is Reason.NOT_ALLOWED
    assert "list root. " in refused.words
    assert "`--as NAME` or FLEET_AS" in refused.words
    assert desk.ask(Stop(), Sender("root@lab", PERSON)).status is Phase.QUEUED
    assert desk.records[-1].command.sender.name == "root@lab"


@pytest.mark.parametrize("entry", ["", "Ann", "ann:boss", "ann@lab", ":lead", "a" * 33])
def test_malformed_person_entry_is_refused(entry: str) -> None:
    with pytest.raises(ValueError, match="write NAME, NAME:lead or NAME:other"):
        People.parse([entry])
