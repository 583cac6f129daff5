"""Reads the dates of a certificate without a library of cryptography, which each command would have to load. Pure.

Nothing is checked here. So trust the result only for certificates in our own directory, or check the certificate then.
"""

import binascii
import re
from datetime import UTC, datetime
from typing import Final, NamedTuple, Self

RENEWED_SHARE: Final = 1 / 3
"""Share of a certificate's life that is left when it is renewed."""
_PEM: Final = re.compile(rb"-----BEGIN CERTIFICATE-----([^-]+)-----END CERTIFICATE-----")
# RFC 5280, 4.1.2.5: Validity is two times in a row, UTCTime to 2049 and GeneralizedTime after it.
_TIME: Final = rb"(?:\x17\x0d(\d{12}Z)|\x18\x0f(\d{14}Z))"
_VALIDITY: Final = re.compile(rb"\x30[\x1e-\x22]" + _TIME + _TIME)


class CertificateDates(NamedTuple):
    """When a certificate begins and ends."""

    begins: datetime
    ends: datetime

    @classmethod
    def of(cls, certificate: bytes) -> Self | None:
        """Return the dates of a certificate in PEM. None if the bytes are not a certificate."""
        try:
            der = binascii.a2b_base64(found[1]) if (found := _PEM.search(certificate)) else b""
            dates = _VALIDITY.search(der)
            if dates is None:
                return None
            return cls(_time(dates[1], dates[2]), _time(dates[3], dates[4]))
        except ValueError:  # binascii.Error is a ValueError
            return None

    def is_due(self, now: datetime) -> bool:
        """Return True if at most a third of its life is left."""
        return now >= self.ends - (self.ends - self.begins) * RENEWED_SHARE


def _time(short: bytes | None, long: bytes | None) -> datetime:
    written = (long or b"20" + (short or b"")).decode()
    return datetime.strptime(written, "%Y%m%d%H%M%SZ").replace(tzinfo=UTC)
