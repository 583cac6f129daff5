"""Random events for a controller and a simulated car, with frequent stops. The car's motors are the judge."""

import random
from dataclasses import dataclass

from gateway.control.commands import EmergencyStop, Find, PartAction, Resume, SetMode, Stop
from gateway.sim.model.arduino import ArduinoCar
from gateway.sim.model.raspberry_pi import RaspberryPiCar, Transport
from schemas.rights import Sender
from schemas.words import Mode, Phase
from tests.fuzz.controller import PLATFORMS, SENDERS, anything
from tests.support.stops import WORLDS, state_of
from tests.support.virtual import Pair

LIFE = 60
"""Number of steps with one car in one world, before another car follows."""
WATCHED_S = 9.0
RESTORED_S = 22.0


@dataclass
class Fuzzed:
    """Result of a run."""

    steps: int = 0
    stops: int = 0
    states: frozenset[str] = frozenset()
    """States of the car before each stop."""


class Driven:
    """One car after another. `step` does one random thing. `stop` stops the car and judges its motors."""

    def __init__(self, seed: int) -> None:
        self.moments = random.Random(seed)
        self.asked = 0
        self._another()

    def _another(self) -> None:
        moments = self.moments
        platform = moments.choice(PLATFORMS)
        known = platform if platform != "unknown" else moments.choice(["arduino", "raspberry_pi"])
        self.world = moments.choice(list(WORLDS))
        self.pair = Pair(
            known,
            seed=moments.randrange(10**6),
            world=WORLDS[self.world](),
            told=platform,
            transport=Transport.SERIAL,
            start_s=2.0,
        )
        self.pair.connect()
        self.linked = True
        # Half a named frame ends the program of a Raspberry Pi, whatever follows. After that no stop works.
        self.cuts = moments.random() < 0.5
        self.named = not self.cuts or not isinstance(self.pair.car, RaspberryPiCar)

    def step(self) -> None:
        """Do one random thing."""
        moments, pair = self.moments, self.pair
        chance = moments.random()
        if not self.linked and chance < 0.5:
            pair.run(2 * moments.random(), linked=False)
            pair.connect()
            self.linked = True
        elif chance < 0.45:
            self._ask()
        elif chance < 0.85:
            pair.run(moments.choice([0.01, 0.06, 0.1, 0.3, 0.7, 1.2, 3.0]), linked=self.linked)
        elif chance < 0.89 and self.cuts:
            pair.cut = moments.randrange(1, 20)
        elif chance < 0.91 and self.linked:
            pair.lose()
            self.linked = False
        elif chance < 0.93:
            pair.deaf_until = pair.now + 3 * moments.random()
        elif chance < 0.95:
            self._stall(2 * moments.random())
        elif chance < 0.97:
            pair.control.on_sender_token(moments.choice(SENDERS).name, alive=moments.random() < 0.5, now=pair.now)
        elif chance < 0.98:
            for event in pair.decoder.feed(moments.randbytes(moments.randrange(40)).replace(b"$", b""), pair.now):
                pair.control.driver.on_event(event, pair.now)
        elif chance < 0.985:
            pair.car.brown_out(pair.now)
        self._see_cut()

    def _see_cut(self) -> None:
        """Note that the link is gone if control lost it, because a write was cut."""
        if self.linked and pair_lost(self.pair):
            self.linked = False

    def _stall(self, gap_s: float) -> None:
        """Stall the loop while the car goes on."""
        self.pair.now += gap_s
        self.pair.control.driver.on_stall(gap_s, self.pair.now)

    def _ask(self) -> None:
        what = anything(self.moments)
        if self.world != "echo" and what == SetMode(Mode.OBSTACLE_AVOIDANCE):
            return  # without an echo this car never reads a frame again
        if isinstance(what, Resume | EmergencyStop):
            what = Resume(tuple(estop.id for estop in self.pair.control.safety.estops))
        if isinstance(what, Find | PartAction) and not self.named:
            return
        self.asked += 1
        self.pair.ask(what, sender=self.moments.choice(SENDERS), identity=f"f{self.asked}")

    def stop(self) -> str | None:
        """Stop the car, and return the state before the stop. The motors must be off within the announced time.

        None if the link is down, or if no frame of recovery can stop the car.
        """
        pair, moments = self.pair, self.moments
        pair.cut = None
        if not self.linked:
            assert pair.ask(Stop(), verb="stop").status is Phase.REJECTED
            return None
        state, asked_at = state_of(pair), pair.now
        self.asked += 1
        identity = f"f{self.asked}"
        answer = pair.ask(Stop(), verb="stop", sender=moments.choice(SENDERS), identity=identity)
        pair.run(RESTORED_S if "restored" in state else WATCHED_S)
        if wedged(pair):
            return None
        off_s = max(0.0, pair.off_for_good_at() - asked_at)
        assert off_s <= answer.worst_case_s, f"{state}: off after {off_s:.3f} s, announced {answer.worst_case_s:.3f} s"
        last = pair.last_of(identity)
        if last is not None and last.phase is not Phase.FAILED:
            assert last.at - asked_at >= off_s, f"{state}: {last.phase} before it was off"
        self._judge_claims(asked_at)
        return state

    def _judge_claims(self, since: float) -> None:
        """Require that the motors were off whenever the car showed a stop after `since`."""
        pair = self.pair
        for at in pair.shown_at:
            if at <= since:
                continue
            log = list(pair.car.motor_log)
            before = [(left, right) for time, left, right in log if time <= at]
            assert before[-1] == (0, 0), f"shown at {at:.3f}, while the motors ran: {log[-4:]}"


def wedged(pair: Pair) -> bool:
    """Return True for the one string that no frame of recovery clears.

    See `test_recovery_of_car_that_wakes_for_one_millisecond`.
    """
    return isinstance(pair.car, ArduinoCar) and pair.car._string.startswith("4WD")


def pair_lost(pair: Pair) -> bool:
    """Return True if control knows that the link is down."""
    return not pair.control.driver.model.link_open


def run(seed: int, steps: int, *, stop_every: int = 12) -> Fuzzed:
    """Do `steps` steps, with a stop now and then."""
    driven, done, states = Driven(seed), Fuzzed(), set()
    sender = Sender("fuzz")
    for number in range(steps):
        try:
            driven.step()
            if driven.moments.random() < 1 / stop_every:
                state = driven.stop()
                if state is not None:
                    done.stops += 1
                    states.add(state)
                driven.pair.ask(Resume(), sender=sender)
        except Exception as error:
            name = driven.pair.control.driver.model.profile.name
            error.add_note(f"seed {seed}, step {number}, {name}, {driven.world}: {driven.pair.sent[-8:]}")
            raise
        if number % LIFE == LIFE - 1:
            driven._another()
    done.steps, done.states = steps, frozenset(states)
    return done
