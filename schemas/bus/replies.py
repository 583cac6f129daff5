"""Replies to queries: messages as protobuf or JSON, and errors."""

from typing import TYPE_CHECKING, Final

import zenoh

from schemas.topics import PROTOBUF, Topic

if TYPE_CHECKING:  # a gateway is on the bus before it imports protobuf
    from google.protobuf.message import Message

BUSY: Final = "busy: too many questions wait here already; ask again later"


def refuse(query: zenoh.Query, words: str) -> None:
    """Reply with an error and close the query."""
    with query:
        query.reply_err(words, encoding="text/plain")


def reply(query: zenoh.Query, key: str, payload: bytes, encoding: str, *, express: bool = True) -> None:
    """Reply with one value under a concrete key. With `express`, send it at once, not in a batch with others."""
    query.reply(key, payload, encoding=encoding, express=express)


def reply_value(query: zenoh.Query, key: str, payload: bytes, topic: Topic, *, express: bool = True) -> None:
    """Reply with a value of a topic, as protobuf or, if the query has `?format=json`, as JSON."""
    # Do not send many values with `express`: each would be its own batch, and Zenoh drops batches beyond its queue.
    if query.parameters.get("format") == "json":
        from schemas import messages

        text = messages.to_json(messages.parse(topic.message, payload, topic.encoding))
        reply(query, key, text.encode(), messages.JSON, express=express)
    else:
        reply(query, key, payload, topic.encoding, express=express)


def is_json_wanted(query: zenoh.Query) -> bool:
    """Return True if a command has `?format=json` or no protobuf payload."""
    encoding = str(query.encoding) if query.encoding is not None else ""
    return query.parameters.get("format") == "json" or not encoding.startswith(PROTOBUF)


def reply_message(query: zenoh.Query, key: str, message: "Message", *, as_json: bool) -> None:
    """Reply with a message, as protobuf or JSON."""
    from schemas import messages

    if as_json:
        reply(query, key, messages.to_json(message).encode(), messages.JSON)
    else:
        reply(query, key, message.SerializeToString(), messages.encoding_of(message.DESCRIPTOR.full_name))
