"""A lease: any exit stops and releases the car. The error of a lost lease names the person who took the car."""

import asyncio
import signal
import sys
import threading
from collections.abc import Callable, Iterator

import pytest

from fleet import Fleet, LeaseLost, NotCarriedOut
from fleet.aio import Car as AsyncCar
from fleet.aio import Fleet as AsyncFleet
from fleet.client.client import Car
from fleet.client.lease import LeaseMonitor
from fleet.client.outcome import Outcome
from schemas.bus import BusError
from schemas.gen import fleet_v1_pb2 as pb
from schemas.rights import Sender
from tests.fleet.conftest import Cars, asked
from tests.support.processes import LONG_S, driving, freeze, wait_for
from tests.support.text_parts import has_parts

# ---------------------------------------------------------------- the state of a lease


def safety(holder: str = "", *, hold: str = "", since_s: int = 1, estop: str = "") -> pb.Safety:
    message = pb.Safety(car="red")
    if holder:
        message.lease.holder, message.lease.kind = holder, "person"
    if hold:
        message.hold.by = hold
        message.hold.since.seconds = since_s
    if estop:
        message.estops.add(id="e", by=estop)
    return message


@pytest.mark.parametrize(
    ("heard", "lost"),
    [
        ([safety()], ""),
        ([safety("mia")], ""),  # from before our lease
        ([safety("mia"), safety("bot")], ""),
        ([safety("bot"), safety()], ""),  # expired, and no other sender has it
        ([safety("bot"), safety("mia")], "red was taken by mia (person)"),
        ([safety("bot"), safety("mia"), safety("bot")], "red was taken by mia (person)"),  # lost stays lost
        ([safety("bot", hold="mia")], ""),  # from before our lease
        ([safety("bot", hold="mia"), safety("bot", hold="mia")], ""),
        ([safety("bot"), safety("bot", hold="mia")], "red was stopped by mia"),
        ([safety("bot", hold="mia"), safety("bot"), safety("bot", hold="mia", since_s=2)], "red was stopped by mia"),
        ([safety("bot"), safety("bot", hold="bot")], ""),  # our own stop
        ([safety("bot"), safety("bot", hold="mia", estop="mia")], "red was e-stopped by mia"),
    ],
)
def test_lease_monitor_detects_loss_from_safety_messages(heard: list[pb.Safety], lost: str) -> None:
    ours = LeaseMonitor("red", Sender("bot"))
    for message in heard:
        ours.on_safety(message)
    assert ours.lost == lost


def paused(message: pb.Safety) -> pb.Safety:
    message.pauses.add(id="p", by="mia", why="lunch")
    return message


def lent(message: pb.Safety, to: str) -> pb.Safety:
    message.loan.to, message.loan.by = to, "mia"
    return message


def listed(message: pb.Safety) -> pb.Safety:
    message.people.drivers.append("bob")
    return message


@pytest.mark.parametrize(
    ("now", "lost"),
    [
        (paused(safety("bot")), "paused … mia: lunch"),
        (paused(safety()), "paused … mia: lunch"),  # the pause has ended the lease
        (lent(safety("bot"), "bob"), "red … lent to bob"),
        (lent(safety("bot"), "bot"), ""),
        (listed(safety("bot")), "bot … list"),
    ],
)
def test_lease_monitor_detects_what_keeps_sender_from_car(now: pb.Safety, lost: str) -> None:
    ours = LeaseMonitor("red", Sender("bot"))
    ours.on_safety(safety("bot"))
    ours.on_safety(now)
    assert has_parts(ours.lost, lost)
    assert bool(ours.lost) is bool(lost)


def test_second_program_of_same_person_is_told_apart() -> None:
    ours = LeaseMonitor("red", Sender("bot@laptop-17"))
    for holder in ("bot@laptop-17", "bot@laptop-18"):
        ours.on_safety(safety(holder))
    assert "laptop" not in ours.lost
    assert "another" in ours.lost
    theirs = LeaseMonitor("red", Sender("bot@laptop-17"))
    for holder in ("bot@laptop-17", "mia@laptop-17"):
        theirs.on_safety(safety(holder))
    assert theirs.lost == "red was taken by mia (person)"


def test_late_publication_of_old_state_is_no_news() -> None:
    ours, told = LeaseMonitor("red", Sender("bot")), [safety("mia"), safety("bot"), safety("mia")]
    for seq, message in enumerate(told, start=1):
        message.boot_id, message.seq = "a", seq
    before, had, taken = told
    ours.on_safety(had)  # the answer to our query
    ours.on_safety(before)
    assert not ours.lost
    ours.on_safety(taken)
    assert ours.lost.endswith("by mia (person)")
    again = safety("bob")
    again.boot_id, again.seq = "b", 1
    ours = LeaseMonitor("red", Sender("bot"))
    for message in (had, again):
        ours.on_safety(message)
    assert ours.lost.endswith("by bob (person)"), "a gateway that began anew counts anew"


def test_lease_monitor_is_lost_by_refused_command() -> None:
    ours = LeaseMonitor("red", Sender("bot"))
    ours.on_outcome(Outcome("red", ok=False, phase="rejected", reason="unsupported", words="no arm"))
    assert not ours.lost
    ours.on_outcome(Outcome("red", ok=False, phase="rejected", reason="leased", words="red is driven by mia"))
    assert ours.lost.endswith("by mia")


# ---------------------------------------------------------------- with real cars


@pytest.fixture
def fleet(cars: Cars) -> Iterator[Fleet]:
    with Fleet(cars.endpoint, sender="bot") as opened:
        yield opened


TAKEN = r"{} (was taken|is driven) by mia \(person\)"
"""Message of a published takeover, or of a rejected command meanwhile. Either may arrive first."""


PAUSED_S = 2.5
"""A pause longer than the timeout of one query."""


def holder(cars: Cars, car: str) -> str:
    found: str = cars.state("safety", car).lease.holder
    return found


def test_lease_block_drives_and_releases_car(fleet: Fleet, cars: Cars) -> None:
    with fleet.car("red").lease() as car:
        assert asked(lambda: car.drive("forward", 0.5)).basis in ("sent", "shown")
        assert holder(cars, "red") == "bot"
    assert holder(cars, "red") == ""


def test_lease_is_renewed_until_block_ends(fleet: Fleet, cars: Cars) -> None:
    with fleet.car("red").lease(), Fleet(cars.endpoint, sender="other") as other:
        for _ in range(4):
            with pytest.raises(TimeoutError):
                other.wait("red/state/safety", "not lease", timeout_s=1.0)
        with pytest.raises(LeaseLost, match="by bot") as error, other.car("red").lease():
            pass
        assert error.value.outcome.reason == "leased"


def test_lease_can_be_used_again_even_if_it_was_lost(fleet: Fleet, cars: Cars) -> None:
    lease = fleet.car("green").lease()
    with (
        Fleet(cars.endpoint, sender="mia", kind="person") as mia,
        lease as car,
        mia.car("green").lease(),
        pytest.raises(LeaseLost),
    ):
        go_on(car)
    with lease as car:
        assert car.light("red").ok
        assert holder(cars, "green") == "bot"
    assert holder(cars, "green") == ""


@pytest.mark.parametrize("error", [ZeroDivisionError, KeyboardInterrupt, SystemExit])
def test_lease_exit_by_exception_stops_car(fleet: Fleet, cars: Cars, error: type[BaseException]) -> None:
    def block() -> None:
        with fleet.car("blue").lease() as car:
            asked(lambda: car.drive("forward", LONG_S, wait=False))
            wait_for(lambda: driving(cars.sim, "blue"), "blue drives")
            raise error

    with pytest.raises(error):
        block()
    assert not driving(cars.sim, "blue")
    assert holder(cars, "blue") == ""
    assert not cars.state("safety", "blue").HasField("hold"), "a coordinator may go on"


def test_lease_exit_ends_mode(fleet: Fleet, cars: Cars) -> None:
    with fleet.car("red").lease() as car:
        car.mode("tracking")
        wait_for(lambda: cars.sim.say({"car": "red", "ask": "truth"})["mode"] == "tracking", "red tracks")
    # The gateway's limit covers the time in which the mode is deaf, not a stall of the car's process.
    wait_for(lambda: cars.sim.say({"car": "red", "ask": "truth"})["mode"] == "manual", "its mode has ended")
    assert not driving(cars.sim, "red")


def test_refused_command_raises_not_carried_out(fleet: Fleet, cars: Cars) -> None:
    with pytest.raises(NotCarriedOut, match=r"green: refused: .*allowed are white.* \[bad_value\]"):
        fleet.car("green").light("pink").check()
    with fleet.car("green").lease() as car, pytest.raises(NotCarriedOut, match="allowed are white") as error:
        car.light("pink")
    assert not isinstance(error.value, LeaseLost)
    with pytest.raises(NotCarriedOut, match=r'purple: .*"purple"'), fleet.car("purple").lease():
        pass


def test_lease_taken_by_person_is_lost(fleet: Fleet, cars: Cars) -> None:
    with Fleet(cars.endpoint, sender="mia", kind="person") as mia:

        def block() -> None:
            with fleet.car("red").lease() as car:
                asked(lambda: car.drive("spin_left", LONG_S, wait=False))
                wait_for(lambda: driving(cars.sim, "red"), "red drives")
                asked(lambda: mia.car("red").drive("forward", LONG_S, wait=False)).check()
                go_on(car)

        with pytest.raises(LeaseLost, match=TAKEN.format("red")):
            block()
        assert cars.state("motion").owner == "mia", "the end of the block stopped a car that was another's"
        mia.stop(["red"])
    fleet.resume(["red"])


def go_on(car: Car) -> None:
    """Send commands until one fails, because the lease is lost."""
    wait_for(lambda: not car.led(1, 2, 3).ok, "the lease is lost")


@pytest.mark.parametrize("late", ["nothing", "what is published", "what is asked for, too"])
def test_lease_lost_during_drive_names_person(fleet: Fleet, cars: Cars, late: str) -> None:
    """`late`: the publications of its gateway arrive too late, or the gateway also answers only after some seconds."""
    paused = threading.Timer(PAUSED_S, lambda: cars.gateways["blue"].popen.send_signal(signal.SIGCONT))

    with Fleet(cars.endpoint, sender="mia", kind="person") as mia:

        async def at_once() -> None:
            async with AsyncFleet(cars.endpoint, sender="eve") as other:
                leased = other.car("blue").lease()
                lease = leased._lease
                if late != "nothing":
                    setattr(lease, "_on_sample", lambda _: None)  # noqa: B010 - mypy lets nobody assign a method
                async with leased as car:
                    if late == "what is asked for, too":
                        setattr(lease, "_query", lambda look=lease._query: paused_look(look))  # noqa: B010 - likewise
                    await stopped(car)

        def paused_look(look: Callable[[], None]) -> None:
            freeze(cars.gateways["blue"].popen.pid)
            paused.start()
            look()

        async def stopped(car: AsyncCar) -> None:
            drive = asyncio.create_task(driven(car))
            await asyncio.to_thread(wait_for, lambda: drive.done() or driving(cars.sim, "blue"), "blue drives")
            await asyncio.to_thread(mia.stop, ["blue"])
            await drive

        async def driven(car: AsyncCar) -> None:
            while True:  # the gateway rejects a drive that is half a second old, see `asked`
                with pytest.raises(NotCarriedOut) as refused:
                    await car.drive("forward", LONG_S)
                if refused.value.outcome.reason != "stale":
                    raise refused.value

        with pytest.raises(LeaseLost, match="stopped by mia"):
            asyncio.run(at_once())
    if paused.ident is not None:
        paused.join()
    fleet.resume(["blue"])


def test_between_persons_only_who_takes_it_gets_it(cars: Cars) -> None:
    with (
        Fleet(cars.endpoint, sender="ann", kind="person") as ann,
        Fleet(cars.endpoint, sender="mia", kind="person") as mia,
    ):

        def block() -> None:
            with ann.car("green").lease() as car:
                with pytest.raises(LeaseLost, match="take the car"), mia.car("green").lease():
                    pass
                with mia.car("green").lease(take=True):
                    go_on(car)

        with pytest.raises(LeaseLost, match=TAKEN.format("green")):
            block()
        assert holder(cars, "green") == ""


async def test_lease_of_cancelled_task_stops_car(cars: Cars) -> None:
    async with AsyncFleet(cars.endpoint, sender="eve") as fleet:

        async def drive() -> None:
            async with fleet.car("blue").lease() as car:
                await car.drive("forward", LONG_S)

        task = asyncio.create_task(drive())
        await asyncio.to_thread(wait_for, lambda: driving(cars.sim, "blue"), "blue drives")
        task.cancel()
        with pytest.raises(asyncio.CancelledError):
            await task
        assert not await asyncio.to_thread(driving, cars.sim, "blue")


async def test_task_that_is_cancelled_while_lease_is_refused_stays_cancelled(cars: Cars) -> None:
    with Fleet(cars.endpoint, sender="ann", kind="person") as ann, ann.car("blue").lease():
        async with AsyncFleet(cars.endpoint, sender="eve") as fleet:

            async def drive() -> None:
                async with fleet.car("blue").lease():
                    pass

            task = asyncio.create_task(drive())
            await asyncio.sleep(0)
            task.cancel()
            with pytest.raises(asyncio.CancelledError):
                await task


async def test_wait_of_closed_fleet_raises_bus_error(cars: Cars) -> None:
    async with AsyncFleet(cars.endpoint, sender="eve") as fleet:
        waiting = asyncio.create_task(fleet.wait("red/state/safety", "motors == 'on'", timeout_s=60.0))
        await asyncio.sleep(0)
        await fleet.get("red/state/safety")  # as `wait` does before it waits
    with pytest.raises(BusError):
        await waiting


async def test_async_for_yields_readings_until_fleet_closes(cars: Cars) -> None:
    async with AsyncFleet(cars.endpoint, sender="eve") as fleet:
        async for reading in fleet.watch("*/state/safety", when="motors == 'off'"):
            assert (reading.car, reading["motors"], reading["hold.by"]) == (reading.key.split("/")[1], "off", None)
            break
        last = fleet.watch("red/state/safety")
    assert [reading async for reading in last] == []


def test_readings_by_field(cars: Cars, fleet: Fleet) -> None:
    (reading,) = fleet.get("red/sensor/range")
    assert reading["range_m"] is None or reading["range_m"] > 0
    with pytest.raises(KeyError, match=r"distance; .*range_m, no_echo"):
        reading["distance"]
    watch = fleet.watch("red")
    fleet.close()
    assert list(watch) == []


def test_import_fleet_loads_neither_zenoh_nor_asyncio(cars: Cars) -> None:
    looked = "import sys, fleet; print(sorted({'zenoh', 'google.protobuf', 'asyncio'} & set(sys.modules)))"
    process = cars.start("-c", looked)
    assert process.wait() == 0, process.stderr
    assert process.line() == []
    assert sys.modules["fleet"].Fleet is Fleet
