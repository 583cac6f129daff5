"""Hold to drive: the dead man's switch of the pages. Pure: time is an argument (s, monotonic).

The server sends each page numbered ticks, ten a second. While the finger is down, the page echoes each tick with the id
of its press.
"""

from collections.abc import Callable
from typing import Final

from msgspec import Struct

from schemas.limits import STREAM_SILENCE_S
from schemas.rights import NO_PEOPLE, LeaseState, People, Sender
from schemas.words import Rank

TICK_INTERVAL_S: Final = 0.1
"""Interval of ticks."""
# A frozen browser still answers pings. A page that thaws, or a link that recovers, delivers old messages in a burst.
# Therefore an echo counts only if its tick is new by the server's own clock. Measured: on a phone slowed down 6 times,
# no press ended by mistake.
MAX_TICK_AGE_S: Final = 0.3
"""Maximum age of a tick when its echo arrives."""
MAX_COMMAND_AGE_S: Final = 2.0
"""Maximum age of a page's newest tick when a command of the page arrives. A gateway rejects a command of a client that
is older, but knows only when the console has sent it."""
MAX_ECHO_GAP_S: Final = 0.3
"""Maximum time without an echo. When it has passed, the press is over."""
# After a stop, a gateway rejects a stream of drives until its sender has been silent. The added 0.1 s is one tick.
AFTER_STOP_S: Final = STREAM_SILENCE_S + 0.1
"""Minimum time from a STOP to the next press."""
_MAX_TICKS: Final = 32
"""Number of remembered ticks. It is larger than the number of ticks within each maximum age."""


TOO_LATE: Final = "Nothing was done: this reached the console more than 2 s after it was pressed. Press again."
"""Answer to a command that is too old."""


class PressRefused(Exception):
    """The press may not begin. The text is for a person."""


class HeldPress(Struct):
    """A motion of some cars that the person at a page holds down."""

    client: int
    id: int
    cars: tuple[str, ...]
    motion: str
    last_echo_at: float
    person: str = ""

    @property
    def sender(self) -> Sender:
        """Return the page as a sender: two pages of one person are two senders."""
        return Sender(f"{self.person}@{self.client}", Rank.PERSON)


class PressBook:
    """The presses that are alive, at most one for each page."""

    def __init__(self) -> None:
        self._number = 0
        self._ticks: dict[int, float] = {}
        self._presses: dict[int, HeldPress] = {}
        self._newest_ids: dict[int, int] = {}
        self._stopped_at = float("-inf")

    @property
    def alive(self) -> list[HeldPress]:
        """All presses that are alive."""
        return list(self._presses.values())

    def tick(self, now: float) -> int:
        """Issue a tick and return its number."""
        self._number += 1
        self._ticks[self._number] = now
        self._ticks.pop(self._number - _MAX_TICKS, None)
        return self._number

    def is_late(self, tick: int, now: float) -> bool:
        """Return True if a command that names this tick is too old to be carried out."""
        return now - self._ticks.get(tick, float("-inf")) > MAX_COMMAND_AGE_S

    def begin(
        self,
        client: int,
        press_id: int,
        cars: tuple[str, ...],
        motion: str,
        tick: int,
        now: float,
        *,
        person: str = "",
        people: People = NO_PEOPLE,
    ) -> tuple[HeldPress, list[HeldPress]]:
        """Begin a press. It replaces the page's earlier press. Raises PressRefused.

        Return the press, and the presses of other pages that it ends: a lead takes cars from persons who are not leads.
        An id counts once: a press that is over never begins again, not even by a late message. person: the person at
        the page. people: the people of these cars.
        """
        if press_id <= self._newest_ids.get(client, -1):
            raise PressRefused("This press is over. Press again.")
        self._newest_ids[client] = press_id
        if not self._is_new(tick, now):
            raise PressRefused("The connection to the console is slow. Press again.")
        if now - self._stopped_at < AFTER_STOP_S:
            raise PressRefused("The cars were stopped just now. Press again.")
        taken = [other for other in self._presses.values() if other.client != client and set(cars) & set(other.cars)]
        press = HeldPress(client, press_id, cars, motion, now, person)
        for other in taken:
            if not _may_take(press.sender, other, people):
                shared = " and ".join(sorted(set(cars) & set(other.cars)))
                raise PressRefused(f"{_driver(other, person)} drives {shared}.")
        for other in taken:
            del self._presses[other.client]
        self._presses[client] = press
        return press, taken

    def echo(self, client: int, press_id: int, tick: int, now: float) -> HeldPress | None:
        """Handle the echo of a tick. Return the press, or None if the press is over or the tick is old."""
        press = self._presses.get(client)
        if press is None or press.id != press_id or not self._is_new(tick, now):
            return None
        if now - press.last_echo_at > MAX_ECHO_GAP_S:  # `expire` has not run yet
            return None
        press.last_echo_at = now
        return press

    def release(self, client: int, press_id: int) -> HeldPress | None:
        """End a press, because the finger was lifted. Return the press, or None if it was over already."""
        self._newest_ids[client] = max(press_id, self._newest_ids.get(client, -1))
        press = self._presses.get(client)
        if press is None or press.id > press_id:
            return None
        return self._presses.pop(client)

    def expire(self, now: float) -> list[HeldPress]:
        """End the presses without a recent echo and return them."""
        return self._end(lambda press: now - press.last_echo_at > MAX_ECHO_GAP_S)

    def drop_client(self, client: int) -> list[HeldPress]:
        """End the press of a page that has gone, and forget the page."""
        self._newest_ids.pop(client, None)
        return self._end(lambda press: press.client == client)

    def on_stop(self, now: float) -> list[HeldPress]:
        """End every press, because all cars were stopped."""
        self._stopped_at = now
        return self._end(lambda _: True)

    def on_sleep(self) -> list[HeldPress]:
        """End every press, because the computer slept.

        Forget all ticks, because their ages do not include the sleep.
        """
        self._ticks.clear()
        return self._end(lambda _: True)

    def on_bus_lost(self) -> list[HeldPress]:
        """End every press, because no command can reach a car."""
        return self._end(lambda _: True)

    def on_cars_stopped(self, cars: set[str]) -> list[HeldPress]:
        """End every press of these cars, because they were stopped."""
        return self._end(lambda press: bool(cars & set(press.cars)))

    def drop_cars_of(self, cars: set[str], person: str, people: People = NO_PEOPLE) -> list[HeldPress]:
        """End presses of these cars, because this person set their mode, or gave them back.

        The person's own presses end. A lead of the cars also ends the presses of persons who are not leads.
        """
        sender = Sender(person, Rank.PERSON)
        return self._end(
            lambda press: bool(cars & set(press.cars)) and (press.person == person or _may_take(sender, press, people))
        )

    def current(self, client: int) -> HeldPress | None:
        """Return the press of a page."""
        return self._presses.get(client)

    def _is_new(self, tick: int, now: float) -> bool:
        return now - self._ticks.get(tick, float("-inf")) <= MAX_TICK_AGE_S

    def _end(self, ends: Callable[[HeldPress], bool]) -> list[HeldPress]:
        over = [press for press in self._presses.values() if ends(press)]
        for press in over:
            del self._presses[press.client]
        return over


def _may_take(sender: Sender, press: HeldPress, people: People) -> bool:
    """Return True if the sender may take the cars of a press. A press counts as a lease until it ends."""
    return not LeaseState(people.ranked(press.sender)).refuses(people.ranked(sender), take=False)


def _driver(press: HeldPress, person: str) -> str:
    return "Another page" if press.person == person else press.person
