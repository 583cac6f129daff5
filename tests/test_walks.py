"""Bounds how many rooms one opens to follow a command or a reading, and on how many floors rooms stand.

A bound is today's count. Who makes one of these walks longer raises it here, and says in the commit what for.
"""

from pathlib import Path
from typing import Final

import grimp
import pytest

from tests.tools.walks import FORMS, rooms, stop_walk

CARRYING_ROOMS: Final = 23
"""Rooms that carry `fleet stop red`, of which `python -m tests.tools.walks` has the names."""
ROOMS_OF_STOP: Final = 65
"""All rooms that run only because of it, also who is asked for a time or a word. Two came with issue 33, and
`fleet.commands.exit_code` was a part of `options`."""
ROOMS_OF_REPORT: Final = 37
"""Rooms from the bytes of a report until it is published and learned from."""
CARRYING_ROOMS_OF_REPORT: Final = 18
MAX_FORMS: Final = 12
MAX_FLOORS: Final = 12
TABLES_OF_A_SESSION: Final = ("analysis", "mode_spans")
"""A session is what readers open, and it also makes tables: see `no two rooms import each other` in pyproject.toml."""


@pytest.fixture(scope="module")
def imports() -> grimp.ImportGraph:
    graph = grimp.build_graph("fleet", "gateway", "schemas", cache_dir=None)
    for name in TABLES_OF_A_SESSION:
        graph.remove_import(importer="fleet.recording.reading.session", imported=f"fleet.recording.tools.{name}")
    return graph


@pytest.fixture
def state(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Let the command keep its state here."""
    monkeypatch.setenv("FLEET_STATE_DIR", str(tmp_path))


def floors(graph: grimp.ImportGraph, folder: str) -> int:
    """Return the number of floors of a folder: a room stands above all that it imports. Fail at a circle."""
    owner = {module: room for room in graph.find_children(folder) for module in (room, *graph.find_descendants(room))}
    below: dict[str, set[str]] = {room: set() for room in owner.values()}
    for module, room in owner.items():
        imported = graph.find_modules_directly_imported_by(module)
        below[room] |= {owner[each] for each in imported if each in owner} - {room}
    count = 0
    while below:
        ground = {room for room, others in below.items() if not others & below.keys()}
        assert ground, f"a circle among {sorted(below)}"
        below = {room: others for room, others in below.items() if room not in ground}
        count += 1
    return count


def test_no_folder_has_more_than_twelve_floors_or_a_circle(imports: grimp.ImportGraph) -> None:
    found = {folder: floors(imports, folder) for folder in imports.modules if imports.find_children(folder)}
    assert {folder: count for folder, count in found.items() if count > MAX_FLOORS} == {}
    assert found["gateway.drivers.yahboom"] > 1


@pytest.mark.soak  # a traced gateway beside other tests is late, and its car shows nothing in time
async def test_stop_passes_no_more_rooms_and_forms_than_before(tmp_path: Path, state: None) -> None:
    _, stop = await stop_walk(tmp_path)
    carrying = rooms(stop.carried)
    assert {"fleet/client/client.py", "gateway/bus/command_handler.py", "gateway/writer.py"} <= set(carrying)
    assert len(carrying) <= CARRYING_ROOMS, carrying
    assert len(FORMS) <= MAX_FORMS


@pytest.mark.soak
async def test_walks_do_not_grow(tmp_path: Path, state: None) -> None:
    idle, stop = await stop_walk(tmp_path, whole=True)
    asked, of_report = rooms(stop.called - idle.called), rooms(idle.of_reading)
    assert "gateway/drivers/yahboom/pacing.py" in asked
    assert len(asked) <= ROOMS_OF_STOP, asked
    assert "gateway/bus/car_publisher.py" in of_report
    assert len(of_report) <= ROOMS_OF_REPORT, of_report
    carrying = rooms(idle.carried_report)
    assert {"gateway/link/tcp.py", "schemas/bus/publisher.py"} <= set(carrying)
    assert len(carrying) <= CARRYING_ROOMS_OF_REPORT, carrying
