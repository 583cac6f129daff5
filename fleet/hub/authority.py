"""The certificate authority of a hub: one key, and the certificates that it signs.

Keys are on the curve P-256. A certificate names one identity. Only the certificate of the hub may be that of a server,
so nobody who has joined can be the hub for others.
"""

import hashlib
import ipaddress
from collections.abc import Iterable
from dataclasses import dataclass
from datetime import datetime, timedelta
from typing import Any, Final

from cryptography import x509
from cryptography.exceptions import UnsupportedAlgorithm
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.x509.oid import ExtendedKeyUsageOID, NameOID

CA_LIFETIME: Final = timedelta(days=3650)
LIFETIME: Final = timedelta(days=397)
"""Lifetime of a certificate."""
RENEWAL_BEFORE: Final = LIFETIME / 3
"""Time before its end from which a certificate is renewed."""
_BACKDATED: Final = timedelta(days=1)
"""The clocks of small computers differ, and a Raspberry Pi without a network has yesterday's."""


class BadRequestForCertificate(ValueError):
    """A request for a certificate that is none, or is not signed with its own key."""


@dataclass(frozen=True, slots=True)
class KeyPair:
    """A certificate and its private key, PEM."""

    certificate: bytes
    key: bytes


def make_authority(now: datetime) -> KeyPair:
    """Return a new authority."""
    key, name = _new_key(), _name("car fleet hub authority")
    made = (
        _builder(name, name, key.public_key(), now, CA_LIFETIME)
        .add_extension(x509.BasicConstraints(ca=True, path_length=0), critical=True)
        .add_extension(_usage(signs=True), critical=True)
        .sign(key, hashes.SHA256())
    )
    return KeyPair(_pem(made), private_pem(key))


def new_request(common_name: str) -> tuple[bytes, bytes]:
    """Return a new private key, and a request for a certificate of it, PEM."""
    key = _new_key()
    request = x509.CertificateSigningRequestBuilder().subject_name(_name(common_name)).sign(key, hashes.SHA256())
    return private_pem(key), request.public_bytes(serialization.Encoding.PEM)


def sign_request(authority: KeyPair, request: bytes, common_name: str, now: datetime) -> bytes:
    """Return the certificate of an identity for the key of a request. Raises BadRequestForCertificate.

    The name in the request does not count: whoever asks does not choose who it is.
    """
    try:
        asked = x509.load_pem_x509_csr(request)
    except ValueError:
        raise BadRequestForCertificate("it is no request for a certificate") from None
    key = asked.public_key()
    if not asked.is_signature_valid or not isinstance(key, ec.EllipticCurvePublicKey):
        raise BadRequestForCertificate("the request is not signed with its own key, or the key is not on a curve")
    return _signed(authority, key, common_name, now, ExtendedKeyUsageOID.CLIENT_AUTH, ())


def issue(authority: KeyPair, common_name: str, now: datetime, addresses: Iterable[str] = ()) -> KeyPair:
    """Return a new key and its certificate. With `addresses`, IP addresses and host names, it is that of the hub."""
    key = _new_key()
    names = tuple(addresses)
    usage = ExtendedKeyUsageOID.SERVER_AUTH if names else ExtendedKeyUsageOID.CLIENT_AUTH
    return KeyPair(_signed(authority, key.public_key(), common_name, now, usage, names), private_pem(key))


def is_due(certificate: bytes, now: datetime, addresses: Iterable[str] = ()) -> bool:
    """Return True if a certificate must be renewed: it ends soon, lacks an address, or is none."""
    try:
        found = x509.load_pem_x509_certificate(certificate)
    except ValueError:
        return True
    try:
        listed = {
            str(each.value) for each in found.extensions.get_extension_for_class(x509.SubjectAlternativeName).value
        }
    except x509.ExtensionNotFound:
        listed = set()
    return now >= found.not_valid_after_utc - RENEWAL_BEFORE or not {*addresses} <= listed


def expires(certificate: bytes) -> datetime:
    """Return when a certificate ends. Raises ValueError if it is none."""
    return x509.load_pem_x509_certificate(certificate).not_valid_after_utc


def belong(certificate: bytes, key: bytes) -> bool:
    """Return True if a private key is that of a certificate. False if one of them is none."""
    try:
        found: Any = serialization.load_pem_private_key(key, None)
        public = x509.load_pem_x509_certificate(certificate).public_key()
    except (ValueError, TypeError, UnsupportedAlgorithm):
        return False
    return bool(found.public_key() == public)


def only_certificate(text: bytes) -> bytes:
    """Return the one certificate in a text, and nothing else of it, PEM. Raises ValueError if there is not just one."""
    found = x509.load_pem_x509_certificates(text)
    if len(found) != 1:
        raise ValueError(f"{len(found)} certificates where there is one")
    return _pem(found[0])


def fingerprint(certificate: bytes) -> bytes:
    """Return the SHA-256 of a certificate. Raises ValueError if it is none."""
    return hashlib.sha256(x509.load_pem_x509_certificate(certificate).public_bytes(serialization.Encoding.DER)).digest()


def _new_key() -> ec.EllipticCurvePrivateKey:
    return ec.generate_private_key(ec.SECP256R1())


def private_pem(key: ec.EllipticCurvePrivateKey) -> bytes:
    """Return a private key as PEM, not encrypted."""
    return key.private_bytes(
        serialization.Encoding.PEM, serialization.PrivateFormat.PKCS8, serialization.NoEncryption()
    )


def _signed(
    authority: KeyPair, key: Any, common_name: str, now: datetime, usage: x509.ObjectIdentifier, names: Iterable[str]
) -> bytes:
    ca_key: Any = serialization.load_pem_private_key(authority.key, None)
    ca = x509.load_pem_x509_certificate(authority.certificate)
    made = (
        _builder(_name(common_name), ca.subject, key, now, LIFETIME)
        .add_extension(x509.BasicConstraints(ca=False, path_length=None), critical=True)
        .add_extension(_usage(signs=False), critical=True)
        .add_extension(x509.ExtendedKeyUsage([usage]), critical=False)
    )
    if alternatives := [_general_name(each) for each in names]:
        made = made.add_extension(x509.SubjectAlternativeName(alternatives), critical=False)
    return _pem(made.sign(ca_key, hashes.SHA256()))


def _builder(
    subject: x509.Name, issuer: x509.Name, key: Any, now: datetime, lifetime: timedelta
) -> x509.CertificateBuilder:
    return (
        x509.CertificateBuilder()
        .subject_name(subject)
        .issuer_name(issuer)
        .public_key(key)
        .serial_number(x509.random_serial_number())
        .not_valid_before(now - _BACKDATED)
        .not_valid_after(now + lifetime)
    )


def _usage(*, signs: bool) -> x509.KeyUsage:
    return x509.KeyUsage(
        digital_signature=not signs,
        content_commitment=False,
        key_encipherment=False,
        data_encipherment=False,
        key_agreement=False,
        key_cert_sign=signs,
        crl_sign=signs,
        encipher_only=False,
        decipher_only=False,
    )


def _name(common_name: str) -> x509.Name:
    return x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, common_name)])


def _general_name(name: str) -> x509.GeneralName:
    try:
        return x509.IPAddress(ipaddress.ip_address(name))
    except ValueError:
        return x509.DNSName(name)


def _pem(made: x509.Certificate) -> bytes:
    return made.public_bytes(serialization.Encoding.PEM)
