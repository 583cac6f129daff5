"""Publishes the status and the marks of a recorder, answers questions, and declares its token.

A fleet has one recorder, and one more at each other site (`fleet record --site north`). Each records all messages that
reach it. Commands of people go to one of them: to the fleet's recorder if it can be reached, or else to the recorder of
the site whose name sorts first. So while two sites are cut off from each other, marks and status work on both sides.

The recorder of a site also publishes its status under its own key, `fleet/@recorder/north/status`.
"""

import contextlib
import threading
from collections.abc import Callable, Iterable
from typing import Any, Final

import zenoh

from schemas import keys, messages
from schemas.bus import Bus, BusError, messages_of
from schemas.printable import printable
from schemas.topics import TOPICS
from schemas.words import RecorderState

STATUS_TOPIC: Final = TOPICS["@recorder/status"]
MARK_TOPIC: Final = TOPICS["@recorder/mark"]
STATUS_TIMEOUT_S: Final = 5.0
"""Timeout for the status of another recorder, which answers only between two writes to its disk."""


_AT_WORK: Final = (RecorderState.RECORDING, RecorderState.FULL, RecorderState.STOPPED)


class AnotherRecorder(Exception):
    """Another recorder records this fleet, or this site. The message names its session."""


def speaks_for_fleet(site: str, others: Iterable[str]) -> bool:
    """Return True if the recorder of `site` carries out the commands for the fleet. `others` are the other sites.

    The site of the fleet's own recorder is empty. Each recorder decides this for itself, by the tokens that it sees.
    """
    return all(site <= other for other in others)


class RecorderService:
    """The declarations of a recorder on the bus. `site` is the other site where it runs, or empty."""

    def __init__(self, bus: Bus, fleet: str, site: str = "") -> None:
        self._bus = bus
        self._fleet = fleet
        self._site = site if not site else keys.check_name(site, "site")
        self._token = keys.recorder_token(fleet, site)
        self.own_status = f"{self._token}/status"
        self._fleet_status = f"{fleet}/{STATUS_TOPIC.name}"
        self.mark_key = f"{fleet}/{MARK_TOPIC.name}"
        self._others: set[str] = set()
        """Sites of the other recorders on the bus."""
        self._lock = threading.Lock()

    def refuse_a_second(self) -> None:
        """Raise AnotherRecorder if this site has a recorder."""
        if not self._bus.tokens(self._token):
            return
        where = "to an unknown place"
        for message in messages_of(self._bus.query(self.own_status, timeout_s=STATUS_TIMEOUT_S)):
            where = f"to {message.session}"
        raise self._another(where)

    def yield_to_another(self, payload: bytes, encoding: str) -> None:
        """Raise AnotherRecorder if this status is of a recorder that goes on, because its boot id is lower.

        Two that start at the same moment do not see each other's token, but each hears the status of the other.
        """
        try:
            status: Any = messages.parse(STATUS_TOPIC.message, payload, encoding)
        except messages.BadPayload:
            return
        if status.state in _AT_WORK and "" < status.boot_id < self._bus.boot_id:
            raise self._another(f"to {printable(status.session)}")

    def _another(self, where: str) -> AnotherRecorder:
        if self._site:
            return AnotherRecorder(f"site {self._site} is recorded already, {where}. One recorder at a site is enough.")
        return AnotherRecorder(
            f"{keys.describe_fleet(self._fleet).capitalize()} is recorded already, {where}. One recorder is enough; at "
            "another site, `fleet record --site NAME` records, too."
        )

    def declare_publishers(self) -> None:
        """Declare the publishers."""
        status = dict.fromkeys((self._fleet_status, self.own_status))  # the two keys are equal, except at another site
        self._status = [self._bus.publisher(key, STATUS_TOPIC, keys.RECORDER) for key in status]
        self._marks = self._bus.publisher(self.mark_key, MARK_TOPIC, keys.RECORDER)

    def open(self, on_query: Callable[[zenoh.Query, str], object]) -> None:
        """Answer queries from now on. on_query: called with each query for this recorder, as by `Bus.queryable`.

        It also gets the key of the answer, because a query may have wildcards.
        """

        def for_fleet(query: zenoh.Query) -> object:
            if self.speaks_for_fleet:
                asked = str(query.key_expr)
                return on_query(query, asked if "/@cmd/" in asked else self._fleet_status)
            with query:  # leave it unanswered, because another recorder answers for the fleet
                return True

        if self._site:
            self._bus.watch_tokens(keys.recorder_token(self._fleet, "**"), self._on_token)
            self._bus.queryable(self.own_status, lambda query: on_query(query, self.own_status))
        self._bus.queryable(self._fleet_status, for_fleet)
        for expression in keys.command_keys(self._fleet, keys.RECORDER):
            self._bus.queryable(expression, for_fleet)
        self._bus.token(self._token)
        # Declaring does not wait for the hub. But an answer of the hub comes only after it has told everybody about our
        # subscriptions.
        self.wait_for_hub()

    def wait_for_hub(self, timeout_s: float = 5.0) -> None:
        """Send the hub a query and wait for the answer. The hub then has everything that was sent before."""
        with contextlib.suppress(zenoh.ZError, BusError):  # if the bus is gone, there is nothing to wait for
            self._bus.tokens(self._token, timeout_s)

    @property
    def speaks_for_fleet(self) -> bool:
        """Return True if this recorder carries out the commands for the fleet now."""
        with self._lock:
            return speaks_for_fleet(self._site, self._others)

    def publish(self, status: Any, now_ns: int) -> None:
        """Publish the status: for the fleet if this recorder speaks for it, and for its own site."""
        for publisher in self._status if self.speaks_for_fleet else self._status[1:]:
            publisher.put(status, now_ns)

    def publish_mark(self, mark: Any, now_ns: int) -> None:
        """Publish a mark, which every recorder records."""
        self._marks.put(mark, now_ns)

    def _on_token(self, key: str, came: bool) -> None:  # noqa: FBT001 - the bus calls it so
        site = keys.recorder_site(self._fleet, key)
        if site is not None and site != self._site:
            with self._lock:
                if came:
                    self._others.add(site)
                else:
                    self._others.discard(site)
