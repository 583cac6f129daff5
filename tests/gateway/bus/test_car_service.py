"""Tests of the limits of a gateway's bus service, on a real bus: payloads too large, queries too many or too often."""

import asyncio
from collections.abc import AsyncIterator, Mapping
from pathlib import Path
from typing import Any

import pytest

from gateway.bus.car_service import MAX_QUEUED_HISTORY_QUERIES, MAX_QUEUED_QUERIES, CarService, Request
from schemas import bus, keys
from tests.support.ports import free_endpoint
from tests.support.processes import FleetProcesses, wait_for

LARGE = b"x" * 5_000_000


class Hall:
    """The receiver behind the bus service. It stores all commands, drives and token changes."""

    def __init__(self, doors: CarService) -> None:
        self.doors = doors
        self.requests: list[Request] = []
        self.batches: list[Mapping[str, bool]] = []
        self.values, self.histories = asyncio.Event(), asyncio.Event()

    def attach(self) -> None:
        self.doors.attach(
            asyncio.get_running_loop(),
            values=self.values,
            histories=self.histories,
            command=self.requests.append,
            senders=self.batches.append,
            cars=lambda _: None,
            poses=lambda _: None,
        )

    async def until(self, so: Any, what: str) -> None:
        await asyncio.to_thread(wait_for, so, what)


@pytest.fixture
async def hall(tmp_path: Path) -> AsyncIterator[tuple[Hall, bus.Bus]]:
    fleet = FleetProcesses(free_endpoint(), tmp_path)
    with bus.Bus.open(fleet.endpoint) as opened:
        there = Hall(CarService(opened, "fleet", "red"))
        await there.until(lambda: fleet.bus.tokens("fleet/red"), "its doors are open")
        yield there, fleet.bus
        there.requests.clear()
    fleet.close()


def ask(asker: bus.Bus, selector: str, payload: bytes | None = None, timeout_s: float = 0.3) -> list[str]:
    """Send a query. Return the words of every error among the answers."""
    answers = list(asker.query(f"fleet/red/{selector}", payload=payload, timeout_s=timeout_s))
    return [answer.words for answer in answers if isinstance(answer, bus.Failure)]


async def test_oversized_request_is_handed_over_unread_with_reason(hall: tuple[Hall, bus.Bus]) -> None:
    """A megabyte of JSON stalled the gateway for 0.2 s. 64 megabytes stalled it until a kill."""
    there, asker = hall
    there.attach()
    for verb in ("drive", "stop"):
        await asyncio.to_thread(ask, asker, f"@cmd/{verb}", LARGE)
    await there.until(lambda: len(there.requests) == 2, "both commands")
    assert {each.why_unread for each in there.requests} == {
        "a payload of 5000000 bytes is too large and was not read: the limit is 65536 bytes"
    }
    assert await asyncio.to_thread(ask, asker, "sensor/range", LARGE) == [there.requests[0].why_unread]
    (long,) = await asyncio.to_thread(ask, asker, f"state/link?a={'x' * 5000}")
    assert "4096" in long
    asker.put_command(keys.command_key("fleet", "red", "drive"), LARGE, "application/json")
    await there.until(lambda: len(there.requests) == 3, "a streamed drive")
    assert (there.requests[2].streamed, there.requests[2].payload) == (True, b"")
    assert there.requests[2].why_unread == there.requests[0].why_unread


async def test_history_queries_have_own_bounded_queue(hall: tuple[Hall, bus.Bus]) -> None:
    there, asker = hall
    there.attach()

    def flood() -> list[str]:
        for _ in range(MAX_QUEUED_HISTORY_QUERIES):  # nobody answers them
            assert set(ask(asker, "sensor/*?last=1500", timeout_s=0.02)) == {"Timeout"}
        return [each for _ in range(3) for each in ask(asker, "sensor/*?last=1500", timeout_s=20.0)]

    assert await asyncio.to_thread(flood) == [bus.BUSY] * 3
    assert there.doors.dropped == 3
    await asyncio.to_thread(ask, asker, "state/link", timeout_s=0.02)
    family, query = await asyncio.wait_for(there.doors.values.next(), 20.0)  # no history query is before it
    assert (family, str(query.key_expr)) == ("state", "fleet/red/state/link")
    assert await there.doors.histories.next()


async def test_stop_finds_room_where_other_commands_find_none(hall: tuple[Hall, bus.Bus]) -> None:
    there, asker = hall  # no receiver is attached yet

    def fill() -> list[str]:
        for _ in range(MAX_QUEUED_QUERIES):  # nobody answers them
            assert set(ask(asker, "@cmd/whistle", b"{}", timeout_s=0.005)) == {"Timeout"}
        return [each for _ in range(2) for each in ask(asker, "@cmd/whistle", b"{}", timeout_s=20.0)]

    assert await asyncio.to_thread(fill) == [bus.BUSY] * 2
    assert set(await asyncio.to_thread(ask, asker, "@cmd/stop")) == {"Timeout"}
    there.attach()
    await there.until(lambda: len(there.requests) == MAX_QUEUED_QUERIES + 1, "all that waited")
    assert there.requests[-1].verb == "stop", "and none after a stop that came before it"


async def test_changes_of_a_token_are_merged(hall: tuple[Hall, bus.Bus]) -> None:
    """1,200 tokens a second woke the writer 2,400 times."""
    there, asker = hall
    there.attach()

    def blink() -> None:
        for number in range(300):
            token = asker.token(f"fleet/{keys.OPERATOR}/ann{number % 3}")
            token.undeclare()
        asker.token(f"fleet/{keys.OPERATOR}/bob")

    await asyncio.to_thread(blink)
    await there.until(lambda: any("bob" in batch for batch in there.batches), "the last token")
    told = {name: alive for batch in there.batches for name, alive in batch.items()}
    assert told == {"ann0": False, "ann1": False, "ann2": False, "bob": True}
    assert sum(len(batch) for batch in there.batches) < 200
