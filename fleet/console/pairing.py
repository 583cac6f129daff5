"""Pairs devices of the network with the console: makes codes, shows them, and takes the code that somebody typed."""

import asyncio
import io
import logging
import secrets
import time
from collections.abc import Callable, Hashable
from typing import Any

import segno

from fleet.console.guess_limit import GuessLimit, TooManyGuesses, WrongCode
from fleet.console.people_book import (
    CLASS_LIFETIME_S,
    CODE_LIFETIME_S,
    PagePerson,
    PeopleBook,
    code_words,
    new_code,
)
from fleet.console.people_file import PeopleFile
from fleet.console.request_filter import PAIR_PATH

log = logging.getLogger("fleet")


class Pairing:
    """The codes of one console. `on_paired` is called with the address of a connection, and the id of its device."""

    # The people file is changed in threads, because waiting for its lock on the loop would delay a STOP.

    def __init__(self, people: PeopleFile, on_paired: Callable[[Hashable, str], object]) -> None:
        self._people = people
        self._on_paired = on_paired
        self.guesses = GuessLimit()

    async def offer(self, person: PagePerson, address: str) -> dict[str, Any]:
        """Return a new code as JSON values: as words and as a picture. Raises ValueError or OSError.

        address: where the console is on the network.
        """
        code = await asyncio.to_thread(issue_code, self._people, person)
        return _shown(code, address, CODE_LIFETIME_S, scale=5)

    async def open_class(self, address: str) -> dict[str, Any]:
        """Open the console for a class. Return its code as JSON values. Raises ValueError or OSError."""
        code = new_code(secrets.choice)
        await asyncio.to_thread(self._people.change, lambda book: (book.open_class(code, time.time()), None))
        log.warning("a class may join for %.0f minutes: its devices watch and stop", CLASS_LIFETIME_S / 60)
        return _shown(code, address, CLASS_LIFETIME_S, scale=10)

    async def close_class(self) -> None:
        """Let no more devices of a class join. Raises OSError."""
        await asyncio.to_thread(self._people.change, lambda book: (book.close_class(), None))

    async def pair(
        self, code: str, client: tuple[str, int], device: str, cookie_before: str = ""
    ) -> tuple[str, PagePerson]:
        """Pair a device. Return its cookie and its person.

        cookie_before: the cookie that the device has already, if any. If the code is that of a class, a paired device
        keeps its person. Raises ClassFull, WrongCode, and TooManyGuesses while the address has to wait.
        """
        now, address = time.monotonic(), client[0]
        if (wait_s := self.guesses.wait_s(address, now)) > 0:
            self.guesses.wrong += 1
            raise TooManyGuesses(wait_s)
        book = self._people.read()
        known, state = book.device_of(cookie_before, time.time())
        if known is not None and state == "valid" and book.is_class_code(code, time.time()):
            return cookie_before, known.person
        cookie = secrets.token_urlsafe(32)
        found = book.redeem(code, cookie, "", device, time.time())
        if found is not None:
            found = await asyncio.to_thread(
                self._people.change, lambda book: self._redeemed(book, code, cookie, device)
            )
        if found is None:
            count = self.guesses.on_wrong(address, now)
            log.warning("%s typed a wrong pairing code (%d from there, %d in all)", address, count, self.guesses.wrong)
            raise WrongCode(self.guesses.wait_s(address, now))
        self.guesses.on_right(address)
        paired = found.devices[-1]
        log.warning("%s paired as %s, %s (%s)", address, paired.person.name, paired.person.rank, paired.id)
        self._on_paired(client, paired.id)
        return cookie, paired.person

    @staticmethod
    def _redeemed(book: PeopleBook, code: str, cookie: str, device: str) -> tuple[PeopleBook, PeopleBook | None]:
        found = book.redeem(code, cookie, secrets.token_hex(3), device, time.time())
        return (book, None) if found is None else (found, found)


def _shown(code: str, address: str, lifetime_s: float, *, scale: int) -> dict[str, Any]:
    """Return what a page shows of a code, as JSON values. `scale` is the size of the picture."""
    qr = segno.make(pairing_link(address, code)).svg_data_uri(scale=scale, border=4, light="#fff", dark="#000")
    return {"code": code_words(code), "qr": qr, "address": address, "lifetime_s": lifetime_s}


def issue_code(people: PeopleFile, person: PagePerson) -> str:
    """Return a new code, good once and for two minutes. Raises ValueError or OSError."""
    code = new_code(secrets.choice)
    people.change(lambda book: (book.issue(code, person, time.time()), None))
    return code


def pairing_link(address: str, code: str) -> str:
    """Return what the QR code contains. The code is in the fragment, which browsers do not send."""
    return f"{address}{PAIR_PATH}#{code}"


def show_code(address: str, code: str, person: PagePerson, write: Callable[[str], object], *, draws: bool) -> None:
    """Write a pairing code to a terminal. With `draws`, also as a QR code."""
    if draws:
        picture = io.StringIO()
        segno.make(pairing_link(address, code)).terminal(picture, compact=True, border=2)
        write(picture.getvalue())
    how = "scan, or open" if draws else "open"
    write(f"To pair a device as {person.name}, {how} {address} and type {code_words(code)}")
    write("The code works once, for 2 minutes. For another code, type: fleet console pair NAME")
