"""Collects the evidence for `diagnosis` from the bus: states, recent commands, processes, recorder and plan."""

import threading
import time
from collections.abc import Iterable, Mapping
from contextlib import suppress
from math import inf
from typing import Any, Final

from fleet.client.car_state import CarState
from fleet.client.client import Fleet
from fleet.client.diagnosis import RECENT_COMMAND_S, CarEvidence
from fleet.client.gateway_clock import MAX_CLOCK_OFF_S, GatewayClock
from fleet.client.reading import Reading, age_of_answer_s
from fleet.client.supervision import ask_status, gateways_of, services_of
from schemas import keys, messages, topics
from schemas.bus import Sample
from schemas.gen import fleet_v1_pb2 as pb
from schemas.running_cars import running_cars_of
from schemas.words import RecorderState, RunState

_CLOCK_LISTEN_S: Final = 3.0
"""Maximum time to listen for the clocks of gateways: states come once a second."""
_EVENT = topics.TOPICS["event/command"]


def collect(client: Fleet) -> dict[str, CarEvidence]:
    """Return the evidence by car, for every car that is on the bus, supervised, or has a gateway on this computer."""
    present = client.cars()
    here = running_cars_of(client.bus.endpoint, client.name)
    supervisions = ask_status(client.bus, client.name)
    processes = {
        car: each
        for status in supervisions
        for car, each in gateways_of(status).items()
        if each.state != RunState.ENDED
    }
    answers: dict[str, list[tuple[str, Reading]]] = {}
    for expression in ("*/state/*", "*/sensor/battery"):
        for reading in client.get(expression):
            if (key := keys.parse(reading.key)) is not None:
                answers.setdefault(key.car, []).append((key.topic, reading))
    newest_s = newest_states(each for found in answers.values() for _, each in found)
    clocks = clocks_off(client, {car: at_s for car, at_s in newest_s.items() if car in present})
    now = time.time()
    commands = _commands(client)
    services = {name: why for status in supervisions for name, why in services_of(status).items()}
    recording = next((each.value for each in client.get(f"{client.name}/{keys.RECORDER}/status")), None)
    if recording is None and (lost := [each.unrecorded for each in supervisions if each.unrecorded]):
        recording = pb.Recording(state=RecorderState.FAILED, error=lost[0])
    assignment = next((each.value for each in client.get(f"{client.name}/{keys.COORDINATOR}/assignment")), None)
    coordinated = bool(client.bus.tokens(keys.car_token(client.name, keys.COORDINATOR)))
    return {
        car: CarEvidence(
            # The stamps are by the gateway's clock, so compute the ages by that clock, too.
            CarState.of_answers(car, answers.get(car, []), now + clocks.get(car, 0.0), present=car in present),
            now + clocks.get(car, 0.0),
            clock_off_s=clocks.get(car),
            commands=commands.get(car, []),
            process=processes.get(car),
            recording=recording,
            assignment=assignment,
            coordinated=coordinated,
            services=services,
            runs_here=car in here,
            asked=True,
        )
        for car in sorted({*present, *processes, *here})
    }


def newest_states(readings: Iterable[Reading]) -> dict[str, float]:
    """Return the stamp of each car's newest state, s since the epoch by its gateway's clock."""
    found: dict[str, float] = {}
    for reading in readings:
        key = keys.parse(reading.key)
        if key is not None and key.topic.startswith("state/"):
            found[key.car] = max(found.get(key.car, 0.0), reading.time.timestamp())
    return found


def clocks_off(client: Fleet, newest_s: Mapping[str, float]) -> dict[str, float]:
    """Return by how many seconds the clock of each car's gateway is wrong.

    Leave out cars whose clock is right or not known. newest_s: by car, the newest stamp in its answers. If a stamp is
    off by more than MAX_CLOCK_OFF_S, listen to the states of that car for at most _CLOCK_LISTEN_S.
    """
    now_s = time.time()
    odd = {car for car, at_s in newest_s.items() if abs(at_s - now_s) > MAX_CLOCK_OFF_S}
    if not odd or client.bus.tokens(keys.replay_token(client.name)):
        return {}
    clocks = {car: GatewayClock() for car in odd}
    complete, lock = threading.Event(), threading.Lock()

    def on_state(sample: Sample) -> None:
        key, came_ns = keys.parse(sample.key), time.time_ns()
        if key is None or (gateway := clocks.get(key.car)) is None:
            return
        try:
            message: Any = sample.message()
        except (messages.BadPayload, KeyError):
            return
        with lock:
            gateway.take(message.boot_id, messages.stamp_ns(message.stamp), came_ns)
            if all(each.off_s is not None for each in clocks.values()):
                complete.set()

    subscriber = client.bus.subscribe(keys.topic_key(client.name, "*", "state/*"), on_state)
    complete.wait(_CLOCK_LISTEN_S)
    subscriber.undeclare()
    with lock:
        found = {car: each.off_s for car, each in clocks.items()}
    return {car: off_s for car, off_s in found.items() if off_s is not None and abs(off_s) > MAX_CLOCK_OFF_S}


def _commands(client: Fleet) -> dict[str, list[tuple[float, Any]]]:
    """Return age and event of the recent commands, by car, the newest last. Gateways cache their last hundred."""
    found: dict[str, list[tuple[float, Any]]] = {}
    now = time.time()
    for sample in client.bus.recall(keys.topic_key(client.name, "*", _EVENT.name), RECENT_COMMAND_S):
        with suppress(messages.BadPayload):
            event: Any = messages.parse(_EVENT.message, bytes(sample.payload), str(sample.encoding))
            age_s = age_of_answer_s(messages.stamp_ns(event.stamp) / 1e9, now)
            if age_s < inf:  # otherwise its age is not known
                found.setdefault(event.car, []).append((age_s, event))
    for events in found.values():
        events.sort(key=lambda each: -each[0])
    return found
