"""The names of platforms as users write them."""

import pytest

from gateway.drivers.yahboom.protocol.platforms import parse_platform
from schemas.platform_name import OPTION_WORDS, parse_name, parse_option


@pytest.mark.parametrize(("told", "name"), [("auto", "unknown"), ("auto+arm", "unknown+arm"), ("stm32", "stm32")])
def test_auto_is_the_unknown_platform_until_then(told: str, name: str) -> None:
    started, auto = parse_option(told)
    assert (started, parse_platform(started).name, auto) == (name, name, told.startswith("auto"))


def test_platform_that_is_none_says_which_there_are() -> None:
    with pytest.raises(ValueError, match=r'Unknown platform "uno"\.'):
        parse_option("uno")


def test_platform_options_ignore_case_except_head() -> None:
    assert parse_name("STM32+Fan_Level+3S+HEAD=BaLa") == ("stm32", {"fan_level", "3s", "head=BaLa"})
    assert parse_option("Auto+Text+Head=4WD")[0] == "unknown+text+head=4WD"


@pytest.mark.parametrize("name", ["arduino+head=A", "arduino+head=", "arduino+head=ABCDEFGHI", "arduino+head=4,D"])
def test_head_is_2_to_8_letters_and_digits(name: str) -> None:
    with pytest.raises(ValueError, match="2 to 8 letters and digits"):
        parse_name(name)


def test_car_has_one_head() -> None:
    with pytest.raises(ValueError, match="one head"):
        parse_name("arduino+head=AB+head=CD")


def test_option_value_missing_or_surplus_is_unknown() -> None:
    for name in ("arduino+head", "arduino+text=1"):
        with pytest.raises(ValueError, match="Unknown option") as error:
            parse_name(name)
        assert OPTION_WORDS in str(error.value)
