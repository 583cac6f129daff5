"""Parts of the certificates that we make: keys on the curve P-256, names, lifetimes, and their forms as text."""

import ipaddress
from collections.abc import Iterable
from datetime import datetime, timedelta
from typing import Any, Final

from cryptography import x509
from cryptography.hazmat.primitives import serialization
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.x509.oid import NameOID

LIFETIME: Final = timedelta(days=397)
"""Lifetime of a certificate. Browsers reject certificates that last much longer."""
_BACKDATED: Final = timedelta(days=1)
"""Certificates are valid from this time before they are made, because clocks differ. A Raspberry Pi without a network
may show yesterday's time."""


def new_key() -> ec.EllipticCurvePrivateKey:
    """Return a new private key."""
    return ec.generate_private_key(ec.SECP256R1())


def private_pem(key: ec.EllipticCurvePrivateKey) -> bytes:
    """Return a private key as PEM, not encrypted."""
    return key.private_bytes(
        serialization.Encoding.PEM, serialization.PrivateFormat.PKCS8, serialization.NoEncryption()
    )


def pem(certificate: x509.Certificate) -> bytes:
    """Return a certificate as PEM."""
    return certificate.public_bytes(serialization.Encoding.PEM)


def builder(
    subject: x509.Name, issuer: x509.Name, key: Any, issuer_key: Any, now: datetime, lifetime: timedelta = LIFETIME
) -> x509.CertificateBuilder:
    """Return the beginning of a certificate for a public key. `issuer_key` is that of the authority, public, too.

    Since Python 3.13, its default settings reject certificates without the identifiers of both keys (RFC 5280, 4.2.1).
    """
    return (
        x509.CertificateBuilder()
        .subject_name(subject)
        .issuer_name(issuer)
        .public_key(key)
        .serial_number(x509.random_serial_number())
        .not_valid_before(now - _BACKDATED)
        .not_valid_after(now + lifetime)
        .add_extension(x509.SubjectKeyIdentifier.from_public_key(key), critical=False)
        .add_extension(x509.AuthorityKeyIdentifier.from_issuer_public_key(issuer_key), critical=False)
    )


def end_entity(
    begun: x509.CertificateBuilder, usages: Iterable[x509.ObjectIdentifier], names: tuple[str, ...] = ()
) -> x509.CertificateBuilder:
    """Add the extensions of a certificate that signs no others. names: IP addresses and host names."""
    made = (
        begun.add_extension(x509.BasicConstraints(ca=False, path_length=None), critical=True)
        .add_extension(key_usage(signs=False), critical=True)
        .add_extension(x509.ExtendedKeyUsage(usages), critical=False)
    )
    if not names:
        return made
    return made.add_extension(x509.SubjectAlternativeName([_general_name(each) for each in names]), critical=False)


def key_usage(*, signs: bool) -> x509.KeyUsage:
    """Return the usage of a key that signs certificates, or of one that is only for handshakes."""
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


def common_name(name: str) -> x509.Name:
    """Return a subject with this common name only."""
    return x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, name)])


def _general_name(name: str) -> x509.GeneralName:
    try:
        return x509.IPAddress(ipaddress.ip_address(name))
    except ValueError:
        return x509.DNSName(name)
