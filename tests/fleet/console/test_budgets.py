"""The budgets of a page and of a person: our page never exceeds them, and a flood costs nobody else anything."""

import random
from itertools import pairwise

import pytest
from hypothesis import given
from hypothesis import strategies as st

from fleet.console.budgets import (
    CHECK_BURST,
    CHECK_RATE,
    COOLDOWN_S,
    MAX_BUDGETS,
    MAX_OPEN_COMMANDS,
    MERGE_S,
    Budgets,
    StopMerge,
    page_budget,
)

OWN_RATE = 15.0
"""Messages a second of our own page while a car is driven: an echo of each tick, and a few presses."""


@pytest.mark.parametrize("slow_s", [0.0, 30.0])
def test_ten_times_what_our_page_sends_never_trips_it(slow_s: float) -> None:
    """Also if a slow Wi-Fi holds the messages of half a minute back, and delivers them at once."""
    budgets, page, now = Budgets(), page_budget(), 0.0
    for _ in range(int(10 * OWN_RATE * slow_s)):
        assert budgets.may_send("mia", page, now)
    for _ in range(int(10 * OWN_RATE * 600)):
        now += 1 / (10 * OWN_RATE)
        assert budgets.may_send("mia", page, now)


def test_flood_closes_own_page_only() -> None:
    budgets, page = Budgets(), page_budget()
    taken = 0
    while budgets.may_send("mia", page, 1.0):
        taken += 1
    assert taken < 10_000
    assert not budgets.may_open("mia", 1.0 + COOLDOWN_S / 2)
    assert budgets.may_open("mia", 1.0 + COOLDOWN_S)
    assert budgets.may_open("bob", 1.0)
    assert budgets.may_send("bob", page_budget(), 1.0)


def test_new_page_brings_its_device_no_new_budget() -> None:
    budgets, taken = Budgets(), 0
    for _ in range(20):
        page = page_budget()
        while budgets.may_send("mia", page, 0.0):
            taken += 1
    assert taken < 20_000


def test_requests_have_a_budget_and_few_are_remembered() -> None:
    budgets = Budgets()
    assert sum(budgets.may_ask("mia", 0.0) for _ in range(5000)) < 2000
    for number in range(5000):
        assert budgets.may_ask(number, 0.0)
    assert len(budgets._all) == MAX_BUDGETS


def test_checks_of_plans_have_a_budget_of_their_own() -> None:
    budgets = Budgets()
    assert sum(budgets.may_check("mia", 0.0) for _ in range(1000)) == CHECK_BURST
    assert budgets.may_check("mia", 1.0 / CHECK_RATE)
    assert not budgets.may_check("mia", 1.0 / CHECK_RATE)
    assert budgets.may_check("bob", 0.0)
    assert budgets.may_ask("mia", 0.0)


def test_commands_in_flight_count_per_device() -> None:
    budgets = Budgets()
    for _ in range(MAX_OPEN_COMMANDS):
        assert budgets.may_open_command("phone")
        budgets.on_command_begun("phone")
    assert not budgets.may_open_command("phone")
    assert budgets.may_open_command("tablet")
    budgets.on_command_ended("phone")
    assert budgets.may_open_command("phone")
    for _ in range(MAX_OPEN_COMMANDS - 1):
        budgets.on_command_ended("phone")
    assert not budgets._open


@given(st.lists(st.floats(0.0, 0.3), min_size=1, max_size=200))
def test_stops_are_merged_and_after_each_one_is_sent(pauses: list[float]) -> None:
    merge, now, sent, asked = StopMerge(), 0.0, [], []
    for pause in pauses:
        now += pause
        asked.append(now)
        delay_s = merge.delay_s(now)
        if delay_s is not None:
            sent.append(now + delay_s)
    assert sent[0] == asked[0], "the first one goes at once"
    assert sent == sorted(sent)
    assert all(any(0.0 <= at - one <= MERGE_S + 1e-9 for at in sent) for one in asked), "none is dropped"
    assert all(later - before >= MERGE_S - 1e-9 for before, later in pairwise(sent))


def test_flood_of_stops_is_ten_a_second() -> None:
    moments, merge = random.Random(1), StopMerge()
    times = sorted(moments.uniform(0.0, 10.0) for _ in range(50_000))
    assert sum(merge.delay_s(at) is not None for at in times) <= 10.0 / MERGE_S + 2
