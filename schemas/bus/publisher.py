"""Publishes one topic of one car, numbered and cached for backfill: for a recorder that has missed messages."""

from typing import Any, Final

import zenoh
from zenoh import ext

from schemas.topics import Qos, Topic

# The losses that each choice avoids are in docs/explanation/measurements.md#quality-of-service.
ZENOH_QOS: Final[dict[Qos, dict[str, Any]]] = {
    Qos.READING: {"congestion_control": zenoh.CongestionControl.DROP, "priority": zenoh.Priority.DATA},
    Qos.STATE: {"congestion_control": zenoh.CongestionControl.DROP, "priority": zenoh.Priority.DATA_HIGH},
    Qos.COMMAND: {
        "congestion_control": zenoh.CongestionControl.BLOCK,
        "priority": zenoh.Priority.REAL_TIME,
        "express": True,
    },
}


class Publisher:
    """Publishes one topic of one car, numbers the messages and fills their common fields.

    It caches the latest messages (`Topic.cache_size`) for backfill, also while there is no hub: see `Bus.recall`.
    """

    def __init__(self, session: zenoh.Session, key: str, topic: Topic, source: str, boot_id: str) -> None:
        self.key = key
        self.topic = topic
        self._publisher = self._next = self._declared_in(session)
        self._source = source
        self._boot_id = boot_id
        self._headed = topic.message.startswith("fleet.v1.")
        self.sequence = 0

    def _declared_in(self, session: zenoh.Session) -> Any:
        return ext.declare_advanced_publisher(
            session,
            self.key,
            encoding=zenoh.Encoding(self.topic.encoding),
            cache=ext.CacheConfig(self.topic.cache_size),
            # Sequence numbers only: heartbeats and a token per publisher would double the load of a hub with 100 cars.
            sample_miss_detection=ext.MissDetectionConfig(heartbeat=None, sporadic_heartbeat=None),
            **ZENOH_QOS[self.topic.qos],
        )

    def prepare(self, session: zenoh.Session) -> None:
        """Declare the publisher in another session too, so that subscribers there know it before `move`."""
        self._next = self._declared_in(session)

    def move(self) -> None:
        """Publish in the prepared session from now on. Zenoh's numbers restart with an empty cache; `seq` continues."""
        self._publisher = self._next

    def put(self, message: Any, stamp_ns: int) -> bytes:
        """Publish a message and return its payload. `stamp_ns` is the time of its measurement, ns since the epoch."""
        self.sequence += 1
        if self._headed:
            message.stamp.seconds, message.stamp.nanos = divmod(stamp_ns, 1_000_000_000)
            message.car = self._source
            message.seq = self.sequence
            message.boot_id = self._boot_id
        payload: bytes = message.SerializeToString()
        self._publisher.put(payload)
        return payload
