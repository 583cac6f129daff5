"""Searches for outcomes of commands that are false, late or missing, as a client tells them to its user.

An episode has one drawn car of the first family (`any_car.draw_car`) or of the second, its control, and people who
send it commands at any moment, also before the last ones have ended. Between control and the clients stand the real
messages, and a bus that delays them. The frames that were written for a command, and the car's true motors, judge what
the clients say.
"""

import random
from collections import Counter, deque
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from typing import Final, Protocol

from fleet.client import commands
from fleet.client.commands import CommandRequest
from fleet.client.outcome import NO_ANSWER, NO_RESULT, Outcome, Progress, Until
from fleet.client.outcome_words import STOP_VERBS
from gateway.bus import command_parser
from gateway.bus.car_service import Request
from gateway.control.control_output import CommandRecord, OutgoingFrame
from gateway.control.controller import Controller
from gateway.control.driver import Driver
from schemas.commands import COMMANDS, Verb
from schemas.topics import PROTOBUF
from schemas.words import Basis, Light, Mode, Motion, Phase, Scope
from tests.fuzz.any_car import draw_car
from tests.fuzz.ugv_search import UgvEpisode
from tests.support.stops import WORLDS
from tests.support.virtual import Pair

CONNECT_S: Final = 20.0
AFTER_S: Final = 60.0
"""Time after the last command, in which every outcome must come."""
STEP_S: Final = 0.02
GONE_S: Final = 1.1
"""Maximum time for which a command of somebody who has left may still begin."""


@dataclass(slots=True)
class Said:
    """One command of a client, and what was said about it."""

    identity: str
    request: CommandRequest
    person: str
    progress: Progress
    asked_at: float
    due: deque[tuple[float, Callable[[], None]]] = field(default_factory=deque)
    """Events on their way to the client, in order, and when they arrive."""
    answer: tuple[float, Callable[[], None]] | None = None
    """The answer on its way."""
    frames: list[float] = field(default_factory=list)
    """When frames were written for it."""
    told: bool = False

    def __str__(self) -> str:
        return f"{self.asked_at:.2f} {self.identity} {self.request.verb} {self.request.detail}"


@dataclass(slots=True)
class OutcomeReport:
    """Result of an episode."""

    seed: int
    car: str
    violations: list[str] = field(default_factory=list)
    outcomes: Counter[str] = field(default_factory=Counter)
    story: list[str] = field(default_factory=list)


class PlayedCar(Protocol):
    """A car and its control on virtual time."""

    control: Controller[Driver]
    records: list[CommandRecord]
    about: str

    @property
    def linked(self) -> bool:
        """Return True if the link is open."""

    @property
    def now(self) -> float:
        """The time, s."""

    @property
    def moves(self) -> bool:
        """Return True if the motors run."""

    def run(self, seconds: float) -> None:
        """Let time pass."""

    def write(self) -> None:
        """Write the frames that are due."""

    def connect(self) -> None:
        """Open the link."""

    def lose(self) -> None:
        """Cut the link."""

    def disturb(self, moments: random.Random) -> None:
        """Let something happen to the car or its link."""


class FirstFamily:
    """A drawn car of the first family."""

    def __init__(self, seed: int, moments: random.Random) -> None:
        car = draw_car(moments, modes=moments.random() < 0.7)
        world = moments.choices(["echo", "no-echo", "flickering"], [4, 1, 1])[0]
        self.about = f"{car}, {world}"
        self.pair = Pair(
            car.platform,
            seed=seed,
            world=WORLDS[world](),
            told=car.told,
            start_s=2.0,
            traits=car.traits if car.platform == "arduino" else None,
        )
        self.control: Controller[Driver] = self.pair.control
        self.records = self.pair.records
        self.linked = False

    @property
    def now(self) -> float:
        return self.pair.now

    @property
    def moves(self) -> bool:
        return self.pair.car.truth.driving

    def run(self, seconds: float) -> None:
        self.pair.run(seconds, linked=self.linked)

    def write(self) -> None:
        self.pair._pump()

    def connect(self) -> None:
        self.pair.connect()
        self.linked = True

    def lose(self) -> None:
        self.pair.lose()
        self.linked = False

    def disturb(self, moments: random.Random) -> None:
        pair, chance = self.pair, moments.random()
        if "feed" in pair.car.__dict__:
            pair.pass_frames()
        elif chance < 0.4:
            pair.deaf_until = pair.now + moments.uniform(0.0, 6.0)
        elif chance < 0.7:
            pair.lose_frames()
        else:
            pair.car.brown_out(pair.now)


class SecondFamily:
    """A car of the second family."""

    def __init__(self, seed: int) -> None:
        self.episode = UgvEpisode(seed)
        self.about = f"{self.episode.car_platform}, {sorted(self.episode.options)}"
        self.control = self.episode.control
        self.records = self.episode.records

    @property
    def linked(self) -> bool:
        return self.episode.linked

    @property
    def now(self) -> float:
        return self.episode.now

    @property
    def moves(self) -> bool:
        return self.episode.car.moving

    def run(self, seconds: float) -> None:
        self.episode.run(seconds)
        self.episode.faults.clear()  # `ugv_search` judges them

    def write(self) -> None:
        self.episode._turn()

    def connect(self) -> None:
        self.episode.connect()

    def lose(self) -> None:
        self.episode.cut()

    def disturb(self, moments: random.Random) -> None:
        episode = self.episode
        if episode.loss:
            episode.loss = 0.0
        elif moments.random() < 0.5:
            episode.loss = moments.choice((0.05, 0.3, 1.0))
        else:
            episode.car.brown_out(episode.now)


class Outcomes:
    """Plays one episode."""

    def __init__(self, seed: int) -> None:
        moments = self._moments = random.Random(f"outcome {seed}")
        self.played: PlayedCar = SecondFamily(seed) if seed % 5 == 4 else FirstFamily(seed, moments)
        self.report = OutcomeReport(seed, self.played.about)
        self.people = [f"p{number}" for number in range(moments.choice([1, 1, 2, 3]))]
        self._kinds = dict(zip(self.people, ("person", "person", "script"), strict=False))
        self._slow = moments.random() < 0.3
        """True if the bus is slow at times."""
        self._said: list[Said] = []
        self._seen = 0
        self._stood_at = 0.0
        """When the motors were off last."""
        self._left_at: dict[str, float] = {}
        """When each person has left, who has not come back."""
        written = self.played.control.driver.on_written

        def on_written(write: OutgoingFrame, now: float) -> None:
            for said in self._said:
                if said.identity == write.command_id:
                    said.frames.append(now)
                    self._judge_presence(said)
            written(write, now)

        self.played.control.driver.on_written = on_written  # type: ignore[method-assign]  # the wire has no ids

    def play(self) -> OutcomeReport:
        """Send commands at random moments, and wait for the outcome of each."""
        played, moments = self.played, self._moments
        played.connect()
        for person in self.people:
            played.control.on_sender_token(person, alive=True, now=played.now)
        self.run(moments.choice([0.0, moments.uniform(0.0, 10.0), CONNECT_S]))
        for _ in range(moments.randrange(3, 12)):
            again = bool(self._said) and moments.random() < 0.2
            self.ask(self._said[-1].request if again else moments.choice(list(self._requests())))
            self.run(
                moments.choice([0.0, moments.uniform(0.0, 0.5), moments.uniform(0.0, 4.0), moments.uniform(0.0, 20.0)])
            )
            self._disturb()
        if not played.linked:
            played.connect()
        self.run(AFTER_S)
        for said in self._said:
            if said.progress.outcome is None:
                self._violate(said, f"no outcome after {played.now - said.asked_at:.1f} s")
        return self.report

    # ------------------------------------------------------------------ people

    def _requests(self) -> Iterator[CommandRequest]:
        moments = self._moments
        yield commands.drive_request(moments.choice(list(Motion)), moments.choice([0.05, 0.5, 2.0, 9.5]))
        yield commands.drive_request(Motion.FORWARD, moments.uniform(0.2, 4.0), wait=moments.random() < 0.8)
        yield commands.drive_request(Motion.STOP)
        yield commands.stop_request()
        yield commands.stop_request()
        yield commands.mode_request(moments.choice(list(Mode)))
        yield commands.mode_request(Mode.MANUAL)
        if moments.random() < 0.3:
            yield commands.estop_request("", Scope.CAR)
        yield commands.resume_request(everything=moments.random() < 0.8)
        yield commands.pause_request()
        yield commands.plain_request(Verb.UNPAUSE)
        yield commands.light_request(moments.choice(list(Light)))
        yield commands.led_request(1, 2, 3)
        yield commands.servo_request("front", deg=moments.randrange(181))
        yield commands.plain_request(Verb.WHISTLE)
        yield commands.plain_request(Verb.FIND)
        yield commands.speed_request(moments.choice(["up", "down"]))
        yield commands.fan_request(moments.choice([None, "on", "off"]))
        yield commands.lease_request(take=moments.random() < 0.3, release=moments.random() < 0.3)

    def ask(self, request: CommandRequest) -> None:
        """Send a command of somebody, and put its answer on the bus."""
        played, moments = self.played, self._moments
        person = moments.choice(self.people)
        if self._left_at.pop(person, None) is not None:
            played.control.on_sender_token(person, alive=True, now=played.now)
        identity = f"c{len(self._said) + 1}"
        progress = Progress(
            "red", request.until, played.now, request.duration_s, verb=request.effect_verb, detail=request.detail
        )
        said = Said(identity, request, person, progress, played.now)
        self._said.append(said)
        message = type(request.message)()
        message.CopyFrom(request.message)
        message.id, message.sender, message.kind, message.take = identity, person, self._kinds[person], request.take
        encoding = f"{PROTOBUF};{COMMANDS[request.verb].message}"
        before = len(played.records)
        try:
            command = command_parser.parse(Request(request.verb, message.SerializeToString(), encoding), 0, car="red")
        except command_parser.BadRequest as error:
            self._violate(said, f"not parsed: {error.words}")
            return
        answer = played.control.command(command, played.now)
        played.write()
        was_sent = any(each.command.id == identity and each.phase is Phase.SENT for each in played.records[before:])
        status = Phase.SENT if was_sent and answer.status is Phase.QUEUED else answer.status
        self.report.story.append(f"{said} by {person}: {status} {answer.words}")

        def arrive() -> None:
            progress.on_answer(
                str(status), str(answer.reason or ""), answer.words, answer.worst_case_s or 0.0, played.now
            )

        said.answer = played.now + self._delay_s(), arrive
        self._take()

    def _delay_s(self) -> float:
        if self._slow and self._moments.random() < 0.2:
            return self._moments.uniform(0.0, 3.0)
        return self._moments.uniform(0.0005, 0.01)

    def _disturb(self) -> None:
        """Let something else happen, sometimes."""
        played, moments = self.played, self._moments
        chance = moments.random()
        if not played.linked:
            if chance < 0.5:
                played.connect()
        elif chance < 0.03:
            played.lose()
        elif chance < 0.10:
            played.disturb(moments)
        elif chance < 0.13:
            self._leave(moments.choice(self.people))

    def _leave(self, person: str) -> None:
        """Let the program of a person end."""
        self._left_at[person] = self.played.now
        self.played.control.on_sender_token(person, alive=False, now=self.played.now)

    # ------------------------------------------------------------------ time

    def run(self, seconds: float) -> None:
        """Let time pass, pass on what is on the bus, and judge each outcome when it is told."""
        played = self.played
        end = played.now + seconds
        while played.now < end - 1e-9:
            played.run(min(STEP_S, end - played.now))
            if not played.moves:
                self._stood_at = played.now
            self._take()
            for said in self._said:
                self._pass_on(said)

    def _take(self) -> None:
        """Put new records on the bus, as events."""
        played = self.played
        for record in played.records[self._seen :]:
            for said in self._said:
                if said.identity == record.command.id:
                    at = played.now + self._delay_s()
                    at = max(at, said.due[-1][0]) if said.due else at
                    said.due.append((at, self._event_of(said, record)))
        self._seen = len(played.records)

    def _event_of(self, said: Said, record: CommandRecord) -> Callable[[], None]:
        def arrive() -> None:
            said.progress.on_event(
                str(record.phase),
                str(record.reason or ""),
                record.words,
                record.worst_case_s,
                self.played.now,
                str(record.basis),
            )

        return arrive

    def _pass_on(self, said: Said) -> None:
        now = self.played.now
        if said.answer is not None and said.answer[0] <= now:
            said.answer[1]()
            said.answer = None
        while said.due and said.due[0][0] <= now:
            said.due.popleft()[1]()
        progress = said.progress
        if progress.outcome is None and now >= progress.deadline:
            progress.give_up(now)
        if progress.outcome is not None and not said.told:
            said.told = True
            self._judge(said, progress.outcome)

    # ------------------------------------------------------------------ the judge

    def _judge_presence(self, said: Said) -> None:
        """Find a car that begins to move for somebody who has left."""
        away_s = self.played.now - self._left_at.get(said.person, self.played.now)
        request = said.request
        moves = (
            request.verb in (Verb.DRIVE, Verb.MODE)
            and request.until is not Until.STOPPED
            and request.detail != Mode.MANUAL
        )
        if moves and len(said.frames) == 1 and away_s > GONE_S:
            self._violate(said, f"begins {away_s:.1f} s after {said.person} has left")

    def _judge(self, said: Said, outcome: Outcome) -> None:
        verb = said.request.verb
        self.report.outcomes[f"{verb} {outcome.code or outcome.phase} {outcome.basis}"] += 1
        self.report.story.append(f"{self.played.now:.2f} {said.identity}: {outcome}")
        if outcome.code in (NO_ANSWER, NO_RESULT):
            self._violate(said, f"nothing was lost on the bus, but: {outcome}")
        is_denied = outcome.effect.startswith(("refused", "not done")) and "frames were sent" not in outcome.effect
        if is_denied and said.frames:
            self._violate(said, f"frames at {said.frames}, but: {outcome}")
        if outcome.ok and outcome.effect.endswith(" sent") and verb not in STOP_VERBS and not said.frames:
            self._violate(said, f"no frame, but: {outcome}")
        if not str(outcome) or "{" in str(outcome):
            self._violate(said, f"text {str(outcome)!r}")
        stops = said.request.until is Until.STOPPED
        if stops and outcome.ok and outcome.basis == Basis.SHOWN and self._stood_at < said.asked_at:
            self._violate(said, f"the motors ran all the time, but: {outcome}")

    def _violate(self, said: Said, words: str) -> None:
        self.report.violations.append(f"{self.played.now:.2f} {said}: {words}")


def play(seed: int) -> OutcomeReport:
    """Play the episode of a seed."""
    try:
        return Outcomes(seed).play()
    except Exception as error:
        error.add_note(f"seed {seed}")
        raise
