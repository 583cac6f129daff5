"""The dead-man of the pages. Time is an argument, so each case is exact."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from fleet.console.hold_to_drive import AFTER_STOP_S, MAX_ECHO_GAP_S, MAX_TICK_AGE_S, PressBook, PressRefused
from schemas.rights import People, PersonRole

RED = ("red",)
PEOPLE = People(dict.fromkeys(("head", "teacher"), PersonRole.LEAD))


def book_with_press(*, at: float = 10.0, cars: tuple[str, ...] = RED) -> tuple[PressBook, int]:
    book = PressBook()
    tick = book.tick(at)
    book.begin(1, 1, cars, "forward", tick, at)
    return book, tick


def test_press_lives_while_new_ticks_are_echoed() -> None:
    book, _ = book_with_press()
    for step in range(1, 50):
        now = 10.0 + step * 0.1
        tick = book.tick(now)
        assert book.echo(1, 1, tick, now + 0.02) is not None
        assert book.expire(now + 0.05) == []


def test_press_without_echo_ends_after_gap_and_stays_over() -> None:
    book, _ = book_with_press()
    assert book.expire(9.99 + MAX_ECHO_GAP_S) == []
    (over,) = book.expire(10.01 + MAX_ECHO_GAP_S)
    assert over.cars == RED
    tick = book.tick(10.4)
    assert book.echo(1, 1, tick, 10.4) is None
    with pytest.raises(PressRefused, match="over"):
        book.begin(1, 1, RED, "forward", tick, 10.4)
    assert book.begin(1, 2, RED, "forward", tick, 10.4)[0].id == 2


def test_late_echo_does_not_count_even_before_expiry() -> None:
    """If our own loop was blocked, it handles the pending echoes before `expire`."""
    book, _ = book_with_press()
    late = book.tick(10.0 + MAX_ECHO_GAP_S + 0.1)
    assert book.echo(1, 1, late, 10.0 + MAX_ECHO_GAP_S + 0.1) is None
    assert len(book.expire(10.0 + MAX_ECHO_GAP_S + 0.1)) == 1


def test_echo_of_old_tick_does_not_count() -> None:
    """A restored link delivers a burst, and so does a resumed page."""
    book, first = book_with_press()
    book.tick(10.1)
    assert book.echo(1, 1, first, 9.99 + MAX_TICK_AGE_S) is not None
    assert book.echo(1, 1, first, 10.01 + MAX_TICK_AGE_S) is None
    assert book.echo(1, 1, 99, 10.1) is None, "a tick that was never issued"


def test_press_with_old_tick_is_refused() -> None:
    book = PressBook()
    tick = book.tick(10.0)
    with pytest.raises(PressRefused, match="slow"):
        book.begin(1, 1, RED, "forward", tick, 10.01 + MAX_TICK_AGE_S)
    assert book.alive == []


def test_release_that_overtakes_its_press_ends_it() -> None:
    book = PressBook()
    tick = book.tick(10.0)
    assert book.release(1, 1) is None
    with pytest.raises(PressRefused):
        book.begin(1, 1, RED, "forward", tick, 10.0)


def test_release_of_earlier_press_ends_no_later_one() -> None:
    book, tick = book_with_press()
    book.begin(1, 2, RED, "back", tick, 10.0)
    assert book.release(1, 1) is None
    assert [press.motion for press in book.alive] == ["back"]
    assert book.release(1, 2) is not None


def test_two_pages_never_drive_one_car() -> None:
    book, tick = book_with_press(cars=("red", "blue"))
    with pytest.raises(PressRefused, match="Another page drives blue"):
        book.begin(2, 1, ("blue", "green"), "back", tick, 10.0)
    assert book.begin(2, 2, ("green",), "back", tick, 10.0)
    assert [press.client for press in book.drop_client(1)] == [1]
    assert book.begin(2, 3, ("blue",), "back", tick, 10.0)


def test_stop_ends_presses_and_delays_next() -> None:
    book, tick = book_with_press()
    assert len(book.on_stop(10.1)) == 1
    tick = book.tick(10.2)
    with pytest.raises(PressRefused, match="just now"):
        book.begin(1, 2, RED, "forward", tick, 10.2)
    later = 10.11 + AFTER_STOP_S
    assert book.begin(1, 3, RED, "forward", book.tick(later), later)


@given(st.lists(st.tuples(st.sampled_from(["tick", "echo", "late echo", "release", "expire"]), st.floats(0.0, 0.5))))
def test_ended_press_never_revives(steps: list[tuple[str, float]]) -> None:
    """In any order of events, no echo counts after a gap, and no press outlives a gap."""
    book, newest = book_with_press()
    now, last_echo, over = 10.0, 10.0, False
    ticks = {newest: 10.0}
    for what, pause in steps:
        now += pause
        if what == "tick":
            newest = book.tick(now)
            ticks[newest] = now
        elif what in ("echo", "late echo"):
            number = newest if what == "echo" else min(ticks)
            counted = book.echo(1, 1, number, now) is not None
            over = over or now - last_echo > MAX_ECHO_GAP_S
            assert not (counted and (over or now - ticks[number] > MAX_TICK_AGE_S))
            if counted:
                last_echo = now
        elif what == "release":
            book.release(1, 1)
            over = True
        else:
            book.expire(now)
            over = over or now - last_echo > MAX_ECHO_GAP_S
            assert not (over and book.alive)


def test_computer_sleep_ends_presses_and_old_ticks_do_not_count() -> None:
    """The clock of the server stood still, so that neither the tick nor the echo looks old."""
    book, tick = book_with_press()
    (over,) = book.on_sleep()
    assert over.cars == RED
    assert book.alive == []
    assert book.echo(1, 1, tick, 10.05) is None
    with pytest.raises(PressRefused):
        book.begin(1, 2, RED, "forward", tick, 10.05)
    assert book.begin(1, 3, RED, "forward", book.tick(10.1), 10.1)[0].id == 3


@pytest.mark.parametrize(
    ("person", "holder", "takes"),
    [("teacher", "pupil", True), ("pupil", "teacher", False), ("teacher", "head", False), ("pupil", "other", False)],
)
def test_press_of_person_is_taken_by_lead_only(person: str, holder: str, *, takes: bool) -> None:
    book = PressBook()
    tick = book.tick(10.0)
    book.begin(1, 1, ("red", "blue"), "forward", tick, 10.0, person=holder, people=PEOPLE)
    if not takes:
        with pytest.raises(PressRefused, match=f"{holder} drives red"):
            book.begin(2, 1, RED, "back", tick, 10.0, person=person, people=PEOPLE)
        assert [press.client for press in book.alive] == [1]
        return
    press, (taken,) = book.begin(2, 1, RED, "back", tick, 10.0, person=person, people=PEOPLE)
    assert (press.motion, taken.client) == ("back", 1)
    assert [each.client for each in book.alive] == [2]
    assert book.echo(1, 1, tick, 10.1) is None, "what was taken does not drive on"


@pytest.mark.parametrize(
    ("person", "holder", "ends"),
    [
        ("teacher", "pupil", True),
        ("pupil", "teacher", False),
        ("teacher", "head", False),
        ("pupil", "other", False),
        ("pupil", "pupil", True),
    ],
)
def test_mode_or_release_ends_no_press_of_higher_rank(person: str, holder: str, *, ends: bool) -> None:
    book = PressBook()
    book.begin(1, 1, RED, "forward", book.tick(10.0), 10.0, person=holder, people=PEOPLE)
    assert not book.drop_cars_of({"blue"}, person, PEOPLE)
    assert bool(book.drop_cars_of({"red"}, person, PEOPLE)) is ends
    assert bool(book.alive) is not ends


def test_bus_loss_ends_presses() -> None:
    book, tick = book_with_press()
    assert [press.client for press in book.on_bus_lost()] == [1]
    assert book.echo(1, 1, tick, 10.1) is None
