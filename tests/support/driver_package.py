"""Installs a package with a driver, as `pip install` would, for tests."""

from pathlib import Path


def install_driver(directory: Path, module: str) -> None:
    """Make a directory, which goes on Python's path, that of a package whose entry point names this module."""
    found = directory / "tank_driver-1.0.dist-info"
    found.mkdir(parents=True)
    (found / "METADATA").write_text("Metadata-Version: 2.1\nName: tank-driver\nVersion: 1.0\n")
    (found / "entry_points.txt").write_text(f"[zenoh_car_fleet.drivers]\ntank = {module}\n")
