"""Which cars have a gateway on this computer, by locks in the state directory: known also while the hub is gone."""

from contextlib import suppress
from pathlib import Path
from typing import Final

from schemas.keys import DEFAULT_FLEET
from schemas.process.file_lock import FileLock
from schemas.state_dir import directory_of

_SUFFIX: Final = ".running"


class RunningMark:
    """The mark of one gateway. It ends with its process, however that ends. `directory` has the state of its bus."""

    def __init__(self, directory: Path, fleet: str, car: str) -> None:
        self._lock = FileLock(directory / f"{fleet}.{car}{_SUFFIX}")

    def renew(self) -> None:
        """Set the mark, if it is not set. Call it again and again: who looks for marks takes one for a moment."""
        with suppress(OSError):  # a full disk, or a place without locks: the gateway runs all the same
            self._lock.try_take()

    def end(self) -> None:
        """Take the mark away."""
        self._lock.release()


def running_cars(endpoint: str) -> list[str]:
    """Return the cars of this bus with a gateway of this user on this computer: `red`, or `two/red` of fleet two."""
    found = []
    for path in sorted(directory_of(endpoint).glob(f"*{_SUFFIX}")):
        lock = FileLock(path)
        with suppress(OSError):
            if not lock.try_take():
                fleet, _, car = path.name.removesuffix(_SUFFIX).partition(".")
                found.append(car if fleet == DEFAULT_FLEET else f"{fleet}/{car}")
            lock.release()
    return found
