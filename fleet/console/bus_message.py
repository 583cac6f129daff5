"""Reads what comes over the bus, where anyone may publish."""

import logging
from typing import Any

from schemas import keys, messages, topics
from schemas.bus import Sample

log = logging.getLogger("fleet")


def message_in(sample: Sample, level: int = logging.DEBUG) -> tuple[keys.Key, Any] | None:
    """Return the key and the message. None if it is not the message of its key, which is logged at this level."""
    topic, key = topics.of_key(sample.key), keys.parse(sample.key)
    if topic is None or key is None:
        return None
    try:
        return key, messages.parse(topic.message, sample.payload, sample.encoding)
    except messages.BadPayload as error:
        log.log(level, "%s: %s", sample.key, error)
        return None
