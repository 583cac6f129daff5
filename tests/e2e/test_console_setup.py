"""The set-up page in a real browser: it finds a simulated car, lets it blink, and writes its name to the fleet file."""

from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.e2e.test_console import serious, unreachable
from tests.support.console import ConsoleProcess, ConsoleStage
from tests.support.ports import free_endpoint
from tests.support.processes import FleetProcesses, wait_for

pytestmark = pytest.mark.soak  # needs Chromium (`make browser`)


@pytest.fixture(scope="module")
def file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("set-up") / "fleet.yaml"
    path.write_text("# the cars of our lab\ncars:\n  ann: {}  # without a link yet\n")
    return path


@pytest.fixture(scope="module")
def stage(file: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[ConsoleStage]:
    stage = ConsoleStage(FleetProcesses(free_endpoint(), tmp_path_factory.mktemp("console")))
    stage.console = ConsoleProcess(stage.fleet, "--fleet-file", str(file))
    yield stage
    stage.close()


def test_setup_finds_car_blinks_and_keeps_comments(stage: ConsoleStage, file: Path) -> None:
    sim, (link,) = stage.fleet.simulate("new:arduino:pty")
    page = stage.page("#/setup")
    page.get_by_text("no link yet").wait_for()
    # By keyboard alone.
    page.locator("input[name=links]").focus()
    page.keyboard.type(link)
    page.keyboard.press("Tab")
    page.keyboard.press("Enter")
    card = page.locator("[data-link]")
    card.wait_for()
    blinks: list[bytes] = []
    stage.fleet.bus.subscribe("fleet/temporary-setup-1/frame/tx", lambda sample: blinks.append(sample.payload))
    assert [each for each in unreachable(page) if "disabled" not in each] == []
    card.locator("[data-setup=blink]").focus()
    page.keyboard.press("Enter")
    card.get_by_text("It blinks and beeps now.").wait_for()
    wait_for(lambda: len(blinks) > 3, "its gateway has sent lights")
    truth = sim.say({"car": "new", "ask": "truth"})
    assert (truth["motor_left"], truth["motor_right"]) == (0, 0)
    card.locator("input[name=car]").focus()
    page.keyboard.type("ann")
    page.keyboard.press("Tab")
    assert page.evaluate("document.activeElement.dataset.setup") == "write"
    page.keyboard.press("Enter")
    page.get_by_text("fleet.yaml now has ann.").wait_for()
    text = file.read_text()
    assert text.startswith("# the cars of our lab\n")
    assert "# without a link yet" in text
    assert link in text
    assert serious(page) == []


@pytest.mark.parametrize("size", ["desktop", "phone"])
def test_stop_is_in_view_and_escape_stops(stage: ConsoleStage, size: str) -> None:
    page = stage.phone("#/setup") if size == "phone" else stage.page("#/setup")
    page.locator("[data-setup=scan]").wait_for()
    assert serious(page) == []
    box, window = page.locator("#stop").bounding_box(), page.viewport_size
    assert box is not None
    assert window is not None
    assert box["y"] + box["height"] <= window["height"]
    assert page.evaluate("document.documentElement.scrollWidth <= window.innerWidth")
    stage.person.car("red").drive("forward", 10.0, wait=False).check()
    wait_for(lambda: stage.judges["red"].driving, "red drives")
    page.locator("input[name=links]").focus()
    page.keyboard.press("Escape")
    stage.stands()
