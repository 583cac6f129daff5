"""A car as the bus shows it: the newest message of each topic, how old it is, and what follows from it.

Pure: time is an argument (s, of any one clock). Lists, status, doctor, console and the plan all look at a car through
one `CarState`, so that they agree. `claims` has the words.

**How old is a message?** Two clocks could tell: ours, when it came, or the gateway's, when it stamped it. The clocks of
two computers differ by seconds, and then a stamp would make a car stale that speaks once a second. So a message that
was published just now counts from when it came. The answer to a query is another matter. It may have waited in a
gateway that hangs, or come from a replay, and only its stamp tells (`age_of_answer_s`). A stamp far ahead of our clock
is from before a clock was set back, and tells nothing: such a message counts as stale.

**Whose word is it?** A gateway that has ended vouches for nothing. Its states are kept as its last words, since a
person wants to know them, and `of` no longer returns them. As soon as another gateway speaks they are forgotten. A
state that comes late from the earlier gateway does not bring them back (`GatewayStarts`).

**Is it ready, silent, unheard?** Each is one property here. What a car has not shown delays no command, so a car is
ready without having shown anything; but a car of which nobody has heard yet, or whose gateway says nothing any more, is
not.
"""

from collections.abc import Iterable
from dataclasses import dataclass, field, replace
from functools import cache
from math import inf
from typing import Any, Final, Self

from fleet.client.claims import CarClaims, claims_of
from fleet.client.reading import Reading, age_of_answer_s
from fleet.conditions.functions import KEPT_READINGS
from schemas import messages, topics
from schemas.messages import Observation
from schemas.rights import Authority
from schemas.words import CarTrust, LinkState, Motors, Rank

NO_ANSWER: Final = "its gateway does not answer"
NEVER_HEARD: Final = "nothing was heard from it yet"
_MAX_KNOWN_ENDED: Final = 8
"""Number of ended gateways of a car whose late messages are recognized."""
LATE_MESSAGE_NS: Final = 2_000_000_000
"""Maximum time by which a late message of an ended gateway is stamped after the last one that counted, ns."""
_UNHEARD_S: Final = 3.0
"""Silence after which a car counts as unheard if the state of its motors is unknown."""


class GatewayStarts:
    """Recognizes which messages are from the running gateway of a car.

    Each start of a gateway has a `boot_id`. A message of an earlier start may come late, through a cache or a slow
    reader. It must not bring back what that gateway claimed. Two gateways of a car may run for a moment, until one of
    them ends. So a message that is stamped clearly later than all others counts, whatever its start.
    """

    def __init__(self) -> None:
        self.current = ""
        """The boot_id of the running gateway. Empty if it is not known."""
        self._newest_ns = 0
        self._ended: dict[str, None] = {}

    def take(self, boot_id: str, stamp_ns: int = 0) -> bool:
        """Return True if a message of this start counts. A new start ends the one before."""
        if boot_id in self._ended and stamp_ns <= self._newest_ns + LATE_MESSAGE_NS:
            return False
        if boot_id and boot_id != self.current:
            self.end()
            self._ended.pop(boot_id, None)
            self.current = boot_id
        self._newest_ns = max(self._newest_ns, stamp_ns)
        return True

    def end(self) -> None:
        """Note that the running gateway has ended: its messages count no more."""
        if self.current:
            self._ended[self.current] = None
            while len(self._ended) > _MAX_KNOWN_ENDED:
                del self._ended[next(iter(self._ended))]
        self.current = ""


@cache
def _empty(topic: str) -> Any:
    return messages.message_class(topics.TOPICS[topic].message)()


@dataclass(slots=True)
class CarState:
    """The newest messages of one car on the bus. Times `at` and `now`: s, of one clock that the caller chooses."""

    car: str
    present: bool = True
    """True if its gateway is there, as far as the caller knows."""
    newest_by_topic: dict[str, Observation] = field(default_factory=dict)
    _boot_id: str = ""
    """The gateway that said the states in `newest_by_topic`."""
    _starts: GatewayStarts = field(default_factory=GatewayStarts)

    @classmethod
    def of_answers(cls, car: str, answers: Iterable[tuple[str, Reading]], now: float, *, present: bool) -> Self:
        """Return the state of a car by the answers to queries, with their topics. `now` is in s since the epoch."""
        state = cls(car, present)
        for topic, reading in sorted(answers, key=lambda each: each[1].time):  # the newest gateway has the last word
            state.take(topic, reading.value, now - age_of_answer_s(reading.time.timestamp(), now))
        return state

    # ------------------------------------------------------------------ what comes in

    def take(self, topic: str, message: Any, at: float) -> bool:
        """Take in a message of a topic such as `state/link`. `at` is the time from which its age counts.

        Return False if it does not count: it is older than what is known, or of a gateway that has ended.
        """
        before = self.newest_by_topic.get(topic)
        if before is not None and before.at > at:
            return False  # what was published meanwhile has overtaken this answer
        if topic.startswith("state/"):
            if not self._starts.take(message.boot_id, messages.stamp_ns(message.stamp)):
                if message.boot_id == self._boot_id:  # the last words of a gateway that has just ended
                    self.newest_by_topic[topic] = Observation(message, at)
                return False
            boot_id = message.boot_id or self._boot_id
            if self._boot_id not in ("", boot_id):
                self._forget_states()
            self._boot_id = boot_id
        earlier = () if before is None or KEPT_READINGS == 1 else (*before.earlier, replace(before, earlier=()))
        self.newest_by_topic[topic] = Observation(message, at, earlier[1 - KEPT_READINGS :])
        return True

    def on_presence(self, *, present: bool) -> None:
        """Note that the car's gateway is on the bus, or not. One that has come back says again what is so."""
        if present and not self.present:
            self._forget_states()
        self.present = present

    def on_gateway_end(self, running: str = "") -> None:
        """Note that its gateway has ended. `running` is the boot_id of the next one, if it is known."""
        self.present = False
        if running:
            self._starts.take(running)
        else:
            self._starts.end()

    def on_sleep(self, slept_s: float) -> None:
        """Let all messages age by a sleep of the computer, which the clock of their times does not count."""
        for topic, seen in self.newest_by_topic.items():
            self.newest_by_topic[topic] = seen.aged(slept_s)

    def _forget_states(self) -> None:
        """Forget what its gateway has said of it. Readings stay: they are of the car."""
        for topic in self.states():
            del self.newest_by_topic[topic]

    # ------------------------------------------------------------------ what is known

    def newest(self, topic: str) -> Any:
        """Return the newest message, also of a gateway that has gone since. None if there is none."""
        found = self.newest_by_topic.get(topic)
        return None if found is None else found.message

    def of(self, topic: str) -> Any:
        """Return the newest message. None if there is none, or if its gateway has gone since."""
        return self.newest(topic) if self.present else None

    def states(self) -> list[str]:
        """Return the topics of the states that its gateway has said."""
        return [topic for topic in self.newest_by_topic if topic.startswith("state/")]

    def fresh(self, topic: str, now: float) -> Any:
        """Return the newest message. None if there is none, or if it is stale."""
        return None if self.is_stale(topic, now) else self.newest(topic)

    def age_s(self, topic: str, now: float) -> float:
        """Return the age of the newest message. Infinite if there is none, or if its stamp tells none."""
        found = self.newest_by_topic.get(topic)
        return inf if found is None else max(0.0, now - found.at)

    def is_stale(self, topic: str, now: float) -> bool:
        """Return True if the newest message should have been followed by another meanwhile."""
        after_s = topics.TOPICS[topic].stale_after_s
        return after_s is not None and self.age_s(topic, now) > after_s

    def stale_topics(self, now: float) -> list[str]:
        """Return the topics whose newest message is stale, sorted."""
        return sorted(topic for topic in self.newest_by_topic if topic in topics.TOPICS and self.is_stale(topic, now))

    def last_word(self, topic: str) -> Any:
        """Return the newest message, also of a gateway that has gone since. An empty one if there is none."""
        return self.newest(topic) or _empty(topic)

    # The states of a gateway that is there, such as a fleet.v1.Link. What nobody said reads as an empty message.
    link = property(lambda self: self.of("state/link") or _empty("state/link"))
    mode = property(lambda self: self.of("state/mode") or _empty("state/mode"))
    motion = property(lambda self: self.of("state/motion") or _empty("state/motion"))
    safety = property(lambda self: self.of("state/safety") or _empty("state/safety"))
    health = property(lambda self: self.of("state/health") or _empty("state/health"))

    # ------------------------------------------------------------------ what follows from it

    def claims(self, now: float) -> CarClaims:
        """Return what is claimed of motors, mode and link. If the gateway is gone, the claims are past."""
        states = {topic: seen.message for topic, seen in self.newest_by_topic.items()}
        return claims_of(states, {topic: self.age_s(topic, now) for topic in states}, present=self.present)

    @property
    def authority(self) -> Authority:
        """The permissions of each client, by the last message of a gateway."""
        return Authority.of(self.last_word("state/safety"))

    @property
    def driver(self) -> str:
        """The client that drives it: the owner of its motion, or the holder of its lease. Empty if none, or a plan."""
        lease = self.safety.lease
        return self.motion.owner or ("" if lease.kind == Rank.COORDINATOR else lease.holder)

    @property
    def last_rx_s(self) -> float | None:
        """Time since the last byte from the car, by its gateway's last report. None if no byte came over this link."""
        return self.link.last_rx_s if self.link.HasField("last_rx_s") else None

    @property
    def is_silent(self) -> bool:
        """True if the link is open, and the car is silent for longer than is normal for it."""
        if self.link.state == LinkState.QUIET:
            return bool(self.safety.trust == CarTrust.UNHEARD)
        return bool(self.link.state == LinkState.STALE)

    @property
    def is_unheard(self) -> bool:
        """True if the link is open and the car is silent: stale, without any byte, or unknown for too long."""
        if self.of("state/link") is None or self.link.state == LinkState.LOST:
            return False
        if self.link.state == LinkState.STALE or self.last_rx_s is None:
            return True
        return bool(self.safety.motors == Motors.UNKNOWN and self.last_rx_s > _UNHEARD_S)

    def why_not_ready(self, now: float) -> str | None:
        """Return why the car is not ready, in words: empty if nothing tells, None if it is ready.

        A ready car answers, and a command to it waits for nothing.
        """
        link, safety, claims = self.link, self.safety, self.claims(now)
        # Stale are the states of a replay, and of a gateway that hangs.
        if not link.state or claims.link.is_stale or claims.motors.is_stale:
            return ""
        if link.state == LinkState.LOST:
            return f"link lost: {link.reason}" if link.reason else "link lost"
        if link.state == LinkState.STALE:  # it gets commands all the same
            return "silent: is it switched on?"
        if safety.waits_for:
            return f"waits for {safety.waits_for}"
        # Of a car that sends nothing a gateway knows the motors without a byte.
        heard = safety.motors in (Motors.OFF, Motors.ON) or (safety.motors and self.last_rx_s is not None)
        return None if heard else NEVER_HEARD

    def why_missing(self, now: float) -> str:
        """Return why a car is missing from a start, in words, or an empty text if it is ready."""
        why = self.why_not_ready(now)
        if why is None or why:
            return why or ""
        if not self.link.state:
            return "its gateway is starting"
        return NO_ANSWER
