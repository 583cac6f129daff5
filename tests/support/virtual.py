"""One gateway's control and one simulated car on virtual time, joined by a link without delay.

Control checks silence as often as in a gateway. Bytes, deadlines and events of the car wake the loop when they are due.
"""

import random
from collections.abc import Callable
from itertools import pairwise

from gateway.control.commands import Action, Answer, Command
from gateway.control.control_output import CommandRecord, LogRecord
from gateway.control.driver import TICK_S
from gateway.drivers.yahboom.protocol.frame_splitter import FrameSplitter
from gateway.drivers.yahboom.protocol.platforms import parse_platform
from gateway.sim.model.factory import build
from gateway.sim.model.firmware_base import Firmware
from gateway.sim.model.raspberry_pi import RaspberryPiCar, Transport
from gateway.sim.model.traits import CarTraits
from gateway.sim.model.world import World
from schemas.rights import Sender
from schemas.words import Level, Phase, Reason
from tests.support.controls import control

SHORTEST_S = 1e-6
"""Minimum step of time."""


class Pair:
    """A controller, its decoder, and the car at the other end of the wire."""

    def __init__(
        self,
        platform: str = "arduino",
        *,
        seed: int = 1,
        world: World | None = None,
        told: str | None = None,
        transport: Transport = Transport.SERIAL,
        start_s: float = 0.0,
        name: str = "red",
        traits: CarTraits | None = None,
    ) -> None:
        self.now = 0.0
        built_as, *options = platform.split("+")  # such as arduino+arm
        self.car: Firmware = build(
            built_as,
            world or World.room(),
            0,
            random.Random(seed),
            options=frozenset(options),
            transport=transport,
            name=name,
            traits=traits,
        )
        self.transport = transport
        self.control = control(parse_platform(told or platform), name=name)
        self.decoder = FrameSplitter()
        self.sent: list[tuple[float, bytes]] = []
        self.records: list[CommandRecord] = []
        self.logs: list[LogRecord] = []
        self.shown_at: list[float] = []
        """Times at which the car's readings showed control that the car stands."""
        self.number = 0
        self.cut: int | None = None
        """Number of bytes of the next write that arrive before the link breaks. None: all, and the link stays."""
        self.deaf_until = 0.0
        """Time until which the car's readings are lost."""
        self._next_tick = 0.0
        self._control_at = 0.0
        """Time of control's next poll. News may make it earlier, but not later, as in the gateway."""
        self._touched = False
        """True if control got news since `_control_at` was computed."""
        self._awake = 0
        """Number of consecutive turns of the loop without a sleep."""
        self.run(start_s, linked=False)

    def connect(self) -> None:
        """Open the link, so that recovery begins."""
        if isinstance(self.car, RaspberryPiCar):
            self.car.connected(self.now)
        self.decoder = FrameSplitter()
        self.control.link_up(self.now)

    def lose(self, reason: str = "unplugged") -> None:
        """Cut the link. All bytes in transit are lost."""
        self.car.drop_link(self.now)
        self.control.driver.link_down(reason, self.now)
        self._take()

    def ready(self) -> "Pair":
        """Connect, and wait until recovery is complete and a reading has arrived."""
        self.connect()
        self.until(
            lambda: self.control.driver.model.known and self.control.driver.model.mode.inferred is not None, 30.0
        )
        return self

    def ask(
        self,
        what: Action,
        *,
        verb: str = "test",
        sender: Sender | None = None,
        identity: str = "",
        streamed: bool = False,
    ) -> Answer:
        """Send a command, and write the frames that control has due."""
        self.number += 1
        command = Command(identity or f"c{self.number}", verb, sender or Sender(), what, streamed=streamed)
        answer = self.control.command(command, self.now)
        self._pump()
        return answer

    def run(self, seconds: float, *, linked: bool = True) -> None:
        """Let time pass."""
        end = self.now + seconds
        self._touched = True  # the test may have called control
        while self.now < end - 1e-9:
            self.turn(end, linked=linked)

    def until(self, condition: Callable[..., bool], seconds: float) -> float:
        """Let time pass until a condition holds. Return the time that passed. Fail after `seconds`."""
        began = self.now
        end = began + seconds
        self._touched = True
        while not condition():
            assert self.now < end - 1e-9, f"not within {seconds} s: {self.sent[-6:]}"
            self.turn(end)
        return self.now - began

    def turn(self, end: float, *, linked: bool = True) -> None:
        """Go to the next event, at `end` at the latest."""
        wake = min(end, self.car.next_event())
        if linked:
            deadline = self.decoder.deadline()
            silence = float("inf") if deadline is None else deadline
            wake = min(wake, self._next_tick, silence, self._wanted_at())
        self._awake = self._awake + 1 if wake < self.now + SHORTEST_S else 0
        assert self._awake < 100, "a loop that never sleeps"
        self.now = min(end, max(self.now + SHORTEST_S, wake))
        self._receive(linked=linked)
        if linked and self._wanted_at() <= self.now:
            self._pump()
        self._take()

    def off_for_good_at(self) -> float:
        """Return the time at which the motors went off for good, by the run until now."""
        time, left, right = self.car.motor_log[-1]
        assert (left, right) == (0, 0), f"the motors are on since {time}: {self.sent[-6:]}"
        return time

    def driven_since(self, begin: float) -> float:
        """Return for how many seconds the motors were on after a time, by the run until now."""
        changes = [*self.car.motor_log, (self.now, 0, 0)]
        on = [(at, until) for (at, left, right), (until, *_) in pairwise(changes) if left or right]
        return sum(max(0.0, until - max(at, begin)) for at, until in on)

    def phases(self, identity: str) -> list[Phase]:
        """Return the phases of one command."""
        return [record.phase for record in self.records if record.command.id == identity]

    def lose_frames(self) -> None:
        """Lose all frames to the car from now on. Its readings still arrive."""
        self.car.feed = lambda data, now: None  # type: ignore[method-assign]  # the car's end of the wire, cut

    def pass_frames(self) -> None:
        """End `lose_frames`."""
        del self.car.__dict__["feed"]

    def last_of(self, identity: str) -> CommandRecord | None:
        """Return the record that ends a stop (shown, sent or failed), None while the stop goes on."""
        begun = (Phase.ASKED, Phase.QUEUED, Phase.SENT)
        life = (record for record in self.records if record.command.id == identity)
        return next((record for record in life if record.phase not in begun or record.basis), None)

    def shown_since(self, since: float) -> float | None:
        """Return the time after `since` at which the car first showed that it stands, None if it did not."""
        return next((at for at in self.shown_at if at > since), None)

    def _wanted_at(self) -> float:
        """Return when control is to be polled."""
        # Most turns are the car's own, without news for control. Polling in each turn took a third of a run.
        if self._touched:
            self._touched = False
            self._control_at = min(self._control_at, self.control.driver.next_at(self.now))
        return self._control_at

    def _receive(self, *, linked: bool) -> None:
        for at, data in self.car.advance(self.now):
            if linked and at >= self.deaf_until:
                for event in self.decoder.feed(data, at):
                    self._touched = True
                    self.control.driver.on_event(event, self.now)
                    self.decoder.use_head(self.control.driver.model.profile.dialect.head)
        if linked:
            for event in self.decoder.flush(self.now):
                self._touched = True
                self.control.driver.on_event(event, self.now)
            self.tick()

    def tick(self) -> None:
        """Let control check silence, if it is time."""
        if self.now >= self._next_tick:
            self._next_tick = self.now + TICK_S
            self._touched = True
            self.control.tick(self.now)

    def _pump(self) -> None:
        self._touched, self._control_at = True, float("inf")
        while (write := self.control.driver.poll(self.now)) is not None:
            if self.cut is not None:
                self.car.feed(write.data[: self.cut], self.now)
                self.cut = None
                self.control.driver.link_down("the write was cut", self.now, cause=Reason.WRITE_FAILED)
                break
            self.sent.append((self.now, write.data))
            self.car.feed(write.data, self.now)
            self.control.driver.on_written(write, self.now)
            self.decoder.sends(write.data, self.now)
        self._take()

    def _take(self) -> None:
        shown_at = self.control.driver.model.trust.shown_at
        if shown_at is not None and shown_at not in self.shown_at[-1:]:
            self.shown_at.append(shown_at)
        for record in self.control.take_records():
            if isinstance(record, CommandRecord):
                self.records.append(record)
            elif record.level is not Level.DEBUG:
                self.logs.append(record)
