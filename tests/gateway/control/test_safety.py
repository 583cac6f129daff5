"""Hold, e-stops and lease as values; e-stops united among gateways in any order end alike."""

from hypothesis import given
from hypothesis import strategies as st

from gateway.control.commands import Sender, SenderKind
from gateway.control.safety import MAX_ENDED_ESTOPS, MAX_ESTOPS, Estop, Hold, LeaseState, PersistedSafety, Safety

ANN, BOB = Sender("ann", SenderKind.PERSON), Sender("bob", SenderKind.PERSON)
SCRIPT, PLAN = Sender("ann", SenderKind.SCRIPT), Sender("plan", SenderKind.COORDINATOR)


def estop(identity: str, *, fleet_wide: bool = True) -> Estop:
    return Estop(identity, "eve", "smoke", 7, fleet_wide)


def test_an_e_stop_holds_and_the_hold_outlives_it() -> None:
    safety = Safety()
    safety.latch(estop("a"))
    safety.latch(estop("b", fleet_wide=False))
    assert [each.id for each in safety.estops] == ["a", "b"]
    assert safety.hold == Hold("eve", 7)
    assert [each.id for each in safety.end(["b", "b", "c"])] == ["b"]
    assert safety.end(["a"])
    assert (safety.estops, safety.ended, safety.hold) == ((), ("b", "a"), Hold("eve", 7))


def test_what_is_said_of_one_car_and_then_of_the_fleet_is_the_fleets() -> None:
    safety = Safety()
    safety.latch(estop("a", fleet_wide=False))
    safety.latch(estop("a"))
    safety.latch(estop("a", fleet_wide=False))
    assert [each.fleet_wide for each in safety.estops] == [True]


def test_an_id_that_was_ended_is_latched_under_another_one() -> None:
    safety = Safety()
    safety.latch(estop("a"))
    safety.end(["a"])
    again = safety.latch(estop("a"))
    assert again.id != "a"
    assert safety.estops == (again,)


def test_what_is_kept_is_restored() -> None:
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


def test_e_stops_in_force_are_bounded_and_one_of_the_fleet_always_finds_room() -> None:
    safety = Safety()
    for number in range(1000):
        safety.latch(estop(str(number), fleet_wide=False))
    assert [each.id for each in safety.estops] == [str(number) for number in range(MAX_ESTOPS)]
    begun, _ = safety.merge([estop(f"fleet {number}") for number in range(1000)], ())
    assert len(begun) == MAX_ESTOPS
    assert safety.merge([estop("one more")], ()) == ([], []), "nothing new: the car is not stopped once more"
    assert len(safety.end([each.id for each in safety.estops])) == len(safety.ended) == 2 * MAX_ESTOPS
    assert safety.latch(estop("later")) in safety.estops


def test_only_fleet_wide_ids_are_united_and_ended_wins() -> None:
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


def test_a_lease() -> None:
    safety = Safety()
    safety.grant(SCRIPT, 10.0)
    lease = safety.lease_at(11.9)
    assert lease == LeaseState(SCRIPT, 12.0)
    assert safety.lease_at(12.0) is None
    assert not lease.refuses(SCRIPT, 11.0, take=False)
    assert not lease.refuses(ANN, 11.0, take=False), "a person outranks a script"
    assert lease.refuses(PLAN, 11.0, take=True)
    assert lease.refuses(Sender("other"), 11.0, take=True), "only a person may take"
    assert not lease.refuses(PLAN, 12.0, take=False), "it is over"
    persons = LeaseState(ANN, 12.0)
    assert persons.refuses(BOB, 11.0, take=False), "between equals the holder keeps it"
    assert not persons.refuses(BOB, 11.0, take=True)
    safety.shorten_lease(5.0)
    assert safety.lease_at(6.9) == LeaseState(SCRIPT, 7.0)
    assert not safety.release(ANN)
    assert safety.release(SCRIPT)
    assert safety.lease_at(5.0) is None
