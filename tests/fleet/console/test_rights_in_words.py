"""The page shows the gateway's decision about a person, an action and a car. One table compares both."""

import itertools
from collections.abc import Iterator

from fleet.console.rights_in_words import management_refusal, rights_of
from fleet.console.rights_in_words import refusals as refusals_shown
from gateway.bus.car_publisher import _fill_safety
from gateway.clock import Sleeps
from gateway.control import refusals
from gateway.control.commands import (
    Action,
    AimServo,
    ChangeSpeed,
    Command,
    Drive,
    EndLoan,
    Find,
    Lend,
    Pause,
    Resume,
    SetLight,
    SetMode,
    TakeLease,
    Unpause,
)
from gateway.control.safety_state import Safety
from schemas.gen import fleet_v1_pb2 as pb
from schemas.rights import NO_PEOPLE, Authority, Estop, FleetPause, Hold, LeaseState, Loan, People, Right, Sender
from schemas.words import Light, Mode, Motion, Rank, SpeedStep
from tests.gateway.control.workbench import Workbench
from tests.support.console import LEADS_ONLY

NOW = 1000.0
PERSON, LEAD = Rank.PERSON, Rank.LEAD
TEACHER, ANN, BOB, EVE, ZED = (
    f"{name}@lab-{number}" for number, name in enumerate(("teacher", "ann", "bob", "eve", "zed"))
)
SENDERS = (TEACHER, ANN, BOB, EVE, ZED)
TABLES = (
    NO_PEOPLE,
    People.parse(["teacher:lead", "ann", "bob", "eve:other"]),
    People.parse(["ann", "bob", "eve:other"]),
)
ESTOPS = (
    (),
    (Estop("e1", BOB, "smoke", 1, fleet_wide=False, rank=PERSON),),
    (Estop("e2", TEACHER, "fire", 1, fleet_wide=True, rank=LEAD),),
    (
        Estop("e2", TEACHER, "fire", 1, fleet_wide=True, rank=LEAD),
        Estop("e3", EVE, "", 1, fleet_wide=True, rank=PERSON),
    ),
    (Estop("e4", ZED, "", 1, fleet_wide=False, rank=PERSON),),
    (Estop("e5", "head@x", "", 1, fleet_wide=False, rank=LEAD),),
)
HOLDS = (None, Hold(ANN, 1, PERSON), Hold(TEACHER, 1, LEAD))
PAUSES = (None, FleetPause("p1", TEACHER, "listen", 1, LEAD), FleetPause("p2", ANN, "", 1, PERSON))
LEASES = (None, Sender(ANN, PERSON), Sender(TEACHER, LEAD), Sender("script@lab-9", Rank.SCRIPT))
LOANS = ("", "bob", "eve", "teacher")
ASKED: dict[Right, tuple[Action, ...]] = {
    Right.MOVE: (Drive(Motion.FORWARD), SetMode(Mode.TRACKING), AimServo(90), ChangeSpeed(SpeedStep.DOWN)),
    Right.ACT: (SetLight(Light.RED), Find()),
    Right.TAKE: (TakeLease(),),
    Right.RESUME: (Resume(),),
    Right.PAUSE: (Pause("listen"),),
    Right.UNPAUSE: (Unpause(),),
    Right.LEND: (Lend("bob", 60.0),),
    Right.END_LOAN: (EndLoan(),),
}
RULES = {"leased", "lent", "not_allowed", "paused", "held", "estopped"}
"""Reasons about rights. All others are about the car."""


def cars() -> Iterator[tuple[refusals.CommandContext, Authority]]:
    """Yield each state of a car: the gateway's own, and what its state/safety says."""
    control = Workbench().control
    for people, estops, hold, pause, lease, loan in itertools.product(TABLES, ESTOPS, HOLDS, PAUSES, LEASES, LOANS):
        if lease is not None and lease.kind is LEAD and not people.leads:
            continue  # a lease ends with its gateway, and so with the gateway's people
        control.people, safety = people, Safety(hold)
        control.safety = safety
        for estop in estops:
            safety.latch(estop)
        if pause is not None:
            safety.merge_pauses([pause], [])
        if loan:
            safety.lend(Loan(loan, TEACHER, LEAD, 1, 60.0), NOW)
        if lease is not None:
            safety.lease = LeaseState(lease, NOW + 1.0)
        message = pb.Safety()
        _fill_safety(message, control, NOW, Sleeps())
        yield control._context(NOW), Authority.of(message)


def decided(context: refusals.CommandContext, sender: Sender, action: Action) -> str | None:
    """Return the rule of RULES by which the gateway rejects an action, None if it has another reason or accepts."""
    refusal = refusals.refuse(Command("1", "any", sender, action, take=isinstance(action, TakeLease)), context)
    return str(refusal[0]) if refusal is not None and str(refusal[0]) in RULES else None


def test_page_shows_what_the_gateway_decides() -> None:
    seen = set()
    for context, authority in cars():
        estops = context.authority.estops
        asked = ASKED | {Right.END_ESTOPS: (Resume(tuple(each.id for each in estops)),) if estops else ()}
        for name in SENDERS:
            sender = authority.people.ranked(Sender(name, PERSON))
            refused = refusals_shown("red", authority, name)
            for right, actions in asked.items():
                denial = authority.denies(sender, right)
                code = None if denial is None else str(denial.reason)
                assert (right in refused) is (denial is not None)
                for action in actions:
                    assert code == decided(context, sender, action), (sender, action, authority)
                    seen.add((right, code))
    assert {right for right, _ in seen} == set(Right)
    assert {code for _, code in seen} == {None, *RULES}


def test_words_name_the_person_the_car_and_the_rule() -> None:
    red = Authority(People.parse(["teacher:lead", "ann", "eve:other"]))
    assert refusals_shown("red", red, EVE)[Right.MOVE] == "eve drives other cars, not red."
    assert refusals_shown("red", red, ZED)[Right.ACT] == "zed watches and stops: the fleet file does not list zed."
    assert refusals_shown("red", red, ANN)[Right.PAUSE] == LEADS_ONLY
    assert refusals_shown("red", red, TEACHER) == {}


def test_recorder_and_plan_are_for_leads_if_there_are_any() -> None:
    red = Authority(People.parse(["teacher:lead", "ann", "eve:other"]))
    blue = Authority(People.parse(["teacher:lead", "eve", "ann:other"]))
    assert [management_refusal({"red": red, "blue": blue}, each) for each in (TEACHER, ANN, EVE, ZED)] == [
        "",
        *[LEADS_ONLY] * 3,
    ]
    assert management_refusal({"green": Authority(), "blue": blue}, ANN) == LEADS_ONLY, "one car has leads"
    no_leads = Authority(People.parse(["ann", "eve:other"]))
    assert [management_refusal({"red": no_leads}, each) for each in (ANN, EVE)] == ["", ""]
    assert management_refusal({"red": no_leads}, ZED) == "zed watches and stops: the fleet file does not list zed."
    assert management_refusal({"red": Authority()}, ZED) == "", "nobody is listed"
    assert rights_of(ANN, {"red": red})["manage"] == LEADS_ONLY
    assert rights_of(ANN, {})["manage"] == ""


def test_fleet_can_be_paused_if_one_car_lets_it() -> None:
    strict = Authority(People.parse(["teacher:lead", "ann"]))
    assert rights_of(ANN, {"red": strict})["pause"] == LEADS_ONLY
    assert rights_of(ANN, {"red": strict, "blue": Authority()})["pause"] == ""
    assert rights_of(TEACHER, {"red": strict})["cars"] == {"red": {}}
    assert rights_of(ANN, {})["pause"] == ""


def test_own_cars_are_listed_whatever_else_refuses() -> None:
    people = People.parse(["teacher:lead", "ann", "bob:other"])
    paused = (FleetPause("p1", TEACHER, "lunch", 0, LEAD),)
    cars = {
        "red": Authority(people, pauses=paused),
        "blue": Authority(people, loan=Loan("bob", TEACHER, LEAD, 0)),
        "green": Authority(people, estops=(Estop("e1", TEACHER, "smoke", 0, fleet_wide=True, rank=LEAD),)),
    }
    assert rights_of(ANN, cars)["mine"] == ["red", "green"]
    assert rights_of(BOB, cars)["mine"] == ["blue"]
    assert rights_of(TEACHER, cars)["mine"] == ["red", "blue", "green"]
    assert rights_of(ZED, cars)["mine"] == []
    assert rights_of(ZED, {"red": Authority()})["mine"] == ["red"], "nobody is listed"
