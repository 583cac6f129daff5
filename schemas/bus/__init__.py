"""The Zenoh bus, for every process of the fleet.

Read `zenoh_session` first: `Bus` is one Zenoh session. `endpoint` finds or starts the `hub`, `publisher` publishes a
topic. `sample` has the messages that come in, `replies` those that go out. `handover` passes messages from Zenoh's
threads to a loop.
`hub_keeper` restarts a lost hub, `singleton` makes sure that there is only one service of a kind.
"""

from schemas.bus.declared import Declared, SampleChannel
from schemas.bus.endpoint import (
    ENDPOINT_VARIABLE,
    LOOPBACK,
    accepts,
    check_listening,
    ensure_hub,
    is_loopback,
    is_secure,
    resolve_endpoint,
    router_config,
    router_settings,
)
from schemas.bus.errors import BadEndpoint, BusError, HubUnreachable, NoFleet
from schemas.bus.handover import Backlog, Handover, Latest
from schemas.bus.hub_keeper import HUB_RESTART_DELAY_S, HubKeeper
from schemas.bus.key_expressions import canon, intersects
from schemas.bus.publisher import Publisher
from schemas.bus.replies import BUSY, is_json_wanted, refuse, reply, reply_message, reply_value
from schemas.bus.sample import (
    LARGEST_PAYLOAD,
    LONGEST_SELECTOR,
    Failure,
    Sample,
    messages_of,
    sample_of,
    sequence_of,
    why_unread,
)
from schemas.bus.singleton import Singleton
from schemas.bus.zenoh_session import Bus
from schemas.state_dir import DEFAULT_ENDPOINT

__all__ = [
    "BUSY",
    "DEFAULT_ENDPOINT",
    "ENDPOINT_VARIABLE",
    "HUB_RESTART_DELAY_S",
    "LARGEST_PAYLOAD",
    "LONGEST_SELECTOR",
    "LOOPBACK",
    "Backlog",
    "BadEndpoint",
    "Bus",
    "BusError",
    "Declared",
    "Failure",
    "Handover",
    "HubKeeper",
    "HubUnreachable",
    "Latest",
    "NoFleet",
    "Publisher",
    "Sample",
    "SampleChannel",
    "Singleton",
    "accepts",
    "canon",
    "check_listening",
    "ensure_hub",
    "intersects",
    "is_json_wanted",
    "is_loopback",
    "is_secure",
    "messages_of",
    "refuse",
    "reply",
    "reply_message",
    "reply_value",
    "resolve_endpoint",
    "router_config",
    "router_settings",
    "sample_of",
    "sequence_of",
    "why_unread",
]
