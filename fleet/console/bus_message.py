"""Reads what comes over the bus, where anyone may publish."""

import logging
import math
from collections.abc import Iterable, Mapping
from typing import Any

from google.protobuf.message import Message

from schemas import keys, messages, topics
from schemas.bus import Sample

log = logging.getLogger("fleet")


def message_in(sample: Sample, level: int = logging.DEBUG) -> tuple[keys.Key, Any] | None:
    """Return the key and the message.

    Return None for a key that is not ours. Return None, and log why at this level, if no car has such a name, if the
    type of the message does not fit its key, or if a number in it is not finite.
    """
    topic, key = topics.of_key(sample.key), keys.parse(sample.key)
    if topic is None or key is None:
        return None
    if not is_shown(key.car):
        log.log(level, "%r: no car has such a name", sample.key)
        return None
    try:
        message = messages.parse(topic.message, sample.payload, sample.encoding)
    except messages.BadPayload as error:
        log.log(level, "%s: %s", sample.key, error)
        return None
    if not is_finite(message):
        log.log(level, "%s: a number in it is infinite or not a number", sample.key)
        return None
    return key, message


def is_shown(name: str) -> bool:
    """Return True for the name of a service, and for a name that a car may have.

    Another name could mislead: it could look like a car's.
    """
    return name.startswith("@") or keys.is_name(name)


def is_finite(message: Any) -> bool:
    """Return True if all numbers of a message are finite.

    JSON has no other numbers, so a page could not read a state that contains one.
    """
    return all(_is_finite(value) for _, value in message.ListFields())


def _is_finite(value: Any) -> bool:
    if isinstance(value, float):
        return math.isfinite(value)
    if isinstance(value, Message):
        return is_finite(value)
    if isinstance(value, str | bytes | int) or not isinstance(value, Iterable):
        return True
    values = value.values() if isinstance(value, Mapping) else value
    return all(_is_finite(each) for each in values)
