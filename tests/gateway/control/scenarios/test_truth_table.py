"""Compares the estimated mode with the car's true mode, for every pair (asked, true) of tests/vectors/mode_truth.tsv.

The true mode changes in each way that it can without us: another writer on the link, a reset, a lost mode frame.
"""

import pytest

from gateway.control.commands import SetMode
from schemas.words import Mode, Verdict
from tests.support.truth import WORLDS, car_in, frame_of, lose_next_mode_frame
from tests.support.vectors import rows
from tests.support.virtual import Pair

TABLE = rows("mode_truth")
LONG_S = 15.0
"""A time longer than any time of the table."""
TALKING = frozenset({Mode.MANUAL, Mode.TRACKING, Mode.LIGHT_SEEKING, Mode.FOLLOWING})
BY = {
    "3 readings": ("3 consecutive readings",),
    "silence of 3 s": ("silent for 3.",),
    "3 readings, or silence of 3 s": (
        "3 consecutive readings",
        "silent for 3.",
        "no reading as in mode manual for 3.",
    ),
    "1 s without a reading of the asked mode": ("silent for 1.", "no reading as in mode"),
}

Row = dict[str, str]
each_world = pytest.mark.parametrize("world", WORLDS)


def names(row: Row) -> str:
    return f"{row['asked']}-{row['true']}"


def modes(row: Row) -> tuple[Mode, Mode]:
    return Mode(row["asked"]), Mode(row["true"])


def contradicted(pair: Pair, row: Row, within: str, since: float) -> None:
    """Require that the mode is contradicted in time, with the evidence of the table."""
    pair.until(lambda: pair.control.driver.model.mode.verdict is Verdict.CONTRADICTED, LONG_S)
    assert pair.now - since <= float(row[within]), pair.control.driver.model.mode
    assert any(words in pair.control.driver.model.mode.evidence for words in BY[row["by"]]), (
        pair.control.driver.model.mode.evidence
    )
    assert pair.logs[-1].code in ("mode_contradicted", "unheard")


def never(pair: Pair, row: Row) -> None:
    """Require that a mode stays assumed if readings cannot distinguish it, with both modes among the candidates."""
    pair.run(LONG_S)
    assert pair.control.driver.model.mode.verdict is Verdict(row["verdict"]) is Verdict.ASSUMED
    assert set(modes(row)) <= set(pair.control.driver.model.mode.candidates)
    assert pair.control.driver.model.mode.inferred is None


def test_truth_table_is_complete_and_says_what_is_unknowable() -> None:
    assert {modes(row) for row in TABLE} == {(asked, true) for asked in Mode for true in Mode}
    assert len(TABLE) == len(Mode) ** 2
    for row in TABLE:
        asked, true = modes(row)
        silent = asked not in TALKING and true not in TALKING
        same = "assumed" if asked not in TALKING else "confirmed"
        assert row["verdict"] == (same if asked is true else "assumed" if silent else "contradicted")


@each_world
@pytest.mark.parametrize("row", TABLE, ids=names)
def test_mode_estimate_after_foreign_mode_change(row: Row, world: str) -> None:
    asked, true = modes(row)
    pair = car_in(asked, world, seed=TABLE.index(row))
    assert pair.control.driver.model.mode.verdict is (Verdict.CONFIRMED if asked in TALKING else Verdict.ASSUMED)
    if asked is not true:
        pair.car.feed(frame_of(true), pair.now)
        if asked is Mode.OBSTACLE_AVOIDANCE and world == "no-echo":
            pair.run(LONG_S)
            assert pair.car.truth.mode is asked, (
                "docs/reference/protocol.md#blocking-times: with no echo at all it is deaf for ever"
            )
            assert pair.control.driver.model.mode.verdict is Verdict.ASSUMED
            return
        pair.until(lambda: pair.car.truth.mode is true, 6.0)
    if row["verdict"] == "contradicted":
        contradicted(pair, row, "within_s", pair.now)
    elif asked in TALKING:
        pair.run(LONG_S)
        assert pair.control.driver.model.mode.confirmed is asked
        assert pair.control.driver.model.mode.candidates == (asked,)
    else:
        never(pair, row)


@pytest.mark.parametrize("mode", [mode for mode in Mode if mode is not Mode.MANUAL], ids=str)
def test_silent_mode_of_stm32_stays_assumed(mode: Mode) -> None:
    pair = car_in(mode, "room", seed=1, platform="stm32")
    pair.run(LONG_S)
    assert pair.car.truth.mode is mode, "the gateway does not end it"
    assert pair.control.driver.model.mode.verdict is Verdict.ASSUMED
    assert not [log for log in pair.logs if log.code in ("mode_contradicted", "unheard")]


@each_world
@pytest.mark.parametrize("row", [row for row in TABLE if row["true"] == "manual"], ids=names)
def test_reset_brings_the_car_to_mode_0(row: Row, world: str) -> None:
    asked, _ = modes(row)
    pair = car_in(asked, world, seed=TABLE.index(row))
    pair.car.brown_out(pair.now)
    if asked is Mode.MANUAL:
        pair.run(LONG_S)
        assert pair.control.driver.model.mode.confirmed is Mode.MANUAL, "a reset in mode 0 cannot be seen"
    else:
        contradicted(pair, row, "within_s", pair.now)


FROM_ASKING = [row for row in TABLE if row["asked_s"] != "-"]


@each_world
@pytest.mark.parametrize("row", [row for row in FROM_ASKING if row["asked"] != row["true"]], ids=names)
def test_mode_frame_that_is_lost(row: Row, world: str) -> None:
    """Control requests a mode while the car is in the true one, and the frame does not reach the car."""
    asked, true = modes(row)
    pair = car_in(true, world, seed=TABLE.index(row))
    lost = lose_next_mode_frame(pair)
    pair.ask(SetMode(asked))
    pair.until(lambda: bool(lost), 6.0)
    if asked is Mode.MANUAL and true not in TALKING:
        told_again(pair, world)
        return
    # A car that was never seen to report in the mode may be silent there, so only readings of another mode contradict.
    is_new = asked not in pair.control.driver.model.learned.reporting
    contradicted(pair, row | {"by": "3 readings"} if is_new else row, "asked_s", lost[0])
    assert pair.car.truth.mode is true


def told_again(pair: Pair, world: str) -> None:
    """Require that control sends the stop again, and claims nothing before. Silence contradicts no running stop."""
    true, end = pair.car.truth.mode, pair.now + LONG_S
    while pair.car.truth.mode is true and pair.now < end:
        assert pair.control.driver.model.mode.verdict is not Verdict.CONFIRMED
        assert pair.control.driver.model.motors in ("stopping", "unknown")
        pair.run(0.01)
    if true is Mode.OBSTACLE_AVOIDANCE and world == "no-echo":
        assert pair.car.truth.mode is true, "docs/reference/protocol.md#blocking-times: deaf without an echo"
        return
    pair.until(lambda: pair.control.driver.model.mode.confirmed is Mode.MANUAL, LONG_S)
    assert pair.car.truth.mode is Mode.MANUAL


@pytest.mark.parametrize(
    ("row", "before", "world"),
    [
        (row, before, world)
        for row in FROM_ASKING
        if row["asked"] == row["true"]
        for before in (tuple(Mode)[1:] if row["asked"] == Mode.MANUAL else (Mode.MANUAL,))
        for world in WORLDS
        if (before, world) != (Mode.OBSTACLE_AVOIDANCE, "no-echo")  # where the car is deaf for ever
    ],
    ids=lambda value: names(value) if isinstance(value, dict) else str(value),
)
def test_mode_that_is_so_is_confirmed(row: Row, before: Mode, world: str) -> None:
    asked, _ = modes(row)
    pair = car_in(before, world, seed=TABLE.index(row))
    pair.ask(SetMode(asked))
    pair.until(lambda: pair.control.driver.model.mode.asked is asked, 6.0)
    asked_at = pair.now
    pair.until(lambda: pair.control.driver.model.mode.confirmed is asked, LONG_S)
    assert pair.now - asked_at <= float(row["asked_s"])
    assert not [log for log in pair.logs if log.code in ("mode_contradicted", "unheard")]


@each_world
def test_raspberry_pi_car_knows_mode_0_only(world: str) -> None:
    pair = car_in(Mode.MANUAL, world, seed=1, platform="raspberry_pi")
    for mode in Mode:
        pair.car.feed(frame_of(mode), pair.now)
        pair.run(5.0)
        assert pair.car.truth.mode is pair.control.driver.model.mode.confirmed is Mode.MANUAL
    pair.car.feed(b"$1#", pair.now)  # shorter than its nine fields: the program dies
    pair.until(lambda: not pair.car.alive, 2.0)
    took = pair.until(lambda: pair.control.driver.model.mode.verdict is Verdict.CONTRADICTED, 4.0)
    assert took <= 3.2
    assert "its program has ended" in pair.control.driver.model.mode.evidence
    assert pair.control.driver.model.mode.candidates == ()
