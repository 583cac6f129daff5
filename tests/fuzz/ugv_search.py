"""Searches for what is dangerous with a car of the second family: random cars, links, people and accidents.

Virtual time; the true state of the simulated car is the judge. `play(seed)` returns what it found.
"""

import json
import math
import random
from collections.abc import Mapping
from dataclasses import dataclass, field

from gateway import drivers
from gateway.control.commands import Action, ChangeSpeed, Command, Drive, EmergencyStop, Find, Resume, SetLight, Stop
from gateway.control.control_output import CommandRecord, LogRecord
from gateway.control.controller import Controller
from gateway.control.driver import TICK_S, Driver, Fields
from gateway.drivers.waveshare.driver import ALLOWED, DRIVE, PWM
from gateway.sim.car_options import UGV_OPTIONS
from gateway.sim.model.factory import build_ugv
from gateway.sim.model.ir_remote import Button
from gateway.sim.model.ugv import LOOP_S, PAGE_OPEN_S, UGV_BUILDS, UGV_DEAD_MAN_S, WIFI_S
from gateway.sim.model.world import World
from schemas.rights import Sender
from schemas.words import Basis, Light, Motion, Motors, Phase, Rank, Reason, SpeedStep

STEP_S = 0.005
BRAKE_S = 0.5
"""Time in which the wheels stand after their power is off, with a turn of the speed loop."""
SETTLED_S = 9.0
"""Time without an accident after which a car is set up: a boot of 2 s, the silence after it, the stop, the set-up."""
IN_A_ROW_S = 0.3
"""Maximum motion with the wrong chassis: a line that was under way when the car restarted, and the stop behind it."""
OTHERS = (
    '{"T":11,"L":200,"R":2',  # cut in "R":-200: it spins
    '{"T":404,"ap_ssid":"UGV"',
    '{"T":242,"name":"dance","interval":10}',
    '{"T":4,"cmd":1}',
    '{"T":143,"cmd":0}',
)
"""What other programs send to its web interface."""
ANN = Sender("ann@desk", Rank.PERSON)


@dataclass
class UgvEpisode:
    """One car and its gateway. `faults` has what must not happen."""

    seed: int
    car_platform: str = ""
    told: str = ""
    frozen_options: frozenset[str] | None = None
    """The options of the car; None: random."""
    faults: list[str] = field(default_factory=list)
    sent: list[tuple[float, bytes]] = field(default_factory=list)
    records: list[CommandRecord] = field(default_factory=list)
    logs: list[LogRecord] = field(default_factory=list)
    shown: int = 0
    drives: int = 0

    def __post_init__(self) -> None:
        self.moments = random.Random(self.seed)
        moments = self.moments
        self.car_platform = self.car_platform or moments.choice(list(UGV_BUILDS))
        self.told = self.told or self.car_platform
        options = {each for each in UGV_OPTIONS if moments.random() < 0.12}
        self.options = frozenset(options) if self.frozen_options is None else self.frozen_options
        self.car = build_ugv(self.car_platform, World.room(), 0, moments, options=self.options)
        self.control: Controller[Driver] = Controller("red", drivers.driver_of(self.told, {}))
        self.now = 0.0
        self.linked = False
        self.loss = 0.0
        self.was_deaf = "quiet" in self.options
        """True if nothing tells the gateway which of its lines arrive, or if the car restarts unseen."""
        self.delay_s = moments.choice((0.0, 0.0, 0.02, 0.15))
        self.to_car: list[tuple[float, bytes]] = []
        self.to_host: list[tuple[float, bytes]] = []
        self.calm_since = 0.0
        self.busy_until = 0.0
        """When a search for Wi-Fi is over, and what another program let it do."""
        self.page_until = float("-inf")
        self.page_closed_at = float("-inf")
        """When the page of the car is closed. Until then, its questions look like a stream of feedback."""
        self.cut_at: float | None = None
        self.stop_due: float | None = None
        self.ids = 0
        self._tick_at = 0.0
        self._moved_at: float | None = None
        self._unfounded_since: float | None = None

    # ------------------------------------------------------------------ time

    def run(self, seconds: float) -> None:
        """Let time pass, and judge each moment."""
        end = self.now + seconds
        while self.now < end and not self.faults:
            self._turn()
            self._judge()
            self.now = round(self.now + STEP_S, 4)

    def _turn(self) -> None:
        driver = self.control.driver
        for _, data in self.car.advance(self.now):
            if self.linked and not self._is_lost():
                self.to_host.append((self.now + self.delay_s, data))
        while self.to_host and self.to_host[0][0] <= self.now:
            for event in driver.feed(self.to_host.pop(0)[1], self.now):
                self._check_measured(driver.measured(event))
                self.control.driver.on_event(event, self.now)
        if self.now >= self._tick_at:
            self._tick_at = self.now + TICK_S
            self.control.tick(self.now)
        # `poll` may end a stop and return None. What it wants at once after that, it writes at the next call.
        while self.linked and (write := driver.poll(self.now) or driver.poll(self.now)) is not None:
            driver.sends(write.data, self.now)
            self.control.driver.on_written(write, self.now)
            self.sent.append((self.now, write.data))
            self._check_line(write.data)
            if not self._is_lost():
                self.to_car.append((self.now + self.delay_s, write.data))
        if self.linked and driver.next_at(self.now) <= self.now:
            self.faults.append(f"{self.now:.2f} s: the loop never sleeps")
        while self.to_car and self.to_car[0][0] <= self.now:
            self.car.feed(self.to_car.pop(0)[1], self.now)
        self._take_records()

    def _take_records(self) -> None:
        for each in self.control.take_records():
            if isinstance(each, CommandRecord):
                self.records.append(each)
            else:
                self.logs.append(each)

    def _is_lost(self) -> bool:
        return self.loss > 0 and self.moments.random() < self.loss

    def _check_measured(self, topics: Mapping[str, Fields]) -> None:
        attitude = topics.get("sensor/attitude")
        if attitude is not None and abs(attitude["yaw_rad"]) > math.pi:
            self.faults.append(f"{self.now:.2f} publishes a number of its arm as an angle")

    def _check_line(self, data: bytes) -> None:
        for text in data.strip().split(b"\n"):
            found = json.loads(text)
            kind = found["T"]
            if kind not in ALLOWED or (kind == PWM and (found["L"], found["R"]) != (0, 0)):
                self.faults.append(f"{self.now:.2f} sent {text!r}")
            if kind == DRIVE and max(abs(found["L"]), abs(found["R"])) > 0.5:
                self.faults.append(f"{self.now:.2f} too fast: {text!r}")

    # ------------------------------------------------------------------ the judge

    @property
    def is_alone(self) -> bool:
        """Return True if nothing but the gateway moves the car: no web page, no mission."""
        return self.now > self.page_until and "mission" not in self.options

    @property
    def _calm_from(self) -> float:
        return max(self.calm_since, self.busy_until)

    def _judge(self) -> None:
        car, model, now = self.car, self.control.driver.model, self.now
        if car.runaway_since is not None and now > car.runaway_since + 2 * LOOP_S:
            self.faults.append(f"{now:.2f} in motion without a dead-man")
        wrong_since = car.wrong_since
        if wrong_since is not None and not self.was_deaf and now > wrong_since + IN_A_ROW_S:
            self.faults.append(f"{now:.2f} driven before it was told its chassis")
        claimed = model.motors is Motors.OFF and model.basis is Basis.SHOWN
        unfounded = claimed and car.moving and self.is_alone
        self._unfounded_since = (self._unfounded_since or now) if unfounded else None
        if self._unfounded_since is not None and now > self._unfounded_since + 0.05:
            self.faults.append(f"{now:.2f} claims that it stands, by its readings, and it moves")
        if self.cut_at is not None and self.is_alone and car.truth.driving and now > self.cut_at + UGV_DEAD_MAN_S + 1.0:
            self.faults.append(f"{now:.2f} drives {now - self.cut_at:.1f} s after its link was cut")
        if self.stop_due is not None and now > self.stop_due:
            self.stop_due = None
            if car.moving and self.is_alone:
                self.faults.append(f"{now:.2f} moves after the announced worst case of its stop")

    # ------------------------------------------------------------------ what happens

    def connect(self) -> None:
        """Open the link."""
        self.linked, self.cut_at = True, None
        self.calm_since = self.now
        self.control.link_up(self.now)

    def cut(self) -> None:
        """Cut the link."""
        self.linked, self.stop_due, self.cut_at = False, None, self.now
        self.car.drop_link(self.now)
        self.to_car.clear()
        self.to_host.clear()
        self.control.driver.link_down("unplugged", self.now)

    def ask(self, what: Action) -> Phase:
        """Give a command as a person."""
        self.ids += 1
        answer = self.control.command(Command(f"c{self.ids}", "any", ANN, what), self.now)
        self._take_records()
        is_calm = not self.loss and self.linked and self.now > self._calm_from + SETTLED_S
        if isinstance(what, Stop | EmergencyStop) and is_calm:
            self.stop_due = self.now + answer.worst_case_s + 2 * self.delay_s + 0.1
        elif isinstance(what, Drive) and what.motion is not Motion.STOP:
            self.stop_due = None
        return answer.status

    def drive_usefully(self) -> None:
        """Drive a calm car. It moves soon, and stands soon after its drive."""
        self.run(max(0.0, max(self._calm_from, self.page_closed_at) + SETTLED_S - self.now))
        self.page_until = min(self.page_until, self.now)
        self.run(1.0)
        for estop in self.control.safety.estops:
            self.ask(Resume((estop.id,)))
        status = self.ask(Drive(self.moments.choice([each for each in Motion if each is not Motion.STOP]), 1.2))
        began = self.now
        if status is Phase.REJECTED:
            self.faults.append(f"{self.now:.2f} a calm car refuses a drive: {self.records[-1]}")
        moved = False
        while self.now < began + 1.2 and not self.faults:
            self.run(0.05)
            moved = moved or self.car.moving
        if not moved and not self.faults:
            self.faults.append(f"{self.now:.2f} a calm car does not drive")
        self.drives += 1
        if self.moments.random() < 0.5:  # it comes as the drive ends, or waits until then
            self.ask(ChangeSpeed(self.moments.choice(list(SpeedStep))))
        self.run(0.9 + BRAKE_S + 2 * self.delay_s)
        if self.car.moving and self.is_alone and not self.faults:
            self.faults.append(f"{self.now:.2f} it moves on after its drive")
        self.run(1.0)
        self.shown += self.control.driver.model.basis is Basis.SHOWN

    def _let_others_send(self, text: str) -> None:
        """Let another program send this to its web interface. The car may be busy for a while after it."""
        self.car.take_http(text, self.now)
        self.page_until = self.now + WIFI_S + UGV_DEAD_MAN_S + BRAKE_S
        self.stop_due = None
        self.run(self.moments.uniform(0.3, WIFI_S))
        self.busy_until = self.page_until

    def accident(self) -> None:
        """Let something happen."""
        moments = self.moments
        match moments.randrange(14):
            case 0:
                self.cut()
                self.run(moments.uniform(0.1, 5.0))
                self.connect()
            case 1:
                self.car.brown_out(self.now)
                self.calm_since = self.now
            case 2:
                self.page_until = self.now + moments.uniform(0.3, 4.0)
                self.car.press(moments.choice([Button.FORWARD, Button.SPIN_LEFT]), self.now)
                self.run(self.page_until - self.now)
                self.car.press(Button.STOP, self.now)
                self.page_until = self.now + 2.0
                self.page_closed_at = self.now + PAGE_OPEN_S
                self.calm_since = self.now
            case 3:
                self.loss = moments.choice((0.05, 0.3, 1.0))
                self.run(moments.uniform(0.2, 4.0))
                self.loss, self.calm_since = 0.0, self.now
            case 4:
                self.ask(Stop())
            case 5:
                self.ask(EmergencyStop("x"))
            case 6:
                self.ask(ChangeSpeed(moments.choice(list(SpeedStep))))
            case 7:
                self.ask(SetLight(moments.choice([Light.WHITE, Light.OFF])))
            case 8:
                self.ask(Find())
            case 9:
                for estop in self.control.safety.estops:
                    self.ask(Resume((estop.id,)))
            case 10:
                self._let_others_send(moments.choice(OTHERS))
            case _:
                self.ask(Drive(moments.choice(list(Motion)), moments.uniform(0.2, 3.0)))


def play(seed: int, accidents: int = 14) -> UgvEpisode:
    """Play one episode."""
    episode = UgvEpisode(seed)
    if episode.moments.random() < 0.3:
        episode.car.brown_out(0.0)
    episode.connect()
    for _ in range(accidents):
        if episode.faults:
            break
        episode.accident()
        episode.run(episode.moments.expovariate(1.0))
    if not episode.faults:
        if not episode.linked:
            episode.connect()
        episode.drive_usefully()
    refused = {each.reason for each in episode.records} & {Reason.UNSUPPORTED}
    if refused:
        episode.faults.append(f"refused as unsupported: {refused}")
    return episode
