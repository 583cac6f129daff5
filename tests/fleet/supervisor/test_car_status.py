"""The row of a car, the table, and the limits of logs."""

import io
import os
import time
from pathlib import Path

import pytest
from google.protobuf.timestamp_pb2 import Timestamp
from rich.console import Console

from fleet.supervisor.car_status import CarStatus
from fleet.supervisor.log_files import MAX_RUN_DIRECTORIES, Log, new_run, runs_directory
from fleet.supervisor.spec import FleetSpec
from fleet.supervisor.start_report import (
    LINK_OPEN_TIMEOUT_S,
    READY_TIMEOUT_S,
    StartProgress,
    describe_old_stops,
    describe_start,
)
from fleet.supervisor.status_table import Table
from fleet.supervisor.supervisor import Supervisor
from schemas.bus import DEFAULT_ENDPOINT
from schemas.gen import fleet_v1_pb2 as pb
from schemas.local_time import date_and_clock
from schemas.words import ProcessKind, RunState
from tests.support.text_parts import has_parts


def test_car_status_reports_each_change_once() -> None:
    row = CarStatus("red")
    online = pb.Link(state="online", reason="readings arrive")
    assert row.take("state/link", online, 0.0).startswith("link online: ")
    assert row.take("state/link", online, 1.0) == ""
    assert row.take("state/mode", pb.Mode(asked="tracking", verdict="assumed"), 1.0) == "mode tracking, assumed"
    assert row.take("state/motion", pb.Motion(motion="stop"), 1.0) == "", "as it should be at first"
    assert row.take("state/motion", pb.Motion(motion="back", owner="ann"), 2.0) == "motion back by ann"
    assert row.take("state/motion", pb.Motion(motion="stop"), 3.0) == "motion stop"
    assert row.take("sensor/battery", pb.Battery(voltage_v=6.5, level="critical"), 3.0) == "battery critical"


@pytest.mark.parametrize(
    ("link", "motors", "waits_for", "why"),
    [
        (pb.Link(), "", "", "gateway is starting"),
        (pb.Link(state="lost", reason="no such port"), "unknown", "its link", "link lost: no such port"),
        (pb.Link(state="stale", reason="open"), "unknown", "", "silent: "),
        (pb.Link(state="online"), "stopping", "", "nothing was heard"),
        (
            pb.Link(state="online", last_rx_s=0.1),
            "unknown",
            "its first stop, for 1 s",
            "its first stop, for 1 s",
        ),
        (pb.Link(state="online", last_rx_s=0.1), "unknown", "", ""),  # in doubt, and yet it takes commands
        (pb.Link(state="online"), "off", "", ""),
        (pb.Link(state="quiet"), "on", "", ""),
    ],
)
def test_car_is_ready_with_open_link_and_no_waiting_command(
    link: pb.Link, motors: str, waits_for: str, why: str
) -> None:
    row = CarStatus("red")
    row.take("state/link", link, 0.0)
    row.take("state/safety", pb.Safety(motors=motors, waits_for=waits_for), 0.0)
    assert has_parts(row.state.why_missing(1.0), why)
    assert bool(row.state.why_missing(1.0)) == bool(why)


def test_late_message_of_ended_gateway_is_ignored() -> None:
    row = CarStatus("red")
    row.take("state/link", pb.Link(state="online", boot_id="a"), 0.0)
    row.take("state/safety", pb.Safety(motors="on", boot_id="a"), 0.0)
    row.reset()
    row.take("state/link", pb.Link(state="online", boot_id="a"), 1.0)
    row.take("state/safety", pb.Safety(motors="off", motors_basis="sent", boot_id="a"), 1.0)
    assert (row.state.link.state, row.state.safety.motors) == ("", "")
    assert (row.motors.what, row.motors.basis) == ("off", "sent"), "its last words tell how it stopped the car"
    row.take("state/link", pb.Link(state="quiet", boot_id="b"), 2.0)
    row.reset("b")
    row.take("state/link", pb.Link(state="quiet", boot_id="b"), 2.0)
    row.take("state/link", pb.Link(state="online", boot_id="a"), 2.0)
    assert row.state.link.state == "quiet"


@pytest.mark.parametrize(
    ("names", "missing", "words"),
    [
        (["red"], {}, "red is ready. Recording to s."),
        (["red", "blue"], {}, "All 2 cars … : red, blue. Recording to s."),
        ([f"car{n}" for n in range(9)], {}, "All 9 cars are ready. Recording to s."),
        (
            ["red", "blue"],
            {"blue": "link lost: no such port.", "@coordinator": "starting"},
            "1 of 2 cars ready. … : blue (link lost: no such port), coordinator (starting). Recording to s.",
        ),
    ],
)
def test_describe_start_is_one_line(names: list[str], missing: dict[str, str], words: str) -> None:
    assert has_parts(describe_start(names, missing, "s"), words)


def test_start_timeout_counts_from_last_ready_car() -> None:
    progress = StartProgress()
    assert not progress.has_ended(3, 100.0, unreachable=False)
    assert not progress.has_ended(2, 100.0 + READY_TIMEOUT_S, unreachable=False), "another car is ready"
    assert not progress.has_ended(2, 100.0 + READY_TIMEOUT_S + LINK_OPEN_TIMEOUT_S, unreachable=False)
    assert progress.has_ended(2, 100.0 + READY_TIMEOUT_S + LINK_OPEN_TIMEOUT_S, unreachable=True)
    assert progress.has_ended(2, 100.0 + 2 * READY_TIMEOUT_S, unreachable=False)
    assert StartProgress().has_ended(0, 0.0, unreachable=False)


def test_car_status_reports_hold_and_estop() -> None:
    row = CarStatus("red")
    assert row.take("state/safety", pb.Safety(motors="off"), 0.0) == ""
    held = pb.Safety(hold=pb.Hold(by="ann@laptop-4711"))
    assert row.take("state/safety", held, 1.0) == "on hold by ann"
    held.estops.add(id="e1", by="bob")
    assert row.take("state/safety", held, 2.0) == "e-stop e1"
    assert (row.state.safety.hold.by, row.state.safety.estops[0].id) == ("ann@laptop-4711", "e1")
    assert row.take("state/safety", pb.Safety(), 3.0) == "not on hold"


YESTERDAY, TODAY = 1_799_900_000, 1_800_000_000


def _since(seconds: int) -> Timestamp:
    return Timestamp(seconds=seconds)


MIAS = pb.Hold(by="mia", since=_since(YESTERDAY))
BOBS = pb.Estop(id="e1", by="bob", why="smoke", stamp=_since(YESTERDAY + 60))


@pytest.mark.parametrize(
    ("safety", "words"),
    [
        (pb.Safety(), ""),
        (pb.Safety(hold=pb.Hold(by="mia", since=_since(TODAY + 1))), ""),  # a hold of this run
        (
            pb.Safety(hold=MIAS),
            (f"on hold by mia since {date_and_clock(YESTERDAY)}: no plan moves red. To end that: `fleet resume red`"),
        ),
        (
            pb.Safety(hold=MIAS, estops=[BOBS]),
            (
                f"e-stopped by bob (smoke) since {date_and_clock(YESTERDAY + 60)}: red only accepts stops; "
                f"on hold by mia since {date_and_clock(YESTERDAY)}: no plan moves red. "
                "To end that: `fleet resume red --estops` and then `fleet resume red`"
            ),
        ),
        (
            pb.Safety(estops=[BOBS, BOBS]),
            (
                f"e-stopped by bob (smoke) since {date_and_clock(YESTERDAY + 60)} and 1 more: red only accepts stops. "
                "To end that: `fleet resume red --estops`"
            ),
        ),
    ],
)
def test_old_hold_or_estop_is_told_with_release(safety: pb.Safety, words: str) -> None:
    assert describe_old_stops("red", safety, TODAY) == words


def test_frame_rate_is_mean_of_seconds() -> None:
    row = CarStatus("red")
    for second in range(5):
        row.take("state/link", pb.Link(state="online", rx_frames=second * 25), float(second))
    assert row.rate_hz == 25.0
    row.take("state/link", pb.Link(state="online", rx_frames=3), 9.0)
    assert row.rate_hz == 25.0, "another gateway counts anew"
    row.reset()
    assert (row.rate_hz, row.state.link.state, row.state.mode.asked) == (None, "", "")


@pytest.mark.parametrize("width", [60, 80, 120, 200])
def test_status_table_fits_width_and_names_every_car(width: int) -> None:
    spec = FleetSpec(endpoint="tcp/127.0.0.1:7999", colors={"red": "#010203", "green": "#030201"})
    supervisor = Supervisor(spec, "", lambda: spec, lambda event: None)
    for name, kind in (("@hub", ProcessKind.HUB), ("red", ProcessKind.GATEWAY), ("green", ProcessKind.GATEWAY)):
        supervisor.processes.add(name, kind, ())
    for process in supervisor.processes:
        process.status.state = RunState.RUNNING
    now = time.monotonic()
    for name in ("red", "green"):
        row = supervisor.rows[name] = CarStatus(name, event="x" * 300)
        row.take("state/link", pb.Link(state="online"), now)
        row.take("state/mode", pb.Mode(asked="obstacle_avoidance"), now)
    leased = pb.Safety(lease=pb.Lease(holder="ann_of_the_laboratory_desk@laptop-4711"))
    supervisor.rows["red"].take("state/safety", leased, now)
    supervisor.rows["red"].take("sensor/battery", pb.Battery(voltage_v=7.42, level="critical"), now)
    console = Console(file=io.StringIO(), width=width)
    console.print(Table(supervisor, console).rendered())
    assert isinstance(console.file, io.StringIO)
    shown = console.file.getvalue()
    assert all(word in shown for word in ("red", "green", "online", "@hub"))
    assert all(len(line) <= width for line in shown.splitlines())
    header, red, green, *_ = shown.splitlines()
    assert (red.split()[:2], green.split()[:2]) == (["●", "red"], ["●", "green"]), "no line is wrapped"
    assert ("last event" in header, "Hz" in header) == (width > 80, width > 80)
    assert "battery" in header
    assert "obstacle_av" in green


def test_status_table_names_holder_driver_and_last_word() -> None:
    spec = FleetSpec(endpoint="tcp/127.0.0.1:7999")
    supervisor = Supervisor(spec, "", lambda: spec, lambda event: None)
    row = supervisor.rows["red"] = CarStatus("red")
    console, now = Console(file=io.StringIO(), width=200), time.monotonic()

    def line() -> str:
        with console.capture() as shown:
            console.print(Table(supervisor, console).rendered())
        return next(each for each in shown.get().splitlines() if each.startswith("red"))

    row.take("sensor/battery", pb.Battery(voltage_v=7.94, level="ok"), now)
    leased = pb.Safety(motors="off", motors_basis="sent", lease=pb.Lease(holder="mia@laptop-1"))
    row.take("state/safety", leased, now)
    assert {"mia", "(sent)", "7.94"} <= set(line().split())
    row.take("sensor/battery", pb.Battery(voltage_v=7.42, level="critical"), now)
    assert "7.42 V critical" in line()
    leased.hold.by = "ann@laptop-1"
    row.take("state/safety", leased, now)
    assert "hold ann" in line()
    leased.pauses.add(by="eve@laptop-1")
    leased.loan.to = "tom"
    row.take("state/safety", leased, now)
    assert "hold ann, paused by eve, lent to tom" in line()
    leased.estops.add(id="e1", by="bob")
    row.take("state/safety", leased, now)
    row.reset()
    assert "e-stop e1" in line()
    assert "(sent)" not in line(), "nobody claims it now"


def test_status_table_says_how_old_a_value_is() -> None:
    """A battery that was measured an hour ago looked new, and so did the link of a gateway that hangs."""
    spec = FleetSpec(endpoint="tcp/127.0.0.1:7999")
    supervisor = Supervisor(spec, "", lambda: spec, lambda event: None)
    supervisor.processes.add("red", ProcessKind.GATEWAY, ())
    for process in supervisor.processes:
        process.status.state = RunState.RUNNING
    row = supervisor.rows["red"] = CarStatus("red")
    row.take("sensor/battery", pb.Battery(voltage_v=7.94, level="ok"), time.monotonic() - 3600.0)
    row.take("state/link", pb.Link(state="online"), time.monotonic() - 5.0)
    row.take("state/safety", pb.Safety(motors="off", motors_basis="sent"), time.monotonic() - 5.0)
    console = Console(file=io.StringIO(), width=200)
    with console.capture() as shown:
        console.print(Table(supervisor, console).rendered())
    line = next(each for each in shown.get().splitlines() if each.startswith("red"))
    for words in ("online (5 s old)", "off (sent, 5 s old)", "7.94 V, 60 min old"):
        assert words in line
    for topic, message in (("state/link", pb.Link(state="online")), ("sensor/battery", pb.Battery(voltage_v=7.9))):
        row.take(topic, message, time.monotonic())
    row.take("state/safety", pb.Safety(motors="off", motors_basis="sent"), time.monotonic())
    with console.capture() as shown:
        console.print(Table(supervisor, console).rendered())
    assert " old" not in shown.get()


def test_log_file_is_bounded_and_keeps_newest_lines(tmp_path: Path) -> None:
    log = Log(tmp_path / "red.log", limit_bytes=10_000)
    for number in range(2000):
        log.add(f"line {number}", 1_700_000_000.25)
    log.close()
    assert sum(path.stat().st_size for path in tmp_path.iterdir()) < 21_000
    text = log.older.read_text() + log.path.read_text()
    assert text.splitlines()[-1] == "2023-11-14T22:13:20.250Z red | line 1999"
    assert "line 1800" in text


def test_unwritable_log_is_told_and_harmless(tmp_path: Path) -> None:
    log = Log(tmp_path / "gone" / "red.log")
    log.add("x", 0.0)
    assert "cannot be written: " in log.failed


def test_old_run_directories_are_removed_unless_in_use(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("FLEET_STATE_DIR", str(tmp_path))
    place = runs_directory("lab", DEFAULT_ENDPOINT)
    for number in range(MAX_RUN_DIRECTORIES + 5):
        old = place / f"20200101-0000{number:02}-1"
        old.mkdir(parents=True)
        (old / "red.log").write_text("x")
        os.utime(old, (0, 0))
    touched = place / "20190101-000000-1"
    touched.mkdir()
    os.utime(touched, (1_700_000_000, 1_700_000_000))
    made = new_run("lab", DEFAULT_ENDPOINT, 1_700_000_100.0)
    left = sorted(each.name for each in place.iterdir())
    assert made.name in left
    assert touched.name in left
    assert len(left) == MAX_RUN_DIRECTORIES + 1
