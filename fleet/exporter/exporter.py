"""The exporter: a client of the bus that answers Prometheus over HTTP. It sends no commands."""

import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from typing import Final

from prometheus_client import CollectorRegistry, start_http_server
from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily
from prometheus_client.registry import Collector

from fleet.client.client import Fleet
from fleet.coordinator.inbox import Inbox
from fleet.exporter.fleet_metrics import EVENTS, STATUS, FleetMetrics
from fleet.exporter.metrics import CONNECTED, DROPS, METRICS, Metric, MetricKind

DEFAULT_EXPORTER_PORT: Final = 9478
_WAIT_S: Final = 0.25
"""Maximum time until the exporter notices that it has to end."""
TOKENS_AFTER_LINK_S: Final = 2.0
"""Time after the link to the hub is back, for the gateways' own links to come back, and for the tokens to arrive: other
clients reconnect within half a second, or later on a loaded machine."""
_TOPICS: Final = ("state/*", "sensor/battery")
"""The exporter subscribes to these topics, and queries them when a car appears. Of the readings, it takes only those of
the battery: in the mode `tracking`, a car sends others 27 times a second."""

_Family = CounterMetricFamily | GaugeMetricFamily


class Exporter(Collector):
    """A collector for the registry of Prometheus' client. `run` reads the bus.

    A thread of the HTTP server calls `collect`.
    """

    def __init__(self, client: Fleet) -> None:
        self._client = client
        self._inbox = Inbox.listening(client, _TOPICS, (EVENTS,))
        self._metrics = FleetMetrics()
        self._lock = threading.Lock()
        self._inbox.subscribe(f"{client.name}/{STATUS}")
        self._link, self._link_began = "", 0.0

    def serve(self, address: str, port: int) -> tuple[int, Callable[[], None]]:
        """Serve the metrics. Return the port, and a function that ends the server.

        Raises OSError if the port is in use.
        """
        registry = CollectorRegistry(auto_describe=False)
        registry.register(self)
        server, thread = start_http_server(port, address, registry)

        def close() -> None:
            server.shutdown()
            server.server_close()
            thread.join()

        return int(server.server_port), close

    def run(self, has_ended: Callable[[], bool]) -> None:
        """Read the bus until `has_ended()` returns True."""
        with ThreadPoolExecutor(max_workers=4) as pool:
            while not has_ended():
                # Wait without the lock, because a scrape must not wait for a message.
                heard = self._inbox.hear(_WAIT_S, pool)
                with self._lock:
                    if (link := self._client.bus.link) != self._link:
                        self._link, self._link_began = link, heard.now
                    for car, alive in heard.gateways.items():
                        self._metrics.observer.on_token(car, heard.now, alive=alive)
                    for sample, wall_s in heard.samples:
                        self._metrics.on_sample(sample, heard.now, wall_s)
                    self._metrics.forget(heard.now)

    def collect(self) -> Iterator[_Family]:
        """Yield all metrics with their values now."""
        families = {metric.name: _family(metric) for metric in METRICS}
        families[CONNECTED.name].add_metric((), float(self._client.bus.connected))
        families[DROPS.name].add_metric((), self._inbox.dropped)
        with self._lock:
            now, link = time.monotonic(), self._client.bus.link
            sees_gateways = link == self._link != "" and now >= self._link_began + TOKENS_AFTER_LINK_S
            for metric, labels, value in self._metrics.values(now, sees_gateways=sees_gateways):
                families[metric.name].add_metric(labels, value)
        yield from families.values()


def _family(metric: Metric) -> _Family:
    family = CounterMetricFamily if metric.kind is MetricKind.COUNTER else GaugeMetricFamily
    return family(metric.name, metric.about, labels=metric.label_names)
