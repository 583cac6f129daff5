"""Codes with which a computer joins a hub."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from fleet.hub.join_code import CODE_ALPHABET, BadCode, JoinCode, pin_of

SHA256 = st.binary(min_size=32, max_size=32)


@given(SHA256, st.sampled_from(["{}", " {} ", "{}\n"]), st.booleans())
def test_code_is_read_as_a_person_types_it(fingerprint: bytes, around: str, lower: bool) -> None:
    code = JoinCode.new(fingerprint)
    typed = around.format(str(code).replace("-", " "))
    assert JoinCode.parse(typed.lower() if lower else typed) == code
    assert code.fits(fingerprint)
    assert code.is_secret(code.secret)


@given(SHA256, SHA256)
def test_join_code_fits_only_its_own_authority(one: bytes, other: bytes) -> None:
    assert JoinCode.new(one).fits(other) == (pin_of(one) == pin_of(other))


@given(st.text())
def test_any_other_text_is_no_code(text: str) -> None:
    letters = [each for each in text.upper() if each in CODE_ALPHABET]
    if len(letters) != 24:
        with pytest.raises(BadCode):
            JoinCode.parse(text)


def test_two_codes_have_two_secrets() -> None:
    assert JoinCode.new(bytes(32)).secret != JoinCode.new(bytes(32)).secret


def test_guess_of_another_length_or_alphabet_is_wrong() -> None:
    code = JoinCode.new(bytes(32))
    assert not any(map(code.is_secret, ("", code.secret[:-1], f"{code.secret}2", "ä" * 12, code.pin)))
