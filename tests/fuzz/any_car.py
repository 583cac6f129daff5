"""Draws a car of the protocol, and uses it on a whole link: another rhythm, other blocks, another program.

The cars that people have differ (docs/reference/protocol.md#programs-that-people-have). Whatever a car can show, it
must be usable (5), and its drives must begin and end on time (6).
"""

import random
from collections.abc import Callable
from dataclasses import dataclass

from gateway.control.commands import Action, Drive, SetLight, SetMode, Stop
from gateway.drivers.yahboom.executor import FREE_ACTIONS
from gateway.drivers.yahboom.protocol.frames import ModeOpen
from gateway.drivers.yahboom.protocol.platforms import parse_platform
from gateway.drivers.yahboom.protocol.timing import REPEAT_INTERVAL_S
from gateway.sim.model.traits import SIM_FIRST_READING_S, CarTraits
from schemas.words import Light, Mode, Motion, Phase, Verdict
from tests.support.stops import WORLDS
from tests.support.virtual import Pair

USABLE_S = 15.0
"""Maximum time from the connect until a car takes commands."""
CLOSES_S = (0.0, 0.2, 1.0, 1.0, 1.3)
_PRINTING = (Mode.TRACKING, Mode.LIGHT_SEEKING, Mode.FOLLOWING)


@dataclass(frozen=True, slots=True)
class DrawnCar:
    """A simulated car, and the platform that the gateway is configured with."""

    platform: str
    told: str
    traits: CarTraits


def draw_car(moments: random.Random, *, modes: bool) -> DrawnCar:
    """Return a car. `modes`: it must have modes."""
    platform, told = moments.choices(
        [("arduino", "arduino"), ("stm32", "stm32"), ("stm32", "arduino"), ("arduino", "stm32")], [10, 2, 1, 1]
    )[0]
    if not modes and moments.random() < 0.1:
        return DrawnCar("course", "raspberry_pi+no_readings", CarTraits(readings=False))
    if platform == "stm32":
        return DrawnCar(platform, told, CarTraits(interval_s=1.0, timer=True, close_s=0.0, last_frame_wins=True))
    readings = moments.random() < 0.95
    traits = CarTraits(
        interval_s=moments.choice([1.254, 1.493, moments.uniform(0.3, 3.0), moments.uniform(0.3, 3.0)]),
        spread_s=moments.choice([0.0, 0.001, moments.uniform(0.0, 0.08)]),
        timer=moments.random() < 0.15,
        close_s=moments.choice(CLOSES_S),
        last_frame_wins=moments.random() < 0.2,
        silent_modes=frozenset(mode for mode in _PRINTING if moments.random() < 0.15),
        first_reading_s=_first_reading_s(random.Random(hash(moments.getstate()[1]))),  # so that older draws stay
        text=moments.random() < 0.2,
        readings=readings,
    )
    if not readings:
        told = f"{told}+no_readings"
    return DrawnCar(platform, told, traits)


def _first_reading_s(moments: random.Random) -> float:
    return SIM_FIRST_READING_S if moments.random() < 0.6 else moments.uniform(0.0, 5.0)


# ---------------------------------------------------------------------- use of a car on a whole link

WIRE_S = 0.3
"""Maximum time from the moment at which control takes a command to its frame on the wire."""
SHARP_S = 0.1
"""Maximum error of the start and the stop of a drive on the wire."""
FALSE_S = 0.3
MODE_STAYS_S = 8.0
LONGEST_FIRST_FRAMES_S = 1.1 + 1.2 + 4.3
"""Maximum time for which the first frames of a stop delay a command: their length, the block before and a turn."""
LONGEST_STOP_S = 18.0
"""Maximum time within which a car shows a stop, if it can (docs/reference/protocol.md#repeated-stops)."""


@dataclass(slots=True)
class Use:
    """One car on a whole link, and what was wrong with its use."""

    seed: int
    violations: list[str]
    car: DrawnCar
    commands: list[str]


class UseEpisode:
    """Sends commands to a drawn car, one at a time, and judges by the car's own motors and mode."""

    def __init__(self, seed: int) -> None:
        self._moments = random.Random(f"use {seed}")
        self.car = draw_car(self._moments, modes=self._moments.random() < 0.7)
        world = self._moments.choices(["echo", "no-echo", "flickering"], [4, 1, 1])[0]
        self._has_echo = world == "echo"
        self.pair = Pair(
            self.car.platform,
            seed=seed,
            world=WORLDS[world](),
            told=self.car.told,
            start_s=2.0,
            traits=self.car.traits if self.car.platform == "arduino" else None,
        )
        self.use = Use(seed, [], self.car, [])
        self._false_since: float | None = None
        self._lit_at: list[float] = []
        """When the lights were written."""

    def play(self) -> Use:
        """Connect, and send some commands at random moments."""
        pair, moments = self.pair, self._moments
        pair.connect()
        began = pair.now
        while not pair.control.is_free(pair.now) and pair.now < began + USABLE_S:
            self._run(0.1)
        if not pair.control.is_free(pair.now):
            self._violate(f"(5) takes no command {USABLE_S:g} s after the connect")
        for _ in range(5):
            self._run(moments.choice([0.0, moments.uniform(0.0, 1.5), moments.uniform(0.0, 9.0)]))
            moments.choice(self._acts)()
        return self.use

    @property
    def _acts(self) -> list[Callable[[], None]]:
        acts = [self._drive, self._drive, self._stop, self._light]
        return (
            [*acts, self._mode, self._mode] if "mode" in self.pair.control.driver.model.profile.capabilities else acts
        )

    def _ask(self, what: Action) -> float | None:
        """Send a command. Return when its first frame was written, None if it was refused."""
        pair, control = self.pair, self.pair.control
        asked_at, count = pair.now, len(pair.records)
        free_at = max(asked_at, control.driver.stops.free_at(asked_at))
        wait_s = control.wait_s(what, asked_at)
        if isinstance(what, SetLight):
            wait_s = max(wait_s, self._light_wait_s)
        if free_at - asked_at > LONGEST_FIRST_FRAMES_S + self._longest_block_s:
            self._violate(f"(5) {what} would wait for {free_at - asked_at:.1f} s")
        self.use.commands.append(f"{asked_at:.2f} {what}")
        answer = pair.ask(what)
        if answer.status is Phase.REJECTED:
            self._violate(f"(5) {what} was refused: {answer.words}")
            return None
        bound = asked_at + wait_s + WIRE_S
        while not self._is_sent(what, count) and pair.now < bound:
            self._run(0.01)
        if not self._is_sent(what, count) and not self._is_right:
            return None
        if not self._is_sent(what, count):
            self._violate(f"(5) {what} is not on the wire after {bound - asked_at:.2f} s")
            return None
        return pair.sent[-1][0]

    @property
    def _light_wait_s(self) -> float:
        """Return the longest time that an action on a part of the car may wait for the actions before it, s."""
        control, now = self.pair.control, self.pair.now
        running, pacing = control.driver.stops.running, control.driver.model.pacing
        if running is not None and sum(at > running.began_at for at in self._lit_at) >= FREE_ACTIONS:
            return LONGEST_STOP_S  # a stream of actions waits for the stop
        if not self._has_echo:
            return min(pacing.buffer_until - now, REPEAT_INTERVAL_S)  # until the car has read the last frame
        return 0.0

    @property
    def _longest_block_s(self) -> float:
        """Return the longest block that the gateway must assume: of a car with modes, if readings deny the name."""
        model = self.pair.control.driver.model
        profile = parse_platform("arduino") if model.platform.doubted else model.profile
        return profile.block_s(ModeOpen(Mode.FOLLOWING))

    def _is_sent(self, what: Action, count: int) -> bool:
        """Return True if a record after the first `count` says that the command was sent."""
        return any(each.phase is Phase.SENT and each.command.what is what for each in self.pair.records[count:])

    def _drive(self) -> None:
        pair, duration_s = self.pair, self._moments.uniform(0.3, 3.0)
        began = self._ask(Drive(self._moments.choice([Motion.FORWARD, Motion.SPIN_LEFT]), duration_s))
        if began is None:
            return
        self._run(began + duration_s + SHARP_S - pair.now)
        stops = [at for at, data in pair.sent if at > began and data == b"$0,0,0,0,0,0,0,0,0#"]
        if not self._is_right:
            return
        if not stops or abs(min(stops) - began - duration_s) > SHARP_S:
            self._violate(f"(6) the stop of a drive of {duration_s:.2f} s that began at {began:.2f}: {stops}")
        self._run(2.5)
        true_s = _driven_s(pair, began)
        if abs(true_s - duration_s) > self._block_s + SHARP_S:
            self._violate(f"(6) a drive of {duration_s:.2f} s lasted {true_s:.2f} s")

    @property
    def _is_right(self) -> bool:
        """Return True if the platform is right. A wrong one has wrong blocks; then only claims and refusals count.

        Nor do the times count of a car that blocks longer than the vendor's while it reports by a timer: nothing ever
        shows that block.
        """
        traits = self.car.traits
        hides = traits.timer and traits.close_s > 1.0
        return self.car.platform == self.car.told.partition("+")[0] and not hides

    @property
    def _block_s(self) -> float:
        """Return the longest block of this car that a drive can meet.

        Until the gateway has learned it, a longer block than the expected one loses the first frame of a drive. It is
        repeated after 1.1 s. A ranging without an echo makes the car read a stop together with the repeated motion
        before it, and lose it.
        """
        if not self._has_echo:
            return 1.05 + 1.1
        traits = self.car.traits
        return max(0.1, traits.close_s if traits.timer else 4 * (traits.close_s - 1.0))

    def _mode(self) -> None:
        pair = self.pair
        mode = self._moments.choice([Mode.TRACKING, Mode.COLOR_LED, Mode.LIGHT_SEEKING, Mode.REMOTE_CONTROL])
        if self._ask(SetMode(mode)) is None:
            return
        self._run(2.2 + MODE_STAYS_S * self._moments.random())
        if pair.car.truth.mode is not mode and self._is_right:
            self._violate(f"(5) mode {mode} was opened, {pair.car.truth.mode} is true")
        if pair.control.driver.model.mode.verdict is Verdict.CONTRADICTED and self._is_right:
            self._violate(f"(3) mode {mode} is contradicted: {pair.control.driver.model.mode.evidence}")
        self._stop()

    def _light(self) -> None:
        if (lit_at := self._ask(SetLight(Light.RED))) is not None:
            self._lit_at.append(lit_at)

    def _stop(self) -> None:
        pair = self.pair
        answer = pair.ask(Stop(), verb="stop")
        self.use.commands.append(f"{pair.now:.2f} stop")
        # Without an echo no report shows by how much longer this car blocks than expected.
        unlearned_s = max(0.0, self.car.traits.close_s - pair.control.driver.model.evidence.close_s)
        within_s = answer.worst_case_s + unlearned_s + SHARP_S
        self._run(within_s)
        if self._is_right and (pair.car.truth.driving or pair.car.truth.mode is not Mode.MANUAL):
            self._violate(f"(2) drives {within_s:.2f} s after a stop")

    def _run(self, seconds: float) -> None:
        """Let time pass, and judge the claims."""
        pair = self.pair
        end = pair.now + seconds
        while pair.now < end - 1e-9:
            pair.run(min(0.05, end - pair.now))
            model = pair.control.driver.model
            false = pair.car.truth.driving and model.motors == "off" and model.basis == "shown"
            self._false_since = (self._false_since or pair.now) if false else None
            if self._false_since is not None and pair.now - self._false_since > FALSE_S:
                self._violate("(1) off, shown, while the motors run")

    def _violate(self, words: str) -> None:
        self.use.violations.append(f"{self.pair.now:.2f} {words}")


def _driven_s(pair: Pair, since: float) -> float:
    """Return for how long the motors were on, s."""
    total, on_at = 0.0, None
    for at, left, right in pair.car.motor_log:
        if at < since - 0.001:
            continue
        if (left or right) and on_at is None:
            on_at = at
        elif not (left or right) and on_at is not None:
            total, on_at = total + at - on_at, None
    return total if on_at is None else total + pair.now - on_at


def play(seed: int) -> Use:
    """Play the use of the car of a seed."""
    try:
        return UseEpisode(seed).play()
    except Exception as error:
        error.add_note(f"seed {seed}: {draw_car(random.Random(f'use {seed}'), modes=False)}")
        raise
