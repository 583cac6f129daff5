"""Fleet, sync and async, against real gateways of simulated cars, and against gateways that do not answer."""

import asyncio
import math
import threading
import time
from collections.abc import Awaitable, Callable, Iterator
from contextlib import suppress
from datetime import UTC, datetime
from decimal import Decimal
from fractions import Fraction
from typing import Any

import pytest
import zenoh

from fleet.aio import Fleet as AsyncFleet
from fleet.client.client import Fleet
from fleet.client.commands import led_request, pause_request
from fleet.client.job_threads import JobThreads
from fleet.client.outcome import Outcome
from schemas import keys, messages, topics
from schemas.bus import BadEndpoint, Bus, BusError, NoFleet, reply
from schemas.gen import fleet_v1_pb2 as pb
from tests.fleet.conftest import Cars, asked
from tests.support.ports import free_endpoint
from tests.support.processes import LONG_S, PATIENCE_S, driving, wait_for


@pytest.fixture
def client(cars: Cars) -> Iterator[Fleet]:
    with Fleet(cars.endpoint, sender="ann", kind="person") as opened:
        yield opened


def test_cars_are_those_with_token(client: Fleet) -> None:
    assert client.cars() == ["blue", "green", "red"]


def test_published_pose_is_answered_by_gateway(client: Fleet, cars: Cars) -> None:
    assert client.get("red/sensor/pose") == [], "nobody has measured one"
    client.publish_pose("red", x_m=1.5, y_m=-0.5, heading_rad=7.0, frame="map", xy_std_m=0.02)

    def poses() -> list[Any]:
        return client.get("red/sensor/pose")

    wait_for(poses, "the gateway has it")
    (reading,) = poses()
    assert (reading["frame"], reading["x_m"], reading["y_m"]) == ("map", 1.5, -0.5)
    assert reading["heading_rad"] == pytest.approx(7.0 - math.tau)
    assert (reading["xy_std_m"], reading["heading_std_rad"]) == (0.02, None)
    key = "fleet/red/sensor/pose"
    cars.bus.put_command(key, b"no pose", "application/json")
    cars.bus.put_command(key, b'{"x_m": "NaN"}', "application/json")
    cars.bus.put_command(key, b'{"frame": "map", "x_m": 2.5}', "application/json")
    wait_for(lambda: poses()[0]["x_m"] == 2.5, "any client may publish one, as JSON, too")
    assert [each["x_m"] for each in client.history("red/sensor/pose", last=10)] == [1.5, 2.5]


@pytest.mark.parametrize(
    "wrong",
    [
        {"x_m": math.inf},
        {"y_m": 2000.0},
        {"x_m": math.nan},
        {"heading_rad": math.nan},
        {"frame": ""},
        {"frame": "a\u202e"},
        {"xy_std_m": -1.0},
        {"heading_std_rad": math.inf},
        {"car": "Red"},
    ],
)
def test_invalid_pose_is_refused(wrong: dict[str, Any], client: Fleet) -> None:
    fields: dict[str, Any] = {"car": "red", "x_m": 0.0, "y_m": 0.0, "heading_rad": 0.0, **wrong}
    with pytest.raises(ValueError, match=r"is not allowed|is not a car"):
        client.publish_pose(**fields)


def test_led_command_is_carried_out(client: Fleet, cars: Cars) -> None:
    outcome = client.car("red").led(255, 0, 16)
    assert (outcome.ok, outcome.phase) == (True, "sent")
    wait_for(lambda: cars.sim.say({"car": "red", "ask": "truth"})["led"] == "#ff0010", "the LED is so")


def test_awaited_drive_ends_with_basis_and_not_early(client: Fleet, cars: Cars) -> None:
    outcome = asked(lambda: client.car("green").drive("forward", 0.7))
    assert outcome.ok
    assert (outcome.phase, outcome.basis) in (("sent", "sent"), ("complete", "shown"))
    assert outcome.took_s >= 0.7
    wait_for(lambda: not driving(cars.sim, "green"), "green stands")


def test_stop_supersedes_drive_and_waits_until_complete(client: Fleet, cars: Cars) -> None:
    ended: list[object] = []
    drive = threading.Thread(target=lambda: ended.append(asked(lambda: client.car("blue").drive("forward", LONG_S))))
    drive.start()
    wait_for(lambda: driving(cars.sim, "blue"), "blue drives")
    (outcome,) = client.stop(["blue"])
    drive.join()
    assert (outcome.ok, outcome.phase, outcome.basis) == (True, "sent", "sent"), "a Raspberry Pi can show nothing"
    assert outcome.worst_case_s is not None
    assert outcome.worst_case_s > 0
    assert not driving(cars.sim, "blue")
    assert [(each.ok, each.phase) for each in ended] == [(False, "superseded")]  # type: ignore[attr-defined]  # Outcome


def test_stop_reaches_every_car(client: Fleet) -> None:
    def stopped() -> list[Outcome] | None:
        outcomes = client.stop()
        return outcomes if all(each.ok for each in outcomes) else None

    # On a busy machine the report that shows the stop of `red` may come too late.
    outcomes = wait_for(stopped, "each stop is shown, or sent to a car that can show none")
    assert [(each.car, each.ok, each.phase, each.basis) for each in outcomes] == [
        ("blue", True, "sent", "sent"),
        ("green", True, "sent", "sent"),
        ("red", True, "complete", "shown"),
    ]


def test_stop_of_str_is_one_car(client: Fleet) -> None:
    """A str is an iterable of letters. `stop("red")` must not ask the cars r, e and d, and leave red driving."""
    (outcome,) = client.stop("red")
    assert (outcome.car, outcome.ok) == ("red", True)


def test_missing_car_does_not_delay_others(client: Fleet) -> None:
    outcomes = client.ask(led_request(1, 2, 3), ["red", "purple", "blue"])
    assert [(each.car, each.ok, each.phase) for each in outcomes] == [
        ("blue", True, "sent"),
        ("purple", False, "no_answer"),
        ("red", True, "sent"),
    ]
    assert '"purple"' in outcomes[1].words
    assert "blue, green, red" in outcomes[1].words


def test_refusal_has_reason_and_words(client: Fleet) -> None:
    outcome = client.car("green").light("pink")
    assert (outcome.ok, outcome.phase, outcome.reason) == (False, "rejected", "bad_value")
    assert "white, red" in outcome.words


def test_person_stop_holds_car_against_coordinator_until_resume(client: Fleet, cars: Cars) -> None:
    client.stop(["green"])
    with Fleet(cars.endpoint, sender="c", kind="coordinator") as coordinator:
        assert coordinator.car("green").mode("manual").reason == "held"
        client.car("green").resume().check()
        # The last driver has a lease for two seconds more.
        wait_for(lambda: coordinator.car("green").mode("manual").ok, "the coordinator has it")


def test_client_that_disconnects_while_driving_leaves_no_car_driving(cars: Cars) -> None:
    events: list[Any] = []
    cars.bus.subscribe("fleet/blue/event/command", lambda sample: events.append(sample.message()))
    with Fleet(cars.endpoint, sender="gone", kind="script") as client:
        asked(lambda: client.car("blue").drive("forward", LONG_S, wait=False)).check()
        wait_for(lambda: driving(cars.sim, "blue"), "blue drives")
    wait_for(lambda: not driving(cars.sim, "blue"), "blue stands")
    ended = wait_for(
        lambda: [each for each in events if each.sender == "gone" and each.phase in ("complete", "expired")],
        "it is told why",
    )
    assert [each.phase for each in ended] == ["expired"]
    assert "gone disconnected" in ended[0].words


@pytest.mark.parametrize("duration_s", [0, -1, 3600.01, pytest.param(10**400, id="huge"), float("nan"), float("inf")])
def test_drive_duration_out_of_range_is_refused_by_client(client: Fleet, duration_s: float) -> None:
    with pytest.raises(ValueError, match="more than 0 and at most 3600 s"):
        client.car("red").drive("forward", duration_s)


@pytest.mark.parametrize("duration_s", [Decimal("0.2"), Fraction(1, 5)])
def test_drive_lasts_any_number_of_seconds(client: Fleet, duration_s: float) -> None:
    assert asked(lambda: client.car("green").drive("forward", duration_s)).ok


def test_estop_ends_with_its_id_as_str(client: Fleet) -> None:
    client.estop(["green"])
    (estop,) = client.get("green/state/safety")[0].value.estops
    released = client.car("green").resume(estop.id)
    assert (released.ok, client.get("green/state/safety")[0]["estops"]) == (True, False), released


@pytest.mark.parametrize("why", [pytest.param("w" * 70_000, id="long"), "smoke \udcff", 7])
def test_no_reason_makes_estop_or_pause_fail(client: Fleet, cars: Cars, why: Any) -> None:
    (outcome,) = client.estop(["green"], why)
    assert outcome.ok, outcome
    assert cars.state("safety", "green").estops[0].why.startswith(str(why)[:5])
    assert all(each.ok for each in client.resume(["green"], everything=True))
    assert pause_request(why).message.ByteSize() < 1000, "more than 64 KiB would be refused"


def test_other_values_that_no_message_can_carry(client: Fleet) -> None:
    with pytest.raises(ValueError, match="r 256 is not allowed"):
        client.car("red").led(256, 0, 0)
    with pytest.raises(TypeError, match="number of seconds"):
        client.car("red").drive("forward", "1s")  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="six joints, 2 given"):
        client.car("red").arm([1, 2])
    with pytest.raises(ValueError, match="deg -1 is not allowed"):
        client.car("red").servo("front", deg=-1)
    with pytest.raises(keys.BadKey):
        client.car("Red")


def test_readings_have_key_time_and_value(client: Fleet) -> None:
    readings = client.get("red")
    assert "fleet/red/sensor/range" in [reading.key for reading in readings]
    (battery,) = client.get("red/sensor/battery")
    assert isinstance(battery.value, pb.Battery)
    assert battery.as_dict()["voltage_v"] == battery.value.voltage_v > 0
    assert abs((datetime.now(UTC) - battery.time).total_seconds()) < 60
    assert {reading.key.split("/")[1] for reading in client.get("*/state/mode")} == {"blue", "green", "red"}
    with pytest.raises(keys.BadKey, match=r"No key red/sensor/rang\. Did you mean red/sensor/range\?"):
        client.get("red/sensor/rang")
    with pytest.raises(keys.BadKey, match=r"Did you mean red/sensor/battery\?"):
        client.history("red/sensor/batery", last=1)
    with pytest.raises(keys.BadKey, match="@a is a group"):
        client.car("@a")
    with pytest.raises(keys.BadKey):
        client.get("red//x")


def test_watch_yields_readings_until_closed(client: Fleet) -> None:
    with client.watch("*/state/health") as readings:
        seen = set()
        for reading in readings:
            seen.add(reading.key)
            if len(seen) == 3:
                break
    assert list(readings) == []
    assert (readings.dropped, readings.unreadable) == (0, 0)


async def test_async_client_commands_and_watches(cars: Cars) -> None:
    async with AsyncFleet(cars.endpoint, sender="eve") as client:
        assert await client.cars() == ["blue", "green", "red"]
        one, other = await asyncio.gather(client.car("red").whistle(), client.car("blue").led(0, 0, 9))
        assert (one.phase, other.phase) == ("sent", "sent")
        assert (await client.get("red/state/mode"))[0].value.asked == "manual"
        async with client.watch("red/state/*") as readings:
            reading = await anext(readings)
        assert reading.key.startswith("fleet/red/state/")
        assert all(outcome.ok for outcome in await client.stop())
        assert (await client.resume(["red"]))[0].ok


async def test_current_reading_counts_even_without_time_to_wait(client: Fleet, cars: Cars) -> None:
    wanted = ("red/state/mode", "asked == 'manual'")
    assert client.wait(*wanted, timeout_s=0).car == "red"
    async with AsyncFleet(cars.endpoint, sender="eve") as other:
        assert (await other.wait(*wanted, timeout_s=0)).car == "red"


async def test_cancelled_opening_leaves_no_session(cars: Cars) -> None:
    fleet = AsyncFleet(cars.endpoint, sender="eve")
    opening = asyncio.create_task(fleet.__aenter__())
    await asyncio.sleep(0)  # its thread begins
    opening.cancel()
    with pytest.raises(asyncio.CancelledError):
        await opening
    await asyncio.to_thread(fleet._threads.shutdown)
    token = keys.operator_token("fleet", "eve")
    await asyncio.to_thread(wait_for, lambda: not cars.bus.tokens(token), "it has left the bus")


async def test_close_does_not_wait_for_free_thread(cars: Cars) -> None:
    free = threading.Event()
    async with AsyncFleet(cars.endpoint, sender="eve") as fleet:
        waiting = asyncio.gather(*(fleet.call(free.wait, PATIENCE_S) for _ in range(300)))
        await asyncio.to_thread(wait_for, fleet._threads._work_queue.qsize, "all threads are busy")
    free.set()
    assert all(await waiting), "none of them had to time out"


# ---------------------------------------------------------------- gateways that do not behave


@pytest.fixture
def gateway(cars: Cars) -> Iterator[Bus]:
    """Yield a session in a fleet of its own, `odd`, in which a test plays the gateways."""
    with Bus.open(cars.endpoint) as opened:
        yield opened


def _asked(query: zenoh.Query) -> str:
    assert query.payload is not None
    command = pb.StopCommand()
    command.ParseFromString(query.payload.to_bytes())
    assert command.sender == "ann"
    assert command.HasField("asked")
    return command.id


def test_hung_gateway_differs_from_late_answer(
    cars: Cars, gateway: Bus, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    """A client once reported six of 50 stopped gateways as hanging, because their answers took over two seconds."""
    monkeypatch.setattr("fleet.client.command_tracker.ANSWER_TIMEOUT_S", 0.1)
    monkeypatch.setattr("fleet.client.client.OVERLOAD_ANSWER_TIMEOUT_S", 4.2)
    caplog.set_level("WARNING", "fleet")
    events = gateway.publisher("odd/fine/event/command", topics.TOPICS["event/command"], "fine")
    held: list[zenoh.Query] = []
    asked = threading.Event()
    ids: list[str] = []

    def answer(query: zenoh.Query) -> None:
        with query:
            ids.append(_asked(query))
            wait_for(lambda: caplog.messages, "it is late")
            result = pb.Result(id=ids[0], car="fine", status="queued", worst_case_s=0.5)
            key = "odd/fine/@cmd/stop"
            reply(query, key, result.SerializeToString(), messages.encoding_of(topics.RESULT))
        asked.set()

    gateway.queryable("odd/fine/@cmd/*", answer)
    gateway.queryable("odd/hung/@cmd/*", held.append)
    for car in ("fine", "hung"):
        gateway.token(keys.car_token("odd", car))

    def complete() -> None:
        asked.wait(20)
        events.put(pb.CommandEvent(id="another", phase="failed"), time.time_ns())
        events.put(pb.CommandEvent(id=ids[0], phase="complete"), time.time_ns())

    worker = threading.Thread(target=complete)
    worker.start()
    with Fleet(cars.endpoint, "odd", sender="ann") as client:
        wait_for(lambda: client.cars() == ["fine", "hung"], "both are there")
        fine, hung = client.stop()
    worker.join()
    assert (fine.car, fine.ok, fine.phase, fine.worst_case_s) == ("fine", True, "complete", 0.5)
    assert (hung.car, hung.ok, hung.phase) == ("hung", False, "no_answer")
    assert "hung" in hung.words
    assert "after 4 s" in hung.words
    assert len(caplog.messages) == 1
    assert caplog.messages[0].startswith("fine, hung: ")


async def test_stop_does_not_wait_for_unanswered_command(
    cars: Cars, gateway: Bus, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("fleet.client.client.OVERLOAD_ANSWER_TIMEOUT_S", 600.0)
    stopped: list[str] = []
    held: list[zenoh.Query] = []

    def answer(query: zenoh.Query) -> None:
        with query:
            stopped.append(_asked(query))
            result = pb.Result(id=stopped[-1], car="fine", status="sent").SerializeToString()
            reply(query, "odd/fine/@cmd/stop", result, messages.encoding_of(topics.RESULT))

    gateway.queryable("odd/fine/@cmd/*", answer)
    gateway.queryable("odd/hung/@cmd/*", held.append)
    for car in ("fine", "hung"):
        gateway.token(keys.car_token("odd", car))
    async with AsyncFleet(cars.endpoint, "odd", sender="ann") as client:
        await asyncio.to_thread(wait_for, lambda: client.sync.cars() == ["fine", "hung"], "both are there")
        commands = [client.ask(led_request(0, 0, 0), ["hung"]) for _ in range(40)]
        stops = [client.stop() for _ in range(40)]
        unanswered = asyncio.gather(*commands, *stops)
        await asyncio.to_thread(wait_for, lambda: len(set(stopped)) == len(stops), "each stop is there")
        assert not unanswered.done()
    assert len(await unanswered) == 80


@pytest.mark.soak
def test_command_without_further_events_ends_with_last_event(cars: Cars, gateway: Bus) -> None:
    def answer(query: zenoh.Query) -> None:
        with query:
            result = pb.Result(id=_asked(query), car="mute", status="queued", worst_case_s=0.1)
            reply(query, "odd/mute/@cmd/stop", result.SerializeToString(), messages.encoding_of(topics.RESULT))

    gateway.queryable("odd/mute/@cmd/*", answer)
    gateway.token(keys.car_token("odd", "mute"))
    with Fleet(cars.endpoint, "odd", sender="ann") as client:
        wait_for(lambda: "mute" in client.cars(), "it is there")
        outcome = client.car("mute").stop()
    assert (outcome.ok, outcome.phase) == (False, "queued")
    assert "(last event: queued, " in outcome.words


def test_unreadable_answer_costs_no_other_car_its_outcome(cars: Cars, gateway: Bus) -> None:
    def answer(car: str, payload: bytes, encoding: str) -> None:
        def take(query: zenoh.Query) -> None:
            with query:
                reply(query, f"odd/{car}/@cmd/stop", payload, encoding)

        gateway.queryable(f"odd/{car}/@cmd/*", take)
        gateway.token(keys.car_token("odd", car))

    answer("good", pb.Result(car="good", status="sent").SerializeToString(), messages.encoding_of(topics.RESULT))
    answer("noise", b"\xff\xff", "application/octet-stream")
    answer("other", pb.Range(range_m=1.0).SerializeToString(), messages.encoding_of("fleet.v1.Range"))
    with Fleet(cars.endpoint, "odd", sender="ann") as client:
        wait_for(lambda: client.cars() == ["good", "noise", "other"], "all are there")
        good, *unreadable = client.stop()
    assert (good.car, good.ok, good.phase) == ("good", True, "sent")
    for outcome in unreadable:
        assert (outcome.ok, outcome.phase) == (False, "no_answer")
        assert f"answered for {outcome.car}: " in outcome.words


@pytest.mark.parametrize("kind", ["another message", "an error"])
def test_foreign_answer_does_not_end_a_stop(cars: Cars, gateway: Bus, kind: str) -> None:
    foreign_answered = threading.Event()

    def answer_foreign(query: zenoh.Query) -> None:
        with query:
            if kind == "an error":
                query.reply_err("no such thing", encoding="text/plain")
            else:
                other = messages.encoding_of("fleet.v1.Range")
                reply(query, "odd/twice/@cmd/stop", pb.Range(range_m=1.0).SerializeToString(), other)
        foreign_answered.set()

    def answer(query: zenoh.Query) -> None:
        with query:
            foreign_answered.wait(5.0)
            result = pb.Result(car="twice", status="sent")
            reply(query, "odd/twice/@cmd/stop", result.SerializeToString(), messages.encoding_of(topics.RESULT))

    gateway.queryable("odd/twice/@cmd/*", answer)
    gateway.token(keys.car_token("odd", "twice"))
    with Bus.open(cars.endpoint) as other, Fleet(cars.endpoint, "odd", sender="ann") as client:
        other.queryable("odd/*/@cmd/*", answer_foreign)
        wait_for(lambda: client.cars() == ["twice"], "it is there")
        (outcome,) = client.stop()
    assert (outcome.car, outcome.ok, outcome.phase) == ("twice", True, "sent")


def test_query_ended_without_answer_does_not_hang(cars: Cars, gateway: Bus) -> None:
    gateway.queryable("odd/brief/@cmd/*", lambda query: query.drop())  # type: ignore[no-untyped-call]
    gateway.token(keys.car_token("odd", "brief"))
    with Fleet(cars.endpoint, "odd", sender="ann") as client:
        wait_for(lambda: client.cars() == ["brief"], "it is there")
        outcome = client.car("brief").whistle()
    assert (outcome.ok, outcome.phase) == (False, "no_answer")
    assert outcome.words.startswith("brief may ")


def test_closing_ends_what_is_waited_for(cars: Cars, gateway: Bus) -> None:
    asked = threading.Event()

    def answer(query: zenoh.Query) -> None:
        result = pb.Result(id=_asked(query), car="slow", status="queued", worst_case_s=600.0)
        reply(query, "odd/slow/@cmd/stop", result.SerializeToString(), messages.encoding_of(topics.RESULT))
        held.append(query)
        asked.set()

    held: list[zenoh.Query] = []
    gateway.queryable("odd/slow/@cmd/*", answer)
    gateway.token(keys.car_token("odd", "slow"))
    client = Fleet(cars.endpoint, "odd", sender="ann")
    wait_for(lambda: "slow" in client.cars(), "it is there")
    outcomes: list[object] = []
    waiting = threading.Thread(target=lambda: outcomes.extend(client.stop(["slow"])))
    waiting.start()
    assert asked.wait(20)
    began = time.monotonic()
    client.close()
    assert time.monotonic() - began < 5.0, "the query that hangs is not waited for"
    waiting.join(20)
    assert len(outcomes) == 1


def test_closing_ends_a_wait_without_timeout(cars: Cars) -> None:
    client = Fleet(cars.endpoint, sender="ann")
    errors: list[BusError] = []

    def wait() -> None:
        try:
            client.wait("red/sensor/range", "range_m > 4.4")
        except BusError as error:
            errors.append(error)

    waiting = threading.Thread(target=wait)
    waiting.start()
    wait_for(lambda: client._watches, "it watches")
    client.close()
    waiting.join(20)
    assert len(errors) == 1


def test_closed_fleet_raises_bus_error(cars: Cars) -> None:
    with Fleet(cars.endpoint, sender="ann") as client:
        red = client.car("red")
    uses: list[Callable[[], object]] = [
        client.cars,
        client.stop,
        lambda: red.drive("forward", 0.2),
        red.lease().__enter__,
        lambda: client.get("red"),
        lambda: client.history("red/sensor/range", last=1),
        lambda: client.watch("red/sensor/range"),
    ]
    for use in uses:
        with pytest.raises(BusError, match="is closed"):
            use()


def test_use_that_began_before_the_fleet_was_closed_ends(cars: Cars, monkeypatch: pytest.MonkeyPatch) -> None:
    client = Fleet(cars.endpoint, sender="ann")
    monkeypatch.setattr(client, "check_open", lambda: None)  # as if another thread closed it right after this check
    client.close()
    uses: list[Callable[[], object]] = [
        client.stop,
        client.car("red").lease().__enter__,
        lambda: client.get("red"),
        lambda: client.watch("red/sensor/range"),
        lambda: client.publish_pose("red", x_m=0.0, y_m=0.0, heading_rad=0.0),
    ]
    for use in uses:
        with pytest.raises(BusError, match="closed"):
            use()
    monkeypatch.setattr(client, "_stop_pool", JobThreads(2, "still-open"))  # and before its pools were closed
    began = time.monotonic()
    with suppress(BusError):  # or its outcome is unknown
        client.stop(["red"])
    assert time.monotonic() - began < 10.0, "a stop waits for a lost bus for 30 s, and this bus is closed"


async def test_closed_async_fleet_raises_bus_error(cars: Cars) -> None:
    client = AsyncFleet(cars.endpoint, sender="ann")
    async with client:
        red = client.car("red")
        lease = red.lease()
    uses: list[Callable[[], Awaitable[object]]] = [
        client.cars,
        client.stop,
        lambda: red.drive("forward", 0.2),
        lambda: red.lease().__aenter__(),
        lease.__aenter__,
        client.__aenter__,
        lambda: client.get("red"),
        lambda: client.history("red/sensor/range", last=1),
        lambda: client.wait("red/sensor/range", "range_m > 0"),
        lambda: anext(client.watch("red/sensor/range")),
    ]
    for use in uses:
        with pytest.raises(BusError, match="is closed"):
            await use()


def test_missing_fleet_and_bad_names_have_own_errors() -> None:
    with pytest.raises(NoFleet):
        Fleet(free_endpoint())
    with pytest.raises(BadEndpoint):
        Fleet("nowhere")
    with pytest.raises(keys.BadKey, match="'A B'"):
        Fleet(name="A B")
    with pytest.raises(keys.BadKey, match="sender 'a/b'"):
        Fleet(sender="a/b")


def test_reading_a_command_key_is_refused(client: Fleet) -> None:
    events: list[Any] = []
    client.bus.subscribe("fleet/red/event/command", lambda sample: events.append(sample.message()))
    began_ns = time.time_ns()
    with pytest.raises(keys.BadKey, match="is a command"):
        client.get("red/@cmd/stop")
    client.car("red").find().check()
    wait_for(lambda: [each for each in events if each.verb == "find"], "a command that is carried out is recorded")
    # Events of an earlier test's command may arrive late.
    assert {each.verb for each in events if each.stamp.ToNanoseconds() > began_ns} == {"find"}
