"""The console's certificate for HTTPS: one key for each user, and a certificate for this computer's names."""

import hashlib
import os
import ssl
from collections.abc import Iterable
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any, Final

from cryptography import x509
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.x509.oid import ExtendedKeyUsageOID
from msgspec import Struct

from fleet.hub.certificate_parts import builder, common_name, end_entity, new_key, pem, private_pem
from schemas.atomic_file import write_atomically
from schemas.process.file_lock import FileLock
from schemas.state_dir import default_directory

RENEWAL_BEFORE: Final = timedelta(days=30)
MAX_NAMES: Final = 24
"""Maximum number of names and addresses in a certificate."""


class BadKeyFile(OSError):
    """The key file does not contain a key."""


class Certificate(Struct, frozen=True):
    """A certificate and its key, as files."""

    path: Path
    key_path: Path
    names: tuple[str, ...]
    """Addresses and host names, the current ones first."""
    expires: datetime
    fingerprint: str
    """SHA-256, as browsers show it."""

    def load_into(self, context: ssl.SSLContext) -> None:
        """Use this certificate for new connections."""
        context.load_cert_chain(self.path, self.key_path)


def names_to_certify(current: Iterable[str], certified: Iterable[str]) -> tuple[str, ...]:
    """Return the names of a new certificate: the current names, then earlier ones.

    With the earlier ones, a computer that returns to an earlier network needs no new certificate.
    """
    return tuple(dict.fromkeys((*current, *certified)))[:MAX_NAMES]


def needs_renewal(current: Iterable[str], certified: Iterable[str], expires: datetime, now: datetime) -> bool:
    """Return True if a name is missing in the certificate, or if it expires soon."""
    return now >= expires - RENEWAL_BEFORE or not {*current} <= {*certified}


def ensure_certificate(names: Iterable[str], now: datetime | None = None, directory: Path | None = None) -> Certificate:
    """Return the certificate. Make the key if there is none yet, and a new certificate if one is needed.

    Raises OSError.
    """
    now = datetime.now(UTC) if now is None else now
    directory = default_directory() / "console" if directory is None else directory
    current = tuple(dict.fromkeys(names))[:MAX_NAMES]
    with FileLock(directory / "lock").held():
        key_path, path = directory / "key.pem", directory / "certificate.pem"
        key = _ensure_key(key_path)
        found = _read(path, key_path, key)
        if found is not None and not needs_renewal(current, found.names, found.expires, now):
            return found
        wanted = names_to_certify(current, () if found is None else found.names)
        write_atomically(path, _signed(key, wanted, now), sync=True, private=True)
        made = _read(path, key_path, key)
    assert made is not None
    return made


def _ensure_key(path: Path) -> Any:
    if not path.exists():
        write_atomically(path, private_pem(new_key()), sync=True, private=True)
    if path.stat().st_mode & 0o077:
        os.chmod(path, 0o600)  # noqa: PTH101 - also on what a link names
    try:
        key = serialization.load_pem_private_key(path.read_bytes(), None)
    except ValueError:
        key = None
    if not isinstance(key, ec.EllipticCurvePrivateKey):
        raise BadKeyFile(0, "it is not a key of the console; delete it, and a new one is made", str(path))
    return key


def _read(path: Path, key_path: Path, key: Any) -> Certificate | None:
    """Return the stored certificate, or None if there is no certificate of this key."""
    try:
        found = x509.load_pem_x509_certificate(path.read_bytes())
        names = found.extensions.get_extension_for_class(x509.SubjectAlternativeName).value
    except (FileNotFoundError, ValueError, x509.ExtensionNotFound):
        return None
    if found.public_key() != key.public_key():
        return None
    listed = (str(each.value) for each in names)
    digest = hashlib.sha256(found.public_bytes(serialization.Encoding.DER)).hexdigest().upper()
    fingerprint = ":".join(digest[index : index + 2] for index in range(0, len(digest), 2))
    return Certificate(path, key_path, tuple(listed), found.not_valid_after_utc, fingerprint)


def _signed(key: ec.EllipticCurvePrivateKey, names: tuple[str, ...], now: datetime) -> bytes:
    subject = common_name("fleet console")
    begun = builder(subject, subject, key.public_key(), key.public_key(), now)
    return pem(end_entity(begun, (ExtendedKeyUsageOID.SERVER_AUTH,), names).sign(key, hashes.SHA256()))
