"""A short change of a condition has no effect."""

import pytest

from fleet.policy.debounce import Debounced, Settled, debounce, settle


def _followed(for_s: float, course: list[tuple[float, bool | None]]) -> list[bool]:
    steady: Debounced | None = None
    found = []
    for now, so in course:
        steady = debounce(steady, so, for_s, now)
        found.append(steady is not None and steady.on)
    return found


@pytest.mark.parametrize(
    ("for_s", "course", "counts"),
    [
        (0, [(0, True), (1, False), (2.4, False), (2.5, False)], [True, True, True, False]),
        (1, [(0, True), (0.9, True), (1, True)], [False, False, True]),
        (1, [(0, True), (0.5, False), (0.6, True), (1.5, True), (1.6, True)], [False, False, False, False, True]),
        (1, [(0, True), (0.5, None), (0.6, True), (1.5, True)], [False, False, False, False]),
        (0, [(0, True), (1, False), (2, True), (3, False), (4, False)], [True, True, True, True, True]),
        (0, [(0, True), (1, None), (5.9, None), (6, None)], [True, True, True, False]),
        (0, [(0, None), (1, False)], [False, False]),
    ],
)
def test_debounced_condition_counts_after_for_s(
    for_s: float, course: list[tuple[float, bool | None]], counts: list[bool]
) -> None:
    assert _followed(for_s, course) == counts


def test_debounce_delays_changes_and_ignores_unknown() -> None:
    settled: Settled | None = None
    found = []
    for now, so in [(0, None), (1, True), (2, False), (3, None), (3.4, False), (3.5, False), (4, True), (4.5, False)]:
        settled = settle(settled, so, now)
        found.append(None if settled is None else settled.value)
    assert found == [None, True, True, True, True, False, False, False]
