"""Each sender has a budget of drives. tests/soak/test_flood_by_key.py floods a real gateway over one key."""

from gateway.bus.sender_budgets import DRIVES_AT_ONCE, DRIVES_PER_S, MAX_SENDERS, SenderBudgets
from schemas import keys
from schemas.identity import person

ANN, BOB = (keys.command_key("fleet", "red", "drive", person(name)) for name in ("ann", "bob"))


def test_flood_takes_nothing_from_others() -> None:
    budgets = SenderBudgets()
    passed = {ANN: 0, BOB: 0}
    for millisecond in range(10_000):
        now = millisecond / 1000
        for _ in range(20):
            passed[BOB] += budgets.take(BOB, "", now)
        if millisecond % 50 == 0:  # a joystick
            passed[ANN] += budgets.take(ANN, "", now)
    assert passed[ANN] == 200
    assert passed[BOB] <= DRIVES_AT_ONCE + 10 * DRIVES_PER_S
    assert budgets.dropped == 200_000 - passed[BOB]


def test_wildcard_counts_as_any_other_key_of_its_identity() -> None:
    budgets = SenderBudgets()
    every = keys.command_key("fleet", "*", "drive", person("bob"))
    assert sum(budgets.take(key, "", 0.0) for key in (every, BOB) * DRIVES_AT_ONCE) == DRIVES_AT_ONCE


def test_session_is_the_sender_without_certificates() -> None:
    budgets = SenderBudgets()
    key = keys.command_key("fleet", "red", "drive")
    assert sum(budgets.take(key, "5e55", 0.0) for _ in range(1000)) == DRIVES_AT_ONCE
    assert sum(budgets.take(key, "5e56", 0.0) for _ in range(1000)) == DRIVES_AT_ONCE
    assert sum(budgets.take(key, "", 0.0) for _ in range(1000)) == DRIVES_AT_ONCE


def test_sessions_of_an_identity_share_its_budget() -> None:
    budgets = SenderBudgets()
    assert sum(budgets.take(BOB, session, 0.0) for session in ("5e55", "5e56") * DRIVES_AT_ONCE) == DRIVES_AT_ONCE


def test_memory_is_bounded() -> None:
    budgets = SenderBudgets()
    for number in range(10 * MAX_SENDERS):
        assert budgets.take(keys.command_key("fleet", "red", "drive", person(f"p{number}")), "", 0.0)
    assert len(budgets._buckets) == MAX_SENDERS
