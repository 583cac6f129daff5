"""The names of platforms as users write them."""

import pytest

from gateway.protocol.platform_name import parse_option
from gateway.protocol.platforms import parse_platform


@pytest.mark.parametrize(("told", "name"), [("auto", "unknown"), ("auto+arm", "unknown+arm"), ("stm32", "stm32")])
def test_auto_is_the_unknown_platform_until_then(told: str, name: str) -> None:
    started, auto = parse_option(told)
    assert (started, parse_platform(started).name, auto) == (name, name, told.startswith("auto"))


def test_a_platform_that_is_none_says_which_there_are() -> None:
    with pytest.raises(ValueError, match=r'Unknown platform "uno"\. .* Leave it out to detect it\.'):
        parse_option("uno")
