"""Pairing codes, cookies and the slow-down, on virtual time."""

from contextlib import suppress

import pytest
from hypothesis import given
from hypothesis import strategies as st
from msgspec.structs import replace

from fleet.console import people_book
from fleet.console.connection_limit import (
    MAX_CONNECTIONS,
    MAX_PER_DEVICE,
    MAX_STRANGERS_PER_ADDRESS,
    STRANGER_TIMEOUT_S,
    ConnectionLimit,
    LogLimit,
)
from fleet.console.guess_limit import GUESS_MEMORY_S, MAX_GUESS_DELAY_S, MAX_GUESSERS, GuessLimit
from fleet.console.people_book import (
    BadBook,
    ClassFull,
    NoGuest,
    PagePerson,
    PeopleBook,
    UnknownPerson,
    code_words,
    new_code,
)
from fleet.hub.join_code import CODE_ALPHABET

MIA = PagePerson("mia")
CODES = st.text(CODE_ALPHABET, min_size=people_book.CODE_LENGTH, max_size=people_book.CODE_LENGTH)
NOW = 1.8e9


def paired(code: str = "K7QF3MXP", cookie: str = "cookie", now: float = NOW) -> PeopleBook:
    found = PeopleBook().issue(code, MIA, now).redeem(code, cookie, "d1", "Phone", now)
    assert found is not None
    return found


@given(CODES, CODES, st.floats(-1e6, 1e6))
def test_pairing_code_is_good_once_within_two_minutes(code: str, other: str, age_s: float) -> None:
    book = PeopleBook().issue(code, MIA, NOW)
    assert (book.redeem(other, "c", "d1", "", NOW) is not None) is (other == code)
    found = book.redeem(code_words(code).lower(), "c", "d1", "", NOW + age_s)
    assert (found is not None) is (0 <= (NOW + age_s) - NOW < people_book.CODE_LIFETIME_S)
    if found is not None:
        assert found.redeem(code, "c2", "d2", "", NOW + age_s) is None, "a replay"
        assert found.devices[0].person == MIA


def test_new_pairing_code_keeps_other_and_old_ones_expire() -> None:
    book = PeopleBook()
    for number in range(people_book.MAX_CODES + 3):
        book = book.issue(f"CODE{number:04}", MIA, NOW)
    assert len(book.codes) == people_book.MAX_CODES
    assert book.redeem("CODE0000", "c", "d", "", NOW) is None
    assert book.redeem("CODE0007", "c", "d", "", NOW) is not None
    assert len(book.issue("LATER234", MIA, NOW + people_book.CODE_LIFETIME_S).codes) == 1


@pytest.mark.parametrize("person", [PagePerson("Mia M"), PagePerson(""), PagePerson("mia", "king"), PagePerson("a/b")])
def test_pairing_code_needs_valid_name_and_rank(person: PagePerson) -> None:
    with pytest.raises(ValueError):
        PeopleBook().issue("K7QF3MXP", person, NOW)


def test_pairing_code_is_for_listed_people() -> None:
    book = replace(PeopleBook(), people=("mia", "teacher"))
    assert len(book.issue("K7QF3MXP", MIA, NOW).codes) == 1
    with pytest.raises(UnknownPerson, match="teacher"):
        book.issue("K7QF3MXP", PagePerson("teachr"), NOW)
    assert PeopleBook.of_text(book.as_text()) == book
    assert PeopleBook.of_text('{"codes": [], "devices": [], "address": ""}').people is None
    with pytest.raises(UnknownPerson):
        replace(book, people=()).issue("K7QF3MXP", MIA, NOW)


def test_paired_lead_is_lead_only_while_fleet_file_says_so() -> None:
    lead, stranger = PagePerson("teacher", "lead"), PagePerson("mia", "lead")
    assert PeopleBook().issue("K7QF3MXP", stranger, NOW).codes, "that fleet lists nobody"
    book = replace(PeopleBook(), people=("mia", "teacher"), leads=("teacher",))
    assert PeopleBook.of_text(book.as_text()) == book
    refused: list[tuple[PagePerson, tuple[str, ...]]] = [(stranger, ("teacher",)), (stranger, ()), (lead, ())]
    for one, listed in refused:
        with pytest.raises(ValueError, match=r"does not make \w+ a lead"):
            replace(book, leads=listed).issue("K7QF3MXP", one, NOW)
    assert book.issue("K7QF3MXP", MIA, NOW).codes
    paired_lead = book.issue("K7QF3MXP", lead, NOW).redeem("K7QF3MXP", "cookie", "d", "", NOW)
    assert paired_lead is not None
    now: list[tuple[tuple[str, ...] | None, str]] = [(("teacher",), "lead"), ((), "person"), (None, "lead")]
    for leads, rank in now:
        device, _ = replace(paired_lead, leads=leads).device_of("cookie", NOW)
        assert device is not None
        assert device.person == PagePerson("teacher", rank)
        assert replace(paired_lead, leads=leads).open_devices(NOW) == [device]


def test_cookie_is_valid_for_a_month_then_only_stops() -> None:
    book = paired()
    states = [book.device_of("cookie", NOW + days * 86_400)[1] for days in (0, 29.9, 30.1, 119.9, 120.1)]
    assert states == ["valid", "valid", "expired", "expired", "unknown"]
    assert book.device_of("cookie", NOW + 121 * 86_400)[0] is None
    assert book.device_of("guess", NOW) == (None, "unknown")
    assert book.device_of("", NOW) == (None, "unknown")


def test_neither_codes_nor_cookies_are_stored() -> None:
    book = paired().issue("ABCDEFGH", MIA, NOW)
    assert "cookie" not in book.as_text()
    assert "ABCDEFGH" not in book.as_text()
    assert "K7QF3MXP" not in book.as_text()


@given(st.lists(st.tuples(CODES, st.text(max_size=80)), max_size=5))
def test_people_book_survives_restart(pairs: list[tuple[str, str]]) -> None:
    book = PeopleBook(address="https://192.168.1.5:7443")
    for index, (code, device) in enumerate(pairs):
        book = book.issue(code, PagePerson("teacher", "lead"), NOW)
        book = book.redeem(code, f"cookie{index}", f"id{index}", device, NOW) or book
    assert PeopleBook.of_text(book.as_text()) == book
    assert all(each.device.isprintable() for each in book.devices)


@given(st.text())
def test_damaged_people_book_is_refused(text: str) -> None:
    with pytest.raises(BadBook):
        PeopleBook.of_text(text)
    with pytest.raises(BadBook):
        PeopleBook.of_text(paired().as_text().replace('"digest": "', '"digest": 1, "x": "'))


CLASS = "CLASS234"


def join(book: PeopleBook, number: int, now: float = NOW, code: str = CLASS) -> PeopleBook | None:
    return book.redeem(code, f"cookie{number}", f"id{number}", "Phone", now)


def test_class_code_pairs_guests_for_ten_minutes_until_closed() -> None:
    book = paired().open_class(CLASS, NOW)
    for number in range(3):
        found = join(book, number, NOW + number)
        assert found is not None
        book = found
    assert [each.person.name for each in book.guests(NOW + 5)] == ["guest-1", "guest-2", "guest-3"]
    assert PeopleBook.of_text(book.as_text()) == book
    assert CLASS not in book.as_text()
    assert join(book, 9, NOW + people_book.CLASS_LIFETIME_S - 1) is not None
    assert join(book, 9, NOW + people_book.CLASS_LIFETIME_S) is None
    assert join(book, 9, NOW - 1) is None, "a clock that was set back ends it"
    assert join(book.close_class(), 9) is None
    assert join(book.open_class("OTHER234", NOW), 9) is None, "a new one ends the one before"
    states = [book.device_of("cookie0", NOW + hours * 3600)[1] for hours in (11.9, 12.1)]
    assert states == ["valid", "unknown"], "a guest is forgotten after a day of school"


def test_thousand_guests_are_one_class_and_displace_nobody() -> None:
    book = PeopleBook()
    for number in range(people_book.MAX_DEVICES - 10):
        book = book.issue(f"CODE{number:04}", MIA, NOW)
        book = book.redeem(f"CODE{number:04}", f"own{number}", f"own{number}", "", NOW) or book
    persons = book.devices
    book = book.open_class(CLASS, NOW)
    full = 0
    for number in range(1000):
        try:
            book = join(book, number) or book
        except ClassFull:
            full += 1
    assert (len(book.guests(NOW)), full) == (10, 990), "there are that many places"
    assert book.devices[: len(persons)] == persons
    book = replace(book, devices=())
    for number in range(1000):
        with suppress(ClassFull):
            book = join(book, number) or book
    assert len(book.guests(NOW)) == people_book.MAX_GUESTS
    names = [each.person.name for each in book.guests(NOW)]
    assert len(set(names)) == len(names)


@given(st.lists(CODES, min_size=1, max_size=200))
def test_guesses_join_no_class(guesses: list[str]) -> None:
    book = PeopleBook().open_class(CLASS, NOW)
    for guess in guesses:
        assert (join(book, 1, code=guess) is not None) is (guess == CLASS)
        assert book.is_class_code(guess, NOW) is (guess == CLASS)


def test_guest_becomes_person_once_and_is_listed() -> None:
    listed = replace(PeopleBook(), people=("mia", "teacher"), leads=("teacher",))
    book = join(listed.open_class(CLASS, NOW), 1)
    assert book is not None
    later = NOW + 3600
    done = book.assign("id1", MIA, later)
    device, state = done.device_of("cookie1", later + 29 * 86_400)
    assert device is not None
    assert (device.person, state) == (MIA, "valid"), "it is paired from then on"
    assert done.guests(later) == []
    for wrong, error in ((PagePerson("nobody"), UnknownPerson), (PagePerson("mia", "lead"), ValueError)):
        with pytest.raises(error):
            book.assign("id1", wrong, later)
    for gone in (done, replace(book, devices=())):
        with pytest.raises(NoGuest):
            gone.assign("id1", MIA, later)
    with pytest.raises(NoGuest):
        book.assign("id1", MIA, NOW + people_book.GUEST_LIFETIME_S)
    with pytest.raises(NoGuest):
        replace(paired(), people=("mia",)).assign("d1", MIA, NOW)  # a person stays who they are
    with pytest.raises(ValueError, match="guest"):
        replace(listed, people=("guest",)).open_class(CLASS, NOW)
    for rank in ("guest", "king"):
        with pytest.raises(ValueError):
            PeopleBook().issue("K7QF3MXP", PagePerson("mia", rank), NOW)
    named = replace(listed, people=("guest-1",)).open_class(CLASS, NOW)
    assert [each.person.name for each in (join(named, 1) or named).guests(NOW)] == ["guest-2"]


@pytest.mark.parametrize("name", ["d1", "mia"])
def test_revoked_device_is_unknown_and_loses_open_code(name: str) -> None:
    book, gone = paired().issue("ABCDEFGH", MIA, NOW).revoke([name])
    assert [each.id for each in gone] == ["d1"]
    assert book.device_of("cookie", NOW) == (None, "unknown")
    assert (book.redeem("ABCDEFGH", "c", "d", "", NOW) is None) is (name == "mia")


def test_pairing_guesses_of_one_address_take_days() -> None:
    limit, now = GuessLimit(), 0.0
    for _ in range(1000):
        now += limit.wait_s("10.0.0.9", now)
        assert limit.wait_s("10.0.0.9", now) == 0
        limit.on_wrong("10.0.0.9", now)
    assert now > 3 * 86_400
    assert limit.wrong == 1000
    assert limit.wait_s("10.0.0.5", now) == 0, "nobody else waits"


@given(st.lists(st.integers(0, 1000), max_size=40))
def test_waits_grow_up_to_a_limit_and_are_forgotten(pauses: list[int]) -> None:
    limit, now, before = GuessLimit(), 0.0, 0.0
    for pause in pauses:
        now += pause
        limit.on_wrong("a", now)
        wait = limit.wait_s("a", now)
        assert before <= wait <= MAX_GUESS_DELAY_S
        before = wait
    assert limit.wait_s("a", now + GUESS_MEMORY_S) == 0
    limit.on_right("a")
    assert limit.wait_s("a", now) == 0


def test_memory_of_guesses_is_bounded() -> None:
    limit = GuessLimit()
    for number in range(MAX_GUESSERS + 50):
        limit.on_wrong(str(number), 0.0)
    assert len(limit._guessers) == MAX_GUESSERS


def test_codes_have_no_letters_that_are_confused() -> None:
    assert new_code(lambda letters: letters[0]) == "22222222"
    assert not {*"01IO"} & {*CODE_ALPHABET}


# ---------------------------------------------------------------- connections

EVENTS = st.lists(
    st.tuples(st.sampled_from(["open", "pair", "close", "expire"]), st.integers(0, 300), st.floats(0, 2)), max_size=600
)


@given(EVENTS)
def test_strangers_are_few_and_paired_devices_stay(events: list[tuple[str, int, float]]) -> None:
    limit, now, opened = ConnectionLimit(), 0.0, 0
    strangers: dict[int, float] = {}
    paired_ones: set[int] = set()
    for kind, number, pause in events:
        now += pause
        match kind:
            case "open":
                opened += 1
                key = 1000 + opened
                stays, ended = limit.admit(key, str(number % 3), now)
                assert ended not in paired_ones
                if isinstance(ended, int):
                    del strangers[ended]
                if stays:
                    strangers[key] = now
            case "pair" if strangers:
                key = sorted(strangers)[number % len(strangers)]
                assert limit.on_paired(key, f"device {key}")
                del strangers[key]
                paired_ones.add(key)
            case "close" if strangers:
                key = sorted(strangers)[number % len(strangers)]
                limit.on_closed(key)
                del strangers[key]
            case _:
                late = limit.expire(now)
                assert set(late) == {key for key, since in strangers.items() if now - since >= STRANGER_TIMEOUT_S}
                strangers = {key: since for key, since in strangers.items() if key not in late}
        assert len(limit) == len(strangers) + len(paired_ones) <= MAX_CONNECTIONS
        assert len(strangers) <= 3 * MAX_STRANGERS_PER_ADDRESS


def test_full_house_drops_oldest_stranger_never_paired_device() -> None:
    limit = ConnectionLimit()
    for number in range(MAX_CONNECTIONS):
        assert limit.admit(number, str(number), float(number)) == (True, None)
        if number:
            assert limit.on_paired(number, str(number))
    assert limit.admit("new", "x", 1000.0) == (True, 0)
    assert limit.on_paired("new", "a new device")
    assert limit.admit("one more", "y", 1001.0) == (False, None)


def test_connections_are_limited_per_device() -> None:
    limit, kept = ConnectionLimit(), 0
    for number in range(100):
        assert limit.admit(number, str(number), 0.0)[0]
        kept += limit.on_paired(number, "greedy")
    assert kept == len(limit) == MAX_PER_DEVICE
    assert limit.on_paired(0, "greedy"), "it shows its cookie with each request"
    assert limit.admit("phone", "phone", 1.0)[0]
    assert limit.on_paired("phone", "calm")


def test_log_limit_counts_suppressed_messages() -> None:
    limit = LogLimit(10.0)
    assert [limit.words("refused", now) for now in (0.0, 1.0, 9.9)] == ["refused", None, None]
    assert limit.words("refused", 10.0) == "refused (2 more since the last message)"
    assert limit.words("refused", 20.0) == "refused"
