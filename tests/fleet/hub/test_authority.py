"""Certificates, as OpenSSL judges them."""

import ssl
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import pytest
from cryptography import x509
from cryptography.exceptions import InvalidSignature
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.x509.oid import ExtendedKeyUsageOID, NameOID

from fleet.hub import authority
from fleet.hub.authority import BadRequestForCertificate
from fleet.hub.x509_parts import LIFETIME
from schemas.bus.certificate_dates import CertificateDates

NOW = datetime(2026, 11, 26, 9, 0, tzinfo=UTC)


@pytest.fixture(scope="module")
def ca() -> authority.KeyPair:
    return authority.make_authority(NOW)


def usage_of(certificate: bytes) -> list[x509.ObjectIdentifier]:
    found = x509.load_pem_x509_certificate(certificate)
    return list(found.extensions.get_extension_for_class(x509.ExtendedKeyUsage).value)


def test_store_change_waits_for_lock_but_not_for_killed_holder(ca: authority.KeyPair) -> None:
    made = x509.load_pem_x509_certificate(authority.issue(ca, "person.mia", NOW).certificate)
    made.verify_directly_issued_by(x509.load_pem_x509_certificate(ca.certificate))
    other = x509.load_pem_x509_certificate(authority.make_authority(NOW).certificate)
    with pytest.raises((ValueError, InvalidSignature)):
        made.verify_directly_issued_by(other)


def test_only_the_hub_may_be_a_server(ca: authority.KeyPair) -> None:
    assert usage_of(authority.issue(ca, "hub", NOW, ["127.0.0.1"]).certificate) == [ExtendedKeyUsageOID.SERVER_AUTH]
    assert usage_of(authority.issue(ca, "person.mia", NOW).certificate) == [ExtendedKeyUsageOID.CLIENT_AUTH]
    _, request = authority.new_request("hub")
    assert usage_of(authority.sign_request(ca, request, "car.red", NOW)) == [ExtendedKeyUsageOID.CLIENT_AUTH]


def test_who_asks_does_not_choose_its_name(ca: authority.KeyPair, tmp_path: Path) -> None:
    key, request = authority.new_request("service.supervisor")
    made = authority.sign_request(ca, request, "person.mia", NOW)
    (name,) = x509.load_pem_x509_certificate(made).subject.get_attributes_for_oid(NameOID.COMMON_NAME)
    assert name.value == "person.mia"
    (tmp_path / "key").write_bytes(key)
    (tmp_path / "pem").write_bytes(made)
    ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT).load_cert_chain(tmp_path / "pem", tmp_path / "key")


@pytest.mark.parametrize("request_bytes", [b"", b"junk", b"-----BEGIN CERTIFICATE REQUEST-----\nAAAA\n"])
def test_what_is_no_request_is_refused(ca: authority.KeyPair, request_bytes: bytes) -> None:
    with pytest.raises(BadRequestForCertificate):
        authority.sign_request(ca, request_bytes, "person.mia", NOW)


def test_a_request_with_another_ones_signature_is_refused(ca: authority.KeyPair) -> None:
    _, request = authority.new_request("a")
    lines = request.splitlines()
    damaged = b"\n".join([*lines[:-2], lines[-2][::-1], lines[-1]])
    with pytest.raises(BadRequestForCertificate):
        authority.sign_request(ca, damaged, "person.mia", NOW)


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
def test_false_hub_beside_right_authority_gets_nothing(
    ca: authority.KeyPair, after: timedelta, names: list[str], is_due: bool
) -> None:
    made = authority.issue(ca, "hub", NOW, ["127.0.0.1", "hall.local"]).certificate
    assert authority.is_due(made, NOW + after, names) == is_due


def test_none_and_a_damaged_one_are_due() -> None:
    assert authority.is_due(b"", NOW)
    assert authority.is_due(b"junk", NOW)


def request_for(key: bytes) -> bytes:
    """Return a request for a certificate of this key."""
    private: Any = serialization.load_pem_private_key(key, None)
    made = x509.CertificateSigningRequestBuilder().subject_name(x509.Name([])).sign(private, hashes.SHA256())
    return made.public_bytes(serialization.Encoding.PEM)


DUE = LIFETIME * 0.9


@pytest.mark.parametrize("names", [[], ["127.0.0.1", "north.local"]])
def test_the_next_certificate_has_the_same_key_and_names(ca: authority.KeyPair, names: list[str]) -> None:
    key, request = authority.new_request("x")
    old = authority.KeyPair(authority.sign_request(ca, request, "person.mia", NOW, names), key)
    made = authority.renew(ca, old.certificate, request_for(old.key), "person.mia", NOW + DUE)
    assert authority.belong(made, old.key)
    assert authority.names_of(made) == names
    assert authority.expires(made) == authority.expires(old.certificate) + DUE
    assert not authority.is_due(made, NOW + DUE)


@pytest.mark.parametrize("wrong", ["name", "key", "authority", "early", "late", "junk", "no request"])
def test_no_next_certificate_for(ca: authority.KeyPair, wrong: str) -> None:
    mine = authority.issue(ca, "person.mia", NOW)
    other = authority.issue(authority.make_authority(NOW), "person.mia", NOW)
    held = other if wrong == "authority" else mine
    after = {"early": LIFETIME / 2, "late": LIFETIME + timedelta(seconds=1)}.get(wrong, DUE)
    request = {"key": authority.new_request("person.mia")[1], "no request": b""}.get(wrong, request_for(held.key))
    certificate = b"junk" if wrong == "junk" else held.certificate
    with pytest.raises(BadRequestForCertificate):
        authority.renew(ca, certificate, request, "person.eve" if wrong == "name" else "person.mia", NOW + after)


def test_the_dates_are_read_as_the_library_reads_them(ca: authority.KeyPair) -> None:
    for made in (ca.certificate, authority.issue(ca, "hub", NOW, ["127.0.0.1"]).certificate):
        read = x509.load_pem_x509_certificate(made)
        assert CertificateDates.of(made) == CertificateDates(read.not_valid_before_utc, read.not_valid_after_utc)
    late = authority.issue(ca, "person.mia", datetime(2060, 1, 1, tzinfo=UTC)).certificate
    dates = CertificateDates.of(late)
    assert dates is not None
    assert dates.ends == authority.expires(late), "GeneralizedTime"
    for junk in (b"", b"junk", b"-----BEGIN CERTIFICATE-----\nAAAA\n-----END CERTIFICATE-----"):
        assert CertificateDates.of(junk) is None
