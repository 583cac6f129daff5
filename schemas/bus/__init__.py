"""The Zenoh bus, for every process of the fleet.

Read `session` first: `Bus` is one Zenoh session. `endpoint` finds or starts the `hub`, `publisher` publishes a topic,
`sample` and `replies` are what comes and what is answered, `handover` brings it from Zenoh's threads to a loop.
"""

from schemas.bus.endpoint import (
    DEFAULT_ENDPOINT,
    ENDPOINT_VARIABLE,
    accepts,
    check_listening,
    ensure_hub,
    is_loopback,
    resolve_endpoint,
    router_config,
)
from schemas.bus.errors import BadEndpoint, BusError, NoFleet
from schemas.bus.handover import Backlog, Handover, Latest
from schemas.bus.key_expressions import canon, intersects
from schemas.bus.publisher import Publisher
from schemas.bus.replies import BUSY, refuse, reply, reply_value
from schemas.bus.sample import LARGEST_PAYLOAD, LONGEST_SELECTOR, Failure, Sample, sample_of, sequence_of, unread
from schemas.bus.session import Bus

__all__ = [
    "BUSY",
    "DEFAULT_ENDPOINT",
    "ENDPOINT_VARIABLE",
    "LARGEST_PAYLOAD",
    "LONGEST_SELECTOR",
    "Backlog",
    "BadEndpoint",
    "Bus",
    "BusError",
    "Failure",
    "Handover",
    "Latest",
    "NoFleet",
    "Publisher",
    "Sample",
    "accepts",
    "canon",
    "check_listening",
    "ensure_hub",
    "intersects",
    "is_loopback",
    "refuse",
    "reply",
    "reply_value",
    "resolve_endpoint",
    "router_config",
    "sample_of",
    "sequence_of",
    "unread",
]
