"""A car as the bus shows it: the newest message of each topic, the age of each message, and conclusions from them.

Pure: time is an argument (s, of any one clock). Lists, status, doctor, console and the plan all look at a car through
one `CarState`, so that they agree. The module `claims` puts that state into words.

**How old is a message?** Its age could count from its arrival, by our clock, or from its stamp, by the gateway's clock.
The clocks of two computers differ by seconds. By stamps, a car that publishes once a second could look stale.
So the age of a message that was published just now counts from its arrival. An answer to a query is different. It may
have waited in a gateway that hangs, or come from a replay, and only its stamp shows its age (`age_of_answer_s`). If the
stamp is far ahead of our clock, a clock was set back after the message was stamped. Such a message counts as stale.

**Does its gateway still run?** The states of a gateway that has ended no longer count. They are kept as its last words,
since a person wants to know them, but `current` does not return them. They are forgotten as soon as another gateway of
the car publishes a state. A late state of the earlier gateway does not bring them back (`GatewayStarts`).

**Is the car ready, silent, unheard?** Each of these words has a property or a method here. A car can be ready before it
has shown that it stops, because a command does not wait for that. A car that nobody has heard yet, or whose gateway
publishes nothing any more, is not ready.
"""

from collections.abc import Iterable
from functools import cache
from math import inf
from typing import Any, Final, Self

from msgspec import Struct, field
from msgspec.structs import replace

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
"""Number of ended gateways that are remembered for each car, to recognize their late messages."""
LATE_MESSAGE_NS: Final = 2_000_000_000
"""A message of an ended gateway counts only if its stamp is newer than all others by more than this time: two of the
intervals in which each running gateway publishes its states (1 s)."""
_UNHEARD_S: Final = 3.0
"""Silence after which a car counts as unheard if the state of its motors is unknown."""


class GatewayStarts:
    """Recognizes the messages of the running gateway of a car.

    Each start of a gateway has a `boot_id`. A message of an earlier start may come late, through a cache or a slow
    reader, and must not bring back what that gateway claimed. Two gateways of a car may run for a moment, until one of
    them ends. So a message that is stamped clearly later than all others counts, whichever start it is from.
    """

    def __init__(self) -> None:
        self.current = ""
        """The boot_id of the running gateway. Empty if it is not known."""
        self._newest_ns = 0
        self._ended: dict[str, None] = {}

    def take(self, boot_id: str, stamp_ns: int = 0) -> bool:
        """Return True if a message of this start counts. A new start ends the earlier one."""
        if boot_id in self._ended and stamp_ns <= self._newest_ns + LATE_MESSAGE_NS:
            return False
        if boot_id and boot_id != self.current:
            self.end()
            self._ended.pop(boot_id, None)
            self.current = boot_id
        self._newest_ns = max(self._newest_ns, stamp_ns)
        return True

    def end(self) -> None:
        """Note that the running gateway has ended: its messages no longer count."""
        if self.current:
            self._ended[self.current] = None
            while len(self._ended) > _MAX_KNOWN_ENDED:
                del self._ended[next(iter(self._ended))]
        self.current = ""


@cache
def _empty(topic: str) -> Any:
    return messages.message_class(topics.TOPICS[topic].message)()


class CarState(Struct):
    """The newest messages of one car on the bus. Times `at` and `now`: s, of one clock that the caller chooses."""

    car: str
    present: bool = True
    """True if its gateway is on the bus, as far as the caller knows."""
    newest_by_topic: dict[str, Observation] = field(default_factory=dict)
    _boot_id: str = ""
    """The boot_id of the gateway that published the states in `newest_by_topic`."""
    _starts: GatewayStarts = field(default_factory=GatewayStarts)

    @classmethod
    def of_answers(cls, car: str, answers: Iterable[tuple[str, Reading]], now: float, *, present: bool) -> Self:
        """Return the state of a car from answers to queries, each with its topic. `now` is in s since the epoch."""
        state = cls(car, present)
        for topic, reading in sorted(answers, key=lambda each: each[1].time):  # the newest gateway's states come last
            state.take(topic, reading.value, now - age_of_answer_s(reading.time.timestamp(), now))
        return state

    # ------------------------------------------------------------------ input

    def take(self, topic: str, message: Any, at: float) -> bool:
        """Add a message of a topic such as `state/link`. `at` is the time from which its age counts.

        Return False if the message does not count: it is older than the newest one, or its gateway has ended.
        """
        before = self.newest_by_topic.get(topic)
        if before is not None and before.at > at:
            return False  # a message that was published meanwhile has overtaken this answer
        if topic.startswith("state/"):
            if not self._starts.take(message.boot_id, messages.stamp_ns(message.stamp)):
                if message.boot_id == self._boot_id:  # the last words of a gateway that has just ended
                    self.newest_by_topic[topic] = Observation(message, at)
                return False
            boot_id = message.boot_id or self._boot_id  # a message without a boot_id counts as the same gateway's
            if self._boot_id not in ("", boot_id):
                self._forget_states()
            self._boot_id = boot_id
        earlier: tuple[Observation, ...] = ()
        if before is not None and KEPT_READINGS > 1:
            earlier = (*before.earlier, replace(before, earlier=()))[1 - KEPT_READINGS :]
        self.newest_by_topic[topic] = Observation(message, at, earlier)
        return True

    def on_presence(self, *, present: bool) -> None:
        """Note whether the car's gateway is on the bus. A gateway that comes back publishes its states again."""
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
        """Add a sleep of the computer to the age of all messages, because our clock stood still during the sleep."""
        for topic, seen in self.newest_by_topic.items():
            self.newest_by_topic[topic] = seen.aged(slept_s)

    def _forget_states(self) -> None:
        """Forget the states that its gateway published. Readings stay, because they come from the car itself."""
        for topic in self.states():
            del self.newest_by_topic[topic]

    # ------------------------------------------------------------------ newest messages

    def newest(self, topic: str) -> Any:
        """Return the newest message, also of a gateway that has gone since. None if there is none."""
        found = self.newest_by_topic.get(topic)
        return None if found is None else found.message

    def current(self, topic: str) -> Any:
        """Return the newest message. None if there is none, or if its gateway has gone since."""
        return self.newest(topic) if self.present else None

    def states(self) -> list[str]:
        """Return the topics of the states that its gateway has published."""
        return [topic for topic in self.newest_by_topic if topic.startswith("state/")]

    def fresh(self, topic: str, now: float) -> Any:
        """Return the newest message. None if there is none, or if it is stale."""
        return None if self.is_stale(topic, now) else self.newest(topic)

    def age_s(self, topic: str, now: float) -> float:
        """Return the age of the newest message. Infinite if there is none, or if its stamp gives no age."""
        found = self.newest_by_topic.get(topic)
        return inf if found is None else max(0.0, now - found.at)

    def is_stale(self, topic: str, now: float) -> bool:
        """Return True if another message should have followed the newest one by now."""
        after_s = topics.TOPICS[topic].stale_after_s
        return after_s is not None and self.age_s(topic, now) > after_s

    def stale_topics(self, now: float) -> list[str]:
        """Return the topics whose newest message is stale, sorted."""
        return sorted(topic for topic in self.newest_by_topic if topic in topics.TOPICS and self.is_stale(topic, now))

    def last_word(self, topic: str) -> Any:
        """Return the newest message, also of a gateway that has gone since. An empty one if there is none."""
        return self.newest(topic) or _empty(topic)

    # The states that the gateway publishes, as messages such as fleet.v1.Link. An empty message stands for a missing
    # state, and for each state of a gateway that is not on the bus.
    link = property(lambda self: self.current("state/link") or _empty("state/link"))
    mode = property(lambda self: self.current("state/mode") or _empty("state/mode"))
    motion = property(lambda self: self.current("state/motion") or _empty("state/motion"))
    safety = property(lambda self: self.current("state/safety") or _empty("state/safety"))
    health = property(lambda self: self.current("state/health") or _empty("state/health"))

    # ------------------------------------------------------------------ conclusions

    def claims(self, now: float) -> CarClaims:
        """Return the claims about motors, mode and link. If the gateway is gone, they are past claims."""
        states = {topic: seen.message for topic, seen in self.newest_by_topic.items()}
        return claims_of(states, {topic: self.age_s(topic, now) for topic in states}, present=self.present)

    @property
    def authority(self) -> Authority:
        """The permissions of each client, by the last message of a gateway."""
        return Authority.of(self.last_word("state/safety"))

    @property
    def driver(self) -> str:
        """The client that drives the car: the owner of its motion, or the holder of its lease.

        Empty if nobody drives the car, or a plan does.
        """
        lease = self.safety.lease
        return self.motion.owner or ("" if lease.kind == Rank.COORDINATOR else lease.holder)

    @property
    def last_rx_s(self) -> float | None:
        """Time since the last byte from the car, by its gateway's last report. None if no byte came over this link."""
        return self.link.last_rx_s if self.link.HasField("last_rx_s") else None

    @property
    def is_silent(self) -> bool:
        """True if the link is open, and the car sends nothing for longer than is normal for it."""
        if self.link.state == LinkState.QUIET:
            return bool(self.safety.trust == CarTrust.UNHEARD)
        return bool(self.link.state == LinkState.STALE) and not self.is_unreadable

    @property
    def is_unreadable(self) -> bool:
        """True if the link is open, and bytes arrive that are no readings.

        A reading brings a stale link back. So bytes that came long after the link became stale are none.
        """
        if self.link.state != LinkState.STALE or self.last_rx_s is None:
            return False
        return bool(self.last_rx_s < min(_UNHEARD_S, self.link.since_s - _UNHEARD_S))

    @property
    def is_unheard(self) -> bool:
        """True if the link is open, but the car was not heard.

        It was not heard if the link is stale, if no byte has come, or if it is silent and the state of its motors is
        unknown.
        """
        if self.current("state/link") is None or self.link.state == LinkState.LOST:
            return False
        if self.link.state == LinkState.STALE or self.last_rx_s is None:
            return True
        return bool(self.safety.motors == Motors.UNKNOWN and self.last_rx_s > _UNHEARD_S)

    def why_not_ready(self, now: float) -> str | None:
        """Return why the car is not ready, in words. Empty if the cause is not known. None if the car is ready.

        A ready car answers, and a command to it does not have to wait.
        """
        link, safety, claims = self.link, self.safety, self.claims(now)
        # States are stale in a replay, or if the gateway hangs.
        if not link.state or claims.link.is_stale or claims.motors.is_stale:
            return ""
        if link.state == LinkState.LOST:
            return f"link lost: {link.reason}" if link.reason else "link lost"
        if self.is_unreadable:
            return "bytes come, but no reading: `fleet doctor` says more"
        if link.state == LinkState.STALE:  # commands are still sent to such a car
            return "silent: is it switched on?"
        if safety.waits_for:
            return f"waits for {safety.waits_for}"
        # Some cars never send a byte. So the motors' states `off` and `on` count before any byte has come, but the
        # other states of the motors do not.
        heard = safety.motors in (Motors.OFF, Motors.ON) or (safety.motors and self.last_rx_s is not None)
        return None if heard else NEVER_HEARD

    def why_missing(self, now: float) -> str:
        """Return why the start of a fleet still waits for this car, in words. Empty if the car is ready."""
        why = self.why_not_ready(now)
        if why is None:
            return ""
        if why:
            return why
        return NO_ANSWER if self.link.state else "its gateway is starting"
