"""The exporter on a bus whose link is cut."""

import threading
import time

from fleet.client.client import Fleet
from fleet.exporter.exporter import Exporter
from schemas import bus, keys, topics
from schemas.gen import fleet_v1_pb2 as pb
from tests.support.processes import FleetProcesses, wait_for
from tests.support.tcp_proxy import StallProxy

STATES = {"state/link": pb.Link(), "state/mode": pb.Mode(), "state/motion": pb.Motion(), "state/safety": pb.Safety()}


def test_cut_off_exporter_calls_no_gateway_gone(fleet: FleetProcesses) -> None:
    proxy = StallProxy(int(fleet.endpoint.rpartition(":")[2]))
    ended = threading.Event()
    with bus.Bus.open(fleet.endpoint) as gateways, Fleet(f"tcp/127.0.0.1:{proxy.port}") as client:
        exporter = Exporter(client)
        running = threading.Thread(target=exporter.run, args=(ended.is_set,))
        running.start()

        def up() -> dict[str, float]:
            families = {each.name: each for each in exporter.collect()}
            found = {each.labels["car"]: each.value for each in families["fleet_car_up"].samples}
            assert 0 not in found.values()
            return found

        def is_up() -> bool:
            for publisher, message in states:  # a gateway also says its state again and again
                publisher.put(message, time.time_ns())
            return up() == {"red": 1, "blue": 1}

        states = []
        try:
            for car in ("red", "blue"):
                gateways.token(keys.car_token(client.name, car))
                for topic, message in STATES.items():
                    key = f"{client.name}/{car}/{topic}"
                    states.append((gateways.publisher(key, topics.TOPICS[topic], car), message))
            wait_for(is_up, "it sees both")
            proxy.cut()
            wait_for(lambda: up() == {}, "it sees none")
            proxy.mend()
            wait_for(is_up, "it sees both again")
        finally:
            ended.set()
            running.join()
            proxy.close()
