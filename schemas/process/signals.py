"""The signals that end a process of ours, so that it ends in order: Ctrl-C, `kill`, and a terminal that was closed."""

import signal
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from types import FrameType
from typing import TYPE_CHECKING

if TYPE_CHECKING:  # most processes have no loop
    import asyncio


def signals() -> list[signal.Signals]:
    """Those that there are here; SIGHUP only if whoever started the process did not have it ignored (`nohup`)."""
    hup = getattr(signal, "SIGHUP", None)  # Windows has none
    if hup is None or signal.getsignal(hup) is signal.SIG_IGN:
        return [signal.SIGINT, signal.SIGTERM]
    return [signal.SIGINT, signal.SIGTERM, hup]


def calls(end: Callable[[], object]) -> None:
    """From now on each of them calls `end`, in the main thread."""
    for number in signals():
        signal.signal(number, lambda *_: end())


def calls_in(loop: "asyncio.AbstractEventLoop", end: Callable[[signal.Signals], object]) -> None:
    """From now on each of them calls `end` in this loop, with its number."""
    for number in signals():
        try:
            loop.add_signal_handler(number, end, number)
        except NotImplementedError:  # Windows has no signal handlers on the loop
            signal.signal(number, lambda *_, number=number: loop.call_soon_threadsafe(end, number))


@contextmanager
def _taken(numbers: Iterable[signal.Signals], handler: Callable[[int, FrameType | None], object]) -> Iterator[None]:
    """Meanwhile they are this handler's; afterwards whose they were."""
    before = {number: signal.signal(number, handler) for number in numbers}
    try:
        yield
    finally:
        for number, handler_before in before.items():
            signal.signal(number, handler_before)


@contextmanager
def held_back() -> Iterator[None]:
    """What comes meanwhile counts afterwards: for what must be done wholly, as starting a process that is to be ended.

    In the main thread only.
    """
    came: list[int] = []
    try:
        with _taken(signals(), lambda number, _: came.append(number)):
            yield
    finally:
        for number in came:
            signal.raise_signal(number)


@contextmanager
def taken_as_ctrl_c(interrupt: Callable[[], object]) -> Iterator[None]:
    """Meanwhile each of them but SIGINT, which Python takes itself, calls `interrupt` in the main thread.

    Python does not take it where it came ignored, as a shell has it in what is put in the background: here it does.
    """
    others = [number for number in signals() if number is not signal.SIGINT]
    ignored = [signal.SIGINT] if signal.getsignal(signal.SIGINT) is signal.SIG_IGN else []
    with _taken(ignored, signal.default_int_handler), _taken(others, lambda *_: interrupt()):
        yield


@contextmanager
def sigterm_interrupts() -> Iterator[None]:
    """Take every signal that ends a process, SIGTERM above all, as Ctrl-C: raise KeyboardInterrupt."""

    def interrupt() -> None:
        raise KeyboardInterrupt

    with taken_as_ctrl_c(interrupt):
        yield
