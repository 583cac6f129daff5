"""Sends commands to the services of a fleet, such as the coordinator, and reads their results."""

import json
from collections.abc import Iterator
from typing import Any, Final

from fleet.client.client import Fleet
from fleet.client.command_tracker import ANSWER_TIMEOUT_S
from schemas import keys, messages, topics
from schemas.bus import Bus, Failure, Sample, messages_of
from schemas.words import RecorderState

RECORDER_TIMEOUT_S: Final = 15.0
"""Timeout for the recorder's answer. It may have to wait for the disk."""
NO_PLAN: Final = "No plan is running. Start one: `fleet plan run FILE`"


def send_command(bus: Bus, fleet: str, service: str, verb: str, command: Any, timeout_s: float) -> Iterator[Any]:
    """Send a command to a service such as `@supervisor`. Yield each answer: a fleet.v1.Result, or a Failure."""
    key = keys.command_key(fleet, service, verb, bus.identity)
    payload, encoding = command.SerializeToString(), messages.encoding_of(command.DESCRIPTOR.full_name)
    for answer in bus.query(key, payload=payload, encoding=encoding, timeout_s=timeout_s):
        yield answer if isinstance(answer, Failure) else messages.parse(topics.RESULT, answer.payload, answer.encoding)


def ask_recorder(bus: Bus, fleet: str, verb: str, **fields: str) -> Any:
    """Send a command to the recorder. Return its fleet.v1.Recording, or a Failure, or None without a recorder."""
    key, payload = keys.command_key(fleet, keys.RECORDER, verb, bus.identity), json.dumps(fields).encode()
    for answer in bus.query(key, payload=payload, encoding=messages.JSON, timeout_s=RECORDER_TIMEOUT_S):
        if isinstance(answer, Failure):
            return answer
        if (found := _recording_in(answer)) is not None:
            return found
    return None


def site_recordings(bus: Bus, fleet: str) -> Iterator[tuple[str, Any]]:
    """Ask the recorders of other sites, whose hubs are linked to ours. Yield each site with its fleet.v1.Recording.

    Skip answers of other programs.
    """
    for answer in bus.query(f"{keys.recorder_token(fleet, '*')}/status", timeout_s=RECORDER_TIMEOUT_S):
        if isinstance(answer, Failure) or not (site := keys.recorder_site(fleet, answer.key.removesuffix("/status"))):
            continue
        if (found := _recording_in(answer)) is not None:
            yield site, found


def _recording_in(answer: Sample) -> Any:
    """Return the fleet.v1.Recording in an answer, or None if the answer has none.

    On a bus without certificates, any program may answer.
    """
    named = topics.TOPICS["@recorder/status"].message
    return next((each for each in messages_of([answer]) if each.DESCRIPTOR.full_name == named), None)


def why_unrecorded(status: Any) -> str:
    """Return why a recorder writes nothing now. Empty if it records, or was stopped.

    status: its state, a fleet.v1.Recording.
    """
    if status.state not in (RecorderState.FULL, RecorderState.FAILED):
        return ""
    return status.error or status.warning or f"the recorder is {status.state}"


def ask_coordinator(client: Fleet, verb: str, plan_text: str = "", sender: str = "") -> Any:
    """Send a request to the coordinator. Return the first answer that `send_command` yields, or None if there is none.

    verb: `plan` to set the plan `plan_text`, or `restart`, `next` or `stop` for the plan in force. sender: the person
    who asks, if that is not the client.
    """
    by = sender or client.sender
    if verb == "plan":
        command: Any = messages.message_class("fleet.v1.Plan")(text=plan_text, set_by=by)
    else:
        command = messages.message_class("fleet.v1.PlanCommand")(sender=by, kind=client.kind)
    return next(send_command(client.bus, client.name, keys.COORDINATOR, verb, command, ANSWER_TIMEOUT_S), None)
