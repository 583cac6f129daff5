"""Says when two copies of a message are one message, although receivers gave them different times. Pure.

If the clock of a publisher is more than half a second ahead of a receiver's, Zenoh at the receiver replaces the publish
time by the receiver's own. So two recorders have different times for one message, and so have a message that was heard
and its copy from the publisher's cache. Only our own messages tell more: who numbered them, or when they were made.
"""

from google.protobuf.message import DecodeError

from fleet.recording.foreign_fields import text_of
from schemas import messages


def identity(message: str, payload: bytes, published_ns: int) -> int:
    """Return a hash that the copies of a message share, among all messages of its key with its number.

    `message`: its full protobuf name, or an empty text if it has none. Other programs may put the same payload with the
    same number once more when they are started again, so their messages also differ by publish time.
    """
    return hash((payload, 0 if _names_its_origin(message, payload) else published_ns))


def _names_its_origin(message: str, payload: bytes) -> bool:
    """Return True if the payload has the start of its publisher, with a number of its own, or the time of an event."""
    try:
        decoded = messages.message_class(message).FromString(payload)
    except (KeyError, DecodeError):
        return False
    return bool(text_of(decoded, "boot_id") or text_of(decoded, "timestamp"))
