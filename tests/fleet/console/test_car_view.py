"""The view of a car on a page, by the car's messages."""

import pytest

from fleet.console.car_view import MAX_LISTED_CARS, MAX_OTHER_CARS, SILENT_AFTER_S, BatteryTrend, FleetView
from gateway.drivers.yahboom.protocol.platforms import parse_platform
from schemas.gen import fleet_v1_pb2 as pb
from schemas.rights import Right, Sender
from schemas.words import Rank


def view_of(platform: str = "arduino", capabilities: tuple[str, ...] | None = None) -> FleetView:
    view = FleetView(lambda *_: "#ff0000")
    known = sorted(parse_platform(platform).capabilities) if capabilities is None else capabilities
    view.on_message("red", "state/health", pb.Health(platform=platform, capabilities=known), 0.0)
    return view


def test_stale_reading_is_left_out() -> None:
    view = view_of()
    view.on_message("red", "sensor/range", pb.Range(range_m=1.234), 10.0)
    view.on_message("red", "sensor/line", pb.Line(left_inner=True), 12.0)
    (car,) = view.as_list(13.0)
    assert car["range_m"] == 1.23
    (car,) = view.as_list(13.1)
    assert "range_m" not in car
    assert car["line"] == [False, True, False, False]


def test_reading_without_echo_has_no_distance() -> None:
    view = view_of()
    view.on_message("red", "sensor/range", pb.Range(no_echo=True), 10.0)
    assert view.as_list(10.0)[0]["range_m"] is None


def test_motors_have_basis_of_their_gateway() -> None:
    view = view_of()
    assert view.as_list(0.0)[0]["motors"] == {"state": "unknown", "basis": ""}
    view.on_message("red", "state/safety", pb.Safety(motors="off", motors_basis="sent"), 10.0)
    assert view.as_list(10.0)[0]["motors"] == {"state": "off", "basis": "sent"}


def test_hold_lease_and_estop_name_their_senders() -> None:
    view = view_of()
    safety = pb.Safety(hold=pb.Hold(by="us"), lease=pb.Lease(holder="mia", kind="person"))
    safety.estops.add(id="e1", by="us", why="smoke", scope="fleet")
    view.on_message("red", "state/safety", safety, 10.0)
    (car,) = view.as_list(10.0)
    assert (car["hold"], car["lease"], car["estops"][0]["by"]) == (
        "us",
        {"holder": "mia", "kind": "person"},
        "us",
    )


def test_gone_gateway_has_duration_and_past_claims() -> None:
    view = view_of()
    view.on_presence(["red"], 10.0)
    view.on_message("red", "state/safety", pb.Safety(motors="off", motors_basis="shown"), 10.0)
    view.on_message("red", "state/mode", pb.Mode(asked="manual", verdict="confirmed"), 10.0)
    (car,) = view.as_list(11.0)
    assert (car["gateway"], car["motors"]["basis"], car["mode"]["verdict"]) == (True, "shown", "confirmed")
    view.on_presence([], 20.0)
    view.on_presence([], 25.0)
    (car,) = view.as_list(32.0)
    assert (car["gateway"], car["gone_s"]) == (False, 12)
    assert car["motors"] == {"state": "unknown", "basis": "", "past": "off (shown)", "past_s": 22}, (
        "it showed that before"
    )
    assert (car["mode"]["asked"], car["mode"]["verdict"]) == ("unknown", "assumed")


@pytest.mark.parametrize(("last_rx_s", "state"), [(0.5, "unreadable"), (60.0, "stale"), (None, "stale")])
def test_car_that_sends_bytes_without_readings_is_not_silent(last_rx_s: float | None, state: str) -> None:
    view = view_of()
    view.on_presence(["red"], 10.0)
    view.on_message("red", "state/link", pb.Link(state="stale", since_s=60.0, last_rx_s=last_rx_s), 10.0)
    assert view.as_list(10.5)[0]["link"]["state"] == state


def test_link_without_gateway_is_not_online() -> None:
    view = view_of()
    view.on_presence(["red"], 10.0)
    view.on_message("red", "state/link", pb.Link(state="online"), 10.0)
    assert view.as_list(10.5)[0]["link"]["state"] == "online"
    view.on_presence([], 11.0)
    assert view.as_list(11.5)[0]["link"]["state"] == "no gateway"
    assert view.look_up("red").describe_gateway() == []


def test_returning_gateway_does_not_revive_old_claims() -> None:
    view = view_of()
    view.on_presence(["red"], 10.0)
    states = {
        "state/link": pb.Link(state="online", boot_id="a"),
        "state/mode": pb.Mode(asked="manual", verdict="confirmed", boot_id="a"),
        "state/safety": pb.Safety(motors="off", motors_basis="shown", boot_id="a"),
    }

    def told() -> tuple[str, str, str]:
        (car,) = view.as_list(21.0)
        return car["link"]["state"], car["mode"]["verdict"], car["motors"]["basis"]

    for topic, state in states.items():
        view.on_message("red", topic, state, 20.0)
    assert told() == ("online", "confirmed", "shown")
    view.on_presence([], 20.2)
    view.on_presence(["red"], 20.9)
    assert told() == ("unknown", "assumed", ""), "nobody has said anything yet"
    for topic, state in states.items():
        view.on_message("red", topic, state, 21.0)
    view.on_message("red", "state/link", pb.Link(state="lost", boot_id="b"), 21.0)
    assert told() == ("lost", "assumed", ""), "the new one speaks: all else was said by the last one"
    for topic, state in states.items():
        view.on_message("red", topic, state, 21.0)
    assert told() == ("lost", "assumed", ""), "late messages of the last one"


def test_hung_gateway_loses_its_claims() -> None:
    view = view_of()
    view.on_presence(["red"], 10.0)
    view.on_message("red", "state/safety", pb.Safety(motors="off", motors_basis="shown"), 10.0)
    assert view.as_list(10.0)[0]["motors"]["basis"] == "shown"
    (car,) = view.as_list(60.0)
    assert car["motors"] == {"state": "unknown", "basis": "", "past": "off (shown)", "past_s": 50}


@pytest.mark.parametrize(("after_s", "silent_s"), [(SILENT_AFTER_S, None), (SILENT_AFTER_S + 0.1, 3), (90.0, 90)])
def test_stale_card_shows_age_and_no_link(after_s: float, silent_s: int | None) -> None:
    view = view_of()
    view.on_presence(["red"], 10.0)
    view.on_message("red", "state/link", pb.Link(state="online"), 9.0)
    view.on_message("red", "sensor/range", pb.Range(range_m=0.5), 10.0)
    view.on_message("red", "sensor/pose", pb.Pose(x_m=1), 10.0 + after_s)  # a camera sees it: that is no news of it
    (car,) = view.as_list(10.0 + after_s)
    assert car.get("silent_s") == silent_s
    assert car["link"]["state"] == "unknown"
    view.on_message("red", "state/link", pb.Link(state="online"), 10.0 + after_s)
    (car,) = view.as_list(10.0 + after_s)
    assert ("silent_s" in car, car["link"]["state"]) == (False, "online")


def test_car_that_cannot_show_stops_is_marked() -> None:
    view = view_of()
    health = pb.Health(platform="arduino", shows_stops="no", shows_stops_words="its reports do not react to frames")
    view.on_message("red", "state/health", health, 1.0)
    (car,) = view.as_list(1.0)
    assert (car["shows"], car["shows_words"]) == ("no", "its reports do not react to frames")


def test_abilities_are_those_of_platform_and_gateway() -> None:
    (arduino,) = view_of().as_list(0.0)
    assert "tracking" in arduino["modes"]
    assert "Arduino cars" in arduino["cannot"]["arm"]
    (pi,) = view_of("raspberry_pi").as_list(0.0)
    assert pi["modes"] == ()
    assert "do not know mode tracking" in pi["cannot"]["mode"]
    assert "servo_vertical" in pi["can"]
    (listed,) = view_of(capabilities=("drive",)).as_list(0.0)
    assert listed["cannot"]["led"] == "The fleet file leaves out led."
    (unknown,) = view_of("hovercraft", ("drive",)).as_list(0.0)
    assert unknown["can"] == ()


def test_battery_trend_needs_half_a_minute_and_ignores_noise() -> None:
    falling, steady = BatteryTrend(), BatteryTrend()
    for second in range(120):
        assert falling.words == "" or second > 30
        falling.add(8.0 - second * 0.002, float(second))
        steady.add(7.5 + 0.01 * (second % 3), float(second))
    assert (falling.words, steady.words) == ("falling", "steady")


def test_last_event_is_shown_and_ledger_is_bounded() -> None:
    view = view_of()
    car = view.look_up("red")
    for number in range(100):
        car.on_message(
            "event/command", pb.CommandEvent(verb="drive", phase="rejected", sender="mia", words=f"no {number}"), 1.0
        )
    assert view.as_list(1.0)[0]["event"]["words"] == "drive rejected: no 99 (mia)"
    assert view.as_list(1.0)[0]["event"]["level"] == "warning"
    assert len(car.ledger) == 60


def test_named_car_is_not_added_and_temporary_one_leaves_nothing() -> None:
    view = view_of()
    assert view.look_up("ghost").as_dict(0.0)["gateway"] is False
    assert view.names == ["red"]
    view.on_presence(["red", "temporary-setup-1"], 1.0)
    assert view.names == ["red", "temporary-setup-1"]
    view.on_presence([], 2.0)
    assert view.names == ["red"], "red has gone, too, but somebody looks for it"


def invent(view: FleetView, count: int, now: float, prefix: str = "junk") -> None:
    """Hear a message of each of many cars that nobody knows."""
    for number in range(count):
        view.on_message(f"{prefix}{number}", "state/safety", pb.Safety(motors="on"), now)


def test_cars_that_nobody_lists_have_places_up_to_a_bound() -> None:
    view = view_of()
    invent(view, MAX_OTHER_CARS - 1, 1.0)
    assert view.left_out == ""
    invent(view, 10 * MAX_OTHER_CARS, 1.0)
    assert len(view.names) == MAX_OTHER_CARS
    assert view.left_out == f"junk{MAX_OTHER_CARS - 1}"
    assert "red" in view.names, "it was heard 1 s ago"
    view.on_presence([f"token{number}" for number in range(1000)], 1.0)
    assert len(view.names) == MAX_OTHER_CARS


def test_longest_silent_car_is_evicted_never_a_heard_one() -> None:
    view = view_of()
    invent(view, MAX_OTHER_CARS - 1, 1.0)
    now = 1.0
    for _ in range(20):
        now += SILENT_AFTER_S / 2
        view.on_message("red", "state/safety", pb.Safety(motors="off"), now)
        invent(view, MAX_OTHER_CARS, now, f"more{now:.0f}_")
        view.on_presence([f"token{now:.0f}_{number}" for number in range(100)], now)
        assert "red" in view.names
        assert len(view.names) == MAX_OTHER_CARS
    assert "junk0" not in view.names


def test_listed_car_is_always_shown() -> None:
    view = view_of()
    invent(view, MAX_OTHER_CARS, 1.0)
    view.list_cars(["red", "black", "not a name"])
    view.on_message("black", "sensor/range", pb.Range(range_m=1.0), 1.0)
    later = 1.0 + 10 * SILENT_AFTER_S
    invent(view, MAX_OTHER_CARS, later, "more")
    assert {"red", "black"} < set(view.names), "they are silent, and somebody looks for them"
    assert len(view.names) == MAX_OTHER_CARS + 2
    assert [view.may_show(name) for name in ("black", "more0", "ghost")] == [True, True, False]
    # Whoever says what the fleet lists, and says it again and again, gains no more.
    for number in range(10):
        names = [f"list{number}_{each}" for each in range(2 * MAX_LISTED_CARS)]
        view.list_cars(names)
        view.on_presence(names, later)
    assert len(view.names) <= MAX_OTHER_CARS + MAX_LISTED_CARS


@pytest.mark.parametrize("ranks", [("lead", "person"), ("person", "lead"), ("lead", "person", "person")])
def test_binding_pause_is_shown(ranks: tuple[str, ...]) -> None:
    """Only a lead ends a lead's pause, whoever has paused after it."""
    view, safety = view_of(), pb.Safety(motors="off")
    for number, rank in enumerate(ranks):
        safety.pauses.add(id=str(number), by=f"{rank}@x-{number}", why=f"{rank} {number}", rank=rank)
    view.on_message("red", "state/safety", safety, 1.0)
    (car,) = view.as_list(1.0)
    at = ranks.index("lead")
    assert car["pause"] == {"by": f"lead@x-{at}", "why": f"lead {at}"}
    denied = view.authority["red"].denies(Sender("mia", Rank.PERSON), Right.MOVE)
    assert denied is not None
    assert denied.mark == view.authority["red"].pauses[at]


def test_of_pauses_of_one_rank_the_newest_is_shown() -> None:
    view, safety = view_of(), pb.Safety(motors="off")
    for by in ("ann", "bob"):
        safety.pauses.add(id=by, by=by, rank="person")
    view.on_message("red", "state/safety", safety, 1.0)
    assert view.as_list(1.0)[0]["pause"]["by"] == "bob"


@pytest.mark.parametrize(("off_s", "named"), [(-240, True), (240, True), (2, False)])
def test_wrong_clock_is_named_for_gateway_not_for_recording(off_s: int, named: bool) -> None:
    def findings(*, live: bool) -> str:
        view = FleetView(lambda *_: "#ff0000")
        view.on_presence(["red"], 9.0)
        for second in (10, 11):
            link = pb.Link(state="online", boot_id="a")
            link.stamp.seconds = 1_000 + second + off_s
            wall_ns = (1_000 + second) * 10**9 if live else None
            view.on_message("red", "state/link", link, float(second), wall_ns)
        return " ".join(view.look_up("red").diagnose(11.0)["findings"])

    assert ("clock" in findings(live=True)) is named
    assert "clock" not in findings(live=False)
