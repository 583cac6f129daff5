"""The operators of the pages: a client of the bus for each person with an open page, and the console's own."""

import asyncio
from collections.abc import Iterator
from typing import Final

from msgspec import Struct

from fleet.aio import Fleet
from fleet.client.client import default_sender
from fleet.console.operator import ConsoleOperator
from schemas.keys import person_of
from schemas.words import Rank

IDLE_CLIENT_S: Final = 5.0
"""Time for which a person's client stays open without a page, because the page may only be reloading."""


class _Member(Struct):
    """The operator of one person, and the number of this person's pages."""

    opening: "asyncio.Task[tuple[Fleet, ConsoleOperator]]"
    pages: int = 0


class Operators:
    """One operator for each person. The person at this computer has the console's own client."""

    def __init__(self, fleet: Fleet) -> None:
        self._fleet = fleet
        self.own = ConsoleOperator(fleet)
        self._members: dict[str, _Member] = {}
        self._clients = 0

    @property
    def person(self) -> str:
        """The person of the console's own client."""
        return person_of(self.own.sender)

    def __iter__(self) -> Iterator[ConsoleOperator]:
        yield self.own
        for member in self._members.values():
            if member.opening.done() and not member.opening.cancelled() and member.opening.exception() is None:
                yield member.opening.result()[1]

    def of(self, person: str) -> ConsoleOperator:
        """Return the operator of a person with an open page. For anybody else return the console's own operator."""
        return next((each for each in self if person_of(each.sender) == person), self.own)

    async def join(self, person: str) -> ConsoleOperator:
        """Return the operator for a page of this person. Raises BusError."""
        if person == self.person:
            return self.own
        member = self._members.get(person)
        if member is None:
            member = self._members[person] = _Member(asyncio.ensure_future(self._open(person)))
        member.pages += 1
        try:
            return (await asyncio.shield(member.opening))[1]
        except BaseException:
            self.leave(person)
            raise

    def leave(self, person: str) -> None:
        """Release the operator, because a page of this person has gone."""
        member = self._members.get(person)
        if member is not None:
            member.pages -= 1
            if not member.pages:
                self.own.spawn(self._close_idle(person, member))

    async def close(self) -> None:
        """Wait for the commands that have no outcome yet, for at most 3 s, and close the clients."""
        members = list(self._members.values())
        self._members.clear()
        await asyncio.gather(self.own.close(), *(_close(member) for member in members))

    async def _open(self, person: str) -> tuple[Fleet, ConsoleOperator]:
        # The number keeps the senders apart if a client of the same person still closes.
        self._clients += 1
        client = self._fleet.sync
        sender = f"{default_sender(person)}.{self._clients}"
        fleet = Fleet(client.bus.endpoint, client.name, sender=sender, kind=Rank.PERSON, identity=client.bus.identity)
        await fleet.__aenter__()
        return fleet, ConsoleOperator(fleet)

    async def _close_idle(self, person: str, member: _Member) -> None:
        await asyncio.sleep(IDLE_CLIENT_S)
        if not member.pages and self._members.get(person) is member:
            del self._members[person]
            await _close(member)


async def _close(member: _Member) -> None:
    try:
        fleet, operator = await member.opening
    except Exception:  # noqa: BLE001 - `join` has raised it
        return
    await operator.close()
    await fleet.__aexit__(None, None, None)
