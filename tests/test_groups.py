"""Tests that must not run at once do not."""

import pytest


@pytest.mark.xdist_group("together")
def test_groups_are_in_force(request: pytest.FixtureRequest) -> None:
    """pytest-xdist tells nobody when a newer pytest makes `--dist loadgroup` group nothing (pytest-xdist#1386)."""
    if getattr(request.config.option, "loadgroup", False):
        assert request.node.nodeid.endswith("@together"), "xdist_group has no effect with this pytest: see constraints"
