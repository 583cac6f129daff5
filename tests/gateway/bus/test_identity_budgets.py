"""Each identity has a budget of drives. tests/soak/test_flood_by_key.py floods a real gateway over one key."""

from gateway.bus.identity_budgets import DRIVES_AT_ONCE, DRIVES_PER_S, MAX_IDENTITIES, IdentityBudgets
from schemas import keys
from schemas.identity import person

ANN, BOB = (keys.command_key("fleet", "red", "drive", person(name)) for name in ("ann", "bob"))


def test_a_flood_takes_nothing_from_others() -> None:
    budgets = IdentityBudgets()
    passed = {ANN: 0, BOB: 0}
    for millisecond in range(10_000):
        now = millisecond / 1000
        for _ in range(20):
            passed[BOB] += budgets.take(BOB, now)
        if millisecond % 50 == 0:  # a joystick
            passed[ANN] += budgets.take(ANN, now)
    assert passed[ANN] == 200
    assert passed[BOB] <= DRIVES_AT_ONCE + 10 * DRIVES_PER_S
    assert budgets.dropped == 200_000 - passed[BOB]


def test_a_wildcard_counts_as_any_other_key_of_its_identity() -> None:
    budgets = IdentityBudgets()
    every = keys.command_key("fleet", "*", "drive", person("bob"))
    assert sum(budgets.take(key, 0.0) for key in (every, BOB) * DRIVES_AT_ONCE) == DRIVES_AT_ONCE


def test_without_certificates_nothing_is_counted() -> None:
    budgets = IdentityBudgets()
    assert all(budgets.take(keys.command_key("fleet", "red", "drive"), 0.0) for _ in range(10 * DRIVES_AT_ONCE))


def test_the_memory_is_bounded() -> None:
    budgets = IdentityBudgets()
    for number in range(10 * MAX_IDENTITIES):
        assert budgets.take(keys.command_key("fleet", "red", "drive", person(f"p{number}")), 0.0)
    assert len(budgets._buckets) == MAX_IDENTITIES
