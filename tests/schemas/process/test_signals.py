"""Signals that end a process, tested in this process."""

import os
import signal

import pytest

from schemas.process import signals


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_signals_held_back_count_afterwards(number: signal.Signals) -> None:
    done: list[str] = []

    def interrupt() -> None:
        raise KeyboardInterrupt

    def work() -> None:
        with signals.taken_as_ctrl_c(interrupt), signals.held_back():
            os.kill(os.getpid(), number)
            done.append("whole")

    with pytest.raises(KeyboardInterrupt):
        work()
    assert done == ["whole"]


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_ctrl_c_counts_also_where_a_shell_had_it_ignored(number: signal.Signals) -> None:
    """A shell starts background processes with SIGINT ignored. A handler that raises SIGINT then has no effect."""

    def work() -> None:
        with signals.taken_as_ctrl_c(lambda: signal.raise_signal(signal.SIGINT)):
            os.kill(os.getpid(), number)

    before = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        with pytest.raises(KeyboardInterrupt):
            work()
        assert signal.getsignal(signal.SIGINT) is signal.SIG_IGN
    finally:
        signal.signal(signal.SIGINT, before)


def test_nothing_that_came_is_nothing_that_counts() -> None:
    before = [signal.getsignal(number) for number in signals.signals()]
    with signals.held_back():
        assert before != [signal.getsignal(number) for number in signals.signals()]
    assert before == [signal.getsignal(number) for number in signals.signals()]
