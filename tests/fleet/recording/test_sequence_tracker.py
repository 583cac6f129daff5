"""Gaps, their backfill, and duplicates."""

import random

from hypothesis import given
from hypothesis import strategies as st

from fleet.recording.sequence_tracker import MAX_TRACKED_SOURCES, SequenceTracker


def is_next(numbers: SequenceTracker, sender: str, number: int) -> bool:
    known = numbers.senders.get(sender)
    return known is not None and known.last == number - 1


def live(numbers: SequenceTracker, *given: int, sender: str = "a") -> list[bool]:
    """Add numbers as the recorder does, which checks only numbers out of sequence."""
    found = []
    for number in given:
        if is_next(numbers, sender, number):
            numbers.senders[sender].last = number
            found.append(True)
        else:
            found.append(numbers.add_live(sender, number, number * 10))
    return found


def test_gap_is_missing_until_filled_and_duplicates_are_told() -> None:
    numbers = SequenceTracker()
    assert all(live(numbers, 5, 6, 10))
    assert numbers.missing == 3
    assert numbers.add_backfilled("a", 8, 80)
    assert numbers.missing == 2
    assert not numbers.add_backfilled("a", 8, 80)
    assert not numbers.add_backfilled("a", 6, 60)
    assert numbers.add_backfilled("a", 7, 70)
    assert numbers.add_backfilled("a", 9, 90)
    assert (numbers.missing, numbers.senders["a"].gaps) == (0, [])


def test_first_message_starts_stream_and_gap_before_is_missing() -> None:
    numbers = SequenceTracker()
    live(numbers, 5)
    assert numbers.add_backfilled("a", 2, 20)
    assert numbers.missing == 2
    assert numbers.add_backfilled("a", 3, 30)
    assert numbers.add_backfilled("a", 4, 40)
    assert numbers.missing == 0


def test_backfilled_message_is_not_written_again_when_it_arrives() -> None:
    numbers = SequenceTracker()
    live(numbers, 1)
    assert all(numbers.add_backfilled("a", number, number * 10) for number in (2, 3, 4))
    assert live(numbers, 2, 3, 4, 5) == [False, False, False, True]
    assert numbers.missing == 0


def test_gap_among_backfilled_messages_is_not_written_again_when_it_arrives() -> None:
    numbers = SequenceTracker()
    live(numbers, 1)
    assert all(numbers.add_backfilled("a", number, number * 10) for number in (2, 4, 3))
    assert live(numbers, 2, 3, 4, 5) == [False, False, False, True]
    assert live(numbers, 7) == [True]
    assert numbers.add_backfilled("a", 6, 60)
    assert numbers._early == {}, "its original can arrive no more"


def test_original_of_an_older_backfilled_message_is_a_duplicate() -> None:
    """An answer that went further back came behind another one, and then the originals of both."""
    numbers = SequenceTracker()
    assert all(numbers.add_backfilled("a", number, number * 10) for number in (2, 1, 3))
    assert live(numbers, 1, 2, 3, 4) == [False, False, False, True]


def test_message_before_backfilled_ones_is_no_restart() -> None:
    numbers = SequenceTracker()
    assert all(numbers.add_backfilled("a", number, number * 10) for number in (4, 5))
    assert live(numbers, 2, 3, 4, 5, 6) == [True, True, False, False, True]
    assert (numbers.missing, numbers.senders["a"].last) == (0, 6)


def test_message_behind_recalled_ones_starts_no_stream() -> None:
    numbers = SequenceTracker()
    live(numbers, 1)
    assert numbers.add_backfilled("a", 5, 50)
    assert numbers.missing == 3
    assert live(numbers, 2, 3, 4, 5, 6) == [True, True, True, False, True]
    assert numbers.missing == 0


def test_number_that_goes_back_is_a_new_stream() -> None:
    numbers = SequenceTracker()
    assert live(numbers, 7, 8, 1, 2, 4) == [True] * 5
    assert numbers.missing == 1


def test_wrap_is_no_gap() -> None:
    numbers = SequenceTracker()
    top = (1 << 32) - 1
    live(numbers, top - 1)
    numbers.add_live("a", top, 0)
    numbers.add_live("a", 0, 0)
    assert numbers.missing == 0
    numbers.add_live("a", 3, 0)
    assert numbers.missing == 2
    numbers.add_live("b", top - 1, 0)
    numbers.add_live("b", 2, 0)
    assert numbers.missing == 5
    assert numbers.add_backfilled("b", top, 0)
    assert numbers.add_backfilled("b", 0, 0)
    assert numbers.missing == 3


def test_oldest_senders_are_forgotten_but_not_their_gaps() -> None:
    numbers = SequenceTracker()
    for sender in range(MAX_TRACKED_SOURCES * 3):
        live(numbers, 1, 3, sender=str(sender))
    assert numbers.missing == MAX_TRACKED_SOURCES * 3
    assert len(numbers.senders) == MAX_TRACKED_SOURCES


@given(st.sets(st.integers(1, 60)), st.integers(0, 2**32))
def test_each_message_is_taken_once_for_random_loss_and_backfill(lost: set[int], seed: int) -> None:
    chance, numbers, taken = random.Random(seed), SequenceTracker(), []
    for number in range(1, 61):
        if number not in lost and all(live(numbers, number)):
            taken.append(number)
        if chance.random() < 0.1:  # now and then, all cached messages are backfilled
            taken += [old for old in range(max(1, number - 20), number + 1) if numbers.add_backfilled("a", old, old)]
    taken += [old for old in range(1, 61) if numbers.add_backfilled("a", old, old)]
    assert sorted(taken) == list(range(1, 61))
    assert numbers.missing == 0


def test_sender_that_is_silent_for_longest_is_forgotten_first() -> None:
    numbers = SequenceTracker()
    for at_ns in range(1, MAX_TRACKED_SOURCES * 3):
        live(numbers, 1, sender=str(at_ns))
        numbers.senders[str(at_ns)].heard_ns = at_ns
        live(numbers, at_ns, sender="gateway")
        numbers.senders["gateway"].heard_ns = at_ns
        assert numbers.add_backfilled("other site", at_ns, 0)
        numbers.senders["other site"].heard_ns = at_ns
    assert {"gateway", "other site"} <= numbers.senders.keys()
    assert not numbers.add_backfilled("gateway", 1, 10)


@given(st.sets(st.integers(1, 60)), st.integers(0, 2**32))
def test_each_message_is_taken_once_by_the_sessions_of_one_recording(lost: set[int], seed: int) -> None:
    """If a message comes after the end of the session that lacks it, a later session takes it."""
    chance, taken = random.Random(seed), []
    trackers = [SequenceTracker()]

    def backfilled(first: int, last: int) -> list[int]:
        found = []
        for old in range(first, last + 1):
            if chance.random() < 0.9:  # else the answer is cut off
                found += [old] if trackers[-1].add_backfilled("a", old, old * 10) else []
        return found

    for number in range(1, 61):
        if number not in lost and all(live(trackers[-1], number)):
            taken.append(number)
        if chance.random() < 0.1:
            taken += backfilled(max(1, number - 20), min(60, number + chance.randrange(4)))  # some are still on the way
        if chance.random() < 0.1:
            trackers.append(trackers[-1].following())
    while len(set(taken)) < 60:
        taken += backfilled(1, 60)
    assert sorted(taken) == list(range(1, 61))
    assert trackers[-1].missing == 0


@given(st.sets(st.integers(2, 60)), st.integers(0, 2**32))
def test_queue_overflow_counts_as_missing_including_last(dropped: set[int], seed: int) -> None:
    """The recorder reports what it dropped now and then, also after later ones came."""
    chance, numbers, count, last, kept = random.Random(seed), SequenceTracker(), 0, 0, 0
    for number in range(1, 61):
        if number in dropped:
            count, last = count + 1, number
        else:
            kept += all(live(numbers, number))
        if count and (number == 60 or chance.random() < 0.3):
            numbers.add_dropped("a", last, count)
            count = 0
    assert kept == 60 - len(dropped)
    assert numbers.missing == len(dropped)
    assert sum(numbers.add_backfilled("a", number, number) for number in range(1, 61)) == len(dropped)
    assert numbers.missing == 0


def test_of_a_sender_that_was_only_dropped_all_are_missing() -> None:
    numbers = SequenceTracker()
    numbers.add_dropped("a", 7, 3)
    assert numbers.missing == 3
    assert [numbers.add_backfilled("a", number, number) for number in (5, 6, 7)] == [True] * 3
    assert numbers.missing == 0
