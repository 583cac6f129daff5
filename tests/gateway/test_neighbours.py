"""What a gateway learns of the e-stops that the other gateways of its fleet know, on a real bus."""

import asyncio
from collections.abc import Sequence
from pathlib import Path

import zenoh

from gateway.control.safety import Estop
from gateway.neighbours import Neighbours
from schemas.bus import Bus, Handover, reply
from schemas.gen import fleet_v1_pb2 as pb
from schemas.messages import encoding_of
from tests.support.ports import free_endpoint
from tests.support.processes import PATIENCE_S, Fleet, wait_for

KEY = "fleet/blue/state/safety"


async def test_one_that_did_not_answer_in_time_is_asked_again(tmp_path: Path) -> None:
    """It may still be starting, or held up, and know of an e-stop of the whole fleet."""
    fleet = Fleet(free_endpoint(), tmp_path)
    asked: list[zenoh.Query] = []
    awake = asyncio.Event()
    learned: list[tuple[str, str]] = []

    def answer(query: zenoh.Query) -> None:
        asked.append(query)
        if awake.is_set():
            with query:
                safety = pb.Safety(car="blue", estops=[pb.Estop(id="e1", by="mia", scope="fleet")])
                reply(query, KEY, safety.SerializeToString(), encoding_of("fleet.v1.Safety"))

    def unite(estops: Sequence[Estop], _: Sequence[str], told_by: str) -> None:
        learned.extend((estop.id, told_by) for estop in estops)

    try:
        with Bus.open(fleet.endpoint, timeout_s=PATIENCE_S) as blue, fleet.bus as opened:
            blue.queryable(KEY, Handover(asyncio.get_running_loop(), answer))
            while not asked:  # until the hub knows of it
                await asyncio.to_thread(lambda: list(opened.query(KEY, timeout_s=0.1)))
            neighbours, before = Neighbours(opened, "fleet", "red"), len(asked)
            keeping = asyncio.ensure_future(neighbours.keep_united(unite))
            neighbours.changed({"blue": True})
            await asyncio.to_thread(wait_for, lambda: len(asked) > before, "it is asked")
            awake.set()
            await asyncio.to_thread(wait_for, lambda: learned, "it is asked again")
            assert learned[0] == ("e1", "blue")
            keeping.cancel()
            await asyncio.gather(keeping, return_exceptions=True)
            asked.clear()
    finally:
        fleet.close()
