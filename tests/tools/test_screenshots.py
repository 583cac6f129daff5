"""Pictures of a replay: not blank, with the expected views, and with the expected colors in their places."""

import contextlib
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from fleet.replay import panels, state_colors
from schemas.colors import car_color
from tests.fleet.replay.make_session import make
from tests.tools.screenshots import NoPicture, Shown, pictures, software_driver

NEAR = 24
"""Maximum distance of a pixel's channels from a color. Lines are smoothed, and the picture has a palette."""


def share(image: np.ndarray, colour: tuple[int, int, int]) -> float:
    """Return the share of an image's pixels that have about this color."""
    return float((np.abs(image.astype(int) - colour).max(axis=2) < NEAR).mean())


def lane(value: int) -> tuple[int, int, int]:
    """Return a state's color as the viewer paints it: darker, for a readable text."""
    return tuple(int(0.785 * (value >> shift & 255)) for shift in (24, 16, 8))  # type: ignore[return-value]  # three


def read(path: Path) -> np.ndarray:
    with Image.open(path) as image:
        return np.asarray(image.convert("RGB"))


@pytest.mark.timeout(300)
def test_pictures_show_the_fleet_a_car_and_the_world(tmp_path: Path) -> None:
    session = tmp_path / "0001.mcap"
    make(session)
    if software_driver() is None:
        # Without a software driver, the viewer may fail, or draw with an unknown card. Both are right.
        with contextlib.suppress(NoPicture):
            pictures(session, tmp_path)
        return
    made = pictures(session, tmp_path)
    assert set(made) == {"fleet.png", "car.png", "world.png"}
    for name, shown in made.items():
        assert shown.faults == (), name
        assert (tmp_path / name).stat().st_size < 300_000
    _is_the_fleet(read(tmp_path / "fleet.png"), made["fleet.png"])
    _is_a_car(read(tmp_path / "car.png"), made["car.png"])
    _is_the_world(read(tmp_path / "world.png"))


def _is_the_fleet(image: np.ndarray, shown: Shown) -> None:
    expected = [name for name, _ in panels.FLEET_TRACKS] + [name for name, _ in panels.FLEET_CURVES]
    expected += [name for name, _, _ in panels.FLEET_TEXTS] + ["Plan"]
    expected += [panel.name for panel in panels.SERVICE_PANELS]
    assert set(expected) <= set(shown.views)
    # A tab per car, each with every panel.
    for panel in panels.CAR_PANELS:
        assert shown.views.count(panel.name) >= 3, panel.name
    middle = image.shape[1] // 2
    for state in ("tracking", "obstacle_avoidance", "manual", "online"):
        assert share(image[:, middle:], lane(state_colors.STATE_COLORS[state])) > 0.002, state
    for car in ("red", "green", "blue"):
        for half in (image[:, :middle], image[:, middle:]):
            assert share(half, car_color(car, 0)) > 0.0001, car


def _is_a_car(image: np.ndarray, shown: Shown) -> None:
    assert {panel.name for panel in panels.CAR_PANELS} <= set(shown.views)
    middle = image.shape[1] // 2
    left, right = image[:, :middle], image[:, middle:]
    for state in ("tracking", "confirmed", "true"):
        assert share(left, lane(state_colors.STATE_COLORS[state])) > 0.002, state
    assert share(left, lane(0xFF0010FF)) > 0.002, "the LED's lanes are in its colour"
    # Measured: 0.00065. Smoothing of lines may lower the share.
    assert share(right, car_color("blue", 0)) > 0.0002, "distance and battery"
    assert share(right, (217, 83, 79)) > 0.00005, "the critical threshold"


def _is_the_world(image: np.ndarray) -> None:
    for what, colour, least in (
        ("walls", (150, 155, 165), 2e-4),
        ("line", (220, 220, 220), 2e-4),
        ("LEDs, which are shaded", (255, 0, 16), 3e-5),
    ):
        assert share(image, colour) > least, what
    for car in ("red", "green", "blue"):
        assert share(image, car_color(car, 0)) > 0.0005, car


def test_without_a_driver_it_is_said(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    session = tmp_path / "0001.mcap"
    make(session, seconds=3)
    monkeypatch.setenv("VK_ICD_FILENAMES", str(tmp_path / "none"))
    with pytest.raises(NoPicture, match="mesa-vulkan-drivers"):
        pictures(session, tmp_path)
    assert list(tmp_path.iterdir()) == [session]
