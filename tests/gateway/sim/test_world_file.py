"""World files: the effect of each field, each fault with line and column, and no traceback for any text."""

import random
import subprocess
import sys
from functools import partial
from itertools import combinations
from math import hypot, radians
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fleet.examples import EXAMPLES
from gateway.sim.model.car_body import CarBody
from gateway.sim.model.firmware_base import Pose
from gateway.sim.model.objects import FAR_M, FASTEST_M_S, Lamp, MovingObject
from gateway.sim.model.world import World
from gateway.sim.world_file import WorldSpec, read_world
from schemas.geometry import RADIUS_M
from schemas.world_check import MIN_SIZE_M
from schemas.world_fields import WorldEntry
from schemas.yaml_document.document import MAX_YAML_BYTES, BadFile
from tests.support.yaml_text import read_yaml

WORLDS = EXAMPLES / "worlds"
EVERYTHING = """\
room: {width_m: 6, depth_m: 0x04}
boxes:
  - {x_m: 1, y_m: 1, width_m: 0.5, depth_m: 0.5}
walls: [[0, 0, 1, 0.5]]
line: [[0, 0], [1, 0], [1, 1]]
cars_meet: false
cars:
  red: {x_m: -1, y_m: -1, heading_deg: 90}
  "011": {x_m: -2, y_m: -1}
things:
  cart: {radius_m: 0.1, path: [[0, 0], [1, 0], [2, 0]], there_and_back: true, speed_m_s: 0.1, waits_for_m: 1}
  crate: {x_m: 1, y_m: 2, width_m: 0.4, depth_m: 0.2, heading_deg: -90}
  mast: {carried_by: red, x_m: -0.1, radius_m: 0.02}
lamps:
  sun: {x_m: 0, y_m: 0, reach_m: 10, brightness: 4, on: false, overhead: true}
  back: {carried_by: red, x_m: -0.1}
  top: {carried_by: cart}
"""


def test_every_field() -> None:
    spec = read_world(EVERYTHING, "w.yaml", ["red"])
    assert len(spec.walls) == 9
    assert spec.walls[8] == (0, 0, 1, 0.5)
    assert spec.line == ((0, 0), (1, 0), (1, 1))
    assert not spec.cars_meet
    assert spec.starts == {"red": Pose(-1, -1, radians(90)), "011": Pose(-2, -1, 0)}
    assert spec.things == (
        MovingObject(
            "cart",
            radius_m=0.1,
            path=((0, 0), (1, 0), (2, 0), (1, 0)),
            speed_m_s=0.1,
            waits_for_m=1,
        ),
        MovingObject("crate", 1, 2, width_m=0.4, depth_m=0.2, heading_rad=radians(-90)),
        MovingObject("mast", -0.1, 0, radius_m=0.02, carried_by="red"),
    )
    assert spec.lamps == (
        Lamp(0, 0, 10, 4, on=False, overhead=True, name="sun"),
        Lamp(-0.1, 0, name="back", carried_by="red"),
        Lamp(0, 0, name="top", carried_by="cart"),
    )
    assert spec.world().start_pose(5, "red") == Pose(-1, -1, radians(90))
    assert spec.world().lively


def test_room_of_the_file_is_the_room() -> None:
    spec, room = read_world((WORLDS / "room.yaml").read_text(), "room"), World.room()
    world = spec.world()
    assert (world.walls, world.line, world.lively) == (room.walls, room.line, False)
    assert [world.start_pose(index, "red") for index in range(9)] == [room.start_pose(index) for index in range(9)]


def test_follow_world_begins_with_room_for_all() -> None:
    spec = read_world((WORLDS / "follow.yaml").read_text(), "follow", ["red", "green", "blue"])
    assert list(spec.starts) == ["red", "green", "blue"]
    assert spec.cars_meet


def test_unplaced_cars_start_where_there_is_room() -> None:
    text = (WORLDS / "follow.yaml").read_text()
    text += "\nboxes: [{x_m: 0, y_m: 0, width_m: 1, depth_m: 1}]\n"
    world = read_world(text, "follow").world()
    bodies: list[CarBody] = []
    for number, name in enumerate(["red", *(f"car{number}" for number in range(20)), "green", "blue"]):
        bodies.append(CarBody(world, world.start_pose(number, name), random.Random(1), name=name))
    places = [body.place for body in bodies]
    assert min(hypot(a.x_m - b.x_m, a.y_m - b.y_m) for a, b in combinations(places, 2)) >= 2 * RADIUS_M
    assert all(abs(place.x_m) < 3 and abs(place.y_m) < 2.2 for place in places)
    assert all(max(abs(place.x_m), abs(place.y_m)) > 0.5 + RADIUS_M - 1e-9 for place in places)
    cart = world.where(world.things[0], 0.0)
    assert cart is not None
    assert all(hypot(place.x_m - cart.x_m, place.y_m - cart.y_m) > RADIUS_M for place in places)


LIMITS = [
    ("lamps: {a: {x_m: VALUE, y_m: 0}}", FAR_M),
    ("lamps: {a: {x_m: 0, y_m: VALUE}}", -FAR_M),
    ("lamps: {a: {x_m: 0, y_m: 0, reach_m: VALUE}}", FAR_M),
    ("lamps: {a: {x_m: 0, y_m: 0, brightness: VALUE}}", 100),
    ("lamps: {a: {x_m: 0, y_m: 0, brightness: VALUE}}", 0),
    ("things: {a: {x_m: 0, y_m: 0, radius_m: VALUE}}", MIN_SIZE_M),
    ("things: {a: {path: [[0, 0], [VALUE, 0]], radius_m: 1}}", FAR_M),
    ("things: {a: {path: [[0, 0], [1, 0]], radius_m: 1, speed_m_s: VALUE}}", FASTEST_M_S),
    ("things: {a: {path: [[0, 0], [1, 0]], radius_m: 1, waits_for_m: VALUE}}", FAR_M),
    ("cars: {a: {x_m: 0, y_m: 0, heading_deg: VALUE}}", 360),
    ("room: {width_m: VALUE, depth_m: 1}", MIN_SIZE_M),
    ("walls: [[0, 0, 1, VALUE]]", -FAR_M),
]


def test_schema_for_editors_accepts_what_the_reader_accepts() -> None:
    for text in (EVERYTHING, *(path.read_text() for path in WORLDS.glob("*.yaml"))):
        read_yaml(text, "w.yaml", WorldEntry)
    for text, limit in LIMITS:
        step = -1e-6 if limit in (0, MIN_SIZE_M, -FAR_M) else 1e-6
        for read in (read_world, partial(read_yaml, model=WorldEntry)):
            read(text.replace("VALUE", f"{limit:f}"), "w.yaml")
            with pytest.raises(ValueError, match=r"^w\.yaml:1:"):
                read(text.replace("VALUE", f"{limit + step:f}"), "w.yaml")
    walls = "walls: [" + "[0, 0, 1, 1], " * 200 + "{more}]"
    read_yaml(walls.format(more=""), "w.yaml", WorldEntry)
    with pytest.raises(BadFile):
        read_yaml(walls.format(more="[0, 0, 1, 1]"), "w.yaml", WorldEntry)


FAULTS = [
    (
        "room: {width_m: 6, depth_m: 0}",
        ["1:29: error: room.depth_m: 0 is not allowed. Write a number, at least 0.02 and at most 100."],
    ),
    ("room: {width_m: 6}", ["1:1: error: room.depth_m: is missing. Its size along y, meters."]),
    ("room: 5", ["1:7: error: room: needs fields. Write: `room: {width_m: …, depth_m: …}`"]),
    ("rooms: {}", ["1:1: error: rooms: there is no such field. Did you mean room?"]),
    ("cars_meet: yes", ["1:12: error: cars_meet: 'yes' is not allowed. Write true or false."]),
    ("cars_meet: true\ncars_meet: false", ["2:1: error: cars_meet: is given twice, first in line 1"]),
    (
        "walls: [[1, 2, 3], [0, 0, 0, 0], [1, 2, 3, .inf], 7]",
        [
            "1:9: error: wall 1, number 4: is missing",
            "1:20: error: wall 2: is shorter than 0.02 m",
            "1:44: error: wall 3, number 4: '.inf' is not a finite number",
            "1:51: error: wall 4: 7 is not allowed. Write a list.",
        ],
    ),
    ("walls: {}", ["1:8: error: walls: a mapping is not allowed. Write a list."]),
    ("line: [[0, 0], [1, 0]]", ["1:7: error: line: has 2 items. Write at least 3."]),
    (
        "line: {width_m: 2, depth_m: 1, radius_m: 0.6}",
        ["1:42: error: line.radius_m: 0.6 is not allowed: up to half of the shorter side, 0.5"],
    ),
    ("lamps: {a: {x_m: 1}}", ["1:9: error: lamps.a.y_m: is missing: write where it stands, or carried_by"]),
    ("lamps: {A: {x_m: 1, y_m: 1}}", ["1:9: error: lamps.A: name 'A' is not allowed"]),
    ("lamps: {1: {x_m: 1, y_m: 1}}", ["1:9: error: lamps: key '1' is not a word. Write it in quotes"]),
    (
        "lamps: {a: {x_m: 1, y_m: 1, on: 1, reach_m: 0, brightness: true}}",
        [
            "1:33: error: lamps.a.on: 1 is not allowed. Write true or false.",
            "1:45: error: lamps.a.reach_m: 0 is not allowed. Write a number, more than 0 and at most 100.",
            "1:60: error: lamps.a.brightness: true is not allowed",
        ],
    ),
    (
        "lamps: {a: {carried_by: pink}}",
        ["1:25: error: lamps.a.carried_by: no car or thing 'pink' is simulated here: use red, green"],
    ),
    ("things: {a: {x_m: 1, y_m: 1}}", ["1:13: error: things.a: must be a disc or a box"]),
    ("things: {a: {x_m: 1, y_m: 1, radius_m: 1, width_m: 1}}", ["1:13: error: things.a: must be a disc or a box"]),
    ("things: {a: {x_m: 1, y_m: 1, width_m: 1}}", ["things.a.depth_m: is missing: a box needs both"]),
    (
        "things: {a: {radius_m: 1}}",
        ["things.a.x_m: is missing: write where it stands, or a path", "things.a.y_m: is missing"],
    ),
    (
        "things: {a: {radius_m: 1, path: [[0, 0], [0, 0]]}}",
        ["1:33: error: things.a.path: needs at least 2 different points [x, y]"],
    ),
    (
        "things: {a: {radius_m: 1, x_m: 0, y_m: 0, speed_m_s: 0.1}}",
        ["1:54: error: things.a.speed_m_s: is not allowed without a path"],
    ),
    (
        "things: {a: {radius_m: 1, path: [[0, 0], [1, 0]], speed_m_s: 0.6, x_m: 1, carried_by: red}}",
        [
            "things.a.speed_m_s: 0.6 is not allowed. Write a number, at least 0 and at most 0.5.",
            "things.a.x_m: is not allowed beside a path",
            "things.a.carried_by: is not allowed beside",
        ],
    ),
    (
        "room: {width_m: 2, depth_m: 2}\ncars: {red: {x_m: 1.5, y_m: 0}}",
        ["2:13: error: cars.red: begins outside"],
    ),
    (
        "boxes: [{x_m: 1, y_m: 0, width_m: 1, depth_m: 1}]\ncars: {red: {x_m: 1, y_m: 0}}",
        ["2:13: error: cars.red: begins in a wall"],
    ),
    ("cars: {red: {x_m: 0}}", ["1:8: error: cars.red.y_m: is missing. Meters up from (0, 0)."]),
    (
        "cars: {red: {x_m: 0, y_m: 0}, green: {x_m: 0.2, y_m: 0}}",
        ["1:38: error: cars.green: begins 0.2 m from red: keep at least 0.26 m"],
    ),
    ("walls: [[0, 0, 1, 0]]\ncars: {red: {x_m: 0, y_m: 0.1}}", ["2:13: error: cars.red: begins in a wall"]),
    (
        "things: {b: {x_m: 0, y_m: 0, width_m: 1, depth_m: 1}}\ncars: {red: {x_m: 0.1, y_m: 0.1}}",
        ["2:13: error: cars.red: begins in b"],
    ),
    ("cars: !!set {}", ["1:7: error: cars: the tag '!!set' is not allowed: leave it out"]),
    ("[" * 5000, ["1:26: error: this is not YAML: nested more than 24 deep"]),
    ("room:\n\t- 1", ["2:1: error: this is not YAML: a tab"]),
    ("a: 1\n---\nb: 2", ["2:1: error: this is not YAML: a second document"]),
    ("", ["1:1: error: the file is empty"]),
    ("# nothing", ["1:1: error: the file is empty"]),
    ("\x00", ["1:1: error: character U+0000 is not allowed in YAML"]),
    ("%YAML " + "9" * 5000 + ".1\n---\na: 1", ["this is not YAML"]),
    ("room: {width_m: " + "9" * 5000 + ", depth_m: 1}", ["1:17: error: room.width_m: '9999"]),
    ("#" * (MAX_YAML_BYTES + 1), ["1:1: error: the file has more than 256 KiB"]),
    ("walls: [" + "[0, 0, 1, 1], " * 250 + "]", ["1:8: error: walls: has 250 items. Write at most 200."]),
    ("- 1", ["1:1: error: a list is not allowed. Write fields"]),
]


@pytest.mark.parametrize(("text", "faults"), FAULTS, ids=[text[:40] for text, _ in FAULTS])
def test_faults(text: str, faults: list[str]) -> None:
    with pytest.raises(BadFile) as error:
        read_world(text, "w.yaml", ["red", "green"])
    lines = str(error.value).splitlines()
    assert len(lines) == len(faults), lines
    for line, words in zip(lines, faults, strict=True):
        assert line.startswith("w.yaml:")
        assert words in line


def test_fault_causes_no_second_one() -> None:
    text = EVERYTHING.replace("x_m: -0.1, radius_m", "x_m: far, radius_m").replace("-1, heading", "north, heading")
    text = text.replace("depth_m: 0x04", "depth_m: 0").replace("carried_by: cart", "carried_by: CART")
    with pytest.raises(BadFile) as error:
        read_world(text, "w.yaml", ["red"])
    fields = [each.field for each in error.value.problems]
    assert fields == ["room.depth_m", "cars.red.y_m", "things.mast.x_m", "lamps.top.carried_by"]


def test_all_faults_are_told_at_once_in_their_order() -> None:
    text = EVERYTHING.replace("width_m: 6", "width_m: six").replace("on: false", "on: maybe")
    with pytest.raises(BadFile) as error:
        read_world(text, "w.yaml", ["red"])
    assert [line.split(": ")[0:3:2] for line in str(error.value).splitlines()] == [
        ["w.yaml:1:17", "room.width_m"],
        ["w.yaml:15:57", "lamps.sun.on"],
    ]


SCRAPS = st.sampled_from(
    [
        *EVERYTHING.split(),
        "{",
        "}",
        "[",
        "]",
        ":",
        "- ",
        "\n",
        "\n  ",
        "&a",
        "*a",
        "!!int",
        "!x",
        "|",
        ">",
        "'",
        '"',
        "---",
        "...",
        "?",
        ",",
        "%YAML",
        "0x",
        "1e999",
        ".nan",
        "~",
        "<<",
        "\t",
        "\ufeff",
        "\ud800",
        "9" * 400,
    ]
)


def read(text: str) -> WorldSpec | None:
    try:
        return read_world(text, "w.yaml", ["red"])
    except BadFile as error:
        assert all(line.startswith("w.yaml:") for line in str(error).splitlines())  # noqa: PT017 - either is fine
        return None


@settings(max_examples=300, deadline=None)
@given(st.lists(SCRAPS, max_size=40).map(" ".join) | st.text(max_size=80))
def test_no_text_is_a_traceback(text: str) -> None:
    read(text)


@settings(max_examples=300, deadline=None)
@given(st.randoms(use_true_random=False), st.integers(1, 4))
def test_mutated_world_file_is_world_or_faults(chance: random.Random, count: int) -> None:
    text = EVERYTHING
    for _ in range(count):
        at = chance.randrange(len(text))
        end = min(len(text), at + chance.choice((0, 1, 1, 3, 20)))
        text = (
            text[:at]
            + chance.choice(("", "9", "-", "x", "{", "]", "\n", " ", ": ", "true", "1e9", "null"))
            + text[end:]
        )
    spec = read(text)
    if spec is not None:
        spec.world()


@pytest.mark.parametrize(
    ("name", "data", "words"),
    [
        ("nothing.yaml", None, "nothing.yaml: error: there is no such file (worlds without a file: room, open"),
        ("bytes.yaml", b"room: \xff", "bytes.yaml:1:7: error: byte 0xff is not UTF-8"),
        pytest.param("large.yaml", b"\xff" * 2 * MAX_YAML_BYTES, "has more than 256 KiB", id="large.yaml"),
        (
            "faulty.yaml",
            b"foo: 1\nbar: 2\n",
            "faulty.yaml:2:1: error: bar: there is no such field. There are boxes, cars, ",
        ),
        ("carried.yaml", b"lamps: {a: {carried_by: blue}}", "no car or thing 'blue' is simulated here: use red"),
    ],
)
def test_gateway_sim_refuses_a_faulty_world(tmp_path: Path, name: str, data: bytes | None, words: str) -> None:
    path = tmp_path / name
    if data is not None:
        path.write_bytes(data)
    command = [sys.executable, "-m", "gateway.sim", "--no-truth", "--car", "red:arduino:pty", "--world", str(path)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=60, check=False)
    assert (done.returncode, done.stdout) == (2, "")
    assert words in done.stderr
    assert "Traceback" not in done.stderr
