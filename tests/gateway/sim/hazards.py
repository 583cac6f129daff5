"""Every row of the two hazards tables of docs/reference/protocol.md as a scenario, for virtual time and real links."""

from collections.abc import Awaitable, Callable
from dataclasses import dataclass

from gateway.sim.model.world import World
from tests.gateway.sim.strangers import (
    BACK,
    FAN,
    MODE00,
    PTZ90,
    RUN,
    STOP,
    Stranger,
    opening,
    opening_s,
)


@dataclass(frozen=True)
class Hazard:
    row: str
    play: Callable[[Stranger], Awaitable[None]]
    platform: str = "arduino"
    tcp: bool = False
    echo: bool = True

    def world(self) -> World:
        return World.room() if self.echo else World.open_field()

    def __str__(self) -> str:
        return f"{self.platform}{'-tcp' if self.tcp else ''}: {self.row}"


HAZARDS: list[Hazard] = []


Play = Callable[[Stranger], Awaitable[None]]


def hazard(row: str, *, platform: str = "arduino", tcp: bool = False, echo: bool = True) -> Callable[[Play], Play]:
    def keep(play: Play) -> Play:
        HAZARDS.append(Hazard(row, play, platform, tcp, echo))
        return play

    return keep


async def drive(car: Stranger) -> None:
    await car.write(RUN)
    await car.until(lambda truth: truth.driving)


async def block(car: Stranger) -> None:
    """Block the car for 0.65 s, with its motors unchanged."""
    await car.write(PTZ90)
    await car.until(lambda truth: truth.blocked)


async def awake(car: Stranger) -> None:
    await car.until(lambda truth: not truth.blocked)


# The Arduino program.


@hazard("one frame while it is blocked")
async def one_frame(car: Stranger) -> None:
    await block(car)
    await car.write(RUN)
    await car.wait(0.1)
    assert car.truth.blocked
    assert not car.truth.driving
    await awake(car)
    assert car.truth.driving


@hazard("two frames while it is blocked, the second a stop")
async def two_frames(car: Stranger) -> None:
    await block(car)
    await car.write(RUN)
    await car.write(STOP)
    await awake(car)
    await car.wait(0.5)
    assert car.truth.driving


@hazard("two frames in a ranging without an echo, the second cut by its end", echo=False)
async def cut_by_the_end(car: Stranger) -> None:
    await awake(car)
    await car.until(lambda truth: truth.blocked)
    await car.write(PTZ90 + b"$4WD,PTZ1")
    await car.wait(1.1)
    assert not car.truth.driving
    await car.write(b"61#")
    await car.until(lambda truth: truth.driving)


@hazard("a run, 60 ms, a stop, while the ranging gets no echo", echo=False)
async def no_echo(car: Stranger) -> None:
    await awake(car)
    await car.until(lambda truth: truth.blocked)
    await car.write(RUN)
    await car.wait(0.06)
    await car.write(STOP)
    await car.wait(0.05)
    assert car.truth.blocked
    await awake(car)
    await car.wait(0.3)
    assert car.truth.driving


@hazard("stop, then MODE00, both while blocked")
async def stop_then_mode(car: Stranger) -> None:
    await drive(car)
    await block(car)
    await car.write(STOP)
    await car.write(MODE00)
    await car.wait(0.7 + opening_s(0) + 0.2)
    assert car.truth.driving
    assert car.truth.mode == "manual"


@hazard("MODE00, then stop, both while blocked")
async def mode_then_stop(car: Stranger) -> None:
    await drive(car)
    await block(car)
    await car.write(MODE00)
    await car.write(STOP)
    await car.until(lambda truth: not truth.driving, within=0.7)
    await car.wait(1.5)
    assert not car.truth.driving


def _closes(mode: int) -> None:
    @hazard(f"MODE00 alone, in any mode ({mode})")
    async def closes(car: Stranger) -> None:
        await drive(car)
        await car.write(opening(mode))
        await car.wait(opening_s(mode) + 0.3)
        await car.write(MODE00)
        await car.until(lambda truth: not truth.driving and truth.mode == "manual", within=4.4)
        assert car.truth.blocked  # the beep. test_firmware.py measures its second.
        await awake(car)
        assert not car.truth.driving


for _mode in range(1, 7):
    _closes(_mode)


@hazard("a general stop in a mode other than 0")
async def stop_in_mode(car: Stranger) -> None:
    await drive(car)
    await car.write(opening(1))
    await car.until(lambda truth: truth.mode == "remote_control")
    await awake(car)
    await car.write(STOP)
    await car.wait(0.5)
    assert car.truth.driving


def _blind(mode: int, name: str) -> None:
    @hazard(f"a mode opened while driving ({name}: for ever)")
    async def blind(car: Stranger) -> None:
        await drive(car)
        before = car.truth
        await car.write(opening(mode))
        await car.until(lambda truth: truth.mode == name)
        for _ in range(5):
            await car.wait(1.0)
            now = car.truth
            assert (now.motor_left, now.motor_right) == (before.motor_left, before.motor_right)


_blind(1, "remote_control")
_blind(4, "color_led")


@hazard("a mode opened while driving (tracking: while it opens)")
async def blind_opening(car: Stranger) -> None:
    await car.write(BACK)
    await car.until(lambda truth: truth.driving)
    await car.write(opening(2))
    await car.until(lambda truth: truth.mode == "tracking")
    await car.wait(opening_s(2) - 1.2)
    assert (car.truth.motor_left, car.truth.motor_right) == (-150, -150)


@hazard("a named frame it does not know: wedged")
async def wedged(car: Stranger) -> None:
    await drive(car)
    await car.write(b"$4WD,ServoJ190,J290,J390,J490,J590,J690#")
    await car.wait(0.1)
    await car.write(STOP)
    await car.wait(0.3)
    await car.write(STOP)
    await car.wait(0.3)
    assert car.truth.driving
    await car.write(MODE00)  # the car reads the digits at a wrong place, so the frame closes no mode
    await car.wait(1.5)
    assert car.truth.driving
    await car.wait(1.0)  # but the frame has cleared the buffer
    await drive(car)
    await car.write(STOP)
    await car.until(lambda truth: not truth.driving)


@hazard("half of a named frame: wedged")
async def half_named(car: Stranger) -> None:
    await drive(car)
    await car.write(b"$4WD,CLR2")
    await car.wait(0.1)
    await car.write(STOP)
    await car.wait(0.3)
    await car.write(STOP)
    await car.wait(0.3)
    assert car.truth.driving


@hazard("half of a named frame, then a MODE frame: it can OPEN mode 4")
async def half_named_mode(car: Stranger) -> None:
    await drive(car)
    await car.write(b"$4WD,PTZ")
    await car.wait(0.1)
    await car.write(MODE00)
    await car.until(lambda truth: truth.mode == "color_led")
    assert car.truth.driving


@hazard("half a general frame, then a stop")
async def half_then_stop(car: Stranger) -> None:
    await car.write(b"$1,0,0,0,0")
    await car.wait(0.1)
    await car.write(STOP)
    await car.wait(0.3)
    assert car.truth.driving


@hazard("half a general frame, then MODE00: it opens mode 4 behind 8 bytes")
async def half_then_mode(car: Stranger) -> None:
    await drive(car)
    await car.write(b"$1,0,0,0")
    await car.wait(0.1)
    await car.write(MODE00)
    await car.until(lambda truth: truth.mode == "color_led")
    await car.wait(1.0)
    assert car.truth.driving


@hazard("half a general frame, then MODE00: it opens mode 0 behind other halves")
async def half_then_mode_0(car: Stranger) -> None:
    await drive(car)
    await car.write(b"$1,0,0,0,0")
    await car.wait(0.1)
    await car.write(MODE00)
    await car.wait(1.5)
    assert car.truth.blocked
    await awake(car)
    assert car.truth.driving
    assert car.truth.mode == "manual"


def _digitless(frame: bytes) -> None:
    @hazard(f"a MODE frame that lost one digit or both ({frame.decode()})")
    async def digitless(car: Stranger) -> None:
        await drive(car)
        await car.write(frame)
        await car.wait(1.8)
        assert car.truth.blocked
        await awake(car)
        assert car.truth.driving
        assert car.truth.mode == "manual"


for _frame in (b"$4WD,MODE0#", b"$4WD,MODE#"):
    _digitless(_frame)


@hazard("a lone # ends a half frame, whose motion is then obeyed")
async def lone_hash_half(car: Stranger) -> None:
    await car.write(b"$1,0,0,0,0")
    await car.wait(0.3)
    assert not car.truth.driving
    await car.write(b"#")
    await car.until(lambda truth: truth.driving)


@hazard("a lone # with nothing pending acts as a stop in mode 0")
async def lone_hash(car: Stranger) -> None:
    await drive(car)
    await car.write(b"#")
    await car.until(lambda truth: not truth.driving)


@hazard("half a frame, #, 50 ms, MODE00, all while blocked")
async def half_hash_mode(car: Stranger) -> None:
    await drive(car)
    await block(car)
    await car.write(b"$1,0,0,0,0,0")
    await car.write(b"#")
    await car.wait(0.05)
    await car.write(MODE00)
    await car.wait(0.7 + opening_s(0) + 0.2)
    assert car.truth.mode == "manual"
    assert car.truth.driving


@hazard("the fan on: obeys motion, but sends no readings until it is off again")
async def fan(car: Stranger) -> None:
    await car.write(b"$1,0,0,0,0,0,0,1,0#")
    await car.until(lambda truth: truth.fan and truth.driving)
    await car.write(STOP)
    await car.until(lambda truth: not truth.driving)
    await car.wait(0.2)
    car.received.clear()
    await car.wait(2.5)
    assert not car.received
    await car.write(FAN)
    await car.until(lambda truth: not truth.fan)
    await car.until_received(40)


# The Raspberry Pi programs.


@hazard("a MODE frame: nothing", platform="raspberry_pi", tcp=True)
@hazard("a MODE frame: nothing", platform="raspberry_pi")
async def pi_mode(car: Stranger) -> None:
    await drive(car)
    await car.write(MODE00)
    await car.wait(0.3)
    await car.write(opening(2))
    await car.wait(0.3)
    assert car.truth.driving
    assert car.truth.mode == "manual"
    await car.write(STOP)
    await car.until(lambda truth: not truth.driving)


@hazard("over TCP, a frame cut over two receives is ignored whole", platform="raspberry_pi", tcp=True)
async def pi_cut(car: Stranger) -> None:
    await drive(car)
    await car.write(STOP[:9])
    await car.wait(0.5)
    await car.write(STOP[9:])
    await car.wait(0.3)
    assert car.truth.driving


@hazard("over TCP, a write not beginning with $ is ignored whole", platform="raspberry_pi", tcp=True)
async def pi_hash_stop(car: Stranger) -> None:
    await drive(car)
    await car.write(b"#" + STOP)
    await car.wait(0.3)
    assert car.truth.driving


@hazard("over TCP, two frames in one receive: only the first", platform="raspberry_pi", tcp=True)
async def pi_two(car: Stranger) -> None:
    await car.write(RUN + STOP)
    await car.until(lambda truth: truth.driving)
    await car.wait(0.5)
    assert car.truth.driving


@hazard("over TCP, two frames while the fan blocks it: only the first", platform="raspberry_pi", tcp=True)
async def pi_fan(car: Stranger) -> None:
    await car.write(FAN)
    await car.until(lambda truth: truth.blocked)
    await car.write(RUN)
    await car.wait(0.06)
    await car.write(STOP)
    await car.wait(0.1)
    assert car.truth.blocked
    await awake(car)
    await car.wait(0.3)
    assert car.truth.driving


@hazard("over Bluetooth, several frames while it is blocked: only the LAST", platform="raspberry_pi")
async def pi_last(car: Stranger) -> None:
    await car.write(FAN)
    await car.until(lambda truth: truth.blocked)
    for frame in (RUN, STOP, BACK):
        await car.write(frame)
    await awake(car)
    await car.wait(0.1)
    assert car.truth.motor_left < 0
    await car.write(FAN)
    await car.until(lambda truth: truth.blocked)
    await car.write(RUN)
    await car.write(STOP)
    await car.until(lambda truth: not truth.driving)


@hazard("a short frame kills the program", platform="raspberry_pi", tcp=True)
async def pi_short(car: Stranger) -> None:
    await drive(car)
    await car.write(b"$0,0,0#")
    await car.until(lambda truth: not truth.alive)
    assert car.truth.driving
    assert await car.refused()
    await car.wait(2.0)
    assert car.truth.driving


@hazard("over Bluetooth a half frame ended by a lone # kills the program", platform="raspberry_pi")
async def pi_lone_hash(car: Stranger) -> None:
    await drive(car)
    await car.write(b"#")  # without a pending frame, a # has no effect
    await car.wait(0.2)
    assert car.truth.alive
    assert car.truth.driving
    await car.write(b"$0,0,0")
    await car.wait(0.2)
    await car.write(b"#")
    await car.until(lambda truth: not truth.alive)
    await car.write(STOP)
    await car.wait(0.5)
    assert car.truth.driving


@hazard("the TCP client goes away", platform="raspberry_pi", tcp=True)
async def pi_hang_up(car: Stranger) -> None:
    await drive(car)
    await car.hang_up()
    await car.until(lambda truth: not truth.alive, within=1.3)
    assert await car.refused()
    await car.wait(0.5)
    assert car.truth.driving


@hazard("light 1 cycles; lights 5..8 are not known", platform="raspberry_pi", tcp=True)
@hazard("light 1 cycles; lights 5..8 are not known", platform="raspberry_pi")
async def pi_light(car: Stranger) -> None:
    seen = []
    for _ in range(9):
        before = car.truth.led
        await car.write(b"$0,0,0,0,0,0,1,0,0#")
        await car.until(lambda truth, before=before: truth.led != before)
        seen.append(car.truth.led)
        await car.wait(0.1)
    assert len(set(seen[:7]) - {"off"}) == 7
    assert seen[7] == "off"
    assert seen[8] == seen[0]
    for digit in b"5678":
        await car.write(b"$0,0,0,0,0,0,%c,0,0#" % digit)
        await car.wait(0.1)
    assert car.truth.led == seen[0]


# From "Consequences", without a row in the table: the car has no dead-man timer.


@hazard("no dead-man")
@hazard("no dead-man", platform="raspberry_pi", tcp=True)
async def no_dead_man(car: Stranger) -> None:
    await drive(car)
    await car.wait(5.0)
    assert car.truth.driving
