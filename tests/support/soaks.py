"""Marks cases of a test that run only in `make soak`."""

from collections.abc import Iterable
from typing import Any

import pytest


def only_in_soak(cases: Iterable[Any]) -> list[Any]:
    """Return the cases for `parametrize`."""
    return [pytest.param(each, marks=pytest.mark.soak) for each in cases]
