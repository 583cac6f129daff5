"""Tests of hold, e-stops, pauses, loan and lease as values. Gateways agree, in whatever order they merge e-stops."""

from hypothesis import given
from hypothesis import strategies as st
from msgspec.structs import replace

from gateway.control.safety_state import (
    MAX_ENDED_ESTOPS,
    MAX_ENDED_PAUSES,
    MAX_ESTOPS,
    MAX_PAUSES,
    PersistedSafety,
    Safety,
)
from schemas.rights import Estop, FleetPause, Hold, LeaseState, Loan, Sender
from schemas.words import Rank

ANN, BOB = Sender("ann", Rank.PERSON), Sender("bob", Rank.PERSON)
SCRIPT, PLAN = Sender("ann", Rank.SCRIPT), Sender("plan", Rank.COORDINATOR)


def estop(identity: str, *, fleet_wide: bool = True) -> Estop:
    return Estop(identity, "eve", "smoke", 7, fleet_wide)


def test_estop_sets_hold_that_outlives_it() -> None:
    safety = Safety()
    safety.latch(estop("a"))
    safety.latch(estop("b", fleet_wide=False))
    assert [each.id for each in safety.estops] == ["a", "b"]
    assert safety.hold == Hold("eve", 7)
    assert [each.id for each in safety.end(["b", "b", "c"])] == ["b"]
    assert safety.end(["a"])
    assert (safety.estops, safety.ended, safety.hold) == ((), ("b", "a"), Hold("eve", 7))


def test_fleet_estop_replaces_same_estop_of_car() -> None:
    safety = Safety()
    safety.latch(estop("a", fleet_wide=False))
    safety.latch(estop("a"))
    safety.latch(estop("a", fleet_wide=False))
    assert [each.fleet_wide for each in safety.estops] == [True]


def test_ended_estop_id_is_latched_under_new_id() -> None:
    safety = Safety()
    safety.latch(estop("a"))
    safety.end(["a"])
    again = safety.latch(estop("a"))
    assert again.id != "a"
    assert safety.estops == (again,)


def test_persisted_safety_is_restored() -> None:
    safety = Safety()
    safety.latch(estop("a"))
    safety.latch(estop("b"))
    safety.end(["a"])
    safety.grant(ANN, 5.0)
    restored = Safety.restore(safety.persisted)
    assert restored.persisted == safety.persisted == PersistedSafety(Hold("eve", 7), (estop("b"),), ("a",))
    assert restored.lease is None, "who drives says so again"


def test_ended_ids_are_bounded() -> None:
    safety = Safety()
    for number in range(MAX_ENDED_ESTOPS + 9):
        safety.latch(estop(str(number)))
        safety.end([str(number)])
    assert safety.ended == tuple(str(number) for number in range(9, MAX_ENDED_ESTOPS + 9))


def test_estops_are_bounded_and_fleet_one_always_fits() -> None:
    safety = Safety()
    for number in range(1000):
        safety.latch(estop(str(number), fleet_wide=False))
    assert [each.id for each in safety.estops] == [str(number) for number in range(MAX_ESTOPS)]
    begun, _ = safety.merge([estop(f"fleet {number}") for number in range(1000)], ())
    assert len(begun) == MAX_ESTOPS
    assert safety.merge([estop("one more")], ()) == ([], []), "nothing new: the car is not stopped once more"
    assert len(safety.end([each.id for each in safety.estops])) == len(safety.ended) == 2 * MAX_ESTOPS
    assert safety.latch(estop("later")) in safety.estops


def test_merge_unites_fleet_wide_estops_and_ended_wins() -> None:
    red, blue = Safety(), Safety()
    red.latch(estop("fleet"))
    red.latch(estop("own", fleet_wide=False))
    begun, over = blue.merge(red.estops, red.ended)
    assert ([each.id for each in begun], over) == (["fleet"], [])
    assert blue.hold == Hold("eve", 7)
    blue.end(["fleet"])
    begun, over = red.merge(blue.estops, blue.ended)
    assert (begun, [each.id for each in over]) == ([], ["fleet"])
    assert [each.id for each in red.estops] == ["own"]
    assert blue.merge((estop("fleet"),), ()) == ([], []), "ended wins over one who has not heard of it"


def test_ended_estop_does_not_come_back_through_a_third_gateway() -> None:
    """Red has ended it, blue has not heard of that, and green hears of the end before it hears of the e-stop."""
    blue, green = Safety(), Safety()
    blue.latch(estop("fleet"))
    assert green.merge((), ("fleet",)) == ([], [])
    assert green.merge(blue.estops, blue.ended) == ([], [])
    assert green.estops == ()


def test_ended_ids_of_others_replace_none_of_our_own() -> None:
    """Each gateway remembers as many as it may. Green hangs, and has not heard that the e-stop and the pause ended."""
    red, blue, green = Safety(), Safety(), Safety()
    for name, car in {"red": red, "blue": blue, "green": green}.items():
        for number in range(MAX_ENDED_ESTOPS):
            car.latch(estop(f"{name} {number}", fleet_wide=False))
            car.end([f"{name} {number}"])
            car.end_pauses([f"{name} {number}"])
        car.latch(estop("fleet"))
        car.pause(FleetPause("fleet", "eve", "", 7))
    for car in (red, blue):
        car.end(["fleet"])
        car.end_pauses(["fleet"])
    before = red.persisted
    for other in (blue, green):
        assert red.merge(other.estops, other.ended) == ([], [])
        assert red.merge_pauses(other.pauses, other.ended_pauses) == ([], [])
    assert red.persisted == before
    assert [each.id for each in green.merge(red.estops, red.ended)[1]] == ["fleet"]


def test_gateway_without_people_learns_rank_of_estop() -> None:
    """The e-stop of a lead reaches each gateway directly. A gateway without people latches it as a person's."""
    own = estop("a")
    lead = replace(own, rank=Rank.LEAD)
    safety = Safety()
    safety.latch(own)
    assert safety.merge([lead], ()) == ([], []), "nothing new: the car is not stopped once more"
    assert (safety.estops, safety.hold) == ((lead,), Hold("eve", 7, Rank.LEAD))
    assert safety.merge([own], ()) == ([], [])
    assert safety.estops == (lead,), "no other gateway lowers the rank"
    safety.end(["a"])
    assert safety.merge([lead], ()) == ([], [])
    assert safety.estops == ()


@given(st.lists(st.tuples(st.integers(0, 2), st.sampled_from("abcd"), st.booleans()), max_size=30))
def test_gateways_that_see_each_other_agree(steps: list[tuple[int, str, bool]]) -> None:
    cars = [Safety(), Safety(), Safety()]
    for number, identity, ends in steps:
        if ends:
            cars[number].end([identity])
        elif identity not in cars[number].ended:
            cars[number].latch(estop(identity))
    for _ in range(2):
        for one in cars:
            for other in cars:
                if one is not other:
                    one.merge(other.estops, other.ended)
    assert len({frozenset(each.id for each in car.estops) for car in cars}) == 1
    ended = {each for car in cars for each in car.ended}
    assert not ended & {each.id for car in cars for each in car.estops}


@given(st.permutations(range(4)), st.lists(st.tuples(st.integers(0, 3), st.sampled_from("abcd"), st.booleans())))
def test_gateways_agree_on_pauses_in_any_order(order: list[int], steps: list[tuple[int, str, bool]]) -> None:
    """A pause may reach the gateways with different times, and its end may arrive first."""
    cars = [Safety() for _ in order]
    for number, identity, ends in steps:
        if ends:
            cars[number].end_pauses([identity])
        else:
            cars[number].pause(FleetPause(identity, "eve", "", number, list(Rank)[number]))
    seen = [(car.pauses, car.ended_pauses) for car in cars]
    first, last = Safety(), Safety()
    for number in order:
        first.merge_pauses(*seen[number])
    for pauses, ended in reversed([seen[number] for number in order]):
        last.merge_pauses(pauses, ended)
    ended_ids = {each for _, ended in seen for each in ended}
    assert first.pauses == last.pauses
    assert set(first.ended_pauses) == set(last.ended_pauses) == ended_ids
    assert {each.id for each in first.pauses} == {each.id for pauses, _ in seen for each in pauses} - ended_ids
    before = first.persisted
    for pauses, ended in seen:
        assert first.merge_pauses(pauses, ended) == ([], [])
    assert first.persisted == before


def test_pauses_are_bounded_and_an_ended_one_stays_ended() -> None:
    safety = Safety()
    assert all(safety.pause(FleetPause(str(number), "eve", "", number)) for number in range(MAX_PAUSES))
    assert not safety.pause(FleetPause("one more", "eve", "", 99))
    assert len(safety.end_pauses([each.id for each in safety.pauses])) == MAX_PAUSES
    assert not safety.pause(FleetPause("7", "eve", "", 7))
    assert safety.end_pauses(["not known yet"]) == []
    assert not safety.pause(FleetPause("not known yet", "eve", "", 7))
    safety.end_pauses(str(number) for number in range(1000, 1000 + MAX_ENDED_PAUSES))
    assert len(safety.ended_pauses) == MAX_ENDED_PAUSES


def test_nobody_lowers_rank_of_foreign_estop_or_hold() -> None:
    safety = Safety()
    lead = Estop("a", "eve", "", 1, fleet_wide=False, rank=Rank.LEAD)
    safety.latch(lead)
    assert safety.latch(replace(lead, by="bob", rank=Rank.PERSON, fleet_wide=True)) == replace(lead, fleet_wide=True)
    safety.put_on_hold("bob", 2, Rank.PERSON)
    assert safety.hold == Hold("eve", 1, Rank.LEAD)


def test_loan_is_restored_for_remaining_time() -> None:
    loan = Loan("bob", "eve", Rank.LEAD, 1_000_000_000, 10.0)
    safety = Safety.restore(PersistedSafety(loan=loan), now=500.0, now_ns=4_000_000_000)
    assert safety.loan_until == 507.0
    assert safety.loan_at(506.9) == loan
    assert safety.loan_at(507.0) is None
    assert loan.left_s(0) == 10.0, "a clock that was set back prolongs no loan"
    assert safety.persisted.loan == loan


def test_lease_refuses_by_rank_and_expires() -> None:
    safety = Safety()
    safety.grant(SCRIPT, 10.0)
    lease = safety.lease_at(11.9)
    assert lease == LeaseState(SCRIPT, 12.0)
    assert safety.lease_at(12.0) is None
    assert not lease.refuses(SCRIPT, take=False)
    assert not lease.refuses(ANN, take=False), "a person outranks a script"
    assert lease.refuses(PLAN, take=True)
    assert lease.refuses(Sender("other"), take=True), "only a person may take"
    persons = LeaseState(ANN, 12.0)
    assert persons.refuses(BOB, take=False), "between equals the holder keeps it"
    assert not persons.refuses(BOB, take=True)
    safety.shorten_lease(5.0)
    assert safety.lease_at(6.9) == LeaseState(SCRIPT, 7.0)
    assert not safety.release(ANN)
    assert safety.release(SCRIPT)
    assert safety.lease_at(5.0) is None
