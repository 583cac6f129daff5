"""Faults of the running simulator's links, at the other end of a real pseudo terminal or socket."""

import asyncio
import socket
import time
from collections.abc import AsyncIterator
from pathlib import Path

import pytest
import serial

from gateway.sim.car_spec import parse_cars
from gateway.sim.endpoints import EndpointError
from gateway.sim.faults import Fault, FaultKind, Press
from gateway.sim.model.faulty_link import Direction, Flood
from gateway.sim.model.ir_remote import Button
from gateway.sim.simulation import Simulation
from tests.gateway.sim.strangers import PATIENCE, RUN, STOP, opening, until


@pytest.fixture
async def cars(tmp_path: Path) -> AsyncIterator[Simulation]:
    simulation = Simulation(
        parse_cars([f"red:arduino:pty:{tmp_path / 'red'}", "plain:arduino:pty", "green:arduino:tcp"]), seed=1
    )
    await simulation.start()
    yield simulation
    await simulation.stop()


def open_port(simulation: Simulation, name: str = "red", *, write_timeout: float = PATIENCE) -> serial.Serial:
    return serial.Serial(simulation.cars[name].url.removeprefix("serial://"), timeout=0, write_timeout=write_timeout)


def address(simulation: Simulation) -> tuple[str, int]:
    host, _, port = simulation.cars["green"].url.removeprefix("tcp://").rpartition(":")
    return host, int(port)


def driving(simulation: Simulation, name: str = "red") -> bool:
    return bool(simulation.cars[name].truth.driving)


async def test_stuck_pty_blocks_write_and_loses_nothing(cars: Simulation) -> None:
    with open_port(cars, write_timeout=0.2) as port:
        await cars.inflict(Fault(FaultKind.STUCK, "red"))
        with pytest.raises(serial.SerialTimeoutException):
            await asyncio.to_thread(port.write, RUN)
        data = bytearray()
        await until(lambda: data.extend(port.read(4096)) or b"CSB" in data, "its readings come all the same")
        assert not driving(cars)
        await cars.inflict(Fault(FaultKind.STUCK, "red", for_s=0))
        port.write_timeout = PATIENCE
        port.write(RUN)
        await until(lambda: driving(cars), "it hears again")
        await cars.inflict(Fault(FaultKind.STUCK, "red", for_s=0.05))
        await asyncio.to_thread(port.write, STOP)
        await until(lambda: not driving(cars), "what waited has arrived")


async def test_stuck_pty_stays_stuck_after_link_drop(cars: Simulation) -> None:
    await cars.inflict(Fault(FaultKind.STUCK, "red"))
    await cars.inflict(Fault(FaultKind.LINK_DROP, "red"))
    await cars.inflict(Fault(FaultKind.LINK_DROP, "red", for_s=0))
    with open_port(cars, write_timeout=0.2) as port, pytest.raises(serial.SerialTimeoutException):
        await asyncio.to_thread(port.write, RUN)


async def test_bytes_to_stuck_tcp_car_arrive_later(cars: Simulation) -> None:
    reader, writer = await asyncio.open_connection(*address(cars))
    car = cars.cars["green"]
    await cars.inflict(Fault(FaultKind.STUCK, "green"))
    writer.write(RUN)
    for _ in range(2):  # readings are a second apart
        await asyncio.wait_for(reader.readuntil(b"#"), PATIENCE)
    assert not driving(cars, "green")
    assert car.firmware.backlog(asyncio.get_running_loop().time()) == 0
    await cars.inflict(Fault(FaultKind.STUCK, "green", for_s=0))
    await until(lambda: driving(cars, "green"), "it arrives")
    writer.close()


async def test_deaf_car_drops_written_bytes(cars: Simulation) -> None:
    with open_port(cars) as port:
        await cars.inflict(Fault(FaultKind.DEAF, "red"))
        port.write(RUN)
        await until(lambda: cars.cars["red"].lost_bytes["car"] == len(RUN), "dropped")
        await cars.inflict(Fault(FaultKind.DEAF, "red", for_s=0))
        assert not driving(cars)
        port.write(RUN)
        await until(lambda: driving(cars), "it hears again")


async def test_mute_car_obeys_and_sends_nothing(cars: Simulation) -> None:
    with open_port(cars) as port:
        await cars.inflict(Fault(FaultKind.MUTE, "red"))
        while port.read(4096):  # until no byte is in transit, because a reset would not discard it
            pass
        port.write(opening(2))
        await until(lambda: cars.cars["red"].lost_bytes["host"] > 200, "it talks to nobody")
        assert cars.cars["red"].truth.mode == "tracking"
        assert port.read(4096) == b""
        await cars.inflict(Fault(FaultKind.MUTE, "red", for_s=0))
        data = bytearray()
        await until(lambda: data.extend(port.read(4096)) or len(data) > 100, "it is heard again")


async def test_echoing_car_returns_bytes_and_obeys(cars: Simulation) -> None:
    with open_port(cars) as port:
        await cars.inflict(Fault(FaultKind.ECHO, "red"))
        port.write(RUN)
        data = bytearray()
        await until(lambda: data.extend(port.read(4096)) or RUN in data, "an echo")
        await until(lambda: driving(cars), "it drives")


async def test_slow_link_delays_both_ways(cars: Simulation) -> None:
    with open_port(cars) as port:
        await cars.inflict(Fault(FaultKind.SLOW, "red", factor=0.1))
        begun = time.monotonic()
        port.write(RUN)
        await until(lambda: driving(cars), "it drives")
        assert time.monotonic() - begun >= len(RUN) / 96
        pieces: list[bytes] = []
        await until(lambda: pieces.append(port.read(4096)) or len(b"".join(pieces)) > 20, "a reading")
        await cars.inflict(Fault(FaultKind.SLOW, "red", for_s=0))


async def test_firehose_over_tcp_and_pty(cars: Simulation) -> None:
    reader, writer = await asyncio.open_connection(*address(cars))
    with open_port(cars) as port:
        # Read all the time, until enough bytes have arrived. Without a reader, a full terminal loses bytes.
        await cars.inflict(Fault(FaultKind.FIREHOSE, for_s=2 * PATIENCE, rate=1e6))
        await cars.inflict(Fault(FaultKind.FIREHOSE, "plain", for_s=0))
        over_tcp, over_pty = bytearray(), bytearray()
        begun = time.monotonic()
        while len(over_tcp) < 100_000 or len(over_pty) < 20_000:
            assert time.monotonic() < begun + PATIENCE
            over_pty += port.read(65536)
            over_tcp += await asyncio.wait_for(reader.read(65536), PATIENCE)
        assert len(set(over_pty)) == len(set(over_tcp)) == 256
    writer.close()


async def test_firehose_of_one_endless_frame(cars: Simulation) -> None:
    with open_port(cars, "plain") as port:
        await cars.inflict(Fault(FaultKind.FIREHOSE, "plain", for_s=2 * PATIENCE, rate=50_000, flood=Flood.FRAME))
        data = bytearray()
        await until(lambda: data.extend(port.read(65536)) or len(data) > 5_000, "zeros")
        _, begun, rest = bytes(data).partition(b"$4WD,CSB000")  # after a reading of the car, if one was due
        assert begun
        assert rest.count(b"0") > 4_000


async def test_lossy_link_to_car_keeps_readings_whole(cars: Simulation) -> None:
    with open_port(cars) as port:
        await cars.inflict(Fault(FaultKind.LOSSY, "red", share=0.5, ways=(Direction.TO_CAR,)))
        port.write(b"x" * 400)
        car = cars.cars["red"]
        await until(lambda: car.lost_bytes["car"] > 150, "lost")
        data = bytearray()
        await until(lambda: data.extend(port.read(4096)) or b"CSB" in data, "its readings are whole")
        assert car.lost_bytes["host"] == 0


async def test_cut_write_reaches_car_then_link_is_gone(cars: Simulation) -> None:
    """The car still has the half frame, and loses the stop after it (docs/reference/protocol.md#hazards)."""
    host, port = address(cars)
    reader, writer = await asyncio.open_connection(host, port)
    await cars.inflict(Fault(FaultKind.CUT_WRITE, "green", for_s=0.1, bytes=8))
    writer.write(RUN)
    with pytest.raises(ConnectionResetError):
        await asyncio.wait_for(_to_the_end(reader), PATIENCE)
    writer.close()

    async def again() -> asyncio.StreamWriter:
        end = time.monotonic() + PATIENCE
        while True:
            try:
                return (await asyncio.open_connection(host, port))[1]
            except ConnectionError:  # a reset: the connection was in the queue of a closed socket
                assert time.monotonic() < end
                await asyncio.sleep(0.01)

    writer = await again()
    assert not driving(cars, "green")
    writer.write(STOP)
    await until(lambda: driving(cars, "green"), "one string: the half frame's motion")
    writer.write(STOP)
    await until(lambda: not driving(cars, "green"), "the next stop, whole")
    writer.close()


async def _to_the_end(reader: asyncio.StreamReader) -> None:
    while await reader.read(4096):
        pass


async def test_cut_on_pty_is_unplugged_cable_once(cars: Simulation, tmp_path: Path) -> None:
    path = tmp_path / "red"
    with open_port(cars) as port:
        await cars.inflict(Fault(FaultKind.CUT_WRITE, "red", bytes=0))
        port.write(RUN)
        await until(lambda: not path.is_symlink(), "gone")
    await cars.inflict(Fault(FaultKind.LINK_DROP, "red", for_s=0))
    with open_port(cars) as port:
        port.write(RUN)
        await until(lambda: driving(cars), "whole")
        assert path.is_symlink()


async def test_rename_keeps_path_with_new_device(cars: Simulation, tmp_path: Path) -> None:
    path = tmp_path / "red"
    before = path.readlink()
    await cars.inflict(Fault(FaultKind.RENAME, "red", for_s=0.05))
    assert not path.is_symlink()
    await until(path.is_symlink, "back")
    assert path.readlink() != before
    with open_port(cars) as port:
        port.write(RUN)
        await until(lambda: driving(cars), "it is the same car")


async def test_rename_to_other_path(cars: Simulation, tmp_path: Path) -> None:
    named: list[str] = []
    cars.cars["red"].on_renamed = lambda car: named.append(car.url)
    await cars.inflict(Fault(FaultKind.RENAME, "red", for_s=0.05, path=str(tmp_path / "other")))
    await until(lambda: named, "back")
    assert named == [f"serial://{tmp_path / 'other'}"]
    assert not (tmp_path / "red").is_symlink()
    with open_port(cars) as port:
        port.write(RUN)
        await until(lambda: driving(cars), "it is the same car")
    await cars.stop()
    assert not (tmp_path / "other").is_symlink()


async def test_renamed_pty_and_tcp_car_tell_where_they_are(cars: Simulation) -> None:
    before = {name: cars.cars[name].url for name in ("plain", "green")}
    named: dict[str, str] = {}
    for name in before:
        cars.cars[name].on_renamed = lambda car: named.__setitem__(car.spec.name, car.url)
        await cars.inflict(Fault(FaultKind.RENAME, name, for_s=0.0))
    await until(lambda: len(named) == 2, "back")
    assert all(named[name] == cars.cars[name].url != before[name] for name in before)
    socket.create_connection(address(cars)).close()
    open_port(cars, "plain").close()


async def test_taken_or_missing_path_is_refused(cars: Simulation, tmp_path: Path) -> None:
    (tmp_path / "file").write_text("precious")
    for path, words in ((tmp_path / "file", "is there already"), (tmp_path / "no" / "x", "directory is not there")):
        with pytest.raises(EndpointError, match=words):
            await cars.inflict(Fault(FaultKind.RENAME, "red", for_s=0.0, path=str(path)))
    assert (tmp_path / "file").read_text() == "precious"
    assert (tmp_path / "red").is_symlink()
    open_port(cars).close()


async def test_path_taken_during_outage_is_told(cars: Simulation, tmp_path: Path) -> None:
    told: list[str] = []
    cars.cars["red"].on_failed = lambda _, error: told.append(str(error))
    await cars.inflict(Fault(FaultKind.LINK_DROP, "red", for_s=0.2))
    (tmp_path / "red").write_text("precious")
    await until(lambda: told, "told")
    assert "is there already" in told[0]


async def test_ir_remote_drives_running_car_and_truth_tells(cars: Simulation) -> None:
    car = cars.cars["red"]
    seen: list[tuple[int, int]] = []
    car.watchers.append(lambda changed: seen.append((changed.truth.motor_left, changed.truth.motor_right)))
    assert cars.press(Press(Button.FORWARD)) == []
    with open_port(cars) as port:
        port.write(opening(1))
        await until(lambda: car.truth.mode == "remote_control", "it listens to the remote")
        assert cars.press(Press(Button.SPIN_LEFT)) == ["red"]
        await until(lambda: (-150, 150) in seen, "it spins")
        port.write(STOP)
        assert cars.press(Press(Button.STOP, "red")) == ["red"]
        await until(lambda: not driving(cars), "it stands")
