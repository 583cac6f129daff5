"""Lists the cars that have a gateway on this computer, by locks in the state directory, so it needs no hub."""

from contextlib import suppress
from pathlib import Path
from typing import Final

from schemas.keys import DEFAULT_FLEET
from schemas.process.file_lock import FileLock
from schemas.state_dir import directory_of

_SUFFIX: Final = ".running"


class RunningMark:
    """The mark of one gateway: a lock, which goes with the process in any case. `directory`: the state of its bus."""

    def __init__(self, directory: Path, fleet: str, car: str) -> None:
        self._lock = FileLock(directory / f"{fleet}.{car}{_SUFFIX}")

    def renew(self) -> None:
        """Set the mark if it is not set. Call it regularly: a program that looks for marks locks each for a moment."""
        with suppress(OSError):  # a full disk, or a place without locks: the gateway runs all the same
            self._lock.try_take()

    def end(self) -> None:
        """Remove the mark."""
        self._lock.release()


def running_cars(endpoint: str) -> list[str]:
    """Return the cars with a gateway of this user and bus on this computer: `red`, or `two/red` of fleet two."""
    found = []
    for path in sorted(directory_of(endpoint).glob(f"*{_SUFFIX}")):
        lock = FileLock(path)
        with suppress(OSError):
            if not lock.try_take():
                fleet, _, car = path.name.removesuffix(_SUFFIX).partition(".")
                found.append(car if fleet == DEFAULT_FLEET else f"{fleet}/{car}")
            lock.release()
    return found
