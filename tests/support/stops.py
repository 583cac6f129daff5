"""Plays `stop` at random moments in every mode and load, and measures the simulated car's motors.

`rows` gives the distribution per state, for the soak's table and docs/explanation/what-happens-when.md. A state is a
situation that control can distinguish. Many loads lead to each state.
"""

import random
from collections.abc import Callable, Iterable
from concurrent.futures import ProcessPoolExecutor
from dataclasses import asdict, dataclass, fields
from itertools import product

from gateway.control.commands import (
    AimServo,
    ChangeSpeed,
    Drive,
    Fan,
    Find,
    Led,
    MoveServo,
    PartAction,
    SetLight,
    SetMode,
    Signal,
    Stop,
)
from gateway.drivers.yahboom.protocol.frames import ModeOpen, encode
from gateway.drivers.yahboom.protocol.platforms import StopStyle
from gateway.drivers.yahboom.protocol.timing import REPEAT_INTERVAL_S
from gateway.sim.model.car_body import SONAR_CONE, SONAR_STEEPEST
from gateway.sim.model.objects import Lamp
from gateway.sim.model.raspberry_pi import Transport
from gateway.sim.model.world import World
from schemas.commands import Verb
from schemas.words import Basis, CarTrust, Light, Mode, Motion, Phase, Platform, ServoAction, SpeedStep, Verdict
from tests.support.virtual import Pair

LONGEST_S = 4.6
"""Maximum time of a stop outside obstacle avoidance and restored links: the longest opening, behind a ranging."""
AVOIDING_S = 4.3
ENDS_S = 18.5
"""Maximum time from the request of a stop to its last record (gateway/drivers/yahboom/stops/stop_in_progress.py)."""
OPENS_S = 14.0
"""Maximum time from the request of a mode to its opening. The stop before it ends within 10 s, or control gives up."""
RATIO = 1.5
"""Maximum ratio of the announced worst case to the measured one."""
SLACK_S = REPEAT_INTERVAL_S + 0.25
"""Maximum difference of the two where the ratio is larger. A frame may be lost, and then the next one stops the car,
after a ranging. In some states, no simulated car loses a frame."""
TWITCH_S = 0.02
"""Maximum time for which a retry may turn a wheel (docs/reference/stopping-times.md)."""
AVOIDANCE = Mode.OBSTACLE_AVOIDANCE
PRINTING = (Mode.TRACKING, Mode.LIGHT_SEEKING, Mode.FOLLOWING)
READS_PINS = (Mode.REMOTE_CONTROL, Mode.TRACKING, Mode.LIGHT_SEEKING, Mode.FOLLOWING)
WHISTLE = Signal(Verb.WHISTLE)
MOTIONS = (Motion.FORWARD, Motion.LEFT, Motion.SPIN_RIGHT, Motion.BACK)

Load = Callable[[Pair, random.Random], None]


# ---------------------------------------------------------------------- worlds


def echoing() -> World:
    """Return the room with lamps that are visible everywhere, so that light seeking drives."""
    room = World.room()
    lamps = [Lamp(x_m, 0.0, reach_m=50.0, overhead=True) for x_m in (9.0, -9.0)]
    return World(room.walls, room.line, lamps)


def before_a_wall() -> World:
    """Return a world with a wall close ahead, so that following drives."""
    return World([(0.4, -9.0, 0.4, 9.0)])


def in_a_pen() -> World:
    """Return walls on all sides, so that avoidance only backs off, looks and turns, 4.3 s each time."""
    corners = [(-0.25, -0.25), (0.25, -0.25), (0.25, 0.25), (-0.25, 0.25)]
    return World([(*a, *b) for a, b in zip(corners, (*corners[1:], corners[0]), strict=True)])


def on_black() -> World:
    """Return a floor that is all line, so that tracking takes its sharpest turn without an end."""
    rows = [0.01 * number for number in range(-30, 31)]
    line = [(x, y) for number, y in enumerate(rows) for x in ((0.3, -0.3) if number % 2 else (-0.3, 0.3))]
    return World([(3.0, -3.0, 3.0, 3.0)], [(0.0, 0.0), *line])


class Flickering(World):
    """The room, in which half of the rangings get no echo, at random, as with slanted walls and curtains."""

    def __init__(self, seed: int = 1) -> None:
        room = echoing()
        super().__init__(room.walls, room.line, room.lamps)
        self._chance = random.Random(seed)
        self._asked = 0
        self._silent = False

    def ray(self, x: float, y: float, angle: float, steepest: float = 0.0) -> float | None:
        if steepest != SONAR_STEEPEST:  # the infrared sensors
            return super().ray(x, y, angle, steepest)
        if self._asked == 0:
            self._silent = self._chance.random() < 0.5
        self._asked = (self._asked + 1) % len(SONAR_CONE)
        return None if self._silent else super().ray(x, y, angle, steepest)


WORLDS: dict[str, Callable[[], World]] = {"echo": echoing, "no-echo": World.open_field, "flickering": Flickering}


# ---------------------------------------------------------------------- loads


def rest(pair: Pair, moments: random.Random) -> None:
    pair.run(3 * moments.random())


def driving(pair: Pair, moments: random.Random) -> None:
    pair.ask(Drive(Motion.FORWARD, 10.0))
    pair.run(3 * moments.random())


def steering(pair: Pair, moments: random.Random) -> None:
    """Send a new motion every 50 to 250 ms, as a joystick does."""
    for _ in range(12):
        pair.ask(Drive(moments.choice(MOTIONS), 0.5))
        pair.run(0.05 + 0.2 * moments.random())


def lossy(before: Load) -> Load:
    """Return the load, after which the car's readings are lost for two seconds."""

    def load(pair: Pair, moments: random.Random) -> None:
        before(pair, moments)
        pair.deaf_until = pair.now + 2.0

    return load


def let_go(pair: Pair, moments: random.Random) -> None:
    """Enter the soft stop after a drive."""
    pair.ask(Drive(Motion.FORWARD, 0.3))
    pair.run(0.3 + 1.3 * moments.random())


def acting(pair: Pair, moments: random.Random) -> None:
    """Queue actions on every part while the car drives."""
    pair.ask(Drive(Motion.FORWARD, 10.0))
    for what in (WHISTLE, AimServo(45), Led(255, 2, 3), WHISTLE, AimServo(120)):
        pair.ask(what)
    pair.run(2.5 * moments.random())


def one_shot(what: PartAction | Fan | Find | ChangeSpeed, block_s: float) -> Load:
    """Return a load: an action on a part during a drive, from just before its frame to the end of its block."""

    def load(pair: Pair, moments: random.Random) -> None:
        pair.ask(Drive(Motion.FORWARD, 10.0))
        pair.run(2.5 + 2 * moments.random())
        pair.ask(what)
        pair.run((block_s + 0.1) * moments.random())

    return load


def fan(pair: Pair, moments: random.Random) -> None:
    """Switch the fan on. While it runs, no reading comes."""
    pair.ask(Fan())
    pair.run(1.5)
    pair.ask(Drive(Motion.FORWARD, 10.0))
    pair.run(2 * moments.random())


def again(pair: Pair, moments: random.Random) -> None:
    """Send a second stop during the first one."""
    steering(pair, moments)
    pair.ask(Stop(), verb="stop")
    pair.run(1.2 * moments.random() ** 3)


def opening(mode: Mode) -> Load:
    """Return a load: the opening of a mode, from the stop before it to the end of its block."""

    def load(pair: Pair, moments: random.Random) -> None:
        pair.ask(Drive(Motion.FORWARD, 10.0))
        pair.run(0.5)
        pair.ask(SetMode(mode))
        if moments.random() < 0.2:
            pair.run(4.0 * moments.random())
            return
        pair.until(lambda: pair.sent[-1][1].endswith(b"1#"), OPENS_S)
        pair.run(3.6 * moments.random())

    return load


def last_moment(mode: Mode) -> Load:
    """Return a load: the end of an opening's block, when the stop may come after the mode's first turn."""

    def load(pair: Pair, moments: random.Random) -> None:
        pair.ask(SetMode(mode))
        pair.until(lambda: pair.sent[-1][1].endswith(b"1#"), OPENS_S)
        pair.run(pair.control.driver.model.pacing.earliest_block_end - pair.now - 0.2 + 0.25 * moments.random())

    return load


def inside(mode: Mode) -> Load:
    def load(pair: Pair, moments: random.Random) -> None:
        pair.ask(SetMode(mode))
        pair.until(lambda: pair.car.truth.mode is mode, OPENS_S)
        pair.run(5.0 + 6.0 * moments.random())

    return load


def closing(mode: Mode) -> Load:
    """Return a load: the closing of a mode by `mode manual`."""

    def load(pair: Pair, moments: random.Random) -> None:
        inside(mode)(pair, moments)
        pair.ask(SetMode(Mode.MANUAL))
        pair.run(2.2 * moments.random() ** 3)

    return load


@dataclass(frozen=True)
class StopTestCase:
    """One load on one car in one world."""

    name: str
    load: Load
    platform: str = "arduino"
    world: str = "echo"
    where: Callable[[], World] | None = None
    """A world that replaces the named one."""
    told: str | None = None
    """The platform that the gateway is configured with, if not the true one."""
    transport: Transport = Transport.SERIAL

    def __str__(self) -> str:
        platform = self.platform if self.platform != "raspberry_pi" else f"{self.platform}-{self.transport}"
        return f"{platform}-{self.name}-{self.world}{f'-told-{self.told}' if self.told else ''}"

    def pair(self, seed: int) -> Pair:
        """Return controller and car, two seconds after the car's start."""
        world = (self.where or WORLDS[self.world])()
        return Pair(self.platform, seed=seed, world=world, told=self.told, transport=self.transport, start_s=2.0)


SERVO = MoveServo(ServoAction.FRONT_LEFT)
LIGHT = SetLight(Light.RED)
MOVING: list[tuple[str, Load]] = [
    ("rest", rest),
    ("driving", driving),
    ("steering", steering),
    ("steering-lossy", lossy(steering)),
    ("let-go", let_go),
    ("again", again),
    ("again-lossy", lossy(again)),
]
EVERY_CAR: list[tuple[str, Load]] = [
    *MOVING,
    ("whistle", one_shot(WHISTLE, 0.3)),
    ("servo", one_shot(SERVO, 0.65)),
    ("light", one_shot(LIGHT, 0.06)),
    ("speed", one_shot(ChangeSpeed(SpeedStep.UP), 0.06)),
    ("fan", one_shot(Fan(), 1.0)),
    ("fan-on", fan),
]
NAMED: list[tuple[str, Load]] = [
    ("ptz", one_shot(AimServo(45), 0.65)),
    ("led", one_shot(Led(255, 2, 3), 0.1)),
    ("find", one_shot(Find(), 1.0)),
    ("acting", acting),
]
OPENED = [mode for mode in Mode if mode is not Mode.MANUAL]
IN_MODES: list[tuple[str, Load]] = [
    (f"{how.__name__}-{mode}", how(mode)) for how in (opening, inside, closing) for mode in OPENED
]
TRANSPORTS = tuple(Transport)


def _cases() -> Iterable[StopTestCase]:
    for world in WORLDS:
        for name, load in (*EVERY_CAR, *NAMED):
            yield StopTestCase(name, load, world=world)
        for name, load in IN_MODES:
            # Avoiding without an echo, the car is deaf without an end, with the motors braked (a test of stops).
            if AVOIDANCE not in name or world == "echo":
                yield StopTestCase(name, load, world=world)
        for name, load in EVERY_CAR:
            yield StopTestCase(name, load, world=world, told="unknown")
            for transport in TRANSPORTS:
                yield StopTestCase(name, load, "raspberry_pi", world, transport=transport)
        for transport in TRANSPORTS:
            for name, load in NAMED:
                yield StopTestCase(name, load, "raspberry_pi", world, transport=transport)
            for name, load in MOVING:
                yield StopTestCase(name, load, "raspberry_pi", world, told="unknown", transport=transport)
        for name, load in MOVING:
            yield StopTestCase(name, load, "stm32", world)
    yield StopTestCase(f"inside-{Mode.TRACKING}", inside(Mode.TRACKING), world="black", where=on_black)
    yield StopTestCase(f"opening-{AVOIDANCE}-at-its-end", last_moment(AVOIDANCE), world="pen", where=in_a_pen)
    yield StopTestCase(f"inside-{AVOIDANCE}", inside(AVOIDANCE), world="pen", where=in_a_pen)
    yield StopTestCase(f"closing-{AVOIDANCE}", closing(AVOIDANCE), world="pen", where=in_a_pen)
    yield StopTestCase(f"inside-{Mode.FOLLOWING}", inside(Mode.FOLLOWING), world="wall", where=before_a_wall)
    yield StopTestCase(f"closing-{Mode.FOLLOWING}", closing(Mode.FOLLOWING), world="wall", where=before_a_wall)


CASES = tuple(_cases())


# ---------------------------------------------------------------------- restored links


def half(*whats: Drive | PartAction | SetMode) -> Load:
    """Return a load: the link breaks anywhere in the write of a frame."""

    def load(pair: Pair, moments: random.Random) -> None:
        pair.cut = 1 + int(17 * moments.random())
        pair.ask(moments.choice(whats))
        pair.run(9.0)
        assert pair.cut is None

    return load


def cut_off(before: Load) -> Load:
    """Return the load, then a link that is lost and comes back. The stop follows at once, or within 6 s."""

    def load(pair: Pair, moments: random.Random) -> None:
        before(pair, moments)
        pair.lose()
        pair.run(1.5 * moments.random(), linked=False)
        pair.connect()
        pair.run(moments.choice([0.0, 0.0, 6.0]) * moments.random())

    return load


def half_closing(count: int) -> Load:
    """Return a load: the frame that closes a mode is cut, late in a turn of the mode."""

    def load(pair: Pair, moments: random.Random) -> None:
        pair.cut = count
        pair.ask(SetMode(Mode.MANUAL))
        pair.run(4.3 * moments.random(), linked=False)
        pair.connect()

    return load


def found(mode: Mode) -> Load:
    """Return a load: after a lost link, the gateway finds the car in a mode that it has not opened."""

    def load(pair: Pair, moments: random.Random) -> None:
        driving(pair, moments)
        pair.lose()
        pair.car.feed(encode(ModeOpen(mode)), pair.now)
        pair.run(9.0 * moments.random(), linked=False)
        pair.connect()

    return load


def then(first: Load, second: Load) -> Load:
    def load(pair: Pair, moments: random.Random) -> None:
        first(pair, moments)
        second(pair, moments)

    return load


HALF_GENERAL = half(*(Drive(motion, 5.0) for motion in (Motion.RIGHT, Motion.SPIN_LEFT)))
HALF_NAMED = half(AimServo(135), Led(255, 128, 33), AimServo(45))
LOST: list[tuple[str, Load]] = [
    ("rest", cut_off(rest)),
    ("driving", cut_off(driving)),
    ("steering", cut_off(steering)),
    ("half-general", cut_off(then(driving, HALF_GENERAL))),
    ("half-general-acting", cut_off(then(acting, HALF_GENERAL))),
]
LOST_NAMED: list[tuple[str, Load]] = [
    ("acting", cut_off(acting)),
    ("half-named", cut_off(then(driving, HALF_NAMED))),
    *((f"opening-{mode}", cut_off(opening(mode))) for mode in OPENED),
    *((f"in-{mode}", cut_off(inside(mode))) for mode in OPENED),
]
RESTORED = (
    *(StopTestCase(f"restored-{name}", load, world=world) for world in WORLDS for name, load in LOST),
    *(
        StopTestCase(f"restored-{name}", load, world=world)
        for world in WORLDS
        for name, load in LOST_NAMED
        if AVOIDANCE not in name or world == "echo"
    ),
    # This half, with `#` and two `MODE00` behind it in one turn of 4.3 s, opens the color LED mode.
    *(
        StopTestCase(
            f"restored-half-mode-{count}", then(inside(AVOIDANCE), half_closing(count)), world="pen", where=in_a_pen
        )
        for count in (4, 7, 9)
    ),
    *(
        StopTestCase(f"restored-found-{mode}", found(mode), world="pen", where=in_a_pen, told=told)
        for mode in OPENED
        for told in (None, "unknown")
        if told is None or mode in PRINTING  # nothing shows a silent mode of a car of an unknown platform
    ),
    *(StopTestCase(f"restored-{name}", load, world=world, told="unknown") for world in WORLDS for name, load in LOST),
    *(StopTestCase(f"restored-{name}", load, "raspberry_pi", world) for world in WORLDS for name, load in LOST),
)


# ---------------------------------------------------------------------- one play of a case


@dataclass(frozen=True, slots=True)
class Seen:
    """One stop. Times are s after its request."""

    case: str
    seed: int
    state: str
    announced_s: float
    driven_late_s: float
    """Time in which the motors were on after the announced time."""
    motors_off_s: float
    """Time until the motors were off for good, 0 if they were off."""
    settled_s: float
    """Time until the car was also in mode 0, where only a command of ours turns them on."""
    complete_s: float
    """Time until the final record (shown or sent), inf if the stop failed or has none."""
    shown_s: float
    """Time until the car had shown that it stands, inf if it did not."""
    motors: str
    """Control's final claim about the motors."""
    basis: str
    """The basis of that claim."""
    phase: str
    """The stop's last phase, its basis and its text."""
    phase_basis: str
    words: str

    @property
    def is_late(self) -> bool:
        """True if the car drove after the announced time, or somebody was told that a car in an open mode stands."""
        left_mode_late = self.settled_s > max(self.motors_off_s, self.announced_s) + TWITCH_S
        return self.driven_late_s > TWITCH_S or (left_mode_late and self.phase != Phase.FAILED)

    @property
    def may_be_late(self) -> bool:
        """True if docs/reference/stopping-times.md says so: nobody knows that a mode of the car is open."""
        return self.case.startswith("arduino-restored-found-") and self.case.endswith("-told-unknown")


def state_of(pair: Pair) -> str:
    """Return the state that control can distinguish when the stop is requested."""
    control, now = pair.control, pair.now
    style = control.driver.model.profile.stop_style
    kind = {
        StopStyle.MODE_FRAME: "",
        StopStyle.BOTH: "readings contradict the platform, ",
        StopStyle.GENERAL: f"{control.driver.model.profile.kind}, ",
        StopStyle.TIMER: f"{Platform.STM32}, ",
    }
    running = control.driver.stops.running
    if control.driver.model.trust.state in (CarTrust.UNHEARD, CarTrust.UNPROVEN):
        return f"{kind[style]}{control.driver.model.trust.state}"
    if not control.driver.model.known:
        return f"{kind[style]}link just restored"
    if running is not None and running.sequence.rank > 1:
        avoiding = " of obstacle avoidance" if running.worst_at - running.began_at > AVOIDING_S else ""
        return f"{kind[style]}a stop under way{avoiding}"
    mode = control.driver.model.mode.asked
    if control.driver.model.mode.verdict is Verdict.CONTRADICTED:
        return f"{kind[style]}mode contradicted"
    if mode is None or mode is Mode.MANUAL:
        pacing = control.driver.model.pacing
        if control.driver.model.at_rest and control.driver.model.basis is Basis.SENT and pacing.is_blocked(now):
            return f"{kind[style]}at rest, a renewal blocks"  # the motors are off, so the ratio has no meaning
        unread = "a frame may be unread" if not pacing.has_read_all(now) else ""
        what = unread or ("in a block of ours" if pacing.is_blocked(now) else "nothing unread")
        return f"{kind[style]}{Mode.MANUAL}, {what}"
    if now < control.driver.model.pacing.block_until:
        return f"{kind[style]}opening {mode}"
    # docs/reference/protocol.md#blocking-times gives these modes one row, "up to 0.1 s per turn". The infrared remote
    # counts as one of them.
    return f"{kind[style]}in {'a mode that reads pins' if mode in READS_PINS else mode}"


def play(case: StopTestCase, seed: int) -> Seen:
    """Bring a car into the case's load, request a stop at a random moment, and run until the stop is over."""
    moments = random.Random(f"{case} {seed}")
    pair = case.pair(seed).ready()
    pair.run(moments.random())
    case.load(pair, moments)
    state, asked_at = state_of(pair), pair.now
    answer = pair.ask(Stop(), verb="stop", identity="the-stop")
    settled_at = asked_at
    end = asked_at + (22.0 if "restored" in state else 9.0)
    while pair.car.truth.mode is not Mode.MANUAL and pair.now < end:
        pair.turn(end)
        settled_at = pair.now
    pair.run(end - pair.now)
    while pair.last_of("the-stop") is None and pair.now < asked_at + ENDS_S:
        pair.run(0.5)
    off_at = pair.off_for_good_at()
    last, shown = pair.last_of("the-stop"), pair.shown_since(asked_at)
    return Seen(
        str(case),
        seed,
        state,
        answer.worst_case_s,
        pair.driven_since(asked_at + answer.worst_case_s),
        max(0.0, off_at - asked_at),
        max(off_at, settled_at) - asked_at if settled_at > asked_at else max(0.0, off_at - asked_at),
        last.at - asked_at if last is not None and last.phase is not Phase.FAILED else float("inf"),
        shown - asked_at if shown is not None else float("inf"),
        pair.control.driver.model.motors,
        pair.control.driver.model.basis or "",
        last.phase if last is not None else "",
        last.basis if last is not None else "",
        last.words if last is not None else "",
    )


# ---------------------------------------------------------------------- the distribution


@dataclass(frozen=True, slots=True)
class StopRow:
    """All stops that were requested in one state. Times are in s."""

    state: str
    stops: int
    p50_s: float
    p90_s: float
    worst_s: float
    announced_s: float
    """The longest announced worst case."""
    ratio: float
    """Ratio of the longest announced time to the longest measured one."""
    worst_motors_s: float
    """Longest time until the motors were off. It is 0 during the opening of a mode, in which they never come on."""
    shown: int
    """Number of stops that the car has shown."""
    shown_p50_s: float
    """Median time until the stop was shown."""
    shown_worst_s: float
    worst_case: str
    """The case with the longest time, and its seed."""


def rows(seen: Iterable[Seen]) -> list[StopRow]:
    """Return the distribution per state."""
    states: dict[str, list[Seen]] = {}
    for one in seen:
        states.setdefault(one.state, []).append(one)
    return [_row(state, states[state]) for state in sorted(states)]


def _row(state: str, stops: list[Seen]) -> StopRow:
    stops = sorted(stops, key=lambda one: one.settled_s)
    worst = stops[-1]
    announced = max(one.announced_s for one in stops)
    shown = sorted(one.shown_s for one in stops if one.shown_s < float("inf"))
    return StopRow(
        state,
        len(stops),
        stops[len(stops) // 2].settled_s,
        stops[len(stops) * 9 // 10].settled_s,
        worst.settled_s,
        announced,
        announced / worst.settled_s if worst.settled_s else float("inf"),
        max(one.motors_off_s for one in stops),
        len(shown),
        shown[len(shown) // 2] if shown else float("inf"),
        shown[-1] if shown else float("inf"),
        f"{worst.case} {worst.seed}",
    )


def _play(chosen: tuple[int, int]) -> Seen:
    number, seed = chosen
    return play((*CASES, *RESTORED)[number], seed)


PLAYED = range(len(CASES) + len(RESTORED))
"""Numbers of all cases."""
CHUNK = 50
"""Number of stops that a process plays at a time."""


def distribution(moments: int, cases: range = PLAYED) -> list[StopRow]:
    """Play each case at this number of moments, and return the distribution."""
    return rows(played(moments, cases))


def played(moments: int, cases: range = PLAYED) -> list[Seen]:
    """Play each case at this number of moments, on all processors."""
    chosen = list(product(cases, range(moments)))
    if len(chosen) <= CHUNK:  # too little work for a second process
        return list(map(_play, chosen))
    with ProcessPoolExecutor() as pool:
        return list(pool.map(_play, chosen, chunksize=CHUNK))


def tsv(table: Iterable[StopRow]) -> str:
    """Return the rows as tab-separated text with a heading."""
    lines = ["\t".join(field.name for field in fields(StopRow))]
    for row in table:
        lines.append("\t".join(f"{v:.3f}" if isinstance(v, float) else str(v) for v in asdict(row).values()))
    return "\n".join(lines) + "\n"
