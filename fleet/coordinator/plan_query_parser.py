"""Reads the commands that come over the bus for the coordinator, and answers them."""

from typing import Any, Final

import zenoh

from fleet.policy.plan_requests import RequestRefused
from schemas import keys, messages, topics
from schemas.bus import reply_message
from schemas.gen import fleet_v1_pb2 as pb
from schemas.identity import NotTheSender, sender_for
from schemas.words import Phase, Reason

PLAN_VERB: Final = "plan"
"""`<fleet>/@coordinator/@cmd/plan` accepts another plan: a fleet.v1.Plan, or the plain text of the plan."""


def reply_result(query: zenoh.Query, result: pb.Result) -> None:
    """Answer a command."""
    reply_message(query, str(query.key_expr), result, as_json=query.parameters.get("format") == "json")


def bad_value(words: str) -> pb.Result:
    """Return the result of a command that cannot be understood."""
    return pb.Result(status=Phase.REJECTED, reason=Reason.BAD_VALUE, words=words)


def rejected(refused: RequestRefused) -> pb.Result:
    """Return the result of a refused request."""
    return pb.Result(status=Phase.REJECTED, reason=refused.reason, words=str(refused))


def _payload(query: zenoh.Query) -> tuple[bytes, str]:
    """Return the payload of a query and its encoding, both empty if there is none."""
    payload = query.payload.to_bytes() if query.payload is not None else b""
    return payload, str(query.encoding) if query.encoding is not None else ""


def plan_command(query: zenoh.Query) -> tuple[str, str]:
    """Return the text of the plan in a query (protobuf, JSON or plain text) and its sender.

    Raises BadPayload, UnicodeDecodeError, or RequestRefused if the sender is not the certificate's owner.
    """
    payload, encoding = _payload(query)
    if not encoding.startswith((topics.PROTOBUF, messages.JSON)):
        return payload.decode(), _proven(query, "")
    message: Any = messages.parse(topics.TOPICS[f"{keys.COORDINATOR}/plan"].message, payload, encoding)
    return str(message.text), _proven(query, str(message.set_by))


def sender_of(query: zenoh.Query, message_type: str) -> str:
    """Return the sender of a command with or without a payload. Raises BadPayload or RequestRefused."""
    payload, encoding = _payload(query)
    command: Any = messages.parse(message_type, payload, encoding) if payload else None
    return _proven(query, str(command.sender if command is not None else ""))


def _proven(query: zenoh.Query, sender: str) -> str:
    """Return the sender, or the certificate's owner if no sender is named. Raises RequestRefused for another name."""
    key = str(query.key_expr)
    try:
        return sender_for(keys.identity_of(key), sender, key.rpartition("/")[2])
    except NotTheSender as error:
        raise RequestRefused(str(error), Reason.NOT_ALLOWED) from None
