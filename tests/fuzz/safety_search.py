"""Searches for e-stops and pauses that are lost, come back, or cannot be ended, among several gateways of a fleet.

An episode has two to five cars and people who stop, pause and resume one car or all, at any moment. Between them is a
bus whose sites part and join, and that delays each message for itself. Gateways hang, are killed and restart. The
rules, the payloads and the merge are the real ones, and only the bus is not. At the end the bus is whole and at rest.
Then all gateways must agree: what was begun and not ended is in force everywhere, and nothing else.
"""

import heapq
import itertools
import random
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from typing import Any, Final

from fleet.client.commands import (
    CommandRequest,
    estop_request,
    pause_request,
    plain_request,
    resume_request,
    stop_request,
)
from gateway.bus import command_parser
from gateway.bus.car_service import Request
from gateway.bus.estop_sync import (
    BATCH_DELAY_S,
    FIRST_RETRY_S,
    ROUND_S,
    SYNC_QUERY_TIMEOUT_S,
    concerns_fleet,
    copy_for_others,
)
from gateway.control.commands import Command, EmergencyStop, Resume, Unpause
from gateway.control.safety_state import PersistedSafety
from gateway.drivers.yahboom.protocol.platforms import parse_platform
from schemas.commands import Verb
from schemas.rights import NO_PEOPLE, People
from schemas.topics import PROTOBUF
from schemas.words import Rank, Scope
from tests.support.controls import Control, control

SENDERS: Final = (
    ("ann", Rank.PERSON),
    ("ben", Rank.PERSON),
    ("mia", Rank.PERSON),
    ("tom", Rank.PERSON),
    ("guest", Rank.PERSON),
    ("mia", Rank.SCRIPT),
    ("script", Rank.SCRIPT),
    ("plan", Rank.COORDINATOR),
)
"""The senders of commands. In a table of people, ann and ben are leads, mia and tom drive, and guest is not listed."""
TABLE: Final = ("ann:lead", "ben:lead", "mia", "tom:other")
EPOCH_NS: Final = 1_700_000_000_000_000_000
COMMANDS_S: Final = 30.0
"""Time in which people send commands and things go wrong."""
QUIET_S: Final = 40.0
"""Time after it, in which all gateways must agree."""
RELEASED_S: Final = 30.0
"""Time in which a person who may end everything has done so."""
HANG_S: Final = 4.0
FORWARD_S: Final = 2.0
"""Time in which an e-stop of one car is known to all that could hear of it: two messages."""


@dataclass(slots=True)
class Node:
    """A car's gateway and where it is on the bus."""

    name: str
    people: People
    site: int
    control: Control
    alive: bool = True
    life: int = 0
    """Number of restarts. What was on its way to an earlier life is lost."""
    free_at: float = 0.0
    """Until then it hangs: messages wait."""
    due: set[str] = field(default_factory=set)
    seen: set[str] = field(default_factory=set)
    """Other gateways whose token it sees."""
    is_syncing: bool = False
    told_ended: set[str] = field(default_factory=set)
    """Ids of which another gateway has told it that they have ended."""


class SafetyEpisode:
    """One fleet, on virtual time."""

    def __init__(self, seed: int) -> None:
        self.moments = random.Random(seed)
        self.now = 0.0
        self.violations: list[str] = []
        self.story: list[str] = []
        self._events: list[tuple[float, int, Callable[[], None]]] = []
        self._number = itertools.count()
        kind = self.moments.choice(["nobody", "table", "table", "mixed"])
        self.is_mixed = kind == "mixed"
        """True if only some gateways know the people."""
        table = People.parse(TABLE)
        self.nodes: dict[str, Node] = {}
        self.sites = self.moments.choice([1, 1, 2])
        for number in range(self.moments.randint(2, 5)):
            people = table if kind == "table" or (self.is_mixed and self.moments.random() < 0.5) else NO_PEOPLE
            name = f"c{number}"
            self.nodes[name] = Node(name, people, self.moments.randrange(self.sites), self._started(name, people))
        self.parted = False
        """True while the sites have no link."""
        self.parted_or_joined_at = 0.0
        self.begun: dict[str, set[str]] = {"estop": set(), "pause": set()}
        """Ids of the fleet-wide e-stops and of the pauses that a gateway has put in force by a command."""
        self.ended: dict[str, set[str]] = {"estop": set(), "pause": set()}
        self._tokens_changed()
        for node in self.nodes.values():
            self._round(node)

    def _started(self, name: str, people: People, persisted: PersistedSafety | None = None) -> Control:
        return control(
            parse_platform("arduino"), name=name, people=people, persisted=persisted, now=self.now, now_ns=self.wall_ns
        )

    @property
    def wall_ns(self) -> int:
        """The wall clock."""
        return EPOCH_NS + int(self.now * 1e9)

    def after(self, delay_s: float, event: Callable[[], None]) -> None:
        """Let something happen later."""
        heapq.heappush(self._events, (self.now + delay_s, next(self._number), event))

    def run(self, seconds: float) -> None:
        """Let time pass."""
        end = self.now + seconds
        while self._events and self._events[0][0] <= end:
            self.now, _, event = heapq.heappop(self._events)
            event()
        self.now = end

    def delay_s(self) -> float:
        """Draw the delay of a message."""
        return self.moments.choice([0.002, 0.02 * self.moments.random(), 0.6 * self.moments.random()])

    def tell(self, words: str) -> None:
        """Add to the story."""
        self.story.append(f"{self.now:7.3f} {words}")

    # ------------------------------------------------------------------ the bus

    def reaches(self, site: int, node: Node) -> bool:
        """Return True if messages from a site reach a gateway now."""
        return node.alive and (node.site == site or not self.parted)

    def _tokens_changed(self) -> None:
        """Let each gateway see soon which others are there."""
        for node in self.nodes.values():
            for other in self.nodes.values():
                if node is not other:
                    self.after(0.01 + 0.5 * self.moments.random(), partial(self._see, node, other))

    def _see(self, node: Node, other: Node) -> None:
        if not node.alive:
            return
        if self.reaches(node.site, other):
            if other.name not in node.seen:
                node.seen.add(other.name)
                node.due.add(other.name)
                self._sync(node)
        else:
            node.seen.discard(other.name)
            node.due.discard(other.name)

    def send(self, payload: Any, verb: str, site: int, target: str, *, is_copy: bool = False) -> None:
        """Send a command from a site to one gateway, or to all (`*`). `is_copy`: a gateway sends it."""
        request = Request(verb, payload.SerializeToString(), PROTOBUF, by_wildcard=target == "*")
        for node in self.nodes.values():
            if target in ("*", node.name) and self.reaches(site, node):
                self._deliver(node, node.life, site, request, self.delay_s(), is_copy=is_copy)

    def _deliver(self, node: Node, life: int, site: int, request: Request, delay_s: float, *, is_copy: bool) -> None:
        def arrive() -> None:
            if node.life != life or not self.reaches(site, node):
                return
            if self.now < node.free_at:
                self._deliver(node, life, site, request, node.free_at - self.now, is_copy=is_copy)
                return
            self._handle(node, request, is_copy=is_copy)

        self.after(delay_s, arrive)

    def _handle(self, node: Node, request: Request, *, is_copy: bool) -> None:
        """Do what `CommandHandler` does with a request."""
        before = node.control.safety.persisted
        try:
            command = command_parser.parse(request, self.wall_ns, car=node.name)
        except command_parser.BadRequest as error:
            self.violations.append(f"{request.verb}: {error.words}")
            return
        answer = node.control.command(command, self.now)
        node.control.take_records()
        now = node.control.safety.persisted
        self._note(node, before, now, command, is_copy=is_copy)
        self.tell(
            f"{node.name} {command.verb} {command.what} by {command.sender}: {answer.status} {answer.reason or ''}"
        )
        if request.by_wildcard:
            if concerns_fleet(command, answer):
                node.due |= node.seen
                self._sync(node)
            return
        copy = copy_for_others(command, node.name, before, node.control.safety)
        if copy is not None:
            self.after(
                self.delay_s(),
                lambda: self.send(copy, command.verb, node.site, "*", is_copy=True) if node.alive else None,
            )
        if isinstance(command.what, EmergencyStop) and command.what.fleet_wide:
            self._expect_everywhere(node, command.id)

    def _expect_everywhere(self, origin: Node, estop: str) -> None:
        """Find the gateways that could hear of an e-stop and do not know it after a moment."""
        could = [(each, each.life) for each in self.nodes.values() if self.reaches(origin.site, each)]
        began, life_of_origin = self.now, origin.life

        def check() -> None:
            if self.parted_or_joined_at > began or origin.life != life_of_origin:
                return
            for node, life in could:
                safety = node.control.safety
                known = (*(each.id for each in safety.estops), *safety.ended)
                is_well = node.life == life and self.now > node.free_at + FORWARD_S
                if is_well and estop not in known and not any(each.startswith(f"{estop}.") for each in known):
                    self.violations.append(f"{node.name} lacks estop {estop} after {FORWARD_S} s")

        self.after(FORWARD_S, check)

    def _note(
        self, node: Node, before: PersistedSafety, now: PersistedSafety, command: Command, *, is_copy: bool
    ) -> None:
        """Note what a command has begun and ended."""
        by_resume = isinstance(command.what, Resume | Unpause)
        by_lead = node.people.ranked(command.sender).kind is Rank.LEAD
        for kind, was, is_now in (("estop", before.estops, now.estops), ("pause", before.pauses, now.pauses)):
            earlier = {each.id for each in was if kind == "pause" or each.fleet_wide}
            later = {each.id for each in is_now if kind == "pause" or each.fleet_wide}
            if not self.is_mixed and not by_lead:
                taken = {each.id for each in was if each.rank is Rank.LEAD} - {each.id for each in is_now}
                self.violations += [f"{command.sender} ends a lead's {kind} {each}" for each in sorted(taken)]
            self.begun[kind] |= later - earlier
            if is_copy and (unasked := earlier - later - self.ended[kind]):
                self.violations.append(f"a copy ends {kind} {sorted(unasked)} at {node.name}, which nobody wanted")
            elif by_resume:
                self.ended[kind] |= earlier - later
            elif earlier - later:
                self.violations.append(f"{node.name} lost {kind} {earlier - later} by no resume")

    def _sync(self, node: Node) -> None:
        """Query the gateways that are due, until they have answered, as `EstopSync.keep_synced` does."""
        if node.is_syncing:
            return
        node.is_syncing, life = True, node.life

        def ask() -> None:
            node.is_syncing = False
            if node.life != life:
                return
            for name in sorted(node.due):
                other = self.nodes[name]
                if self.reaches(node.site, other) and self.now >= other.free_at:
                    self.after(self.delay_s(), partial(answer, other, other.life))
            if node.due:
                self.after(SYNC_QUERY_TIMEOUT_S + FIRST_RETRY_S, lambda: self._sync(node) if node.due else None)

        def answer(other: Node, its_life: int) -> None:
            if other.life != its_life or not self.reaches(node.site, other):
                return
            state = other.control.safety.persisted
            self.after(self.delay_s(), lambda: merge(other, state))

        def merge(other: Node, state: PersistedSafety) -> None:
            if node.life != life or not node.alive:
                return
            node.due.discard(other.name)
            node.control.merge_estops(state.estops, state.ended, other.name, self.now)
            node.control.merge_pauses(state.pauses, state.ended_pauses, other.name, self.now)
            node.control.take_records()
            node.told_ended |= {*state.ended, *state.ended_pauses}
            if back := node.told_ended & (self.in_force("estop", node) | self.in_force("pause", node)):
                self.violations.append(f"{node.name} begins again what it knows to be over: {sorted(back)}")

        self.after(BATCH_DELAY_S, ask)

    def _round(self, node: Node) -> None:
        """Query one of the others from time to time."""

        def draw() -> None:
            if node.alive and node.seen:
                node.due.add(self.moments.choice(sorted(node.seen)))
                self._sync(node)
            self._round(node)

        self.after(2.0 * ROUND_S * self.moments.random(), draw)

    # ------------------------------------------------------------------ people, and what goes wrong

    def command(self, request: CommandRequest, sender: tuple[str, Rank], site: int, target: str) -> None:
        """Send a command of somebody, as the client does."""
        message = request.message
        message.id, message.sender, message.kind = f"i{next(self._number)}", *sender
        message.asked.FromNanoseconds(self.wall_ns)
        self.tell(f"   {sender[0]} ({sender[1]}) at site {site}: {request.verb} {target} {message.id}")
        self.send(message, request.verb, site, target)

    def act(self) -> None:
        """Let somebody do something."""
        moments = self.moments
        site, target = moments.randrange(self.sites), moments.choice(["*", *self.nodes])
        known = [each.id for node in self.nodes.values() for each in node.control.safety.estops]
        requests = (
            estop_request("", Scope.FLEET),
            estop_request("", Scope.CAR),
            stop_request(),
            pause_request("lunch"),
            plain_request(Verb.UNPAUSE),
            resume_request(),
            resume_request(everything=True),
            resume_request([moments.choice(known)] if known else (), everything=not known),
        )
        request = moments.choices(requests, [3, 1, 1, 3, 3, 1, 3, 2])[0]
        self.command(request, moments.choice(SENDERS), site, target)

    def disturb(self) -> None:
        """Let something go wrong, or be well again."""
        moments, node = self.moments, self.moments.choice(list(self.nodes.values()))
        match moments.choices(["part", "join", "kill", "hang", "cut"], [2, 2, 2, 2, 1])[0]:
            case "part" if not self.parted and self.sites > 1:
                self.parted, self.parted_or_joined_at = True, self.now
                self.tell("   the sites part")
                self._tokens_changed()
            case "join" if self.parted:
                self.join()
            case "kill" if node.alive:
                self.tell(f"   {node.name} is killed")
                node.alive, node.life = False, node.life + 1
                self._tokens_changed()
                self.after(0.5 + 2.0 * moments.random(), lambda: self._restart(node))
            case "hang":
                node.free_at = self.now + HANG_S * moments.random()
                self.tell(f"   {node.name} hangs until {node.free_at:.3f}")
            case _:
                pass

    def join(self) -> None:
        """Link the sites again."""
        self.parted, self.parted_or_joined_at = False, self.now
        self.tell("   the sites join")
        self._tokens_changed()

    def _restart(self, node: Node) -> None:
        self.tell(f"   {node.name} is back")
        node.control = self._started(node.name, node.people, node.control.safety.persisted)
        node.alive, node.due, node.seen, node.free_at, node.is_syncing = True, set(), set(), 0.0, False
        self._tokens_changed()

    # ------------------------------------------------------------------ the judge

    def in_force(self, kind: str, node: Node) -> set[str]:
        """Return the ids of the fleet-wide e-stops or of the pauses that are in force at a gateway."""
        safety = node.control.safety
        if kind == "pause":
            return {each.id for each in safety.pauses}
        return {each.id for each in safety.estops if each.fleet_wide}

    def judge(self) -> None:
        """Find what differs from what people were told."""
        for kind in ("estop", "pause"):
            found = {name: self.in_force(kind, node) for name, node in self.nodes.items()}
            wanted = self.begun[kind] - self.ended[kind]
            for name, ids in found.items():
                if wanted - ids:
                    self.violations.append(f"{name} lacks {kind} {sorted(wanted - ids)}")
                if ids - wanted:
                    self.violations.append(f"{name} has {kind} {sorted(ids - wanted)} that was ended")

    def release(self) -> None:
        """Let a person who may do so end everything."""
        for request in (resume_request(everything=True), plain_request(Verb.UNPAUSE)):
            self.command(request, ("ann", Rank.PERSON), 0, "*")
        self.run(RELEASED_S)
        for node in self.nodes.values():
            safety = node.control.safety
            # A gateway that knows no people keeps the hold of a lead, who alone may end it there.
            if safety.estops or safety.pauses or (safety.hold and not self.is_mixed):
                self.violations.append(f"{node.name} cannot be released: {safety.persisted}")


def play(seed: int) -> SafetyEpisode:
    """Play one fleet."""
    episode = SafetyEpisode(seed)
    moments = episode.moments
    episode.run(2.0)
    end = episode.now + COMMANDS_S
    while episode.now < end:
        episode.run(moments.choice([0.0, 0.05, 0.5, 3.0]) * moments.random())
        if moments.random() < 0.7:
            episode.act()
        else:
            episode.disturb()
    if episode.parted:
        episode.join()
    episode.run(QUIET_S)
    episode.judge()
    episode.release()
    return episode
