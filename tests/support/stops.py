"""`stop` at random moments in every mode and load: what is played, and what the simulated car's motors say of it.

`rows` gives the distribution per state, for the soak's table and for whoever wants the numbers (the page on
what happens when). A state is what control can tell apart; many loads lead to each.
"""

import random
from collections.abc import Callable, Iterable
from concurrent.futures import ProcessPoolExecutor
from dataclasses import asdict, dataclass, fields
from itertools import product

from gateway.control.commands import ChangeSpeed, Drive, Fan, Find, OneShot, Phase, SetMode, Stop
from gateway.control.estimate.mode import Verdict
from gateway.control.estimate.trust import Basis, CarTrust
from gateway.protocol.enums import Light, Mode, Motion, ServoAction, SpeedStep
from gateway.protocol.frames import ColorLed, General, ModeOpen, Ptz, encode
from gateway.protocol.platforms import Platform, StopStyle
from gateway.sim.model.car_body import SONAR_CONE, SONAR_STEEPEST
from gateway.sim.model.objects import Lamp
from gateway.sim.model.raspberry_pi import Transport
from gateway.sim.model.world import World
from tests.support.virtual import Pair

LONGEST_S = 4.0
"""Outside obstacle avoidance and links just restored no stop takes longer."""
AVOIDING_S = 4.3
ENDS_S = 18.5
"""So long after it was asked, every stop has its last record (gateway/control/stops/stopping.py)."""
OPENS_S = 14.0
"""So long after it was asked, a mode opens: the stop before it is over within 10 s, or the mode is given up."""
RATIO = 1.5
"""The announced worst case is at most so many times the worst seen."""
AVOIDANCE = Mode.OBSTACLE_AVOIDANCE
READS_PINS = (Mode.REMOTE_CONTROL, Mode.TRACKING, Mode.LIGHT_SEEKING, Mode.FOLLOWING)
WHISTLE = OneShot(General(Motion.STOP, whistle=True))
MOTIONS = (Motion.FORWARD, Motion.LEFT, Motion.SPIN_RIGHT, Motion.BACK)

Load = Callable[[Pair, random.Random], None]


# ---------------------------------------------------------------------- worlds


def echoing() -> World:
    """The room, and lamps that are seen from everywhere, so that light seeking drives."""
    room = World.room()
    lamps = [Lamp(x_m, 0.0, reach_m=50.0, overhead=True) for x_m in (9.0, -9.0)]
    return World(room.walls, room.line, lamps)


def before_a_wall() -> World:
    """What following follows."""
    return World([(0.4, -9.0, 0.4, 9.0)])


def in_a_pen() -> World:
    """Walls on all sides: avoidance does nothing but back off, look and turn, 4.3 s each time."""
    corners = [(-0.25, -0.25), (0.25, -0.25), (0.25, 0.25), (-0.25, 0.25)]
    return World([(*a, *b) for a, b in zip(corners, (*corners[1:], corners[0]), strict=True)])


def on_black() -> World:
    """A floor that is all line: tracking takes its sharpest turn, for ever."""
    rows = [0.01 * number for number in range(-30, 31)]
    line = [(x, y) for number, y in enumerate(rows) for x in ((0.3, -0.3) if number % 2 else (-0.3, 0.3))]
    return World([(3.0, -3.0, 3.0, 3.0)], [(0.0, 0.0), *line])


class Flickering(World):
    """The room, in which every second ranging gets no echo: what slanted walls and curtains do."""

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
    """A new motion every 50 to 250 ms: what a joystick does."""
    for _ in range(12):
        pair.ask(Drive(moments.choice(MOTIONS), 0.5))
        pair.run(0.05 + 0.2 * moments.random())


def lossy(before: Load) -> Load:
    """And what the car sends is lost from just before the stop on."""

    def load(pair: Pair, moments: random.Random) -> None:
        before(pair, moments)
        pair.deaf_until = pair.now + 2.0

    return load


def let_go(pair: Pair, moments: random.Random) -> None:
    """Within the soft stop after a drive."""
    pair.ask(Drive(Motion.FORWARD, 0.3))
    pair.run(0.3 + 1.3 * moments.random())


def acting(pair: Pair, moments: random.Random) -> None:
    """One-shots of every kind queue while it drives."""
    pair.ask(Drive(Motion.FORWARD, 10.0))
    for what in (WHISTLE, OneShot(Ptz(45)), OneShot(ColorLed(255, 2, 3)), WHISTLE, OneShot(Ptz(120))):
        pair.ask(what)
    pair.run(2.5 * moments.random())


def one_shot(what: OneShot | Fan | Find | ChangeSpeed, block_s: float) -> Load:
    """While driving, from just before it is written to the end of its block."""

    def load(pair: Pair, moments: random.Random) -> None:
        pair.ask(Drive(Motion.FORWARD, 10.0))
        pair.run(2.5 + 2 * moments.random())
        pair.ask(what)
        pair.run((block_s + 0.1) * moments.random())

    return load


def fan(pair: Pair, moments: random.Random) -> None:
    """No reading comes while it runs."""
    pair.ask(Fan())
    pair.run(1.5)
    pair.ask(Drive(Motion.FORWARD, 10.0))
    pair.run(2 * moments.random())


def again(pair: Pair, moments: random.Random) -> None:
    """A second stop while the first is under way."""
    steering(pair, moments)
    pair.ask(Stop(), verb="stop")
    pair.run(1.2 * moments.random() ** 3)


def opening(mode: Mode) -> Load:
    """From the stop before it to the end of its block."""

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
    """About the end of its block, when it is not sure any more that the stop comes before the first turn."""

    def load(pair: Pair, moments: random.Random) -> None:
        pair.ask(SetMode(mode))
        pair.until(lambda: pair.sent[-1][1].endswith(b"1#"), OPENS_S)
        pair.run(pair.control.model.pacing.block_from - pair.now - 0.2 + 0.25 * moments.random())

    return load


def inside(mode: Mode) -> Load:
    def load(pair: Pair, moments: random.Random) -> None:
        pair.ask(SetMode(mode))
        pair.until(lambda: pair.car.truth.mode is mode, OPENS_S)
        pair.run(5.0 + 6.0 * moments.random())

    return load


def closing(mode: Mode) -> Load:
    """While `mode manual` is under way."""

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
    """Another world than the one named."""
    told: str | None = None
    """The platform that the gateway was told, if not the true one."""
    transport: Transport = Transport.SERIAL

    def __str__(self) -> str:
        platform = self.platform if self.platform != "raspberry_pi" else f"{self.platform}-{self.transport}"
        return f"{platform}-{self.name}-{self.world}{f'-told-{self.told}' if self.told else ''}"

    def pair(self, seed: int) -> Pair:
        """The two, just set up, the car running for two seconds."""
        world = (self.where or WORLDS[self.world])()
        return Pair(self.platform, seed=seed, world=world, told=self.told, transport=self.transport, start_s=2.0)


SERVO = OneShot(General(Motion.STOP, servo=ServoAction.FRONT_LEFT))
LIGHT = OneShot(General(Motion.STOP, light=Light.RED))
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
    ("ptz", one_shot(OneShot(Ptz(45)), 0.65)),
    ("led", one_shot(OneShot(ColorLed(255, 2, 3)), 0.1)),
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
            # Avoiding without an echo it is deaf for ever, with the motors braked (test_stops.py).
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


# ---------------------------------------------------------------------- links just restored


def half(*whats: Drive | OneShot | SetMode) -> Load:
    """The write is cut anywhere in its frame, and the link with it."""

    def load(pair: Pair, moments: random.Random) -> None:
        pair.cut = 1 + int(17 * moments.random())
        pair.ask(moments.choice(whats))
        pair.run(9.0)
        assert pair.cut is None

    return load


def cut_off(before: Load) -> Load:
    """And the link is lost, comes back after a moment, and a stop is asked for while it recovers."""

    def load(pair: Pair, moments: random.Random) -> None:
        before(pair, moments)
        pair.lose()
        pair.run(1.5 * moments.random(), linked=False)
        pair.connect()
        pair.run(moments.choice([0.0, 0.0, 6.0]) * moments.random())

    return load


def half_closing(count: int) -> Load:
    """The frame that closes a mode is cut, late in a turn of it."""

    def load(pair: Pair, moments: random.Random) -> None:
        pair.cut = count
        pair.ask(SetMode(Mode.MANUAL))
        pair.run(4.3 * moments.random(), linked=False)
        pair.connect()

    return load


def found(mode: Mode) -> Load:
    """A gateway that was told nothing finds a car in a mode."""

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
HALF_NAMED = half(OneShot(Ptz(135)), OneShot(ColorLed(255, 128, 33)), OneShot(Ptz(45)))
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
    # Ended by `#` and with two `MODE00` behind it, all within one turn of 4.3 s, this half opens the colour LED mode.
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
    ),
    *(StopTestCase(f"restored-{name}", load, world=world, told="unknown") for world in WORLDS for name, load in LOST),
    *(StopTestCase(f"restored-{name}", load, "raspberry_pi", world) for world in WORLDS for name, load in LOST),
)


# ---------------------------------------------------------------------- one play of a case


@dataclass(frozen=True, slots=True)
class Seen:
    """One stop. Times from when it was asked, s."""

    case: str
    seed: int
    state: str
    announced_s: float
    motors_off_s: float
    """Motors off, and off for good; 0 if they were off."""
    settled_s: float
    """And back in mode 0, where nothing but a command of ours turns them on."""
    complete_s: float
    """What the final record says, as shown or as sent; inf if the stop has none."""
    shown_s: float
    """When the car had shown that it stands; inf if it did not."""
    motors: str
    """What control says of them in the end."""
    basis: str
    """On what that rests."""
    phase: str
    """How the stop's life ended, the basis of that, and the words."""
    phase_basis: str
    words: str


def state_of(pair: Pair) -> str:
    """What control can tell apart when a stop is asked."""
    control, now = pair.control, pair.now
    style = control.model.profile.stop_style
    kind = {
        StopStyle.MODE_FRAME: "",
        StopStyle.UNKNOWN: "unknown platform, ",
        StopStyle.RASPBERRY_PI: f"{Platform.RASPBERRY_PI}, ",
    }
    running = control.stops.running
    if control.model.trust.state in (CarTrust.UNHEARD, CarTrust.UNPROVEN):
        return f"{kind[style]}{control.model.trust.state}"
    if not control.model.known:
        return f"{kind[style]}link just restored"
    if running is not None and running.sequence.rank > 1:
        avoiding = " of obstacle avoidance" if running.worst_at - running.began_at > AVOIDING_S else ""
        return f"{kind[style]}a stop under way{avoiding}"
    mode = control.model.mode.asked
    if control.model.mode.verdict is Verdict.CONTRADICTED:
        return f"{kind[style]}mode contradicted"
    if mode is None or mode is Mode.MANUAL:
        pacing = control.model.pacing
        if control.model.at_rest and control.model.basis is Basis.SENT and pacing.blocked_at(now):
            return f"{kind[style]}at rest, a renewal blocks"  # the motors are off, so the ratio says nothing
        unread = "a frame may be unread" if not pacing.clear_at(now) else ""
        what = unread or ("in a block of ours" if pacing.blocked_at(now) else "nothing unread")
        return f"{kind[style]}{Mode.MANUAL}, {what}"
    if now < control.model.pacing.block_until:
        return f"{kind[style]}opening {mode}"
    # docs/reference/protocol.md#blocking-times gives these one row, "up to 0.1 s per turn"; the infrared remote is
    # taken as one of them.
    return f"{kind[style]}in {'a mode that reads pins' if mode in READS_PINS else mode}"


def play(case: StopTestCase, seed: int) -> Seen:
    """Bring a car into the case's load, ask for a stop at a random moment, and watch until it is over."""
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
        max(0.0, off_at - asked_at),
        max(off_at, settled_at) - asked_at if settled_at > asked_at else max(0.0, off_at - asked_at),
        last.at - asked_at if last is not None and last.phase is not Phase.FAILED else float("inf"),
        shown - asked_at if shown is not None else float("inf"),
        pair.control.model.motors,
        pair.control.model.basis or "",
        last.phase if last is not None else "",
        last.basis if last is not None else "",
        last.words if last is not None else "",
    )


# ---------------------------------------------------------------------- the distribution


@dataclass(frozen=True, slots=True)
class StopRow:
    """All stops that were asked for in one state; s."""

    state: str
    stops: int
    p50_s: float
    p90_s: float
    worst_s: float
    announced_s: float
    """The longest that was announced."""
    ratio: float
    """Of the longest announced to the worst seen."""
    worst_motors_s: float
    """The worst until the motors were off: 0 where a mode is opened, in which they never come on."""
    shown: int
    """Stops that the car has shown."""
    shown_p50_s: float
    """When these were shown."""
    shown_worst_s: float
    worst_case: str
    """Where the worst was seen."""


def rows(seen: Iterable[Seen]) -> list[StopRow]:
    """The distribution per state."""
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
"""Stops that a process plays at a time."""


def distribution(moments: int, cases: range = PLAYED) -> list[StopRow]:
    """Play each case at so many moments, on all processors, and return the distribution."""
    chosen = list(product(cases, range(moments)))
    if len(chosen) <= CHUNK:  # one process has all the work
        return rows(map(_play, chosen))
    with ProcessPoolExecutor() as pool:
        return rows(pool.map(_play, chosen, chunksize=CHUNK))


def tsv(table: Iterable[StopRow]) -> str:
    """The rows as tab-separated text with a heading."""
    lines = ["\t".join(field.name for field in fields(StopRow))]
    for row in table:
        lines.append("\t".join(f"{v:.3f}" if isinstance(v, float) else str(v) for v in asdict(row).values()))
    return "\n".join(lines) + "\n"
