"""Tests that pytest-xdist runs each group of tests on one worker."""

import pytest


@pytest.mark.xdist_group("together")
def test_groups_are_in_force(request: pytest.FixtureRequest) -> None:
    """`--dist loadgroup` groups tests. With a newer pytest, it groups none, without a warning (pytest-xdist#1386)."""
    if getattr(request.config.option, "loadgroup", False):
        assert request.node.nodeid.endswith("@together"), "xdist_group has no effect with this pytest: see constraints"


@pytest.fixture(scope="module")
def costly() -> str:
    return "a fleet of processes, or a recorded session"


@pytest.mark.usefixtures("costly")
def test_tests_sharing_module_fixture_are_grouped(request: pytest.FixtureRequest) -> None:
    (mark,) = request.node.iter_markers("xdist_group")
    assert mark.args == ("tests/test_groups.py",)
    if getattr(request.config.option, "loadgroup", False):
        assert request.node.nodeid.endswith("@tests/test_groups.py")
