"""Runs a car normally for hours of virtual time, and collects all alarms. Each of them is false."""

import random
from collections.abc import Callable

from gateway.control.commands import (
    Action,
    AimServo,
    ChangeSpeed,
    Drive,
    Fan,
    Find,
    Led,
    MoveServo,
    SetLight,
    SetMode,
    Signal,
    Stop,
)
from gateway.control.driver import Event
from gateway.control.link_health import LinkHealth
from gateway.drivers.yahboom.protocol.sensors import Sensors
from gateway.sim.model.raspberry_pi import Transport
from schemas.commands import Verb
from schemas.words import Light, LinkState, Mode, Motion, Phase, Reason, ServoAction, SpeedStep, Verdict
from tests.support.truth import WORLDS
from tests.support.virtual import Pair

LOOK_S = 0.2
"""Interval at which a gateway checks its states."""
MODE_TRIES = 3
"""How often a mode is commanded if it expires. Without an echo, the eight actions of a full queue take 35 s at most (a
`Find` has four frames, 1.1 s apart), and each command waits for 15 s."""
SETTLED_S = 2.5
"""Pause after a change of mode. The closing block may lose an earlier frame, and an alarm about that loss is true."""
ALARMS = frozenset(
    {
        "mode_contradicted",
        "platform_contradicted",
        "unheard",
        "not_shown",
        "not_obeyed",
        "answers_again",
        "not_stopped",
    }
)
EXPECTED = frozenset({Reason.SUPERSEDED, Reason.EXPIRED, Reason.QUEUE_FULL, Reason.UNSUPPORTED, Reason.WRONG_MODE})
"""Reasons for the end of a command that are no alarm."""
MOTIONS = tuple(motion for motion in Motion if motion is not Motion.STOP)


class NormalRun:
    """One car without faults, whose link is checked as a gateway checks it."""

    def __init__(
        self,
        world: str,
        seed: int,
        *,
        platform: str = "arduino",
        told: str | None = None,
        transport: Transport = Transport.SERIAL,
    ) -> None:
        self.world = world
        # A silent car of an unknown platform may have its fan on, so each of its stops would give up.
        self.acts = tuple(act for act in MANUAL if act is not _fan or told != "unknown")
        self.moments = random.Random(seed)
        self.pair = Pair(platform, seed=seed, world=WORLDS[world](), told=told, transport=transport, start_s=2.0)
        self.health = LinkHealth()
        self.alarms: list[str] = []
        self.commands = 0
        self._mode_expired = False
        """True if a mode command has waited too long behind actions."""
        heard = self.pair.control.driver.on_event

        def counted(event: Event, now: float) -> None:
            if isinstance(event, Sensors):
                self.health.on_reading(event.at)
            heard(event, now)

        self.pair.control.driver.on_event = counted  # type: ignore[method-assign]  # as car.py does
        self.health.on_open(self.pair.now)
        self.pair.ready()
        self.pair.logs.clear()

    def run(self, seconds: float) -> None:
        """Let time pass, and check the states."""
        end = self.pair.now + seconds
        while self.pair.now < end:
            self.pair.run(min(LOOK_S, max(end - self.pair.now, 1e-3)))
            self.look()

    def look(self) -> None:
        """Note the alarms."""
        pair, mode = self.pair, self.pair.control.driver.model.mode
        self.health.update(
            now=pair.now,
            limit_s=mode.silence_limit(fan=bool(pair.control.driver.model.believed.fan)),
            unheard_s=mode.unheard_s(pair.now),
            why_quiet="silent",
            is_heard=pair.control.driver.model.is_heard,
        )
        if self.health.state in (LinkState.STALE, LinkState.LOST):
            self._alarm(f"link {self.health.state}: {self.health.reason}")
        if mode.verdict is Verdict.CONTRADICTED:
            self._alarm(f"{mode.asked} contradicted: {mode.evidence}")
        for log in pair.logs:
            if log.code in ALARMS:
                self._alarm(f"{log.code}: {log.words}")
        for record in pair.records:
            failed = record.phase is Phase.FAILED or (record.reason is not None and record.reason not in EXPECTED)
            if failed:
                self._alarm(f"{record.command.verb} {record.phase}: {record.words}")
            self._mode_expired |= record.phase is Phase.EXPIRED and isinstance(record.command.what, SetMode)
        pair.logs.clear()
        pair.records.clear()
        del pair.sent[:-6]

    def ask(self, what: Action) -> None:
        """Send a command."""
        self.commands += 1
        self.pair.ask(what, verb=type(what).__name__)
        self.look()

    def go(self, mode: Mode) -> None:
        """Bring the car to a mode, and wait until its true mode is this one."""
        assert any(self._reaches(mode) for _ in range(MODE_TRIES)), f"{mode} expired {MODE_TRIES} times"
        self.run(SETTLED_S)

    def _reaches(self, mode: Mode) -> bool:
        """Command a mode. Return True when it is the true mode, or False if the command waited too long."""
        self._mode_expired = False
        self.ask(SetMode(mode))
        end = self.pair.now + 20.0
        while self.pair.car.truth.mode is not mode and not self._mode_expired:
            assert self.pair.now < end, f"{mode} was not reached"
            self.run(LOOK_S)
        return not self._mode_expired

    def _alarm(self, words: str) -> None:
        if len(self.alarms) < 20:
            self.alarms.append(f"at {self.pair.now:.1f} s {words}; {self.pair.car.truth}")


def _drives(run: NormalRun) -> None:
    for _ in range(run.moments.randint(1, 4)):
        run.ask(Drive(run.moments.choice(MOTIONS), 0.3 + 2.0 * run.moments.random()))
        run.run(2.5 * run.moments.random())


def _joystick(run: NormalRun) -> None:
    """Send a drive every 0.1 s, now and then with another motion."""
    motion = Motion.FORWARD
    for _ in range(run.moments.randint(5, 80)):
        if run.moments.random() < 0.2:
            motion = run.moments.choice(MOTIONS)
        run.ask(Drive(motion, 0.5))
        run.run(0.1)


def _acts(run: NormalRun) -> None:
    """Send actions on each kind of part, as fast as the queue takes them or slower."""
    actions: tuple[Action, ...] = (
        Signal(Verb.WHISTLE),
        AimServo(run.moments.randint(0, 180)),
        MoveServo(run.moments.choice((ServoAction.FRONT_LEFT, ServoAction.FRONT_RESET))),
        Led(*(run.moments.randint(0, 255) for _ in range(3))),
        SetLight(run.moments.choice((Light.RED, Light.GREEN, Light.BLUE))),
        ChangeSpeed(run.moments.choice((SpeedStep.UP, SpeedStep.DOWN))),
        Find(),
    )
    for _ in range(run.moments.randint(1, 25)):
        run.ask(run.moments.choice(actions))
        run.run(run.moments.choice((0.0, 0.35, 1.0)) + 0.01)


def _whistles(run: NormalRun) -> None:
    """Signal without a pause for half a minute, so that the car's loop hardly runs."""
    for _ in range(80):
        run.ask(Signal(Verb.WHISTLE))
        run.run(0.36)


def _fan(run: NormalRun) -> None:
    """Switch the fan on for a while in mode 0, and perhaps go to a mode and back meanwhile."""
    run.ask(Fan())
    run.run(1.5 + 40.0 * run.moments.random())
    if run.moments.random() < 0.3:
        run.ask(Drive(run.moments.choice(MOTIONS), 1.0))
        run.run(5.0 * run.moments.random())
    run.ask(Fan())
    run.run(2.5)


def _stops(run: NormalRun) -> None:
    for _ in range(run.moments.randint(1, 6)):
        run.ask(Stop())
        run.run(4.0 * run.moments.random())


MANUAL: tuple[Callable[[NormalRun], None], ...] = (_drives, _joystick, _acts, _whistles, _fan, _stops)


def normal(run: NormalRun, mode: Mode, seconds: float) -> None:
    """Run the car in a mode, and now and then in mode 0 for commands that only work there."""
    end = run.pair.now + seconds
    for_ever = mode is Mode.OBSTACLE_AVOIDANCE and run.world == "no-echo"  # docs/reference/protocol.md#blocking-times
    while run.pair.now < end:
        run.moments.choice(run.acts)(run)
        run.run(10.0 * run.moments.random())
        if mode is Mode.MANUAL:
            continue
        run.go(mode)
        run.run(max(end - run.pair.now, 10.0) if for_ever else 5.0 + 120.0 * run.moments.random())
        if not for_ever:
            run.go(Mode.MANUAL)
