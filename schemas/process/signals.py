"""The signals that shut down a process: Ctrl-C, `kill`, and a closed terminal."""

import signal
import sys
import threading
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from types import FrameType
from typing import TYPE_CHECKING

if TYPE_CHECKING:  # most processes have no loop
    import asyncio


def signals() -> list[signal.Signals]:
    """Return the signals that shut down the process. Leave out SIGHUP if it is ignored (`nohup`)."""
    hup = getattr(signal, "SIGHUP", None)  # Windows has none
    if hup is None or signal.getsignal(hup) is signal.SIG_IGN:
        return [signal.SIGINT, signal.SIGTERM]
    return [signal.SIGINT, signal.SIGTERM, hup]


def calls(end: Callable[[], object]) -> None:
    """Call `end` on each of the signals, in the main thread."""
    for number in signals():
        signal.signal(number, lambda *_: end())


def calls_in(loop: "asyncio.AbstractEventLoop", end: Callable[[signal.Signals], object]) -> None:
    """Call `end` with the signal's number on each of the signals, in this loop."""
    for number in signals():
        try:
            loop.add_signal_handler(number, end, number)
        except NotImplementedError:  # Windows has no signal handlers on the loop
            signal.signal(number, lambda *_, number=number: loop.call_soon_threadsafe(end, number))


@contextmanager
def _taken(numbers: Iterable[signal.Signals], handler: Callable[[int, FrameType | None], object]) -> Iterator[None]:
    """Install the handler for a block."""
    before = {number: signal.signal(number, handler) for number in numbers}
    try:
        yield
    finally:
        for number, handler_before in before.items():
            signal.signal(number, handler_before)


@contextmanager
def held_back() -> Iterator[Sequence[int]]:
    """Delay signals until the end of a block that must not be interrupted. Yield the signals that have come so far.

    Do nothing in other threads and in a loop: no signal interrupts them.
    """
    came: list[int] = []
    if threading.current_thread() is not threading.main_thread() or _in_loop():
        yield came
        return
    try:
        with _taken(signals(), lambda number, _: came.append(number)):
            yield came
    finally:
        for number in came:
            signal.raise_signal(number)


def _in_loop() -> bool:
    loops = sys.modules.get("asyncio")
    return loops is not None and loops._get_running_loop() is not None


@contextmanager
def taken_as_ctrl_c(interrupt: Callable[[], object]) -> Iterator[None]:
    """During a block in the main thread, let SIGINT raise KeyboardInterrupt, and each other signal call `interrupt`."""
    # A shell starts background processes with SIGINT ignored, and Python leaves it so. Here, handle SIGINT anyway.
    others = [number for number in signals() if number is not signal.SIGINT]
    ignored = [signal.SIGINT] if signal.getsignal(signal.SIGINT) is signal.SIG_IGN else []
    with _taken(ignored, signal.default_int_handler), _taken(others, lambda *_: interrupt()):
        yield


@contextmanager
def sigterm_interrupts() -> Iterator[None]:
    """Treat every signal that shuts down a process, such as SIGTERM, like Ctrl-C: raise KeyboardInterrupt."""

    def interrupt() -> None:
        raise KeyboardInterrupt

    with taken_as_ctrl_c(interrupt):
        yield
