"""The file of the paired devices.

The console and `fleet console people` share it, so each change is made under a lock.
"""

import logging
from collections.abc import Callable
from pathlib import Path
from typing import Final, TypeVar

from fleet.console.people_book import BadBook, PeopleBook
from schemas.atomic_file import write_atomically
from schemas.process.file_lock import FileLock
from schemas.state_dir import directory_of

T = TypeVar("T")
_NO_FILE: Final = (0, 0, 0)

log = logging.getLogger("fleet")


def people_path(endpoint: str, fleet: str) -> Path:
    """Return the people file of one fleet."""
    return directory_of(endpoint) / f"{fleet}.@console.json"


class PeopleFile:
    """A book of people on disk, which only the user can read (0600)."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self._book = PeopleBook()
        self._version: tuple[int, int, int] | None = None
        self._served = FileLock(path.with_suffix(".served"))

    def read(self) -> PeopleBook:
        """Return the book as it is now.

        If the file is damaged or missing, the book is empty, and everybody must pair again.
        """
        version = self._stat()
        if version != self._version:
            self._book, self._version = self._load(), version
        return self._book

    def change(self, function: Callable[[PeopleBook], tuple[PeopleBook, T]]) -> T:
        """Replace the book by the first value that the function returns. Return its second value. Raises OSError."""
        with FileLock(self.path.with_name(f"{self.path.name}.lock")).held():
            book, value = function(self._load())
            write_atomically(self.path, book.as_text().encode(), sync=True, private=True)
        return value

    def serve(self) -> None:
        """Let others see that a console serves the network with this file, until this process ends. Raises OSError.

        If a fleet has two consoles and the first one ends, the second one takes over. So call this again and again.
        """
        self._served.try_take()

    @property
    def is_served(self) -> bool:
        """True if a console serves the network with this file now. Raises OSError."""
        if self._served.is_held:
            return True
        is_free = self._served.try_take()
        self._served.release()
        return not is_free

    def _stat(self) -> tuple[int, int, int]:
        try:
            found = self.path.stat()
        except OSError:
            return _NO_FILE
        return found.st_mtime_ns, found.st_size, found.st_ino

    def _load(self) -> PeopleBook:
        try:
            return PeopleBook.of_text(self.path.read_text(encoding="utf-8"))
        except FileNotFoundError:
            return PeopleBook()
        except (OSError, UnicodeDecodeError, BadBook) as error:
            log.error("%s cannot be read, so all devices must pair again: %s", self.path, error)
            return PeopleBook()
