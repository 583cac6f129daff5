"""The certificate authority of a hub: one key, and the certificates that it signs.

Keys are on the curve P-256. A certificate names one identity. Only certificates of hubs are valid for a server, so no
other computer that has joined can pretend to be the hub.
"""

import hashlib
from collections.abc import Iterable
from datetime import datetime, timedelta
from typing import Any, Final

from cryptography import x509
from cryptography.exceptions import InvalidSignature, UnsupportedAlgorithm
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.x509.oid import ExtendedKeyUsageOID
from msgspec import Struct

from fleet.hub.certificate_parts import builder, common_name, end_entity, key_usage, new_key, pem, private_pem
from schemas.bus.certificate_dates import CertificateDates

CA_LIFETIME: Final = timedelta(days=3650)
_SERVER: Final = ExtendedKeyUsageOID.SERVER_AUTH


class BadRequestForCertificate(ValueError):
    """A certificate is not made for this request. The text says why."""


class KeyPair(Struct, frozen=True):
    """A certificate and its private key, PEM."""

    certificate: bytes
    key: bytes


def make_authority(now: datetime) -> KeyPair:
    """Return a new authority."""
    key, name = new_key(), common_name("car fleet hub authority")
    made = (
        builder(name, name, key.public_key(), key.public_key(), now, CA_LIFETIME)
        .add_extension(x509.BasicConstraints(ca=True, path_length=0), critical=True)
        .add_extension(key_usage(signs=True), critical=True)
        .sign(key, hashes.SHA256())
    )
    return KeyPair(pem(made), private_pem(key))


def new_request(name: str) -> tuple[bytes, bytes]:
    """Return a new private key, and a request for its certificate, PEM."""
    key = new_key()
    request = x509.CertificateSigningRequestBuilder().subject_name(common_name(name)).sign(key, hashes.SHA256())
    return private_pem(key), request.public_bytes(serialization.Encoding.PEM)


def sign_request(authority: KeyPair, request: bytes, name: str, now: datetime, addresses: Iterable[str] = ()) -> bytes:
    """Return the certificate of an identity for the key of a request. Raises BadRequestForCertificate.

    The name in the request does not count, because a computer must not choose its own identity. With `addresses`, it is
    the certificate of the hub of another site.
    """
    try:
        asked = x509.load_pem_x509_csr(request)
    except ValueError:
        raise BadRequestForCertificate("it is not a request for a certificate") from None
    key = asked.public_key()
    if not asked.is_signature_valid or not isinstance(key, ec.EllipticCurvePublicKey):
        raise BadRequestForCertificate("the request is not signed with its own key, or the key is not on a curve")
    names, usages = tuple(addresses), [ExtendedKeyUsageOID.CLIENT_AUTH]
    if names:
        usages.append(_SERVER)
    try:
        return _signed(authority, key, name, now, usages, names)
    except ValueError:
        raise BadRequestForCertificate("these are not names of a computer") from None


def issue(authority: KeyPair, name: str, now: datetime, addresses: Iterable[str] = ()) -> KeyPair:
    """Return a new key and its certificate.

    With `addresses` (IP addresses, host names), it is the hub's certificate.
    """
    key = new_key()
    names = tuple(addresses)
    usage = _SERVER if names else ExtendedKeyUsageOID.CLIENT_AUTH
    return KeyPair(_signed(authority, key.public_key(), name, now, (usage,), names), private_pem(key))


def renew(authority: KeyPair, certificate: bytes, request: bytes, name: str, now: datetime) -> bytes:
    """Return the next certificate for the same key, if `certificate` is in force and due.

    Raises BadRequestForCertificate. The request proves that the sender has the key. The names of a site's hub
    are copied from the old certificate.
    """
    ca = x509.load_pem_x509_certificate(authority.certificate)
    try:
        old = x509.load_pem_x509_certificate(certificate)
        old.verify_directly_issued_by(ca)
        asked = x509.load_pem_x509_csr(request)
    except (ValueError, TypeError, InvalidSignature):
        raise BadRequestForCertificate("there is no certificate of this authority, or no request") from None
    if old.subject != common_name(name):
        raise BadRequestForCertificate(f"the certificate is not that of {name}")
    if asked.public_key() != old.public_key():
        raise BadRequestForCertificate("the request is not for the key of the certificate")
    if not old.not_valid_before_utc <= now < old.not_valid_after_utc:
        raise BadRequestForCertificate("the certificate is not in force")
    if not is_due(certificate, now):
        raise BadRequestForCertificate("a certificate is renewed only in the last third of its life")
    return sign_request(authority, request, name, now, sorted(_names(old)))


def is_due(certificate: bytes, now: datetime, addresses: Iterable[str] = ()) -> bool:
    """Return True if a certificate must be renewed: it expires soon, lacks an address, or is not valid."""
    try:
        found = x509.load_pem_x509_certificate(certificate)
    except ValueError:
        return True
    dates = CertificateDates(found.not_valid_before_utc, found.not_valid_after_utc)
    return dates.is_due(now) or not {*addresses} <= _names(found)


def _names(certificate: x509.Certificate) -> set[str]:
    """Return the IP addresses and host names of a certificate."""
    try:
        listed = certificate.extensions.get_extension_for_class(x509.SubjectAlternativeName).value
    except x509.ExtensionNotFound:
        return set()
    return {str(each.value) for each in listed}


def names_of(certificate: bytes) -> list[str]:
    """Return the IP addresses and host names of a certificate. Raises ValueError if it is not one."""
    return sorted(_names(x509.load_pem_x509_certificate(certificate)))


def expires(certificate: bytes) -> datetime:
    """Return when a certificate expires. Raises ValueError if it is not a certificate."""
    return x509.load_pem_x509_certificate(certificate).not_valid_after_utc


def belong(certificate: bytes, key: bytes) -> bool:
    """Return True if a private key belongs to a certificate. False if one of them is not valid."""
    try:
        found: Any = serialization.load_pem_private_key(key, None)
        public = x509.load_pem_x509_certificate(certificate).public_key()
    except (ValueError, TypeError, UnsupportedAlgorithm):
        return False
    return bool(found.public_key() == public)


def only_certificate(text: bytes) -> bytes:
    """Return the only certificate in a text, PEM, without the rest. Raises ValueError if there is not exactly one."""
    found = x509.load_pem_x509_certificates(text)
    if len(found) != 1:
        raise ValueError(f"{len(found)} certificates, expected one")
    return pem(found[0])


def fingerprint(certificate: bytes) -> bytes:
    """Return the SHA-256 of a certificate. Raises ValueError if it is not one."""
    return hashlib.sha256(x509.load_pem_x509_certificate(certificate).public_bytes(serialization.Encoding.DER)).digest()


def _signed(
    authority: KeyPair,
    key: Any,
    name: str,
    now: datetime,
    usages: Iterable[x509.ObjectIdentifier],
    names: tuple[str, ...] = (),
) -> bytes:
    ca_key: Any = serialization.load_pem_private_key(authority.key, None)
    ca = x509.load_pem_x509_certificate(authority.certificate)
    begun = builder(common_name(name), ca.subject, key, ca_key.public_key(), now)
    return pem(end_entity(begun, usages, names).sign(ca_key, hashes.SHA256()))
