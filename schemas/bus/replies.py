"""Answers to queries: values as protobuf or JSON, and refusals."""

from typing import Final

import zenoh

from schemas.topics import Topic

BUSY: Final = "busy: too many questions wait here already; ask again later"


def refuse(query: zenoh.Query, words: str) -> None:
    """Answer a query with an error, and end it."""
    with query:
        query.reply_err(words, encoding="text/plain")


def reply(query: zenoh.Query, key: str, payload: bytes, encoding: str, *, express: bool = True) -> None:
    """Answer a query with one value under a concrete key; `express`: at once, not batched with others."""
    query.reply(key, payload, encoding=encoding, express=express)


def reply_value(query: zenoh.Query, key: str, payload: bytes, topic: Topic, *, express: bool = True) -> None:
    """Answer a query with a value of a topic, as protobuf or as JSON as it asks (`?format=json`).

    Of many values each must not be express: each would be a batch of its own, and what finds no room is dropped.
    """
    if query.parameters.get("format") == "json":
        from schemas import messages

        text = messages.to_json(messages.parse(topic.message, payload, topic.encoding))
        reply(query, key, text.encode(), messages.JSON, express=express)
    else:
        reply(query, key, payload, topic.encoding, express=express)
