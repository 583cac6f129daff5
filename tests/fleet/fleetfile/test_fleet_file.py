"""Fleet files: layers are resolved, faults between cars are reported, and links mean the same as for gateways."""

import contextlib
import json
import time
from itertools import combinations
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from fleet.fleet_links import FleetLink, SimLink, may_be_same, parse_fleet_link, shared_ports
from fleet.fleetfile.fleet_file import FleetCar, FleetFile, Limits, parse_fleet, profile_capabilities, read_fleet
from fleet.fleetfile.fleet_model import FileEntry
from fleet.quota import Quota
from gateway.control import battery
from gateway.link import BadUrl, parse_url
from schemas.colors import car_color, hex_color
from schemas.links import BadLink, parse_link
from schemas.words import BatteryAction, Mode
from schemas.yaml_document.document import BadFile, schema_of
from tests.support.text_parts import has_parts

LAYERS = """\
name: lab
endpoint: tcp/127.0.0.1:7000
plan: plan.yaml
record: {to: ../kept, quota: 20GB}
groups: {a: [red, blue]}
defaults: {platform: arduino, roles: [patrol, guard], limits: {longest_drive_s: 5, battery_low_v: 7.2}}
types:
  slow: {limits: {speed_max: 0.5, longest_drive_s: 3}, color: "#00FF00", roles: [guard]}
cars:
  red: {link: /dev/ttyUSB7}
  green: {type: slow, link: tcp://Pi:8888, limits: {on_battery_low: stop}}
  blue: {type: slow, platform: raspberry_pi+arm, link: ble://aa:bb:cc:dd:ee:ff, without: [servo], roles: []}
"""


def _fleet(text: str, *, unbound: bool = False) -> FleetFile:
    return parse_fleet(text, Path("/nowhere/f.yaml"), unbound=unbound)


def _faults(text: str) -> list[str]:
    with pytest.raises(BadFile) as caught:
        _fleet(text)
    return str(caught.value).splitlines()


def test_car_overrides_its_type_and_a_type_the_defaults(tmp_path: Path) -> None:
    (tmp_path / "plan.yaml").touch()
    path = tmp_path / "fleet.yaml"
    path.write_text(LAYERS)
    fleet = read_fleet(path)
    assert (fleet.name, fleet.endpoint, fleet.record, fleet.text) == ("lab", "tcp/127.0.0.1:7000", True, LAYERS)
    assert (fleet.quota, dict(fleet.groups)) == (Quota(20 * 10**9), {"a": ("red", "blue")})
    assert (fleet.plan, fleet.recordings) == (tmp_path / "plan.yaml", tmp_path.parent / "kept")
    assert list(fleet.cars) == ["red", "green", "blue"]
    red, green, blue = fleet.cars.values()
    assert red.limits == Limits(longest_drive_s=5, battery_low_v=7.2)
    assert (red.roles, red.color) == (("patrol", "guard"), hex_color(car_color("red", 0)))
    assert red.capabilities == profile_capabilities("arduino")
    slow = Limits(longest_drive_s=3, battery_low_v=7.2, speed_max=0.5, on_battery_low=BatteryAction.STOP)
    assert green == FleetCar(
        "green", "tcp://Pi:8888", "arduino", "#00ff00", profile_capabilities("arduino"), slow, ("guard",)
    )
    assert (blue.platform, blue.roles) == ("raspberry_pi+arm", ())
    servos = {word for word in profile_capabilities("raspberry_pi+arm") if word.startswith("servo")}
    assert blue.capabilities == profile_capabilities("raspberry_pi+arm") - servos


ONE = "cars: {red: {link: COM1}}\n"


def test_pins_have_the_conditions_of_plans() -> None:
    fleet = _fleet(f"{ONE}pin:\n- {{when: battery_v < 6.6, before: 2m}}\n- {{when: 'rate(range_m) < -1', after: 1h}}\n")
    assert [(str(pin.condition), pin.before_s, pin.after_s) for pin in fleet.pins] == [
        ("battery_v < 6.6", 120, 30),
        ("rate(range_m) < -1", 30, 3600),
    ]
    assert _fleet(ONE).pins == ()


@pytest.mark.parametrize(
    ("pin", "place", "fault"),
    [
        ("{when: rang_m < 0.1}", "2:14", "pin 1, when: rang_m … mean range_m?"),
        ("{when: range_m < 0}", "2:14", "never true"),
        ("{when: 'true'}", "2:14", "names no reading"),
        ("{when: range_m}", "2:14", "compare it"),
        ("range_m < 0.1", "2:7", "pin 1: needs fields. Write: `- {when: …}`"),
        ("{before: 3s}", "2:7", "pin 1, when: is missing"),
        ("{when: range_m < 1, before: 2h}", "2:35", "at most 1h"),
        ("{when: range_m < 1, after: 0s}", "2:34", "at least 1s"),
        ("{when: range_m < 1, after: 1 min}", "2:34", "write 1m"),
        ("{when: range_m < 1, during: 3s}", "2:27", " after, before, when."),
    ],
)
def test_pin_faults_in_fleet_file(pin: str, place: str, fault: str) -> None:
    (words,) = _faults(f"{ONE}pin: [{pin}]\n")
    assert f"f.yaml:{place}: error" in words
    assert has_parts(words, fault)


TWO = "cars: {red: {link: COM1}, blue: {link: COM2}}\ngroups: {a: [red]}\n"


def test_people_have_a_rank_and_cars() -> None:
    text = 'people: {lee: {drives: ["@a", blue]}, ana: {drives: []}, kim: {}, teacher: {rank: lead}}\n'
    people = _fleet(TWO + text).people
    assert people is not None
    assert {name: (str(person.rank), person.drives) for name, person in people.items()} == {
        "lee": ("person", ("red", "blue")),
        "ana": ("person", ()),
        "kim": ("person", None),
        "teacher": ("lead", None),
    }
    assert [people[name].may_drive("blue") for name in people] == [True, False, True, True]
    assert _fleet(TWO).people is None, "everyone may drive"


@pytest.mark.parametrize(
    ("people", "fault"),
    [
        ('{lee: {drives: ["@b"]}}', "3:25: error: people.lee, drive 1: … '@b'. … mean @a?"),
        ("{lee: {drives: [rad]}}", "3:25: error: people.lee, drive 1: … 'rad'. … mean red?"),
        ("{lee: {drives: [a]}}", "3:25: error: people.lee, drive 1: … 'a'. … mean \"@a\"?"),
        ("{lee: {drives: [@a]}}", "3:25: error: … YAML: … with @. … in quotes"),
        ("{lee: {rank: led}}", "3:22: error: people.lee.rank: 'led' … mean lead?"),
        ("{lee: {rank: lead, drives: [red]}}", "error: people.lee.drives: a lead "),
        ("{lee: {drive: [red]}}", "3:16: error: people.lee.drive: … mean drives?"),
    ],
)
def test_people_faults_in_fleet_file(people: str, fault: str) -> None:
    (found,) = _faults(f"{TWO}people: {people}\n")
    assert has_parts(found, fault)


def test_fleet_file_defaults() -> None:
    fleet = _fleet("cars: {red: {link: sim, platform: stm32}, b2: {link: COM3}}")
    assert (fleet.name, fleet.endpoint, fleet.plan, fleet.recordings, fleet.record) == ("fleet", None, None, None, True)
    assert (fleet.cars["b2"].platform, fleet.cars["b2"].roles, fleet.cars["b2"].limits) == ("auto", None, Limits())
    assert {"tracking", "servo_vertical", "drive"} <= fleet.cars["b2"].capabilities
    assert "arm" not in fleet.cars["b2"].capabilities


def test_battery_defaults_match_gateway_defaults() -> None:
    policy = battery.BatteryPolicy()
    assert (Limits().on_battery_low, Limits().on_battery_critical) == (policy.on_low, policy.on_critical)


def test_all_faults_of_a_fleet_are_told_at_once() -> None:
    lines = _faults("""\
name: Lab
plan: nope.yaml
defaults: {platform: arduino, limits: {battery_low_v: 6.5}}
types:
  small: {without: [drive, servo_vertical], color: rad}
cars:
  red: {type: smal, link: /dev/ttyUSB0}
  green: {type: small, link: "serial:///dev/ttyUSB0?baud=9600", limits: {on_battery_low: stp}}
  blue: {link: 11:22:33:44:55:10, roles: [Patrol], platfrom: stm32}
  white: {}
  black: {link: sim, platform: auto}
""")
    found = [line.removeprefix("/nowhere/f.yaml:") for line in lines]
    assert [line.split(": ")[0:3:2] for line in found] == [
        ["1:7", "name"],
        ["2:7", "plan"],
        ["3:39", "defaults.limits"],
        ["5:20", "types.small.without"],
        ["5:52", "types.small.color"],
        ["7:15", "cars.red.type"],
        ["8:30", "cars.green.link"],
        ["8:90", "cars.green.limits.on_battery_low"],
        ["9:16", "cars.blue.link"],
        ["9:43", "cars.blue, role 1"],
        ["9:52", "cars.blue.platfrom"],
        ["10:3", "cars.white.link"],
        ["11:32", "cars.black.platform"],
    ]
    assert " mean small?" in found[5]
    assert "red and green " in found[6]
    assert "same port" in found[6]
    assert " mean platform?" in found[10]
    assert "fleet bind" in found[11]


@pytest.mark.parametrize(("value", "example"), [("tcp://h:9", "{link: tcp://h:9}"), ("3", "{link: …}")])
def test_car_without_fields_shows_how_to_write_link(value: str, example: str) -> None:
    (fault,) = _faults(f"cars:\n  red: {value}\n")
    assert fault.startswith("/nowhere/f.yaml:2:8: error: cars.red: ")
    assert f"`red: {example}`" in fault


def test_wrong_endpoint_is_a_fault_of_the_file() -> None:
    (line,) = _faults("endpoint: localhost:7447\ncars: {red: {link: tcp://h:9}}\n")
    assert ":1:11: error: endpoint: 'localhost:7447' " in line
    assert "tcp/HOST:PORT" in line


def test_no_car_is_called_all() -> None:
    (found,) = _faults("cars:\n  all: {link: COM1}\n")
    assert found.startswith("/nowhere/f.yaml:2:3: error: cars.all: ")


@pytest.mark.parametrize(
    ("one", "other", "same"),
    [
        ("/dev/ttyUSB0", "serial:///dev/ttyUSB0", True),
        ("/dev/ttyUSB0", "/dev/../dev/ttyUSB0", True),
        ("COM3", "serial://com3", True),
        ("COM3", "COM4", False),
        ("ble://aa:bb:cc:dd:ee:ff", "BLE://AA:BB:CC:DD:EE:FF", True),
        ("ble://name=BT04", "ble://name=bt04", False),
        ("tcp://localhost:8888", "tcp://127.0.0.1:8888", True),
        ("tcp://PI.local:8888", "tcp://pi.local.:8888", True),
        ("tcp://pi:8888", "tcp://pi:8889", False),
        ("serial://?vid=1A86&serial=A", "serial://?vid=0x1a86&serial=A&baud=9600", True),
        ("serial://?vid=1a86&serial=A", "serial://?serial=A", True),
        ("serial://?vid=1a86&serial=A", "serial://?vid=1a86&serial=B", False),
        ("sim", "sim", False),
    ],
)
def test_two_cars_on_one_port(one: str, other: str, same: bool) -> None:
    text = json.dumps({"defaults": {"platform": "arduino"}, "cars": {"a": {"link": one}, "b": {"link": other}}})
    if same:
        (line,) = _faults(text)
        assert "cars.b.link" in line
        assert "same port" in line
    else:
        assert len(_fleet(text).cars) == 2


def test_port_behind_two_names(tmp_path: Path) -> None:
    (tmp_path / "tty").touch()
    (tmp_path / "by-id").symlink_to(tmp_path / "tty")
    (line,) = _faults(f"cars: {{a: {{link: {tmp_path}/tty}}, b: {{link: {tmp_path}/by-id}}}}")
    assert "same port" in line


_PORTS = [parse_fleet_link(each) for each in ("/dev/a", "/dev/b", "tcp://a:1", "tcp://a:2", "ble://name=a", "sim")] + [
    parse_link(f"serial://?{ids}")
    for ids in (
        "vid=1a86",
        "pid=7523",
        "serial=A",
        "serial=B",
        "vid=1a86&pid=7523",
        "vid=1a86&serial=A",
        "pid=7523&serial=B",
    )
]


@given(st.lists(st.sampled_from(_PORTS), max_size=12))
def test_shared_ports_equal_pairwise_comparison(links: list[FleetLink]) -> None:
    named = {f"car{number}": link for number, link in enumerate(links)}
    first: dict[str, str] = {}
    for (one, before), (other, after) in combinations(named.items(), 2):
        if may_be_same(before, after):
            first.setdefault(other, one)
    assert set(shared_ports(named)) == {(one, other) for other, one in first.items()}


@pytest.mark.parametrize("link", ["tcp://10.0.{}.{}:8888", "/dev/tty{}.{}", "serial://?vid=1a86&serial={}.{}"])
def test_large_fleet_file_takes_linear_time(link: str) -> None:
    lines = "".join(f"  c{n}: {{link: '{link.format(n >> 8, n & 255)}'}}\n" for n in range(4000))
    began = time.process_time()
    assert len(_fleet(f"cars:\n{lines}").cars) == 4000
    assert time.process_time() - began < 4.0, "a comparison of each pair takes 9 to 60 s"


@pytest.mark.parametrize(
    ("without", "modes"),
    [
        ("[drive]", {"manual", "color_led"}),
        ("[mode]", {"manual"}),
        ("[tracking, following]", set(Mode) - {"tracking", "following"}),
        ("[led]", set(Mode)),
    ],
)
def test_car_without_drive_or_mode_is_without_its_modes(without: str, modes: set[str]) -> None:
    car = _fleet(f"cars: {{red: {{link: COM1, platform: arduino, without: {without}}}}}").cars["red"]
    assert {mode for mode in Mode if mode in car.capabilities} == modes


def test_car_without_link_is_allowed_for_finders() -> None:
    fleet = _fleet("cars: {red: {platform: stm32}, green: {link: COM1}}", unbound=True)
    assert (fleet.unbound, list(fleet.cars)) == (("red",), ["green"])


LINKS = [
    *(
        "/dev/ttyUSB0",
        "serial:///dev/ttyUSB0",
        "serial:///dev/x?baud=115200",
        "serial:///dev/x?baud=1",
        "COM3",
        "com1234",
    ),
    *(
        "serial://COM3",
        "serial://x",
        "serial://",
        "serial:///",
        "serial://?vid=1a86",
        "serial://?vid=1a8",
        "serial://?",
    ),
    *("serial://?serial=", "serial://?serial=A+B", "serial://?serial=A&serial=B", "serial:///dev/x?vid=1a86"),
    *("serial://?vid=0x1A86&pid=7523&baud=9600", "serial:///dev/x#1", "serial://dev/x", "serial://?speed=1"),
    *("tcp://pi:8888", "tcp://pi", "tcp://:1", "tcp://pi:0", "tcp://pi:99999", "tcp://[::1]:8888", "tcp://a:1/x"),
    *("tcp://u@a:1", "tcp://a:1?x", "TCP://a:1", "udp://a:1", "ble://aa:bb:cc:dd:ee:ff", "ble://aabb", "BLE://name=x"),
    *("ble://name=", "ble://name=%00", "ble://name=" + "x" * 249, "ble://12345678-1234-1234-1234-1234567890ab"),
    *(
        "",
        " ",
        "x",
        "11:22:33:44:55:10",
        "/dev/x\n",
        "tcp://a:b",
        "tcp://[::1:8888",
        "dev/ttyUSB0",
        "~/x",
        "serial://?baud=9600",
    ),
]


@pytest.mark.parametrize("text", LINKS)
def test_gateways_and_fleet_files_take_the_same_links(text: str) -> None:
    try:
        link = parse_url(text)
    except BadUrl:
        with pytest.raises(BadLink):
            parse_fleet_link(text)
    else:
        assert parse_fleet_link(text) == parse_link(str(link)) == link


_PIECES = [
    "serial",
    "tcp",
    "ble",
    "://",
    "/",
    "?",
    "&",
    "vid=",
    "1a86",
    "serial=",
    "baud=",
    "9600",
    ":",
    "[",
    "]",
    "a",
    "%",
]


@given(st.lists(st.sampled_from(_PIECES), max_size=9).map("".join))
def test_any_pieces_are_a_link_or_a_bad_link(text: str) -> None:
    with contextlib.suppress(BadLink):
        parse_link(text)


def test_head_of_a_platform_keeps_its_case() -> None:
    fleet = _fleet("cars: {red: {link: COM3, platform: STM32+Fan_Level+HEAD=BaLa}}")
    assert fleet.cars["red"].platform == "stm32+fan_level+head=BaLa"


def test_only_fleet_files_know_simulated_links() -> None:
    assert parse_fleet_link("sim") == SimLink()
    with pytest.raises(BadUrl):
        parse_url("sim")


def test_schema_is_one_for_editors() -> None:
    made = schema_of(FileEntry, "fleet file")
    assert made["required"] == ["cars"]
    car = made["$defs"]["CarEntry"]["properties"]
    options = "arm|imu|text|no_readings|3s|fan_level|ptz_direct|head=[A-Za-z0-9]{2,8}"
    kinds = "auto|arduino|stm32|raspberry_pi|unknown|wave_rover|ugv01|ugv02|ugv_rover|ugv_beast"
    assert car["platform"]["pattern"] == f"^({kinds})([+]({options}))*$"
    assert all("description" in field for field in car.values())
