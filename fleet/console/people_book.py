"""Pairing codes, paired devices and their people, which open the console from the network. Pure.

A normal code pairs one device. The code of a class pairs any number of devices as guests, for ten minutes. Times are
seconds since the epoch, because the book outlives the process. Codes and cookies are stored only as hashes.
"""

import hashlib
import hmac
import json
from collections.abc import Callable, Iterable
from itertools import count
from typing import Any, Final, Literal, Self

from msgspec import Struct, to_builtins
from msgspec.structs import replace

from fleet.hub.join_code import CODE_ALPHABET
from schemas import keys
from schemas.process.stdio import printable
from schemas.suggestion import did_you_mean
from schemas.words import Rank

CODE_LENGTH: Final = 8
"""40 random bits. At 1,000 guesses per second, a code is guessed within its two minutes once in nine million times."""
CODE_LIFETIME_S: Final = 120.0
COOKIE_LIFETIME_S: Final = 30 * 86_400.0
COOKIE_MEMORY_S: Final = 90 * 86_400.0
"""How long an expired cookie still stops the cars."""
MAX_CODES: Final = 16
"""Maximum number of open codes. A new one replaces the oldest."""
MAX_DEVICES: Final = 256
"""Maximum number of paired devices. A new one replaces the oldest."""
MAX_DEVICE_NAME_LENGTH: Final = 60
CLASS_LIFETIME_S: Final = 600.0
"""Time for which the code of a class pairs devices. At 1,000 guesses per second it is guessed once in 1.8 million
times."""
GUEST: Final = "guest"
"""The rank of a device paired by the code of a class, until a lead assigns it to a person. It may only watch and
stop."""
MAX_GUESTS: Final = 48
"""Maximum number of guests: a class. When it is reached, the code pairs no further device."""
GUEST_LIFETIME_S: Final = 12 * 3600.0
"""Time after which a guest is forgotten."""
RANKS: Final = (str(Rank.PERSON), str(Rank.LEAD))  # text: click takes an enum by the names of its members

CookieState = Literal["unknown", "expired", "valid"]


class UnknownPerson(ValueError):
    """The fleet lists its people, and this person is not among them. The text lists them."""


class ClassFull(Exception):
    """There is no place for another guest. The message says what to do."""


class NoGuest(ValueError):
    """There is no guest with this id. The message says so."""


class BadBook(ValueError):
    """The text is not a book of people."""


class PagePerson(Struct, frozen=True):
    """The person at a page. The person at this computer has the console's own name."""

    name: str
    rank: str = Rank.PERSON
    """`person`, `lead`, or `guest`."""

    @property
    def is_guest(self) -> bool:
        """True for a device that came with a class and is not assigned to a person yet."""
        return self.rank == GUEST

    @property
    def acts_as(self) -> str:
        """The name of the person's client on the bus. All guests share one client, because they only stop."""
        return GUEST if self.is_guest else self.name


_ANY: Final = PagePerson(GUEST, GUEST)
"""The person of the code of a class."""


class PairingCode(Struct, frozen=True):
    """A code that pairs one device, once. The code of a class (its person is a guest) pairs any number of devices."""

    digest: str
    person: PagePerson
    issued_s: float

    def is_open(self, now: float) -> bool:
        """Return True until the lifetime of the code has passed.

        The code also ends if the clock is set back to before its start.
        """
        return 0 <= now - self.issued_s < (CLASS_LIFETIME_S if self.person.is_guest else CODE_LIFETIME_S)


class PairedDevice(Struct, frozen=True):
    """A browser with a cookie of the console."""

    id: str
    person: PagePerson
    device: str
    """The browser's own name."""
    digest: str
    paired_s: float

    @property
    def expires_s(self) -> float:
        """When its cookie expires."""
        return self.paired_s + (GUEST_LIFETIME_S if self.person.is_guest else COOKIE_LIFETIME_S)

    def state(self, now: float) -> CookieState:
        """Return whether its cookie opens the console, only stops the cars, or neither."""
        if now < self.expires_s:
            return "valid"
        if self.person.is_guest:
            return "unknown"
        return "expired" if now < self.expires_s + COOKIE_MEMORY_S else "unknown"


class PeopleBook(Struct, frozen=True):
    """The open codes and the paired devices of one console, oldest first."""

    codes: tuple[PairingCode, ...] = ()
    devices: tuple[PairedDevice, ...] = ()
    address: str = ""
    """The address at which the console last served the network."""
    people: tuple[str, ...] | None = None
    """The people of the fleet, as the console knows them. None if the fleet lists nobody. Then a code may be for
    anybody."""
    leads: tuple[str, ...] | None = None
    """The leads among them, or None if the fleet lists nobody. Then a code may make anybody a lead."""

    def issue(self, code: str, person: PagePerson, now: float) -> Self:
        """Add a code for a person. Raises UnknownPerson, and ValueError if the name or the rank is invalid."""
        self._check(person)
        return self._with_code(code, person, now)

    def _with_code(self, code: str, person: PagePerson, now: float) -> Self:
        """Add a code. Forget those that are not open any more, and the oldest beyond the maximum."""
        open_codes = [each for each in self.codes if each.is_open(now)]
        codes = (*open_codes, PairingCode(digest(normal_code(code)), person, now))
        return replace(self, codes=codes[-MAX_CODES:])

    def open_class(self, code: str, now: float) -> Self:
        """Add the code of a class, in place of an earlier one.

        Raises ValueError if somebody has the name that guests have.
        """
        if GUEST in (self.people or ()):
            raise ValueError(f"`people:` in the fleet file has a {GUEST}. Give that person another name first.")
        return self.close_class()._with_code(code, _ANY, now)

    def close_class(self) -> Self:
        """End the code of the class. Its guests stay."""
        return replace(self, codes=tuple(each for each in self.codes if not each.person.is_guest))

    def is_class_code(self, code: str, now: float) -> bool:
        """Return True for the open code of a class."""
        return any(each.person.is_guest for each in self._matching(code, now))

    def assign(self, device_id: str, person: PagePerson, now: float) -> Self:
        """Turn a guest into a person. The device is then paired as any other.

        Raises NoGuest, and ValueError as `issue` does.
        """
        self._check(person)
        guest = next((each for each in self.guests(now) if each.id == device_id), None)
        if guest is None:
            raise NoGuest("This guest is not there any more.")
        assigned = replace(guest, person=person, paired_s=now)
        return replace(self, devices=tuple(assigned if each is guest else each for each in self.devices))

    def guests(self, now: float) -> list[PairedDevice]:
        """Return the devices that nobody has assigned yet."""
        return [each for each in self.devices if each.person.is_guest and each.state(now) == "valid"]

    def _check(self, person: PagePerson) -> None:
        """Raise UnknownPerson, or ValueError if the name or the rank is invalid."""
        keys.check_name(person.name, "a person's name")
        if self.people is not None and person.name not in self.people:
            hint = did_you_mean(person.name, self.people) or f"There are: {', '.join(self.people)}."
            words = f"`people:` in the fleet file lists no {person.name}, who could only watch and stop."
            raise UnknownPerson(f"{words} {hint}")
        if person.rank not in RANKS:
            raise ValueError(f"There is no rank {person.rank!r}.")
        if self._ranked(person) != person:
            leads = f"Leads are: {', '.join(self.leads)}." if self.leads else "It has no lead."
            raise ValueError(f"`people:` in the fleet file does not make {person.name} a lead. {leads}")

    def _matching(self, code: str, now: float) -> list[PairingCode]:
        wanted = digest(normal_code(code))
        # Compare with every code, in constant time.
        return [each for each in self.codes if hmac.compare_digest(each.digest, wanted) & each.is_open(now)]

    def redeem(self, code: str, cookie: str, device_id: str, device: str, now: float) -> Self | None:
        """Pair a device: add it, and end the code, unless it is the code of a class.

        None if the code is wrong, used or too old. Raises ClassFull.
        """
        matching = self._matching(code, now)
        if not matching:
            return None
        used = matching[0]
        devices = [each for each in self.devices if each.state(now) != "unknown"]
        person = used.person
        if person.is_guest:
            # A guest never replaces a device. The code of a class hangs on a wall, so anyone may have used it.
            if len(self.guests(now)) >= MAX_GUESTS or len(devices) >= MAX_DEVICES:
                raise ClassFull("The class is full. A lead assigns some devices, or revokes them.")
            person = PagePerson(self._guest_name(), GUEST)
        words = printable(device)[:MAX_DEVICE_NAME_LENGTH].strip()
        added = PairedDevice(device_id, person, words, digest(cookie), now)
        codes = self.codes if person.is_guest else tuple(each for each in self.codes if each is not used)
        return replace(self, codes=codes, devices=(*devices, added)[-MAX_DEVICES:])

    def _guest_name(self) -> str:
        """Return a name that is easy to find on a projector, and that is not in use."""
        taken = {each.person.name for each in self.devices} | set(self.people or ())
        return next(name for number in count(1) if (name := f"{GUEST}-{number}") not in taken)

    def revoke(self, names: Iterable[str]) -> tuple[Self, list[PairedDevice]]:
        """Remove the devices with these ids or of these people. Return the new book and the removed devices."""
        chosen = set(names)
        gone = [each for each in self.devices if chosen & {each.id, each.person.name}]
        # Remove the open codes of a person, too: with such a code the device could be paired again.
        codes = tuple(each for each in self.codes if each.person.name not in chosen)
        return replace(self, codes=codes, devices=tuple(each for each in self.devices if each not in gone)), gone

    def device_of(self, cookie: str, now: float) -> tuple[PairedDevice | None, CookieState]:
        """Return the device of a cookie, and what the cookie may do."""
        wanted = digest(cookie)
        found = None
        for each in self.devices:
            if hmac.compare_digest(each.digest, wanted):
                found = each
        state = "unknown" if found is None else found.state(now)
        return (None, "unknown") if found is None or state == "unknown" else (self._as_of_now(found), state)

    def open_devices(self, now: float) -> list[PairedDevice]:
        """Return the devices whose cookie opens the console."""
        return [self._as_of_now(each) for each in self.devices if each.state(now) == "valid"]

    def _as_of_now(self, device: PairedDevice) -> PairedDevice:
        """Return a device with the rank that the fleet file gives its person now."""
        return replace(device, person=self._ranked(device.person))

    def _ranked(self, person: PagePerson) -> PagePerson:
        """Return the person, with rank `person` if their code said lead, but the fleet does not list them as a lead."""
        is_lead = self.leads is None or person.name in self.leads
        return person if is_lead or person.rank != Rank.LEAD else replace(person, rank=Rank.PERSON)

    def as_text(self) -> str:
        """Return the book as JSON."""
        return json.dumps(to_builtins(self), indent=1)

    @classmethod
    def of_text(cls, text: str) -> Self:
        """Parse a book. Raises BadBook."""
        try:
            fields = json.loads(text)
            codes = tuple(PairingCode(**_with_person(each)) for each in fields["codes"])
            devices = tuple(PairedDevice(**_with_person(each)) for each in fields["devices"])
            hashes = [each.digest for each in codes] + [each.digest for each in devices]
            if not all(isinstance(each, str) for each in hashes):
                raise BadBook("a hash is not a text")
            # The console of an earlier version did not write people, or leads.
            people, leads = (_names(fields.get(name)) for name in ("people", "leads"))
            return cls(codes, devices, str(fields["address"]), people, leads)
        except (ValueError, TypeError, KeyError, RecursionError) as error:
            raise BadBook(str(error)) from None


def new_code(choose: Callable[[str], str]) -> str:
    """Return a code. `choose` picks a letter at random, as `secrets.choice` does."""
    return "".join(choose(CODE_ALPHABET) for _ in range(CODE_LENGTH))


def code_words(code: str) -> str:
    """Return a code in the form in which a person reads it: K7QF-3MXP."""
    return f"{code[: CODE_LENGTH // 2]}-{code[CODE_LENGTH // 2 :]}"


def normal_code(text: str) -> str:
    """Return what a person typed without blanks and dashes, in capitals."""
    return "".join(letter for letter in text.upper() if letter.isalnum())


def digest(secret: str) -> str:
    """Return the hash under which a code or a cookie is stored."""
    return hashlib.sha256(secret.encode("utf-8", "surrogatepass")).hexdigest()


def _names(found: Iterable[Any] | None) -> tuple[str, ...] | None:
    return None if found is None else tuple(map(str, found))


def _with_person(fields: dict[str, Any]) -> dict[str, Any]:
    return fields | {"person": PagePerson(**fields["person"])}
