"""Asks the hub for the next certificate of an identity. The key stays the same, and never leaves this computer.

The package `cryptography` takes a while to load, so programs import this module only when a certificate is due.
"""

import json
from collections.abc import Callable
from datetime import datetime
from pathlib import Path
from typing import Any, Final

from cryptography import x509
from cryptography.exceptions import UnsupportedAlgorithm
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.x509.oid import NameOID

from schemas.atomic_file import write_atomically
from schemas.bus.certificate_dates import CertificateDates
from schemas.bus.credentials import Credentials

CERTIFICATE: Final = "certificate"
REQUEST: Final = "request"


def identity_in(path: Path) -> str:
    """Return the identity in a certificate, such as car.red. Raises OSError, ValueError.

    A later invitation of the same identity adds a number to the name in the certificate. This number is not part of the
    result.
    """
    names = x509.load_pem_x509_certificate(path.read_bytes()).subject.get_attributes_for_oid(NameOID.COMMON_NAME)
    if not names:
        raise ValueError(f"{path} names no identity")
    return ".".join(str(names[0].value).split(".")[:2])


def renew(credentials: Credentials, identity: str, file: str, now: datetime, ask: Callable[[bytes], bytes]) -> str:
    """Fetch and store the next certificate of an identity. Return why that failed, or an empty text if it is stored.

    `file` is the name of the files of the certificate and its key, without their ending. `ask` sends a request to the
    hub, and returns the answer, or nothing if there is none. Raises OSError if a file cannot be read or written.
    """
    path = credentials.directory / f"{file}.pem"
    try:
        key: Any = serialization.load_pem_private_key((credentials.directory / f"{file}.key").read_bytes(), None)
        name = x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, identity)])
        request = x509.CertificateSigningRequestBuilder().subject_name(name).sign(key, hashes.SHA256())
        old = path.read_text(encoding="ascii")
    except (ValueError, TypeError, UnsupportedAlgorithm) as error:
        return f"the key or the certificate of {identity} is damaged: {error}"
    asked = {CERTIFICATE: old, REQUEST: request.public_bytes(serialization.Encoding.PEM).decode()}
    answer = ask(json.dumps(asked).encode())
    dates = CertificateDates.of(answer)
    if dates is None:
        return "the hub gave no certificate"
    if dates.is_due(now):
        return "the hub gave no newer certificate"
    try:
        if x509.load_pem_x509_certificate(answer).public_key() != key.public_key():
            return "the certificate that the hub sent is for another key"
    except ValueError:
        return "the hub gave no certificate"
    write_atomically(path, answer, sync=True, private=True)
    return ""
