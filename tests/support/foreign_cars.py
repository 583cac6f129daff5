"""Cars of foreign programs behind wires with gaps, and the claims about them. Shared by tests/e2e and tests/soak.

Each car's own program reports the true state (tests/e2e/strangers_car.py).
A car stands if its motors are off in mode 0.
"""

import contextlib
import json
import random
import threading
import time
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

from schemas.bus import Bus, Sample
from tests.support.gap_proxy import ByteGap, GapDirection, GapProxy
from tests.support.judge import stamp_ns
from tests.support.kills import BUSY_S
from tests.support.ports import free_endpoint
from tests.support.processes import TAKEN, FleetProcesses, GatewayProcess, wait_for
from tests.support.up import Up

PROGRAM: Final = Path(__file__).parents[1] / "e2e" / "strangers_car.py"
MODES: Final = {
    "manual": 0,
    "remote_control": 1,
    "tracking": 2,
    "obstacle_avoidance": 3,
    "color_led": 4,
    "light_seeking": 5,
    "following": 6,
}
FALSE_S: Final = 0.3
"""Maximum time for which a claim may be false."""
STANDS_S: Final = 12.0
"""Maximum time from a whole link to a car that stands."""
SHOWN_S: Final = 40.0
"""Maximum time from a whole link to the evidence, on a busy machine."""
WATCHED_S: Final = 3.0
"""Minimum time for which a car must have stood to count as stopped."""
ENTERED_S: Final = 10.0
"""Maximum time until a mode is open, on a busy machine."""
STOP_BYTES: Final = 13
"""Length of `$4WD,MODE00#`, and one byte more."""
LENGTHS_S: Final = (0.3, 0.6, 2.0, 6.0)


def gaps(cars: Iterable[str], seed: int) -> dict[str, ByteGap]:
    """Return one gap for each car. Seven cars have every length and direction among them."""
    chance = random.Random(seed)
    cars = list(cars)
    lengths = [LENGTHS_S[each % len(LENGTHS_S)] for each in range(len(cars))]
    directions = [list(GapDirection)[each % 3] for each in range(len(cars))]
    chance.shuffle(lengths)
    chance.shuffle(directions)
    return {
        car: ByteGap(
            direction, length_s, chance.randrange(STOP_BYTES), chance.random() < 0.4, 1.0, chance.randrange(1000)
        )
        for car, length_s, direction in zip(cars, lengths, directions, strict=True)
    }


def any_gaps(cars: Iterable[str], seed: int) -> dict[str, ByteGap]:
    """Return one gap for each car, of any length and direction. Some gaps lose a tenth of the bytes."""
    chance = random.Random(seed)
    return {
        car: ByteGap(
            chance.choice(list(GapDirection)),
            chance.uniform(0.3, 6.0),
            chance.randrange(2 * STOP_BYTES),
            chance.random() < 0.4,
            chance.choice((1.0, 1.0, 0.1)),
            chance.randrange(1000),
        )
        for car in cars
    }


@dataclass(frozen=True, slots=True)
class Claim:
    """A claim that the car stands, with its begin and end, s since the epoch."""

    by: str
    since: float
    until: float


@dataclass
class ForeignCar:
    """One car, its wire, and all claims of gateways about it."""

    mode: str
    """The mode in which the car is stopped. It is also the car's name."""
    process: GatewayProcess
    wire: GapProxy
    truths: list[tuple[float, bool, int]] = field(default_factory=list)
    """Time, whether the motors are on, and mode, at each change."""
    read: list[tuple[float, str]] = field(default_factory=list)
    """Time and text of each string that the car's program has read."""
    heard_until: float = 0.0
    claims: list[tuple[float, str, str, str]] = field(default_factory=list)
    """Each state/safety: time, motors, basis, trust."""
    records: list[Any] = field(default_factory=list)
    _lock: threading.Lock = field(default_factory=threading.Lock)

    def follow(self, bus: Bus) -> None:
        """Subscribe to the claims about the car."""
        bus.subscribe(f"fleet/{self.mode}/state/safety", self._safety)
        bus.subscribe(f"fleet/{self.mode}/event/command", self._record)

    def look(self) -> "ForeignCar":
        """Take the reports of the car's program."""
        for line in self.process.lines():
            said = json.loads(line)
            self.heard_until = max(self.heard_until, said["t"])
            if "read" in said:
                self.read.append((said["t"], said["read"]))
            now = said["motors"], said["mode"]
            if not self.truths or self.truths[-1][1:] != now:
                self.truths.append((said["t"], *now))
        return self

    @property
    def true_mode(self) -> int:
        return next((mode for *_, mode in self.look().truths[-1:]), MODES["manual"])

    @property
    def motors(self) -> bool:
        return bool(self.look().truths) and self.truths[-1][1]

    @property
    def shown(self) -> bool:
        """True if the newest claim is that the car stands, with the car's readings as its basis."""
        with self._lock:
            return bool(self.claims) and self.claims[-1][1:3] == ("off", "shown")

    def stands_since(self) -> float | None:
        """Return the time since which the car stands, None if it does not."""
        self.look()
        return next((at for at, on, mode in self.truths[-1:] if not on and mode == 0), None)

    def stays(self, since: float) -> bool:
        """Return True if the car has stood for long enough, and also since this moment."""
        at = self.stands_since()
        return at is not None and self.heard_until >= max(at, since) + WATCHED_S

    def moving(self) -> list[tuple[float, float]]:
        """Return begin and end of each time in which the car did not stand."""
        self.look()
        found: list[tuple[float, float]] = []
        began = None
        for at, on, mode in self.truths:
            moves = on or mode != MODES["manual"]
            if moves and began is None:
                began = at
            elif not moves and began is not None:
                found.append((began, at))
                began = None
        return found if began is None else [*found, (began, self.heard_until)]

    def stop_records(self, since: float) -> list[Any]:
        """Return the records after this moment that end a stop."""
        with self._lock:
            return [
                each
                for each in self.records
                if each.verb == "stop" and stamp_ns(each) / 1e9 >= since and _is_last(each)
            ]

    def claimed(self, since: float) -> list[Claim]:
        """Return the claims after this moment."""
        found: list[Claim] = []
        since_at = None
        with self._lock:
            for at, motors, basis, _ in self.claims:
                stands = at >= since and motors == "off" and basis == "shown"
                if stands and since_at is None:
                    since_at = at
                elif not stands and since_at is not None:
                    found.append(Claim("state/safety", since_at, at))
                    since_at = None
        if since_at is not None:
            found.append(Claim("state/safety", since_at, float("inf")))
        complete = [each for each in self.stop_records(since) if each.phase == "complete"]
        return found + [Claim("stop complete", stamp_ns(each) / 1e9, float("inf")) for each in complete]

    def false_claims(self, since: float) -> list[str]:
        """Return the claims that were false for longer than FALSE_S."""
        return [
            f"{self.mode}: {claim.by} at {claim.since - since:.2f} s, but it moved from {begin - since:.2f} "
            f"to {end - since:.2f} s"
            for claim in self.claimed(since)
            for begin, end in self.moving()
            if min(end, claim.until) - max(begin, claim.since) > FALSE_S
        ]

    def late_s(self, whole_at: float) -> float:
        """Return how long after this moment the car moved last, s."""
        return max((end - whole_at for _, end in self.moving()), default=0.0)

    def outcome(self, began: float, whole_at: float) -> str:
        """Return a text about the end of a stop. Times are s after its request."""
        stood = max((end for _, end in self.moving()), default=began) - began
        last = "; ".join(f"{each.phase} {stamp_ns(each) / 1e9 - began:.1f}" for each in self.stop_records(began))
        shown = next((f"{claim.since - began:.1f}" for claim in self.claimed(began)), "never")
        return f"whole {whole_at - began:.1f}, stands {max(0.0, stood):.1f}, shown {shown}, {last}"

    def story(self, since: float) -> str:
        """Return all events in order, with their times in s after this moment."""
        self.look()
        with self._lock:
            told = [(at, f"says    {motors} {basis} {trust}") for at, motors, basis, trust in self.claims]
            told += [
                (stamp_ns(each) / 1e9, f"record  {each.verb} {each.phase} {each.reason} {each.basis}: {each.words}")
                for each in self.records
            ]
        told += [(at, f"truth   motors {'on' if on else 'off'}, mode {mode}") for at, on, mode in self.truths]
        told += [(at, f"reads   {text}") for at, text in self.read]
        told += [
            (at, f"written {data.decode()}" + ("" if kept == data else f" arrives as {kept.decode()!r}"))
            for at, data, kept in self.wire.frames(since - 10)
        ]
        told += [(at, f"hears   {data!r} as {kept!r}") for at, data, kept in self.wire.to_host.passed if kept != data]
        told += [(self.wire.whole_at, "the wire is whole")] if self.wire.whole_at else []
        return "\n".join(f"{at - since:8.3f} {what}" for at, what in sorted(told) if at >= since - 10)

    def _safety(self, sample: Sample) -> None:
        said: Any = sample.message()
        with self._lock:
            self.claims.append((stamp_ns(said) / 1e9, said.motors, said.motors_basis, said.trust))

    def _record(self, sample: Sample) -> None:
        with self._lock:
            self.records.append(sample.message())


def _is_last(record: Any) -> bool:
    return record.phase in ("complete", "failed", "superseded", "rejected") or (
        record.phase == "sent" and bool(record.basis)
    )


@dataclass
class ForeignCars:
    """Cars of foreign programs, each in the mode of its name."""

    cars: list[ForeignCar]

    def __iter__(self) -> Iterator[ForeignCar]:
        return iter(self.cars)

    def enter_modes(self, fleet: FleetProcesses | Up) -> None:
        """Bring each car into the mode in which the test stops the car.

        A gap may have left half a general stop in the car's buffer. That half swallows a command, so send it twice.
        """
        for _ in range(2):
            for car in self.cars:
                if not self._is_in_mode(car):
                    _enter_mode(fleet, car.mode)
            with contextlib.suppress(AssertionError):
                wait_for(lambda: all(self._is_in_mode(car) for car in self.cars), "all are in their modes", ENTERED_S)
                return
        outside = [car for car in self.cars if not self._is_in_mode(car)]
        assert not outside, "\n".join(car.story(time.time()) for car in outside)

    def _is_in_mode(self, car: ForeignCar) -> bool:
        return car.motors if car.mode == "manual" else car.true_mode == MODES[car.mode]

    def run(self, seconds: float) -> None:
        """Let the cars run for this time, by their own clocks."""
        ends = {car.mode: car.look().heard_until + seconds for car in self.cars}
        for car in self.cars:
            wait_for(lambda car=car: car.look().heard_until >= ends[car.mode], f"{car.mode} goes on")

    def arm(self, gaps: dict[str, ByteGap]) -> None:
        for car in self.cars:
            car.wire.arm(gaps[car.mode])

    def close(self) -> None:
        for car in self.cars:
            car.wire.close()


def _enter_mode(fleet: FleetProcesses | Up, car: str) -> None:
    if car == "manual":
        answer = fleet.ask("drive", car, motion="forward", duration_s=60)
    else:
        answer = fleet.ask("mode", car, mode=car)
    assert answer["status"] in TAKEN, answer


def start(fleet: FleetProcesses, modes: list[str], seed: int) -> ForeignCars:
    """Start cars and wires, without gateways."""
    cars = []
    for number, mode in enumerate(modes):
        process = fleet.start(str(PROGRAM), "--seed", str(seed + number))
        cars.append(ForeignCar(mode, process, GapProxy(process.line()["port"])))
    return ForeignCars(cars)


class ForeignLot:
    """Seven cars, one for each mode, with their gateways."""

    def __init__(self, directory: Path) -> None:
        self.fleet = FleetProcesses(free_endpoint(), directory)
        self.cars = start(self.fleet, list(MODES), seed=1)
        for car in self.cars:
            car.follow(self.fleet.bus)
        self.gateways: dict[str, GatewayProcess] = {
            car.mode: self.fleet.gateway(car.wire.link, "--longest-drive", "60", car=car.mode) for car in self.cars
        }

    def ready(self) -> None:
        """Wait until the gateways claim that all motors are off."""
        for car in self.cars:
            self.fleet.ready(car.mode)

    def close(self) -> None:
        self.cars.close()
        self.fleet.close()


def stop_all(lot: ForeignLot, wanted: dict[str, ByteGap], *, pause_s: float = 1.0, busy_s: float = BUSY_S) -> list[str]:
    """Stop all cars with `fleet stop`, `pause_s` after they are in their modes. Return the faults."""
    lot.cars.enter_modes(lot.fleet)
    lot.cars.run(pause_s)
    lot.cars.arm(wanted)
    began = time.time()
    stopping = lot.fleet.start("-m", "fleet.cli", "stop")
    code = stopping.wait()
    said = stopping.lines()
    found = judge(lot.cars, wanted, began, busy_s)
    records = {car.mode: [each.phase for each in car.stop_records(began)] for car in lot.cars}
    found += [f"{mode}: ends as {phases}" for mode, phases in records.items() if len(phases) != 1]
    if (code == 0) != all(phases in (["complete"], ["sent"]) for phases in records.values()):
        found.append(f"fleet stop: exit code {code} for {records}: {said}")
    return found


def judge(cars: ForeignCars, wanted: dict[str, ByteGap], began: float, busy_s: float) -> list[str]:
    """Wait until each car stands and its stop is shown. Return the faults until then, each with its story."""
    found: list[str] = []
    for car in cars:
        whole_at = wait_for(lambda car=car: car.wire.whole_at, f"a frame is written to {car.mode}")
        wrong = []
        try:
            left_s = max(1.0, whole_at + SHOWN_S - time.time())
            wait_for(lambda car=car, at=whole_at: car.shown and car.stays(at), f"{car.mode} has shown it", left_s)
        except AssertionError as error:
            wrong.append(str(error))
        print(f"{car.mode:20}{wanted[car.mode]!s:50}{car.outcome(began, whole_at)}")
        found += report(car, wanted[car.mode], began, wrong + verdict(car, began, whole_at, busy_s))
    return found


def verdict(car: ForeignCar, began: float, whole_at: float, busy_s: float) -> list[str]:
    """Return the faults of one car after a stop."""
    wrong = car.false_claims(began)
    if (late_s := car.late_s(max(began, whole_at))) > STANDS_S + busy_s:
        wrong.append(f"{car.mode}: moved until {late_s:.1f} s after the wire was whole")
    return wrong


def report(car: ForeignCar, gap: ByteGap, began: float, wrong: list[str]) -> list[str]:
    """Return one text about the faults of a car, with its story."""
    return ["\n".join([*wrong, f"({gap})", car.story(began)])] if wrong else []
