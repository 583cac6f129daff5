"""One client of the bus for each person with an open page."""

import asyncio
from collections.abc import Iterator
from pathlib import Path

import pytest

from fleet.aio import Fleet
from fleet.console import operators
from fleet.console.operators import Operators
from tests.support.ports import free_endpoint
from tests.support.processes import FleetProcesses, wait_for


@pytest.fixture
def hub(tmp_path: Path) -> Iterator[FleetProcesses]:
    processes = FleetProcesses(free_endpoint(), tmp_path)
    yield processes
    processes.close()


def test_each_person_has_a_client_until_the_last_page_leaves(
    hub: FleetProcesses, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(operators, "IDLE_CLIENT_S", 0.2)

    def there() -> set[str]:
        tokens = hub.bus.tokens("fleet/@operator/*")
        return {token.rpartition("/")[2].partition("@")[0] for token in tokens}

    async def pages() -> None:
        async with Fleet(hub.endpoint, person="teacher", kind="person") as fleet:
            book = Operators(fleet)
            assert await book.join("teacher") is book.own
            ann, again, bob = await asyncio.gather(book.join("ann"), book.join("ann"), book.join("bob"))
            assert ann is again
            assert ann.sender.startswith("ann@")
            assert (book.of("bob"), book.of("eve")) == (bob, book.own)
            assert await asyncio.to_thread(wait_for, lambda: there() == {"teacher", "ann", "bob"}, "all are there")
            book.leave("ann")
            book.leave("bob")
            assert await asyncio.to_thread(wait_for, lambda: there() == {"teacher", "ann"}, "bob has gone")
            assert list(book) == [book.own, ann], "ann has a page yet"
            book.leave("ann")
            assert await book.join("ann") is ann, "a page that is loaded again finds its client"
            await book.close()
            assert await asyncio.to_thread(wait_for, lambda: there() == {"teacher"}, "all have gone")

    asyncio.run(pages())
