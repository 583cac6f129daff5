"""A gateway learns e-stops from the other gateways of its fleet, on a real bus."""

import asyncio
from functools import partial
from pathlib import Path

import pytest
import zenoh

from gateway.bus import estop_sync
from gateway.bus.estop_sync import MAX_SINGLE_QUERIES, EstopSync
from gateway.control.safety_state import PersistedSafety
from schemas.bus import Bus, Handover, reply
from schemas.gen import fleet_v1_pb2 as pb
from schemas.messages import encoding_of
from tests.support.ports import free_endpoint
from tests.support.processes import PATIENCE_S, FleetProcesses, wait_for

KEY = "fleet/blue/state/safety"
SAFETY = encoding_of("fleet.v1.Safety")


async def test_one_that_did_not_answer_in_time_is_asked_again(tmp_path: Path) -> None:
    """A gateway that does not answer may be starting or stalled, and may know a fleet-wide e-stop."""
    fleet = FleetProcesses(free_endpoint(), tmp_path)
    asked: list[zenoh.Query] = []
    awake = asyncio.Event()
    learned: list[tuple[str, str]] = []

    def answer(query: zenoh.Query) -> None:
        asked.append(query)
        if awake.is_set():
            with query:
                safety = pb.Safety(car="blue", estops=[pb.Estop(id="e1", by="mia", scope="fleet")])
                reply(query, KEY, safety.SerializeToString(), encoding_of("fleet.v1.Safety"))

    def unite(other: PersistedSafety, told_by: str) -> None:
        learned.extend((estop.id, told_by) for estop in other.estops)

    try:
        with Bus.open(fleet.endpoint, timeout_s=PATIENCE_S) as blue, fleet.bus as opened:
            blue.queryable(KEY, Handover(asyncio.get_running_loop(), answer))
            while not asked:  # until the hub knows the queryable
                await asyncio.to_thread(lambda: list(opened.query(KEY, timeout_s=0.1)))
            neighbours, before = EstopSync(opened, "fleet", "red"), len(asked)
            keeping = asyncio.ensure_future(neighbours.keep_synced(unite))
            neighbours.on_tokens({"blue": True})
            await asyncio.to_thread(wait_for, lambda: len(asked) > before, "it is asked")
            awake.set()
            await asyncio.to_thread(wait_for, lambda: learned, "it is asked again")
            assert learned[0] == ("e1", "blue")
            keeping.cancel()
            await asyncio.gather(keeping, return_exceptions=True)
            asked.clear()
    finally:
        fleet.close()


async def test_estop_is_merged_although_another_gateway_has_not_answered(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Over a full link the last answer of many may come seconds after the first one."""
    monkeypatch.setattr(estop_sync, "SYNC_QUERY_TIMEOUT_S", 10 * PATIENCE_S)
    fleet = FleetProcesses(free_endpoint(), tmp_path)
    held: list[zenoh.Query] = []
    learned: list[str] = []

    def answer(query: zenoh.Query) -> None:
        with query:
            safety = pb.Safety(car="blue", estops=[pb.Estop(id="e1", by="mia", scope="fleet")])
            reply(query, KEY, safety.SerializeToString(), SAFETY)

    def unite(other: PersistedSafety, _: str) -> None:
        learned.extend(estop.id for estop in other.estops)

    try:
        with Bus.open(fleet.endpoint, timeout_s=PATIENCE_S) as others, fleet.bus as opened:
            loop = asyncio.get_running_loop()
            others.queryable(KEY, Handover(loop, answer))
            others.queryable("fleet/green/state/safety", Handover(loop, held.append))
            await asyncio.to_thread(lambda: list(opened.query(KEY, timeout_s=PATIENCE_S)))
            neighbours = EstopSync(opened, "fleet", "red")
            keeping = asyncio.ensure_future(neighbours.keep_synced(unite))
            neighbours.on_tokens(dict.fromkeys(("blue", "green", *map(str, range(MAX_SINGLE_QUERIES))), True))
            await asyncio.to_thread(wait_for, lambda: held and learned == ["e1"], "it is known")
            for query in held:
                with query:
                    pass
            keeping.cancel()
            await asyncio.gather(keeping, return_exceptions=True)
    finally:
        fleet.close()


async def test_one_that_came_is_asked_and_not_all_others_again(tmp_path: Path) -> None:
    """Otherwise a hundred gateways that start one after the other would have to send 300,000 answers."""
    fleet = FleetProcesses(free_endpoint(), tmp_path)
    asked: dict[str, int] = {"blue": 0, "green": 0}
    learned: list[str] = []

    def answer(query: zenoh.Query, car: str) -> None:
        asked[car] += 1
        with query:
            reply(query, f"fleet/{car}/state/safety", pb.Safety(car=car).SerializeToString(), SAFETY)

    def learn(_: PersistedSafety, told_by: str) -> None:
        learned.append(told_by)

    try:
        with Bus.open(fleet.endpoint, timeout_s=PATIENCE_S) as cars, fleet.bus as opened:
            loop = asyncio.get_running_loop()
            for car in asked:
                cars.queryable(f"fleet/{car}/state/safety", Handover(loop, partial(answer, car=car)))
            while not all(asked.values()):  # until the hub knows both queryables
                await asyncio.to_thread(lambda: list(opened.query("fleet/*/state/safety", timeout_s=0.1)))
            neighbours = EstopSync(opened, "fleet", "red")
            keeping = asyncio.ensure_future(neighbours.keep_synced(learn))
            for car in asked:
                neighbours.on_tokens({car: True})
                await asyncio.to_thread(wait_for, lambda car=car: car in learned, f"{car} is asked")
            assert learned == ["blue", "green"]
            neighbours.sync_soon()
            await asyncio.to_thread(wait_for, lambda: learned == ["blue", "green"] * 2, "all are asked")
            neighbours.on_tokens({"blue": False})
            neighbours.sync_soon()
            await asyncio.to_thread(wait_for, lambda: len(learned) == 5, "who is there is asked")
            assert learned[4] == "green"
            keeping.cancel()
            await asyncio.gather(keeping, return_exceptions=True)
    finally:
        fleet.close()


async def test_others_are_asked_again_from_time_to_time(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A command to all cars may have missed one of them, and then no token changes."""
    monkeypatch.setattr(estop_sync, "BATCH_RESET_S", 0.01)
    monkeypatch.setattr(estop_sync, "ROUND_S", 0.01)
    fleet = FleetProcesses(free_endpoint(), tmp_path)
    learned: list[str] = []

    def answer(query: zenoh.Query) -> None:
        with query:
            reply(query, KEY, pb.Safety(car="blue").SerializeToString(), SAFETY)

    try:
        with Bus.open(fleet.endpoint, timeout_s=PATIENCE_S) as blue, fleet.bus as opened:
            blue.queryable(KEY, Handover(asyncio.get_running_loop(), answer))
            neighbours = EstopSync(opened, "fleet", "red")
            keeping = asyncio.ensure_future(neighbours.keep_synced(lambda _, told_by: learned.append(told_by)))
            neighbours.on_tokens({"blue": True})
            await asyncio.to_thread(wait_for, lambda: len(learned) > 2, "blue is asked again and again")
            assert {*learned} == {"blue"}
            keeping.cancel()
            await asyncio.gather(keeping, return_exceptions=True)
    finally:
        fleet.close()


async def test_estop_sync_asks_newcomers_one_by_one(tmp_path: Path) -> None:
    """With one query to all gateways, the answers took half of the time in which a hundred gateways start."""
    fleet = FleetProcesses(free_endpoint(), tmp_path)
    old, new = [f"old{number}" for number in range(24)], [f"new{number}" for number in range(12)]
    asked: list[str] = []
    learned: list[str] = []

    def answer(query: zenoh.Query) -> None:
        asked.append(name := str(query.key_expr).split("/")[1])
        with query:
            if name.startswith("hung"):
                return
            for car in old if name == "*" else [name]:
                reply(query, f"fleet/{car}/state/safety", pb.Safety(car=car).SerializeToString(), SAFETY)

    def learn(_: PersistedSafety, told_by: str) -> None:
        learned.append(told_by)

    try:
        with Bus.open(fleet.endpoint, timeout_s=PATIENCE_S) as cars, fleet.bus as opened:
            cars.queryable("fleet/*/state/safety", Handover(asyncio.get_running_loop(), answer))
            while not asked:  # until the hub knows the queryable
                await asyncio.to_thread(lambda: list(opened.query("fleet/old0/state/safety", timeout_s=0.1)))
            asked.clear()
            neighbours = EstopSync(opened, "fleet", "red")
            keeping = asyncio.ensure_future(neighbours.keep_synced(learn))
            neighbours.on_tokens(dict.fromkeys(old, True))
            await asyncio.to_thread(wait_for, lambda: sorted(learned) == sorted(old), "the old ones are asked")
            neighbours.on_tokens(dict.fromkeys(new, True))
            await asyncio.to_thread(wait_for, lambda: sorted(learned[24:]) == sorted(new), "the new ones are asked")
            assert asked == ["*", *sorted(new)]

            asked.clear()
            hung = [f"hung{number}" for number in range(12)]
            neighbours.on_tokens(dict.fromkeys([*hung, "later"], True))
            await asyncio.to_thread(wait_for, lambda: "*" in asked, "those that answer do not wait for all others")
            assert asked == [*sorted(hung)[:MAX_SINGLE_QUERIES], "*"]
            keeping.cancel()
            await asyncio.gather(keeping, return_exceptions=True)
    finally:
        fleet.close()
