"""The order of the messages to one page."""

import asyncio
import json
from typing import Any

from fleet.console.page_link import PageLink
from fleet.console.people_book import PagePerson
from schemas.words import Rank


def sent_by(page_does: Any) -> list[str]:
    """Return what a page gets that is filled before its sender runs, and once more when it has taken that."""

    async def run() -> list[str]:
        sent: list[str] = []
        drained = asyncio.Event()

        async def send(text: str) -> None:
            sent.append(json.loads(text)["t"])
            if len(sent) in (2, 4):
                drained.set()

        operator: Any = None  # the sender asks nothing of it
        page = PageLink(1, send, PagePerson("mia", Rank.PERSON), operator)
        page_does(page)
        sender = asyncio.ensure_future(page.run())
        await asyncio.wait_for(drained.wait(), 5.0)
        drained.clear()
        page_does(page)
        await asyncio.wait_for(drained.wait(), 5.0)
        sender.cancel()
        return sent

    return asyncio.run(run())


def test_page_gets_hello_before_first_tick_then_ticks_first() -> None:
    def tick_and_answer(page: PageLink) -> None:
        page.show("tick", '{"t": "tick"}')
        page.answer(t="hello")

    assert sent_by(tick_and_answer) == ["hello", "tick", "tick", "hello"]
