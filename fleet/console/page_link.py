"""The messages to one page. Answers wait in a bounded queue. Of ticks and of states, only the newest waits.

A page that does not read does not delay any other page.
"""

import asyncio
import json
from collections import deque
from collections.abc import Awaitable, Callable, Mapping
from typing import Any, Final

from fleet.console.operator import ConsoleOperator
from fleet.console.people_book import PagePerson

SEND_TIMEOUT_S: Final = 5.0
"""Timeout of one message. A page that does not read for this time is disconnected."""
_MAX_PAGE_ANSWERS: Final = 256
"""Maximum number of queued answers. Beyond it, the oldest are dropped."""


class PageLink:
    """One connected page."""

    def __init__(
        self,
        number: int,
        send: Callable[[str], Awaitable[None]],
        person: PagePerson,
        operator: ConsoleOperator,
        device: str = "",
    ) -> None:
        self.number = number
        self.device = device
        self.person = person
        self.operator = operator
        self._send = send
        self._answers: deque[str] = deque(maxlen=_MAX_PAGE_ANSWERS)
        self._newest: dict[str, str] = {}
        self._last: dict[str, Mapping[str, Any]] = {}
        """The last value of each kind that is sent only when it changes."""
        self._not_empty = asyncio.Event()

    def answer(self, **fields: Any) -> None:
        """Queue an answer to this page."""
        self._answers.append(json.dumps(fields, separators=(",", ":")))
        self._not_empty.set()

    def show(self, kind: str, text: str) -> None:
        """Set the newest message of a kind (`tick`, `state`). It replaces an older one that was not sent yet."""
        self._newest[kind] = text
        self._not_empty.set()

    def show_new(self, kind: str, value: Mapping[str, Any]) -> None:
        """Set the newest message of a kind if it differs from the last one."""
        if self._last.get(kind) != value:
            self._last[kind] = value
            self.show(kind, json.dumps({"t": kind, **value}, separators=(",", ":")))

    def has_unsent(self, kind: str) -> bool:
        """Return True if the newest message of a kind was not sent yet."""
        return kind in self._newest

    async def run(self) -> None:
        """Send until the page has gone. Raises TimeoutError if it does not read."""
        greeted = False
        while True:
            await self._not_empty.wait()
            self._not_empty.clear()
            while self._newest or self._answers:
                # Send the tick first, because the page's answer to it (the echo) keeps a car driving. Only the
                # greeting, which is the first answer, precedes it.
                kind = "tick" if "tick" in self._newest else next(iter(self._newest), "")
                answers = bool(self._answers) and (kind != "tick" or not greeted)
                text = self._answers.popleft() if answers else self._newest.pop(kind)
                greeted = greeted or answers
                # Python 3.11's wait_for forgets a cancellation that comes as the message is sent.
                async with asyncio.timeout(SEND_TIMEOUT_S):
                    await self._send(text)
