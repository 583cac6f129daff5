"""The code with which a computer joins a hub: a secret, then a pin that identifies the right hub. Pure.

A computer that joins connects to a hub whose certificate it does not know. The pin, the second half of the code, is the
beginning of the fingerprint of the hub's authority. So nobody between the two computers can pretend to be the hub.
"""

import base64
import hmac
import secrets
from typing import Final, Self

from msgspec import Struct

CODE_ALPHABET: Final = "23456789ABCDEFGHJKLMNPQRSTUVWXYZ"
"""Letters and digits that people do not confuse."""
_BASE32: Final = "ABCDEFGHIJKLMNOPQRSTUVWXYZ234567"
_HALF: Final = 12
"""Characters of each half, 60 bits. The hub allows five guesses. Forging an authority with this pin takes 10^18 tries.
"""
_GROUP: Final = 4
"""Characters between two hyphens."""
JOIN_CODE_LIFETIME_S: Final = 600.0
MAX_GUESSES: Final = 5
"""Number of wrong codes after which an invitation ends."""


class BadCode(ValueError):
    """A text that is not a code."""


class JoinCode(Struct, frozen=True):
    """A code of 24 characters."""

    secret: str
    pin: str

    @classmethod
    def new(cls, fingerprint: bytes) -> Self:
        """Return a new code for the authority with this SHA-256 fingerprint."""
        return cls("".join(secrets.choice(CODE_ALPHABET) for _ in range(_HALF)), pin_of(fingerprint))

    @classmethod
    def parse(cls, text: str) -> Self:
        """Return the code that a person typed. Raises BadCode if the text is not a code."""
        letters = "".join(each for each in text.upper() if not (each in "-_." or each.isspace()))
        if len(letters) != 2 * _HALF or set(letters) - set(CODE_ALPHABET):
            raise BadCode(
                f"{text!r} is not a code. A code has {2 * _HALF} of the characters {CODE_ALPHABET}, "
                f"in groups of {_GROUP}"
            )
        return cls(letters[:_HALF], letters[_HALF:])

    def __str__(self) -> str:
        letters = self.secret + self.pin
        return "-".join(letters[at : at + _GROUP] for at in range(0, len(letters), _GROUP))

    def fits(self, fingerprint: bytes) -> bool:
        """Return True if the code is for the authority with this SHA-256 fingerprint."""
        return hmac.compare_digest(self.pin, pin_of(fingerprint))

    def is_secret(self, guess: str) -> bool:
        """Return True if the guess is the secret half. The comparison takes the same time for every guess."""
        return hmac.compare_digest(self.secret.encode(), guess.encode(errors="replace"))


def pin_of(fingerprint: bytes) -> str:
    """Return the half of a code that identifies an authority."""
    letters = base64.b32encode(fingerprint).decode()[:_HALF]
    return letters.translate(str.maketrans(_BASE32, CODE_ALPHABET))
