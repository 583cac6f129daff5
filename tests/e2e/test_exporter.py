"""`fleet exporter` as a process, scraped as Prometheus does, on a bus with certificates, with a real gateway."""

import urllib.request
from pathlib import Path

from prometheus_client.parser import text_string_to_metric_families

from schemas import keys
from schemas.commands import Verb
from schemas.identity import car, person
from schemas.words import Rank
from tests.support.processes import PATIENCE_S, TAKEN, GatewayProcess, wait_for
from tests.support.secure import ask, client_of, secure_fleet, sender_of

ANN = person("ann")
Values = dict[tuple[str, tuple[tuple[str, str], ...]], float]


def scrape(address: str) -> Values:
    with urllib.request.urlopen(address, timeout=PATIENCE_S) as answer:
        assert answer.headers["Content-Type"].startswith("text/plain")
        text = answer.read().decode()
    families = text_string_to_metric_families(text)
    return {
        (each.name, tuple(sorted(each.labels.items()))): each.value for family in families for each in family.samples
    }


def address_of(exporter: GatewayProcess) -> str:
    found = wait_for(lambda: [*exporter.lines()], "the exporter serves")
    return str(found[0].split()[1])


def test_car_is_scraped_with_what_it_does(tmp_path: Path) -> None:
    with secure_fleet(tmp_path, ANN, [car("red")]) as (fleet, store):
        _, (link,) = fleet.simulate("red:arduino:tcp")
        gateway = fleet.gateway(link)
        exporter = fleet.start("-m", "fleet.cli", "exporter", "--port", "0")
        address = address_of(exporter)
        fleet.start("-m", "fleet.cli", "record", "run", "--sessions", str(tmp_path / "sessions"))
        own = (("car", "red"),)

        def value(name: str, **labels: str) -> float | None:
            return scrape(address).get((name, tuple(sorted(labels.items()))))

        wait_for(lambda: value("fleet_recorder", state="recording") == 1, "it is recorded")
        wait_for(lambda: value("fleet_car_link", car="red", state="online") == 1, "the car was heard")
        with client_of(store.credentials, ANN) as ann:
            key = keys.command_key("fleet", "red", Verb.ESTOP, ANN)
            (answer,) = ask(ann, key, sender=sender_of(ANN), kind=Rank.PERSON)
            assert answer["status"] in TAKEN
        asked = {"car": "red", "verb": "estop", "phase": "asked"}
        wait_for(lambda: value("fleet_car_commands_total", **asked) == 1, "the command is counted")
        wait_for(lambda: value("fleet_car_estops", car="red") == 1, "the e-stop is in force")
        wait_for(lambda: value("fleet_car_battery_volts", car="red"), "its battery is known")
        values = scrape(address)
        assert 6 < values["fleet_car_battery_volts", own] < 9
        assert values["fleet_car_silence_seconds", own] < PATIENCE_S
        assert values["fleet_car_received_bytes_total", own] > 0
        assert values["fleet_exporter_connected", ()] == 1
        gateway.kill()
        wait_for(lambda: value("fleet_car_up", car="red") == 0, "its gateway is gone")
        assert [name for name, labels in scrape(address) if labels == own and name != "fleet_car_up"] == []
        taken = fleet.start("-m", "fleet.cli", "exporter", "--port", address.rpartition(":")[2].partition("/")[0])
        assert taken.wait() == 1
        assert "fleet exporter --port 0" in taken.stderr
        assert exporter.end() == 0
