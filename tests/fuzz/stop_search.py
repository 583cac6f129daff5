"""Searches for false claims of a stop, with the real control, a simulated car, and a link that fails at random.

An episode brings a car into a state and lets the link fail around a stop. The car's true motors judge the claims of
control. `EpisodePlan` has all random values of an episode, so a failure can be shrunk to the faults that it needs.
Everything runs on virtual time. Half of the episodes draw the car, too (`any_car.draw_car`): another rhythm, other
blocks, another program.
"""

import random
from collections import Counter, deque
from collections.abc import Iterable, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, field, replace
from enum import StrEnum
from functools import partial
from typing import Any

from gateway.control.commands import Action, AimServo, Command, Drive, EmergencyStop, Led, SetMode, Signal, Stop
from gateway.control.control_output import CommandRecord
from gateway.control.driver import TICK_S
from gateway.drivers.yahboom.estimate.learned import KEPT_INTERVALS, Learned
from gateway.drivers.yahboom.estimate.mode import MAX_FADE_EXCUSE_S
from gateway.drivers.yahboom.protocol.frame_splitter import FrameSplitter
from gateway.drivers.yahboom.protocol.platforms import parse_platform
from gateway.drivers.yahboom.stops.stop_in_progress import EVIDENCE_INTERVALS, evidence_s
from gateway.sim.model.arduino import ArduinoCar
from gateway.sim.model.factory import build
from gateway.sim.model.raspberry_pi import RaspberryPiCar, Transport
from gateway.sim.model.traits import ECHO_RANGING_S, CarTraits
from schemas.commands import Verb
from schemas.limits import MAX_EVIDENCE_TIMEOUT_S
from schemas.rights import Sender
from schemas.words import CarTrust, Mode, Motion, Phase, Reason, Shows, Verdict
from tests.fuzz.any_car import USABLE_S, draw_car
from tests.support.controls import control
from tests.support.stops import WORLDS, before_a_wall, in_a_pen, on_black

BYTES_PER_S = 960
FALSE_S = 0.3
"""Maximum time that a claim may be false."""
STANDS_S, AVOIDING_STANDS_S = 15.0, 20.0
"""Maximum time from the last fault or stop until the motors are off for good. The second is for obstacle avoidance."""
VERDICT_S = 2.5
"""Maximum time that an ended mode stays confirmed after the silence that contradicts it: a block of ours, and a reading
in transit."""
READY_S = 25.0
"""Maximum time until the rest of a car is claimed, on a whole link. Of slow cars, and of such whose program blocks for
another time than the vendor's, it takes longer to learn what they can show."""
KEPT_SHARE = 0.25
"""Share of the episodes in which the gateway knows the car from before."""
STREAM_SHARE = 0.12
"""Share of the episodes in which somebody sends one action after the other from the stop on."""
EARLY_S = 3.0
"""Time before the request of a mode in which the link may already fail."""

ALL_WORLDS = {**WORLDS, "black": on_black, "pen": in_a_pen, "wall": before_a_wall}


class Way(StrEnum):
    """The directions of a link."""

    TO_CAR = "to_car"
    TO_HOST = "to_host"
    BOTH = "both"


class Kind(StrEnum):
    """The kinds of faults of a link."""

    DEAD = "dead"
    """The link loses all bytes, also from the middle of a frame."""
    LOSSY = "lossy"
    """The link loses some bytes at random."""
    SLOW = "slow"
    """Bytes come later, in order."""
    STUCK = "stuck"
    """The link holds all bytes, and delivers them at once at the end."""
    DOUBLED = "doubled"
    """Each piece comes twice."""
    HALF_DUPLEX = "half_duplex"
    """Each write of ours mutes the reception for `delay_s`."""
    FLIPPED = "flipped"
    """The link changes single bits of some bytes."""


@dataclass(frozen=True, slots=True)
class LinkFault:
    """One fault of the link. Its times count in seconds from the stop."""

    kind: Kind
    way: Way
    at_s: float
    for_s: float
    share: float = 0.0
    """Share of the bytes that a lossy link loses."""
    delay_s: float = 0.0

    @property
    def end_s(self) -> float:
        return self.at_s + self.for_s


class Ending(StrEnum):
    """How the episode stops the car."""

    STOP = "stop"
    ESTOP = "estop"
    EXPIRY = "expiry"
    RELEASE = "release"
    LOST_SENDER = "lost_sender"
    MANUAL = "manual"
    SHUTDOWN = "shutdown"
    RECONNECT = "reconnect"


@dataclass(frozen=True, slots=True)
class EpisodePlan:
    """All random values of one episode."""

    seed: int
    platform: str
    told: str
    world: str
    load: str
    """`rest`, `drive`, `steer`, `acts`, or a mode."""
    load_s: float
    ending: Ending
    faults: tuple[LinkFault, ...]
    opening: bool = False
    """True if `load_s` counts from the frame that opens the mode. If not, it counts from the open mode."""
    traits: CarTraits = field(default_factory=CarTraits)
    again_s: float = 0.0
    """Time from the first stop to a second stop. 0 for none."""
    drive_again_s: float = 0.0
    """Time from the last stop to another drive, which a stop ends. 0 for none."""
    early: bool = False
    """True if the faults also hit the opening of the mode. Their times then count from `load_s` after its request, and
    again from the stop."""
    driven: bool = False
    """True if the car drives when the mode is requested."""
    rest_s: float = 0.0
    """Additional rest before the load. A mode then opens at any moment between two reports, not only after one."""
    kept: bool = False
    """True if the gateway knows the car from an earlier session with an echo."""
    stream_s: float = 0.0
    """Interval of actions on parts of the car, such as colors, from the stop on. 0 for none."""


@dataclass(slots=True)
class Report:
    """Result of one episode."""

    plan: EpisodePlan
    violations: list[str] = field(default_factory=list)
    ends: Counter[str] = field(default_factory=Counter)
    """Number of stops by their end, and of shutdowns by the basis of the stop."""
    false_sent: Counter[str] = field(default_factory=Counter)
    """Number of `sent` claims that were false for longer than `FALSE_S`, by the case of the stop."""
    sent: Counter[str] = field(default_factory=Counter)
    wedged: bool = False


def draw(seed: int) -> EpisodePlan:
    """Return the plan of a seed. Even seeds play themes that are known to be hard. Odd seeds play anything.

    Of both, every other pair of seeds also draws the car.
    """
    moments = random.Random(f"episode {seed}")
    plan = _any(seed, moments) if seed % 2 else THEMES[seed // 2 % len(THEMES)](seed, moments)
    plan = replace(plan, kept=random.Random(f"kept {seed}").random() < KEPT_SHARE)
    stream = random.Random(f"stream {seed}")
    if stream.random() < STREAM_SHARE:
        plan = replace(plan, stream_s=stream.uniform(0.08, 1.2))
    if seed // 2 % 2 == seed // 2 // len(THEMES) % 2:
        return plan
    car = draw_car(random.Random(f"car {seed}"), modes=plan.load in _MODE_WORDS)
    return replace(plan, platform=car.platform, told=car.told, traits=car.traits)


def learned_of(traits: CarTraits, moments: random.Random) -> Learned:
    """Return what a gateway keeps of an arduino car with these traits that stood before an echo."""
    reacts = not traits.timer and traits.close_s > 0.0
    spread_s = traits.spread_s
    return Learned.restore(
        {
            "echo_s": [traits.interval_s + moments.uniform(-spread_s, spread_s) for _ in range(KEPT_INTERVALS)],
            "no_echo_s": [],
            "shows": "yes" if reacts else "no",
            "doubted": False,
            "reporting": ["manual"],
            "blocks_s": {"mode_close": traits.close_s} if reacts else {},
        }
    )


def _theme(seed: int, load: str, load_s: float, faults: tuple[LinkFault, ...], **more: Any) -> EpisodePlan:
    world, ending = more.pop("world", "echo"), more.pop("ending", Ending.STOP)
    return EpisodePlan(seed, "arduino", "arduino", world, load, load_s, ending, faults, **more)


def _report_swallowed(seed: int, moments: random.Random) -> EpisodePlan:
    """Lose the stop and the report after it, so that the next report is late as if the car had obeyed."""
    gap = LinkFault(Kind.DEAD, Way.BOTH, moments.uniform(-0.2, 0.0), moments.uniform(0.5, 1.9))
    return _theme(
        seed, moments.choice(["drive", "steer"]), moments.uniform(0.5, 4.0), (gap,),
        traits=_every(moments.uniform(0.93, 1.0)), ending=moments.choice([Ending.STOP, Ending.STOP, Ending.SHUTDOWN]),
    )  # fmt: skip


def _digit_lost(seed: int, moments: random.Random) -> EpisodePlan:
    """Lose one or both digits of `MODE00`, which then opens mode 0 with the motors on. Lose later frames."""
    at_s, for_s = moments.choice([9.5, 10.5]) / BYTES_PER_S, 1 / BYTES_PER_S
    later = LinkFault(Kind.DEAD, Way.TO_CAR, 0.5, moments.uniform(1.0, 8.0))
    load = moments.choice(["tracking", "light_seeking", "following", "obstacle_avoidance", "color_led"])
    load_s, traits = moments.uniform(0.5, 6.0), _every(moments.uniform(0.9, 1.0))
    rest_s = moments.choice([0.0, moments.uniform(3.0, 5.0)])
    if moments.random() < 0.5:
        at_s, for_s = 9.5 / BYTES_PER_S, 2 / BYTES_PER_S
    lost = LinkFault(Kind.DEAD, Way.TO_CAR, at_s, for_s)
    return _theme(seed, load, load_s, (lost, later), traits=traits, rest_s=rest_s)


def _opened_behind_a_held_report(seed: int, moments: random.Random) -> EpisodePlan:
    """Lose a digit of `MODE00` while the car drives, and the frames after it. Hold the report before it."""
    lost = LinkFault(Kind.DEAD, Way.TO_CAR, moments.choice([9.5, 10.5]) / BYTES_PER_S, 1 / BYTES_PER_S)
    later = LinkFault(Kind.DEAD, Way.TO_CAR, 0.5, moments.uniform(3.0, 8.0))
    held_s = moments.uniform(1.0, 1.6)
    held = LinkFault(Kind.STUCK, Way.TO_HOST, moments.uniform(0.95, 1.18) - held_s, held_s)
    return _theme(
        seed, "drive", moments.uniform(0.5, 4.0), (lost, later, held), traits=_every(moments.uniform(0.93, 1.0))
    )


def _stop_while_opening(seed: int, moments: random.Random) -> EpisodePlan:
    """Delay old reports while a silent mode opens, and lose the stop."""
    slow = LinkFault(Kind.SLOW, Way.TO_HOST, -3.0, 30.0, delay_s=1.2)  # in two steps: a gap of 3 s would show
    slower = LinkFault(Kind.SLOW, Way.TO_HOST, -1.5, 28.5, delay_s=moments.uniform(1.8, 2.5))
    lost = LinkFault(Kind.DEAD, Way.TO_CAR, -0.01, moments.uniform(3.0, 6.0))
    load_s = moments.uniform(0.05, 0.4)
    return _theme(seed, "obstacle_avoidance", load_s, (slow, slower, lost), opening=True, early=True)


def _mode_over_a_lost_stop(seed: int, moments: random.Random) -> EpisodePlan:
    """Lose the stop before a mode, the opening and the next stop. Without an echo nothing shows the first stop."""
    load_s = moments.uniform(0.1, 2.0)
    lost = LinkFault(Kind.DEAD, Way.TO_CAR, -load_s - 0.01, moments.uniform(12.0, 20.0))
    unheard = LinkFault(Kind.DEAD, Way.TO_HOST, moments.uniform(-1.0, 0.5), moments.uniform(1.0, 2.5))
    return _theme(
        seed, moments.choice(["obstacle_avoidance", "color_led", "remote_control"]), load_s, (lost, unheard),
        world=moments.choice(["no-echo", "no-echo", "flickering"]), opening=True, early=True, driven=True,
    )  # fmt: skip


def _half_a_frame(seed: int, moments: random.Random) -> EpisodePlan:
    """Cut the first frame of the stop, so that the car reads the next frame behind it. Often lose later tries."""
    cut = LinkFault(Kind.DEAD, Way.TO_CAR, moments.uniform(1, 18) / BYTES_PER_S, 0.03)
    later = LinkFault(Kind.DEAD, Way.TO_CAR, moments.uniform(1.3, 1.9), moments.uniform(6.0, 15.0))
    load = moments.choice(["steer", "steer", "tracking", "light_seeking", "acts"])
    return _theme(seed, load, moments.uniform(0.5, 4.0), (cut, later) if moments.random() < 0.7 else (cut,))


def _short_gap(seed: int, moments: random.Random) -> EpisodePlan:
    """Lose all bytes for a time around a stop, in any mode. A gap of 0.6 s was the reason for this search."""
    gap = LinkFault(Kind.DEAD, moments.choice(list(Way)), moments.uniform(-0.5, 0.0), moments.uniform(0.3, 6.0))
    load = moments.choice(["drive", *(mode.value for mode in Mode if mode is not Mode.MANUAL)])
    ending = moments.choice([Ending.STOP, Ending.STOP, Ending.SHUTDOWN, Ending.MANUAL])
    return _theme(seed, load, moments.uniform(0.5, 9.0), (gap,), ending=ending)


def _damaged_reports(seed: int, moments: random.Random) -> EpisodePlan:
    """Lose the stop, and some bytes of the car's frames, so that some frames look like reports of mode 0."""
    lossy = LinkFault(
        Kind.LOSSY, Way.TO_HOST, -0.1, moments.uniform(3.0, 9.0), share=moments.choice([0.01, 0.02, 0.04])
    )
    lost = LinkFault(Kind.DEAD, Way.TO_CAR, -0.01, moments.uniform(1.0, 8.0))
    return _theme(seed, moments.choice(["light_seeking", "following"]), moments.uniform(0.5, 6.0), (lossy, lost))


def _joined_reports(seed: int, moments: random.Random) -> EpisodePlan:
    """Lose the stop, and join the start of one report with the end of a later one. The result lacks some bytes."""
    bytes_lost = 41 * moments.randrange(30, 50) + moments.choice([1, 1, 1, 2])
    joined = LinkFault(Kind.DEAD, Way.TO_HOST, -moments.uniform(0.1, 0.2), bytes_lost / BYTES_PER_S)
    lost = LinkFault(Kind.DEAD, Way.TO_CAR, -0.01, moments.uniform(3.0, 6.0))
    return _theme(seed, "light_seeking", moments.uniform(2.0, 6.0), (joined, lost))


def _misread_and_lost(seed: int, moments: random.Random) -> EpisodePlan:
    """Join half a general frame and `MODE00`, which opens a silent mode while driving. Lose later tries."""
    cut = LinkFault(Kind.DEAD, Way.TO_CAR, moments.uniform(2, 18) / BYTES_PER_S, 0.03)
    later = LinkFault(Kind.DEAD, Way.TO_CAR, 1.5, moments.uniform(9.0, 15.0))
    again_s = moments.uniform(0.02, 0.2) if moments.random() < 0.5 else 0.0
    return _theme(seed, "steer", moments.uniform(0.5, 4.0), (cut, later), again_s=again_s)


def _driven_over(seed: int, moments: random.Random) -> EpisodePlan:
    """Hide the stop with a link that is dead in one direction. Then drive all the same."""
    way = moments.choice([Way.TO_CAR, Way.TO_CAR, Way.TO_HOST])
    fault = LinkFault(Kind.DEAD, way, -0.1, moments.uniform(14.0, 24.0))
    return _theme(
        seed, "drive", 1.0, (fault,), again_s=moments.uniform(2.0, 6.0), drive_again_s=moments.uniform(10.0, 16.0)
    )  # fmt: skip


def _half_duplex(seed: int, moments: random.Random) -> EpisodePlan:
    """Mute the reception at each write of ours, while the car is deaf: each stop seems to make a pause."""
    deaf = LinkFault(Kind.DEAD, Way.TO_CAR, -0.1, moments.uniform(14.0, 30.0))
    muted = LinkFault(Kind.HALF_DUPLEX, Way.TO_HOST, -0.1, deaf.for_s, delay_s=moments.uniform(0.1, 1.5))
    return _theme(
        seed, "drive", moments.uniform(0.5, 4.0), (deaf, muted), traits=_every(moments.uniform(0.3, 1.3)),
        again_s=moments.choice([0.0, moments.uniform(1.0, 9.0)]),
    )  # fmt: skip


def _every(loop_s: float) -> CarTraits:
    """Return the traits of a car that reports so often, without the ranging."""
    return CarTraits(interval_s=loop_s + ECHO_RANGING_S)


THEMES = (
    _report_swallowed,
    _digit_lost,
    _opened_behind_a_held_report,
    _stop_while_opening,
    _mode_over_a_lost_stop,
    _half_a_frame,
    _short_gap,
    _damaged_reports,
    _joined_reports,
    _misread_and_lost,
    _driven_over,
    _half_duplex,
)


def _any(seed: int, moments: random.Random) -> EpisodePlan:
    platform, told = moments.choices(
        [
            ("arduino", "arduino"),
            ("arduino", "stm32"),
            ("raspberry_pi", "raspberry_pi"),
            ("arduino", "unknown"),
            ("raspberry_pi", "unknown"),
        ],
        [12, 2, 2, 2, 1],
    )[0]
    has_modes = (platform, told) in _WITH_MODES
    modes = [mode.value for mode in Mode if mode is not Mode.MANUAL] if has_modes else []
    load = moments.choice(["rest", "drive", "drive", "drive", "steer", "acts", *modes])
    if has_modes and moments.random() < 0.15:
        load = moments.choice(["light_seeking", "following", "tracking"])
    world = moments.choices(["echo", "no-echo", "flickering"], [6, 2, 1])[0]
    if load == "tracking" and moments.random() < 0.3:
        world = "black"
    elif load == "obstacle_avoidance":
        world = moments.choice(["echo", "pen"])
    elif load == "following" and moments.random() < 0.5:
        world = "wall"
    endings = [Ending.STOP] * 7 + [Ending.ESTOP, Ending.MANUAL, Ending.SHUTDOWN, Ending.SHUTDOWN, Ending.RECONNECT]
    if load in ("drive", "steer"):
        endings += [Ending.EXPIRY, Ending.RELEASE, Ending.LOST_SENDER]
    opening = load in modes and moments.random() < 0.25
    return EpisodePlan(
        seed,
        platform,
        told,
        world,
        load,
        moments.uniform(0.1, 3.5)
        if opening
        else moments.uniform(0.5, 9.0)
        if load in modes
        else moments.uniform(0.2, 2.0),
        moments.choice(endings),
        _faults(moments),
        opening=opening,
        traits=_every(moments.choice([0.9, 0.9, moments.uniform(0.9, 1.0)])),
        again_s=moments.uniform(0.3, 6.0) if moments.random() < 0.15 else 0.0,
        drive_again_s=moments.uniform(4.0, 14.0) if moments.random() < 0.15 else 0.0,
        early=opening and moments.random() < 0.5,
        driven=load in modes and moments.random() < 0.15,
    )


_WITH_MODES = {("arduino", "arduino"), ("arduino", "stm32")}
_MODE_WORDS = frozenset(mode.value for mode in Mode if mode is not Mode.MANUAL)
_FRAME_S = 12 / BYTES_PER_S
"""Time of `$4WD,MODE00#` on the wire."""


def _faults(moments: random.Random) -> tuple[LinkFault, ...]:
    """Return random faults. In 60 % of the plans one fault aims at the stop itself."""
    chance = moments.random()
    if chance < 0.25:  # a gap around the stop
        for_s = 0.1 * 60 ** moments.random()
        return (LinkFault(Kind.DEAD, moments.choice(list(Way)), moments.uniform(-min(for_s, 1.0), 0.1), for_s),)
    if chance < 0.45:  # the stop's first frame is cut, or lacks bytes
        at_s = moments.uniform(0.0, _FRAME_S)
        for_s = moments.choice([1 / BYTES_PER_S, 2 / BYTES_PER_S, 0.02 * 100 ** moments.random()])
        cut = LinkFault(Kind.DEAD, moments.choice([Way.TO_CAR, Way.TO_CAR, Way.BOTH]), at_s, for_s)
        return (cut, _fault(moments)) if moments.random() < 0.3 else (cut,)
    if chance < 0.55:  # the car's frames are damaged, and the stop is lost
        lossy = LinkFault(
            Kind.LOSSY, Way.TO_HOST, -0.5, moments.uniform(1.0, 9.0), share=moments.choice([0.02, 0.05, 0.1])
        )
        return (lossy, LinkFault(Kind.DEAD, Way.TO_CAR, moments.uniform(-0.3, 0.01), moments.uniform(0.1, 6.0)))
    if chance < 0.6:  # old reports come late, and the stop is lost
        slow = LinkFault(Kind.SLOW, Way.TO_HOST, -4.0, 30.0, delay_s=moments.uniform(0.5, 1.5))
        return (slow, LinkFault(Kind.DEAD, Way.TO_CAR, -0.01, moments.uniform(0.05, 3.0)))
    return tuple(_fault(moments) for _ in range(moments.choices([1, 2, 3], [5, 3, 1])[0]))


def _fault(moments: random.Random) -> LinkFault:
    for_s = 0.05 * 400 ** moments.random()  # 0.05 to 20 s, log-uniform
    at_s = moments.uniform(-min(for_s, 4.0), 2.5)
    kind = moments.choices(list(Kind), [8, 4, 2, 2, 1, 1, 0])[0]
    return LinkFault(
        kind,
        moments.choice(list(Way)),
        at_s,
        for_s,
        share=moments.choice([0.02, 0.1, 0.3, 0.7]),
        delay_s=0.03 * 50 ** moments.random(),
    )


class SearchedDirection:
    """One direction of the link, which loses, delays or doubles pieces of bytes."""

    def __init__(self, faults: Sequence[LinkFault], moments: random.Random) -> None:
        self._faults = faults
        self._moments = moments
        self._held: deque[tuple[float, bytes]] = deque()
        self.written_at = float("-inf")
        """When the last frame was written to the other direction, for a half-duplex link."""

    def put(self, data: bytes, at: float, end: float) -> None:
        """Send bytes that occupy the wire from `at` to `end`, in seconds from the stop."""
        each_s = (end - at) / len(data)
        out = bytearray()
        due = end
        twice = False
        for number, sent in enumerate(data):
            byte = sent
            now = at + each_s * (number + 1)
            lost = False
            for fault in self._faults:
                if not fault.at_s <= now < fault.end_s:
                    continue
                match fault.kind:
                    case Kind.DEAD:
                        lost = True
                    case Kind.LOSSY:
                        lost = lost or self._moments.random() < fault.share
                    case Kind.SLOW:
                        due = max(due, now + fault.delay_s)
                    case Kind.STUCK:
                        due = max(due, fault.end_s)
                    case Kind.DOUBLED:
                        twice = True
                    case Kind.HALF_DUPLEX:
                        lost = lost or self.written_at <= now < self.written_at + fault.delay_s
                    case Kind.FLIPPED:
                        if self._moments.random() < fault.share:
                            byte ^= 1 << self._moments.randrange(8)
            if not lost:
                out.append(byte)
        if self._held:
            due = max(due, self._held[-1][0])
        if out:
            self._held.append((due, bytes(out)))
            if twice:
                self._held.append((due, bytes(out)))

    @property
    def next_at(self) -> float:
        return self._held[0][0] if self._held else float("inf")

    def take(self, now: float) -> Iterable[tuple[float, bytes]]:
        """Yield each piece that has come through by `now`, with its time."""
        while self._held and self._held[0][0] <= now + 1e-9:
            yield self._held.popleft()


class Episode:
    """Plays one plan."""

    def __init__(self, plan: EpisodePlan) -> None:
        self.plan = plan
        moments = self._moments = random.Random(f"chances {plan.seed}")
        self.report = Report(plan)
        world = ALL_WORLDS[plan.world]()
        self.car = build(
            plan.platform,
            world,
            0,
            random.Random(plan.seed),
            transport=Transport.SERIAL,
            name="red",
            traits=plan.traits if plan.platform == "arduino" else None,
        )
        is_known = plan.kept and plan.platform == "arduino" and plan.traits.readings
        learned = learned_of(plan.traits, random.Random(f"learned {plan.seed}")) if is_known else None
        self.control = control(parse_platform(plan.told), learned=learned)
        self.decoder = FrameSplitter()
        self.now = 0.0
        self.zero = float("inf")
        """Time of the stop."""
        down = [fault for fault in plan.faults if fault.way is not Way.TO_HOST]
        up = [fault for fault in plan.faults if fault.way is not Way.TO_CAR]
        self._down, self._up = SearchedDirection(down, moments), SearchedDirection(up, moments)
        self.whole_s = max((fault.end_s for fault in plan.faults), default=0.0)
        self._next_tick = 0.0
        self._next_action = float("inf")
        self._linked = False
        self._number = 0
        self._ends: dict[str, list[str]] = {}
        self._asked_at: dict[str, float] = {}
        self._on_since: float | None = None
        self._claim_since: float | None = None
        self._complete = False
        """True if a stop was complete, and no command came later that may move the car."""
        self._complete_since = 0.0
        self._verdict_since: float | None = None
        self._case = ""
        self._ended_as_sent = False
        self._platform_doubted = False
        self._false_counted = False
        self.trace: list[str] = []
        self.tracing = False

    # ------------------------------------------------------------------ the play

    def play(self) -> Report:
        """Play the plan to its end, and return the report."""
        plan = self.plan
        self._run(2.0)
        self._connect()
        self._until(lambda: self.control.is_free(self.now), USABLE_S, fails=False)
        if not self.control.is_free(self.now):
            self._violate(f"(5) takes no command {USABLE_S:g} s after the connect")
        self._until(
            lambda: self.control.driver.model.motors == "off",
            READY_S,
            fails=plan.traits.close_s == 1.0 and plan.traits.interval_s < 1.5,
        )
        self._run(self._moments.random() + plan.rest_s)
        self.zero = self.now + 60.0  # `_load` sets the time
        self._load()
        self._run_to(self.zero)
        self._end()
        if plan.stream_s:
            self._next_action = self.now + plan.stream_s
        if plan.again_s:
            self._run(plan.again_s)
            self._ask(Stop(), stop=True)
        if plan.drive_again_s and plan.ending is not Ending.SHUTDOWN:
            self._run(plan.drive_again_s)
            self._complete = False
            self._ask(Drive(Motion.BACK, 10.0))
            self._run(1.0 + self._moments.random())
            self._ask(Stop(), stop=True)
        asked_s = self.now - self.zero
        whole_s = max(self.whole_s, asked_s)
        self._run_to(self.zero + whole_s)
        avoiding = self.car.truth.mode is Mode.OBSTACLE_AVOIDANCE or plan.load == "obstacle_avoidance"
        self._run(AVOIDING_STANDS_S if avoiding else STANDS_S)
        self._judge_rest(3.0)
        return self.report

    def _load(self) -> None:
        plan, moments = self.plan, self._moments
        if plan.load in ("rest", "drive", "steer", "acts"):
            self.zero = self.now + plan.load_s
        match plan.load:
            case "rest":
                pass
            case "drive":
                self._ask(Drive(moments.choice([Motion.FORWARD, Motion.LEFT, Motion.SPIN_RIGHT]), self._drive_s()))
            case "steer":
                while self.now < self.zero - 0.3:
                    motion = moments.choice([Motion.FORWARD, Motion.BACK, Motion.SPIN_LEFT])
                    self._ask(Drive(motion, self._drive_s()))
                    self._run(0.05 + 0.2 * moments.random())
            case "acts":
                self._ask(Drive(Motion.FORWARD, 10.0))
                for what in self._actions:
                    self._ask(what)
            case mode:
                if plan.driven:
                    self._ask(Drive(Motion.FORWARD, 10.0))
                    self._run(0.5 + moments.random())
                if plan.early:
                    self.zero = self.now + EARLY_S + plan.load_s
                    self._run(EARLY_S)
                self._ask(SetMode(Mode(mode)))
                if plan.opening:
                    self._until(lambda: self.control.driver.model.trust.state is CarTrust.IN_MODE, 12.0, fails=False)
                else:
                    self._until(lambda: self.car.truth.mode is Mode(mode), 15.0, fails=False)
                self.zero = self.now + plan.load_s

    def _drive_s(self) -> float:
        if self.plan.ending is Ending.EXPIRY:
            return max(0.2, self.zero - self.now)
        return 10.0

    def _end(self) -> None:
        control, now = self.control, self.now
        match self.plan.ending:
            case Ending.STOP:
                self._ask(Stop(), stop=True)
            case Ending.ESTOP:
                self._ask(EmergencyStop(), stop=True)
            case Ending.MANUAL:
                self._ask(SetMode(Mode.MANUAL))
            case Ending.RELEASE:
                self._ask(Drive(Motion.STOP))
            case Ending.LOST_SENDER:
                control.on_sender_token("mia", alive=True, now=now)
                control.on_sender_token("mia", alive=False, now=now)
                self._run(1.2)
            case Ending.RECONNECT:
                self.car.drop_link(now)
                control.driver.link_down("unplugged", now)
                self._linked = False
                self._run(2 * self._moments.random())
                self._connect()
            case Ending.SHUTDOWN:
                self._shut_down()
            case _:
                pass

    def _shut_down(self) -> None:
        """Shut the gateway down. If its car is not stopped, start another gateway, as `fleet up` does."""
        for _ in range(6):
            self.control.driver.shut_down(self.now)
            self._until(lambda: self.control.driver.finished, 18.0)
            ended, self._claim_since = self.control, None
            self._note(f"ended: not stopped {ended.driver.stops.not_stopped!r}, {ended.driver.model.basis}")
            if not ended.driver.stops.not_stopped:
                self.report.ends[f"shutdown {ended.driver.model.basis}"] += 1
                self._complete = ended.driver.model.basis == "shown"
                self._ended_as_sent = ended.driver.model.basis == "sent"
                self.report.sent["shutdown"] += self._ended_as_sent
                self._complete_since = self.now
                self._linked = False
                return
            self.report.ends["shutdown not_stopped"] += 1
            self.control = control(parse_platform(self.plan.told))
            self._connect()
            self._run(0.1)

    def _connect(self) -> None:
        if isinstance(self.car, RaspberryPiCar):
            self.car.connected(self.now)
        self.decoder = FrameSplitter()
        self._linked = True
        self.control.link_up(self.now)

    def _ask(self, what: Action, *, stop: bool = False) -> None:
        self._number += 1
        identity = f"c{self._number}"
        self._complete = False
        if stop:
            self._ends[identity] = []
            self._asked_at[identity] = self.now
        answer = self.control.command(Command(identity, "test", Sender("mia"), what), self.now)
        self._note(f"ask {what} -> {answer.status}")
        if stop and answer.reason is Reason.LINK_DOWN:
            self._ends[identity].append("rejected")
        self._pump()

    # ------------------------------------------------------------------ time

    def _run(self, seconds: float) -> None:
        self._run_to(self.now + seconds)

    def _until(self, condition: "object", seconds: float, *, fails: bool = True) -> None:
        end = self.now + seconds
        while not condition():  # type: ignore[operator]
            if self.now >= end:
                assert not fails or self.zero < float("inf"), "not ready on a link that is whole"
                return
            self._turn(end)

    def _run_to(self, end: float) -> None:
        while self.now < end - 1e-9:
            self._turn(end)

    def _turn(self, end: float) -> None:
        """Advance to the next event."""
        zero = self.zero if self.zero < float("inf") else 0.0
        wake = min(end, self.car.next_event(), self._up.next_at + zero, self._down.next_at + zero, self._next_action)
        if self._linked:
            deadline = self.decoder.deadline()
            wake = min(
                wake,
                self.control.driver.next_at(self.now),
                self._next_tick,
                float("inf") if deadline is None else deadline,
            )
        self.now = max(self.now + 1e-4, min(wake, end))
        self._carry(zero)
        if self._linked:
            for event in self.decoder.flush(self.now):
                self.control.driver.on_event(event, self.now)
            if self.now >= self._next_tick:
                self._next_tick = self.now + TICK_S
                self.control.tick(self.now)
            self._pump()
        if self.now >= self._next_action:
            self._next_action = self.now + self.plan.stream_s
            self._ask(self._moments.choice(self._actions))
        self._judge()

    @property
    def _actions(self) -> list[Action]:
        """The actions on parts of the car that this platform has."""
        acts: list[Action] = [Signal(Verb.WHISTLE)]
        if self.plan.platform == "arduino" and self.plan.told != "unknown":
            acts += [AimServo(self._moments.randrange(181)), Led(255, 2, 3)]
        return acts

    def _carry(self, zero: float) -> None:
        now = self.now
        for at, data in self._down.take(now - zero):
            self.car.feed(data, max(at + zero - len(data) / BYTES_PER_S, self.car.now))
        for at, data in self.car.advance(now):
            if self._faulty(at):
                self._up.put(data, at - zero - len(data) / BYTES_PER_S, at - zero)
            else:
                self._hear(data, at)
        for at, data in self._up.take(now - zero):
            self._hear(data, at + zero)

    def _faulty(self, at: float) -> bool:
        """Return True if a fault may hit the bytes. Other bytes go straight to the decoder."""
        return self.zero < float("inf") and (self._up.next_at < float("inf") or self._touched(at))

    def _touched(self, at: float) -> bool:
        since_s = at - self.zero
        return any(fault.at_s <= since_s and since_s - 0.1 < fault.end_s for fault in self.plan.faults)

    def _hear(self, data: bytes, at: float) -> None:
        if self._linked:
            for event in self.decoder.feed(data, max(at, 0.0)):
                self.control.driver.on_event(event, self.now)
                self.decoder.use_head(self.control.driver.model.profile.dialect.head)

    def _pump(self) -> None:
        if not self._linked:
            return
        control, now = self.control, self.now
        for _ in range(4):
            write = control.driver.poll(now)
            if write is None:
                break
            self._note(f"write {write.data!r} {write.why}")
            self._up.written_at = now - self.zero if self.zero < float("inf") else float("-inf")
            zero = self.zero if self.zero < float("inf") else 0.0
            took_s = len(write.data) / BYTES_PER_S
            if self.zero < float("inf") and (
                self._down.next_at < float("inf") or self._touched(now) or self._touched(now + took_s)
            ):
                self._down.put(write.data, now - zero, now + took_s - zero)
            else:
                self.car.feed(write.data, max(now, self.car.now))
            control.driver.on_written(write, now)
            self.decoder.sends(write.data, now)
        else:
            raise AssertionError("control writes without end")
        for record in control.take_records():
            if isinstance(record, CommandRecord):
                self._record(record)
            elif self.tracing:
                self._note(f"log {record.code}: {record.words}")

    def _note(self, words: str) -> None:
        if self.tracing:
            self.trace.append(f"{self.now - self.zero if self.zero < float('inf') else self.now:9.3f} {words}")

    # ------------------------------------------------------------------ the judge

    def _record(self, record: CommandRecord) -> None:
        identity = record.command.id
        last = (
            "complete"
            if record.phase is Phase.COMPLETE
            else "sent"
            if record.phase is Phase.SENT and record.basis
            else "failed"
            if record.phase is Phase.FAILED
            else ""
        )
        self._note(f"record {identity} {record.phase} {record.basis} {record.words} {record.evidence}")
        if identity not in self._ends and record.phase is Phase.SENT:
            self._complete = False
        if identity in self._ends and last:
            self._ends[identity].append(last)
            if self.now - self._asked_at[identity] > self._ends_s:
                self._violate(f"(4) {identity} ended after {self.now - self._asked_at[identity]:.0f} s")
            self.report.ends[last] += 1
            if last == "sent" and self._shows:
                self._violate(f"(4) {identity} ended as sent, and the car could have shown it")
            if last == "complete":
                self._complete, self._complete_since = True, self.now
        if identity in self._ends and record.phase in (Phase.SUPERSEDED, Phase.EXPIRED):
            self._ends[identity].append(record.phase)

    @property
    def _ends_s(self) -> float:
        """Return the maximum time from the request of a stop to its end, as docs/reference/protocol.md has it.

        The gateway assumes that `MODE00` blocks for 1 s until it has learned this car's block, which may be after the
        stop began. On a link that loses reports it learns a slower rhythm than the car has. At the end of its time, a
        stop that is just being shown waits for the end of the silence that shows it.
        """
        traits, model = self.plan.traits, self.control.driver.model
        true_s = EVIDENCE_INTERVALS * (traits.interval_s + traits.spread_s + max(1.0, traits.close_s) + 0.1)
        timeout_s = max(min(true_s, MAX_EVIDENCE_TIMEOUT_S), evidence_s(model.profile, model.learned))
        return 5.5 + timeout_s + model.evidence.settling_s

    @property
    def _shows(self) -> bool:
        """Return True if the car has shown a stop before, and nothing hides the evidence."""
        plan = self.plan
        return (
            (plan.platform, plan.told) == ("arduino", "arduino")
            and plan.world == "echo"
            and self.control.driver.model.learned.shows is Shows.YES
            and not (self.car.truth.fan or self._platform_doubted)
        )

    def _judge(self) -> None:
        """Compare the claims with the true motors."""
        if self.zero == float("inf"):
            return
        control, truth, now = self.control, self.car.truth, self.now
        self._platform_doubted = self._platform_doubted or control.driver.model.platform.doubted
        driving = truth.driving
        if not driving:
            self._on_since = None
        elif self._on_since is None:
            self._on_since = now
        shown = self._linked and control.driver.model.motors == "off" and control.driver.model.basis == "shown"
        if not shown:
            self._claim_since = None
        elif self._claim_since is None:
            self._claim_since = now
        if self._on_since is not None:
            if self._claim_since is not None and now - max(self._on_since, self._claim_since) > FALSE_S:
                self._violate(f"(1) off, shown ({control.driver.model.trust.evidence}), while the motors run")
            # A true claim that control has withdrawn no longer counts: a damaged frame can start the motors later.
            claimed = self._complete and (shown or self._on_since <= self._complete_since)
            if claimed and now - max(self._on_since, self._complete_since) > FALSE_S:
                self._violate("(1) complete, while the motors run")
        self._judge_sent(driving=driving)
        self._judge_verdict(truth.mode)

    def _judge_sent(self, *, driving: bool) -> None:
        control = self.control
        case = (
            control.driver.model.rest_case.name
            if self._linked and control.driver.model.motors == "off" and control.driver.model.basis == "sent"
            else ""
        )
        if case and not self._case:
            self.report.sent[case] += 1
            self._false_counted = False
            self._sent_since = self.now
        self._case = case
        if not case or not driving or self._false_counted:
            return
        if self.now - max(self._on_since or self.now, self._sent_since) > FALSE_S:
            self._false_counted = True
            self.report.false_sent[case] += 1

    def _judge_verdict(self, true: Mode) -> None:
        mode = self.control.driver.model.mode
        if not self._linked:
            self._verdict_since = None
            return
        if mode.verdict is Verdict.CONFIRMED and mode.inferred is None:
            self._violate("(3) confirmed, inferred unknown")
        verdict_s = mode.manual_silence_s + VERDICT_S + (MAX_FADE_EXCUSE_S if self.plan.stream_s else 0.0)
        if mode.verdict is Verdict.CONFIRMED and self.now - (mode.evidence_at or 0.0) > verdict_s:
            self._violate("(3) confirmed by old evidence")
        if mode.verdict is not Verdict.CONFIRMED or mode.asked is true or not self.car.alive:
            self._verdict_since = None
        elif self._verdict_since is None:
            self._verdict_since = self.now
        elif self.now - self._verdict_since > verdict_s:
            self._violate(f"(3) {mode.asked} is confirmed, {true} is true")

    def _judge_rest(self, seconds: float) -> None:
        """Require that the motors are off for good, and that each stop has ended once."""
        end = self.now + seconds
        while self.now < end:
            if self.car.truth.driving and self.car.alive:
                if _is_wedged(self.car) and self.control.driver.model.basis == "sent":
                    self.report.wedged = True
                elif not self.control.driver.model.is_heard or not self.plan.traits.readings:
                    self.report.false_sent["no readings"] += 1  # nothing shows it, and the words say so
                elif self._ended_as_sent:
                    self.report.false_sent["shutdown"] += 1  # nothing showed the stop, and no gateway is left
                else:
                    self._violate("(2) the motors run")
                break
            self._turn(end)
        for identity, ends in self._ends.items():
            if self.now - self._asked_at[identity] > self._ends_s and self._linked and len(ends) != 1:
                self._violate(f"(4) {identity} ended as {ends}")

    def _violate(self, words: str) -> None:
        short = words.split(" (", maxsplit=1)[0] if words.startswith("(1)") else words
        if not any(each.startswith(short) for each in self.report.violations):
            self.report.violations.append(words)
            self._note(f"VIOLATION {words}")


def _is_wedged(car: object) -> bool:
    """Return True if the car keeps half a named frame: no general stop works (docs/reference/protocol.md#hazards)."""
    return isinstance(car, ArduinoCar) and "4WD" in car._string


# ---------------------------------------------------------------------- many episodes


@dataclass(slots=True)
class Total:
    """Results of many episodes."""

    episodes: int = 0
    failures: list[Report] = field(default_factory=list)
    ends: Counter[str] = field(default_factory=Counter)
    sent: Counter[str] = field(default_factory=Counter)
    false_sent: Counter[str] = field(default_factory=Counter)
    wedged: int = 0

    def add(self, report: Report) -> None:
        """Count one episode."""
        self.episodes += 1
        self.ends += report.ends
        self.sent += report.sent
        self.false_sent += report.false_sent
        self.wedged += report.wedged
        if report.violations:
            self.failures.append(report)

    def __str__(self) -> str:
        lines = [f"{self.episodes} episodes, {len(self.failures)} failures, {self.wedged} wedged cars"]
        lines.append("ends: " + ", ".join(f"{name} {count}" for name, count in sorted(self.ends.items())))
        for case, count in sorted(self.sent.items()):
            lines.append(f"off, sent ({case}): {count}, false for longer than {FALSE_S} s: {self.false_sent[case]}")
        lines += [f"seed {each.plan.seed}: {'; '.join(each.violations)}\n  {each.plan}" for each in self.failures[:20]]
        return "\n".join(lines)


def play(seed: int) -> Report:
    """Play the episode of a seed."""
    plan = draw(seed)
    try:
        return Episode(plan).play()
    except Exception as error:
        error.add_note(f"seed {seed}: {plan}")
        raise


def shrink(plan: EpisodePlan) -> EpisodePlan:
    """Return the plan without the faults and second acts that its violations do not need."""
    wanted = {words[:3] for words in Episode(plan).play().violations}

    def fails(candidate: EpisodePlan) -> bool:
        return bool(wanted & {words[:3] for words in Episode(candidate).play().violations})

    smaller = True
    while smaller:
        smaller = False
        candidates = [
            replace(plan, faults=tuple(each for each in plan.faults if each is not fault)) for fault in plan.faults
        ]
        candidates += [replace(plan, again_s=0.0)] if plan.again_s else []
        candidates += [replace(plan, drive_again_s=0.0)] if plan.drive_again_s else []
        for candidate in candidates:
            if fails(candidate):
                plan, smaller = candidate, True
                break
    return plan


def explain(total: Total, limit: int = 5) -> str:
    """Return the failures with their seeds and their shrunk plans."""
    shrunk = [f"seed {each.plan.seed}: {each.violations}\n  {shrink(each.plan)}" for each in total.failures[:limit]]
    return "\n".join([f"{len(total.failures)} failures", *shrunk])


def found_at(seeds: Iterable[int]) -> str:
    """Return the first seed that fails, and its violations. Empty if no seed fails. Used with a rule removed."""
    for seed in seeds:
        try:
            violations = play(seed).violations
        except AssertionError as error:  # control did not even bring the car to a known state
            violations = [str(error)]
        if violations:
            return f"seed {seed}: {'; '.join(violations)}"
    return ""


def search(seeds: Iterable[int], *, processes: int = 1) -> Total:
    """Play many episodes, and return their results."""
    total = Total()
    if processes == 1:
        for seed in seeds:
            total.add(play(seed))
        return total
    with ProcessPoolExecutor(processes) as pool:
        for report in pool.map(partial(play), seeds, chunksize=50):
            total.add(report)
    return total
