"""Publishes one topic of one car, numbered and cached for backfill."""

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
    """Publishes one topic of one car; numbers the messages and fills their common fields.

    It holds the last of them (`Topic.held`), also those published while there was no hub: see `Bus.recall`.
    """

    def __init__(self, session: zenoh.Session, key: str, topic: Topic, source: str, boot_id: str) -> None:
        self._publisher = ext.declare_advanced_publisher(
            session,
            key,
            encoding=zenoh.Encoding(topic.encoding),
            cache=ext.CacheConfig(topic.held),
            # Numbers only. Heartbeats and a token for each would double what a hub of a hundred cars has to do.
            sample_miss_detection=ext.MissDetectionConfig(heartbeat=None, sporadic_heartbeat=None),
            **ZENOH_QOS[topic.qos],
        )
        self._source = source
        self._boot_id = boot_id
        self._headed = topic.message.startswith("fleet.v1.")
        self.key = key
        self.topic = topic
        self.sequence = 0

    def put(self, message: Any, stamp_ns: int) -> bytes:
        """Publish, return the payload; `stamp_ns`: ns since the epoch, when bytes were had or a decision was made."""
        self.sequence += 1
        if self._headed:
            message.stamp.seconds, message.stamp.nanos = divmod(stamp_ns, 1_000_000_000)
            message.car = self._source
            message.seq = self.sequence
            message.boot_id = self._boot_id
        payload: bytes = message.SerializeToString()
        self._publisher.put(payload)
        return payload
