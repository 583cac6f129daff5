"""Feeds the plan page: what the coordinator publishes, and the requests of a page to it."""

import asyncio
import json
import logging
from collections.abc import Callable, Iterable, Mapping
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import Any, Final

from fleet.aio import Fleet
from fleet.client.supervision import describe_silent_coordinator
from fleet.console.bus_message import is_shown, message_in
from fleet.console.hold_to_drive import TOO_LATE
from fleet.console.operator import ConsoleOperator
from fleet.console.page_feed import Handler, PageFeed
from fleet.console.page_link import PageLink
from fleet.console.page_requests import PageMessage
from fleet.console.people_book import PagePerson
from fleet.console.plan_answer import PlanQuestion
from fleet.console.plan_checks import PlanChecks
from fleet.console.plan_process import PlanProcess
from fleet.console.plan_view import PlanView, coordinator_topic, named
from fleet.policy.plan_requests import PlanRequest
from schemas import keys
from schemas.bus import Handover, Sample

_MAX_MESSAGES: Final = 4096


class PlanFeed(PageFeed):
    """The plan in force, and who may change it. file: the fleet file. operator: the console's own operator.

    sender_of: returns the name under which a person acts. refusal: returns why a person may not manage plans. newest:
    returns the newest messages of the cars, each with its age (s). is_late: returns True for a message that is too old.
    """

    def __init__(
        self,
        fleet: Fleet,
        file: Path,
        operator: ConsoleOperator,
        sender_of: Callable[[PagePerson | None], str],
        refusal: Callable[[PagePerson | None], str],
        newest: Callable[[], Iterable[tuple[float, Sample]]],
        is_late: Callable[[PageMessage], bool],
    ) -> None:
        self._fleet = fleet
        self._operator = operator
        self._sender_of = sender_of
        self._refusal = refusal
        self._newest = newest
        self._is_late = is_late
        self.checks = PlanChecks(file)
        self._process = PlanProcess(fleet, file)
        self._coordinators: set[str] = set()
        """Tokens of the coordinator."""
        self._view = PlanView()
        self._place = f"{fleet.sync.name}/{keys.COORDINATOR}"
        self._samples: Handover[Sample] = Handover(
            asyncio.get_running_loop(), self._on_sample, limit=_MAX_MESSAGES, newest=True
        )

    async def begin(self) -> None:
        """Subscribe to the coordinator, and read what it published before."""
        bus, loop = self._fleet.sync.bus, asyncio.get_running_loop()
        bus.subscribe(f"{self._place}/*", self._samples)

        def on_token(token: str, alive: bool) -> None:  # noqa: FBT001 - watch_tokens calls it so
            change = self._coordinators.add if alive else self._coordinators.discard
            with suppress(RuntimeError):  # the loop is closed
                loop.call_soon_threadsafe(change, token)

        await self._fleet.call(bus.watch_tokens, self._place, on_token)
        self._operator.spawn(self._read())

    async def _read(self) -> None:
        for reading in await self._fleet.get(f"{self._place}/*"):
            self._view.on_message(coordinator_topic(reading.key, self._fleet.sync.name), reading.value)

    def _on_sample(self, sample: Sample) -> None:
        if (found := message_in(sample, logging.WARNING)) is not None:
            self._view.on_message(coordinator_topic(sample.key, self._fleet.sync.name), found[1])

    @property
    def messages(self) -> Mapping[str, Handler]:
        """The message that asks the coordinator for the next phase, a restart or a stop."""
        return {"plan": self._ask}

    def _ask(self, page: PageLink, message: PageMessage) -> None:
        request_id, verb = message.number("id"), message.one_of("verb", frozenset(PlanRequest))
        late = TOO_LATE if verb != PlanRequest.STOP and self._is_late(message) else ""
        if words := self._refusal(page.person) or late:
            page.answer(t="plan_done", id=request_id, ok=False, words=words)
        else:
            page.operator.spawn(self._ask_coordinator(page, request_id, verb))

    async def _ask_coordinator(self, page: PageLink, request_id: int, verb: str) -> None:
        if (answer := await page.operator.ask_coordinator(verb)) is None:
            silent = await self._silent_coordinator()
            answer = False, f"{silent}." if silent else "No plan is running. Put one in force."
        ok, words = answer
        page.answer(t="plan_done", id=request_id, ok=ok, words=words)

    async def _silent_coordinator(self) -> str:
        return await self._fleet.call(describe_silent_coordinator, self._fleet.sync.bus, self._fleet.sync.name)

    async def check(self, text: str, person: PagePerson | None) -> dict[str, Any]:
        """Return the answer to a person about a plan (plan_answer.answer_to). Raises TooManyQuestions."""
        present = tuple(name for name in self._fleet.sync.cars() if is_shown(name))
        before, roles, phase = self._view.in_force
        question = PlanQuestion(text, present, tuple(self._newest()), before, roles, phase)
        return await self.checks.check(question, person and person.name)

    async def set_plan(self, text: str, person: PagePerson | None) -> dict[str, Any]:
        """Put a plan in force for this person. Return whether this succeeded, and words, or the faults, one per line.

        If no plan runs, the console starts a coordinator. Raises TooManyQuestions.
        """
        sender = self._sender_of(person)
        found = await self.check(text, person)
        if not found["ok"]:
            return found
        ask = partial(self._operator.ask_coordinator, "plan", text, sender)
        ok, words = await self._process.set_plan(text, ask, self._silent_coordinator)
        return {"ok": ok, "words": named(words, text)}

    def on_page(self, page: PageLink) -> None:
        """Show the plan to a new page."""
        page.show("plan", self._text())

    def tick(self, pages: Mapping[int, PageLink]) -> None:
        """Show the plan if it has changed."""
        self._view.on_presence(running=self._place in self._coordinators)
        if self._view.changed:
            self._view.changed = False
            text = self._text()
            for page in pages.values():
                page.show("plan", text)

    def _text(self) -> str:
        return json.dumps({"t": "plan", **self._view.as_dict()}, separators=(",", ":"))

    async def close(self) -> None:
        """End the checks, and the coordinator that the console has started."""
        await self.checks.close()
        await self._process.close()
