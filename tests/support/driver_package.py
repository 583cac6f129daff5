"""Installs a package with a driver, as `pip install` would, for tests."""

import contextlib
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from gateway import drivers


def install_driver(directory: Path, module: str) -> None:
    """Put into this directory the metadata of a package whose entry point names this module.

    The caller puts the directory on Python's path.
    """
    found = directory / "tank_driver-1.0.dist-info"
    found.mkdir(parents=True)
    (found / "METADATA").write_text("Metadata-Version: 2.1\nName: tank-driver\nVersion: 1.0\n")
    (found / "entry_points.txt").write_text(f"[zenoh_car_fleet.drivers]\ntank = {module}\n")


@contextlib.contextmanager
def installed_driver(directory: Path, monkeypatch: pytest.MonkeyPatch, module: str) -> Iterator[None]:
    """Install a package with the driver of a tank for this process."""
    install_driver(directory, module)
    monkeypatch.setattr(sys, "path", [str(directory), *sys.path])
    _forget()
    try:
        yield
    finally:
        _forget()
        drivers.broken.clear()


def _forget() -> None:
    for cached in (drivers._installed, drivers._find, drivers.all_profiles):
        cached.cache_clear()
