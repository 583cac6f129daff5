"""Lists the cars whose gateways this user runs here, by locks in the state directory, so it needs no hub."""

from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from typing import Final

from schemas.keys import DEFAULT_FLEET
from schemas.process.file_lock import FileLock
from schemas.state_dir import directory_of

_SUFFIX: Final = ".running"


class RunningMark:
    """The mark of one gateway: a lock that ends with its process, even if that is killed.

    `directory` is the state directory of its bus.
    """

    def __init__(self, directory: Path, fleet: str, car: str) -> None:
        self._lock = FileLock(directory / f"{fleet}.{car}{_SUFFIX}")

    def renew(self) -> None:
        """Set the mark if it is not set.

        Call this regularly, because it may fail: a program that looks for marks takes each lock for a moment.
        """
        with suppress(OSError):  # a full disk, or a place without locks: the gateway runs all the same
            self._lock.try_take()

    def end(self) -> None:
        """Remove the mark."""
        self._lock.release()


def running_cars(endpoint: str) -> list[str]:
    """Return the cars whose gateways this user runs on this computer and bus: `red`, or `two/red` of fleet two."""
    return [car if fleet == DEFAULT_FLEET else f"{fleet}/{car}" for fleet, car in _running(endpoint)]


def running_cars_of(endpoint: str, fleet: str) -> set[str]:
    """Return the cars of one fleet whose gateways this user runs on this computer and bus."""
    return {car for of, car in _running(endpoint) if of == fleet}


def _running(endpoint: str) -> Iterator[tuple[str, str]]:
    """Yield fleet and car of each mark that a gateway holds."""
    for path in sorted(directory_of(endpoint).glob(f"*{_SUFFIX}")):
        lock = FileLock(path)
        with suppress(OSError):
            is_held = not lock.try_take()
            lock.release()
            if is_held:
                fleet, _, car = path.name.removesuffix(_SUFFIX).partition(".")
                yield fleet, car
