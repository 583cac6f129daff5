"""Certificates, as OpenSSL judges them."""

import ssl
from contextlib import suppress
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import pytest
from cryptography import x509
from cryptography.exceptions import InvalidSignature
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.x509.oid import ExtendedKeyUsageOID, NameOID

from fleet.hub import certificate_authority
from fleet.hub.certificate_authority import BadRequestForCertificate
from fleet.hub.certificate_parts import LIFETIME
from schemas.bus import certificate_request
from schemas.bus.certificate_dates import CertificateDates

NOW = datetime(2026, 11, 26, 9, 0, tzinfo=UTC)


@pytest.fixture(scope="module")
def ca() -> certificate_authority.KeyPair:
    return certificate_authority.make_authority(NOW)


def usage_of(certificate: bytes) -> list[x509.ObjectIdentifier]:
    found = x509.load_pem_x509_certificate(certificate)
    return list(found.extensions.get_extension_for_class(x509.ExtendedKeyUsage).value)


def test_certificate_is_signed_by_own_authority_only(ca: certificate_authority.KeyPair) -> None:
    made = x509.load_pem_x509_certificate(certificate_authority.issue(ca, "person.mia", NOW).certificate)
    made.verify_directly_issued_by(x509.load_pem_x509_certificate(ca.certificate))
    other = x509.load_pem_x509_certificate(certificate_authority.make_authority(NOW).certificate)
    with pytest.raises((ValueError, InvalidSignature)):
        made.verify_directly_issued_by(other)


def test_only_the_hub_may_be_a_server(ca: certificate_authority.KeyPair) -> None:
    assert usage_of(certificate_authority.issue(ca, "hub", NOW, ["127.0.0.1"]).certificate) == [
        ExtendedKeyUsageOID.SERVER_AUTH
    ]
    assert usage_of(certificate_authority.issue(ca, "person.mia", NOW).certificate) == [ExtendedKeyUsageOID.CLIENT_AUTH]
    _, request = certificate_authority.new_request("hub")
    assert usage_of(certificate_authority.sign_request(ca, request, "car.red", NOW)) == [
        ExtendedKeyUsageOID.CLIENT_AUTH
    ]


def test_signed_certificate_ignores_name_in_request(ca: certificate_authority.KeyPair, tmp_path: Path) -> None:
    key, request = certificate_authority.new_request("service.supervisor")
    made = certificate_authority.sign_request(ca, request, "person.mia", NOW)
    (name,) = x509.load_pem_x509_certificate(made).subject.get_attributes_for_oid(NameOID.COMMON_NAME)
    assert name.value == "person.mia"
    (tmp_path / "key").write_bytes(key)
    (tmp_path / "pem").write_bytes(made)
    ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT).load_cert_chain(tmp_path / "pem", tmp_path / "key")


@pytest.mark.parametrize("strict", [True, False])
def test_hub_is_accepted_by_strict_clients_too(strict: bool, tmp_path: Path) -> None:
    """Since Python 3.13, its default settings are strict."""
    now = datetime.now(UTC)
    ca = certificate_authority.make_authority(now)
    hub = certificate_authority.issue(ca, "hub", now, ["127.0.0.1"])
    (tmp_path / "both").write_bytes(hub.certificate + hub.key)
    server = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
    server.load_cert_chain(tmp_path / "both")
    client = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
    client.load_verify_locations(cadata=ca.certificate.decode())
    client.verify_flags |= ssl.VERIFY_X509_STRICT if strict else 0
    to_server, to_client = ssl.MemoryBIO(), ssl.MemoryBIO()
    ends = (
        client.wrap_bio(to_client, to_server, server_hostname="127.0.0.1"),
        server.wrap_bio(to_server, to_client, server_side=True),
    )
    for end in ends * 3:
        with suppress(ssl.SSLWantReadError):
            end.do_handshake()
    assert ends[1].cipher() is not None


@pytest.mark.parametrize("request_bytes", [b"", b"junk", b"-----BEGIN CERTIFICATE REQUEST-----\nAAAA\n"])
def test_malformed_certificate_request_is_refused(ca: certificate_authority.KeyPair, request_bytes: bytes) -> None:
    with pytest.raises(BadRequestForCertificate):
        certificate_authority.sign_request(ca, request_bytes, "person.mia", NOW)


def test_request_with_another_ones_signature_is_refused(ca: certificate_authority.KeyPair) -> None:
    _, request = certificate_authority.new_request("a")
    lines = request.splitlines()
    damaged = b"\n".join([*lines[:-2], lines[-2][::-1], lines[-1]])
    with pytest.raises(BadRequestForCertificate):
        certificate_authority.sign_request(ca, damaged, "person.mia", NOW)


@pytest.mark.parametrize(
    ("after", "names", "is_due"),
    [
        (timedelta(0), ["127.0.0.1"], False),
        (LIFETIME * 2 / 3 - timedelta(days=1), ["127.0.0.1"], False),
        (LIFETIME * 2 / 3 + timedelta(days=1), ["127.0.0.1"], True),
        (timedelta(0), ["127.0.0.1", "192.0.2.7"], True),
        (timedelta(0), [], False),
    ],
)
def test_renewal_is_due_a_third_before_end_or_for_new_address(
    ca: certificate_authority.KeyPair, after: timedelta, names: list[str], is_due: bool
) -> None:
    made = certificate_authority.issue(ca, "hub", NOW, ["127.0.0.1", "hall.local"]).certificate
    assert certificate_authority.is_due(made, NOW + after, names) == is_due


def test_none_and_a_damaged_one_are_due() -> None:
    assert certificate_authority.is_due(b"", NOW)
    assert certificate_authority.is_due(b"junk", NOW)


def request_for(key: bytes) -> bytes:
    """Return a request for a certificate of this key."""
    private: Any = serialization.load_pem_private_key(key, None)
    made = x509.CertificateSigningRequestBuilder().subject_name(x509.Name([])).sign(private, hashes.SHA256())
    return made.public_bytes(serialization.Encoding.PEM)


DUE = LIFETIME * 0.9


@pytest.mark.parametrize("names", [[], ["127.0.0.1", "north.local"]])
def test_next_certificate_has_the_same_key_and_names(ca: certificate_authority.KeyPair, names: list[str]) -> None:
    key, request = certificate_authority.new_request("x")
    old = certificate_authority.KeyPair(certificate_authority.sign_request(ca, request, "person.mia", NOW, names), key)
    made = certificate_authority.renew(ca, old.certificate, request_for(old.key), "person.mia", NOW + DUE)
    assert certificate_authority.belong(made, old.key)
    assert certificate_authority.names_of(made) == names
    assert certificate_authority.expires(made) == certificate_authority.expires(old.certificate) + DUE
    assert not certificate_authority.is_due(made, NOW + DUE)


@pytest.mark.parametrize("wrong", ["name", "key", "authority", "early", "late", "junk", "no request"])
def test_no_next_certificate_for(ca: certificate_authority.KeyPair, wrong: str) -> None:
    mine = certificate_authority.issue(ca, "person.mia", NOW)
    other = certificate_authority.issue(certificate_authority.make_authority(NOW), "person.mia", NOW)
    held = other if wrong == "authority" else mine
    after = {"early": LIFETIME / 2, "late": LIFETIME + timedelta(seconds=1)}.get(wrong, DUE)
    request = {"key": certificate_authority.new_request("person.mia")[1], "no request": b""}.get(
        wrong, request_for(held.key)
    )
    certificate = b"junk" if wrong == "junk" else held.certificate
    with pytest.raises(BadRequestForCertificate):
        certificate_authority.renew(
            ca, certificate, request, "person.eve" if wrong == "name" else "person.mia", NOW + after
        )


def test_dates_are_read_as_the_library_reads_them(ca: certificate_authority.KeyPair) -> None:
    for made in (ca.certificate, certificate_authority.issue(ca, "hub", NOW, ["127.0.0.1"]).certificate):
        read = x509.load_pem_x509_certificate(made)
        assert CertificateDates.of(made) == CertificateDates(read.not_valid_before_utc, read.not_valid_after_utc)
    late = certificate_authority.issue(ca, "person.mia", datetime(2060, 1, 1, tzinfo=UTC)).certificate
    dates = CertificateDates.of(late)
    assert dates is not None
    assert dates.ends == certificate_authority.expires(late), "GeneralizedTime"
    for junk in (b"", b"junk", b"-----BEGIN CERTIFICATE-----\nAAAA\n-----END CERTIFICATE-----"):
        assert CertificateDates.of(junk) is None


def test_certificate_without_a_name_has_no_identity(tmp_path: Path) -> None:
    """A renewal says why it failed. It does not end the program that renews."""
    key = ec.generate_private_key(ec.SECP256R1())
    nobody = x509.Name([])
    builder = x509.CertificateBuilder(nobody, nobody, key.public_key(), 1, NOW, NOW + timedelta(days=1))
    path = tmp_path / "nobody.pem"
    path.write_bytes(builder.sign(key, hashes.SHA256()).public_bytes(serialization.Encoding.PEM))
    with pytest.raises(ValueError, match="names no identity"):
        certificate_request.identity_in(path)
