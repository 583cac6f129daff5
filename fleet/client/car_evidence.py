"""Collects from the bus what `diagnosis` judges: states, recent commands, processes, recorder and plan."""

import time
from contextlib import suppress
from math import inf
from typing import Any

from fleet.client.car_state import CarState
from fleet.client.client import Fleet
from fleet.client.diagnosis import RECENT_COMMAND_S, CarEvidence
from fleet.client.reading import Reading, age_of_answer_s
from fleet.client.supervision import ask_status
from schemas import keys, messages, topics
from schemas.gen import fleet_v1_pb2 as pb
from schemas.words import ProcessKind, RecorderState, RunState

_EVENT = topics.TOPICS["event/command"]


def collect(client: Fleet) -> dict[str, CarEvidence]:
    """Return the evidence of every car that is on the bus or that a supervisor starts a gateway for, by name."""
    present = client.cars()
    supervisions = ask_status(client.bus, client.name)
    processes = {
        each.name: each
        for status in supervisions
        for each in status.processes
        if each.kind == ProcessKind.GATEWAY and each.state != RunState.ENDED
    }
    answers: dict[str, list[tuple[str, Reading]]] = {}
    for expression in ("*/state/*", "*/sensor/battery"):
        for reading in client.get(expression):
            if (key := keys.parse(reading.key)) is not None:
                answers.setdefault(key.car, []).append((key.topic, reading))
    now = time.time()
    commands = _commands(client)
    recording = next((each.value for each in client.get(f"{client.name}/{keys.RECORDER}/status")), None)
    if recording is None and (lost := [each.unrecorded for each in supervisions if each.unrecorded]):
        recording = pb.Recording(state=RecorderState.FAILED, error=lost[0])
    assignment = next((each.value for each in client.get(f"{client.name}/{keys.COORDINATOR}/assignment")), None)
    coordinated = bool(client.bus.tokens(keys.car_token(client.name, keys.COORDINATOR)))
    return {
        car: CarEvidence(
            CarState.of_answers(car, answers.get(car, []), now, present=car in present),
            now,
            commands=commands.get(car, []),
            process=processes.get(car),
            recording=recording,
            assignment=assignment,
            coordinated=coordinated,
            asked=True,
        )
        for car in sorted({*present, *processes})
    }


def _commands(client: Fleet) -> dict[str, list[tuple[float, Any]]]:
    """Return age and event of the recent commands, by car, the newest last. Gateways cache their last hundred."""
    found: dict[str, list[tuple[float, Any]]] = {}
    now = time.time()
    for sample in client.bus.recall(keys.topic_key(client.name, "*", _EVENT.name), RECENT_COMMAND_S):
        with suppress(messages.BadPayload):
            event: Any = messages.parse(_EVENT.message, bytes(sample.payload), str(sample.encoding))
            age_s = age_of_answer_s(messages.stamp_ns(event.stamp) / 1e9, now)
            if age_s < inf:  # else nothing tells its age
                found.setdefault(event.car, []).append((age_s, event))
    for events in found.values():
        events.sort(key=lambda each: -each[0])
    return found
