"""The lines of the connections that wait for TLS."""

import random
from collections.abc import Hashable

from hypothesis import given
from hypothesis import strategies as st

from fleet.console.waiting_room import (
    ADDRESS_BURST,
    ADDRESS_RATE,
    HELLO_TIMEOUT_S,
    MAX_ADDRESSES,
    MAX_HANDSHAKES_PER_ADDRESS,
    MAX_WAITING,
    TOTAL_BURST,
    WaitingRoom,
)

CLASS, OTHER = "10.0.0.9", "10.0.0.7"


def room() -> WaitingRoom:
    return WaitingRoom(random.Random(1).choice)


def serve(waiting: WaitingRoom, now: float, address: str = CLASS) -> list[Hashable]:
    """Serve all that may begin, each at once. Return their keys."""
    served: list[Hashable] = []
    while (key := waiting.take(now)) is not None:
        served.append(key)
        waiting.on_begun(address)
    return served


def used_up(waiting: WaitingRoom) -> WaitingRoom:
    """Use up the burst of the class."""
    for number in range(int(ADDRESS_BURST)):
        waiting.add(("burst", number), CLASS, 0.0)
        waiting.on_hello(("burst", number), CLASS)
        assert serve(waiting, 0.0) == [("burst", number)]
    return waiting


def test_full_waiting_room_drops_only_silent_connections() -> None:
    waiting = used_up(room())
    for number in range(5000):
        dropped = waiting.add(("flood", number), CLASS, 0.0)
        assert dropped != "lead"
        if number == 2000:
            assert waiting.add("lead", CLASS, 0.0) != "lead"
            waiting.on_hello("lead", CLASS)
    assert serve(waiting, 0.0) == []
    assert serve(waiting, 1.0 / ADDRESS_RATE) == ["lead"]


def test_clients_that_connect_again_and_again_wait_behind_everybody_else() -> None:
    waiting = used_up(room())
    for key in ("a", "b", "lead"):
        waiting.add(key, CLASS, 0.0)
        waiting.on_hello(key, CLASS)
    order: list[Hashable] = []
    for turn in range(1, 5):
        served = serve(waiting, turn / ADDRESS_RATE)
        order += served
        for again in served:
            waiting.add(again, CLASS, 0.0)
            waiting.on_hello(again, CLASS)
    assert order == ["a", "b", "lead", "a"]


def test_flood_costs_no_other_address_its_turn() -> None:
    waiting = used_up(room())
    for number in range(1000):
        waiting.add(number, CLASS, 0.0)
        waiting.on_hello(number, CLASS)
    assert waiting.add("phone", OTHER, 0.0) != "phone"
    waiting.on_hello("phone", OTHER)
    assert waiting.take(0.0) == "phone"
    assert waiting.take(0.0) is None
    assert waiting.has_ready


def test_handshakes_that_do_not_end_take_so_many_places() -> None:
    waiting = room()
    for number in range(MAX_HANDSHAKES_PER_ADDRESS + 5):
        waiting.add(number, CLASS, 0.0)
        waiting.on_hello(number, CLASS)
    begun = 0
    while waiting.take(0.0) is not None:
        begun += 1
    assert begun == MAX_HANDSHAKES_PER_ADDRESS
    waiting.on_begun(CLASS)
    assert waiting.take(0.0) is not None


def test_waiting_room_expires_silent_connection() -> None:
    waiting = room()
    waiting.add("silent", CLASS, 0.0)
    waiting.add("ready", CLASS, 0.0)
    waiting.on_hello("ready", CLASS)
    assert waiting.expire(HELLO_TIMEOUT_S - 0.1) == []
    assert waiting.expire(HELLO_TIMEOUT_S) == ["silent"]
    assert len(waiting) == 1


def test_many_addresses_stay_within_the_limits() -> None:
    waiting, begun = room(), 0
    for number in range(5000):
        address = f"10.1.{number // 250}.{number % 250}"
        waiting.add(number, address, 0.0)
        waiting.on_hello(number, address)
        begun += len(serve(waiting, 0.0, address))
    assert begun == TOTAL_BURST
    assert len(waiting) <= MAX_WAITING
    assert len(waiting._lines) <= MAX_ADDRESSES + MAX_WAITING


EVENTS = st.lists(
    st.tuples(st.sampled_from(["add", "hello", "remove", "take", "expire"]), st.integers(0, 400), st.floats(0, 0.5)),
    max_size=400,
)


@given(EVENTS)
def test_waiting_room_counts_for_random_events(events: list[tuple[str, int, float]]) -> None:
    waiting, now, here, served = room(), 0.0, dict[Hashable, str](), 0
    for number, (kind, chosen, pause) in enumerate(events):
        now += pause
        key = sorted(here)[chosen % len(here)] if here else None  # type: ignore[type-var]
        match kind:
            case "add":
                here[number] = str(chosen % 3)
                if (dropped := waiting.add(number, here[number], now)) is not None:
                    del here[dropped]
            case "hello" if key is not None:
                waiting.on_hello(key, here[key])
            case "remove" if key is not None:
                waiting.remove(key, here.pop(key))
            case "take":
                if (taken := waiting.take(now)) is not None:
                    served += 1
                    waiting.on_begun(here.pop(taken))
            case _:
                for late in waiting.expire(now):
                    del here[late]
        assert len(waiting) == len(here) <= MAX_WAITING
    assert served <= 3 * (ADDRESS_BURST + now * ADDRESS_RATE)
