"""Two sites, whose hubs link to one another: real routers, real certificates, invitations over real TLS."""

import json
import threading
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from datetime import UTC, datetime, timedelta
from pathlib import Path

import pytest
import zenoh

from fleet.hub import certificate_authority
from fleet.hub.hub_store import HubStore
from fleet.hub.invitation import Invitation
from fleet.hub.join import join
from fleet.hub.local_hub import ensure_hub_here, store_joined
from schemas import identity, keys
from schemas.bus import Bus, BusError, hub, hub_renewals
from schemas.bus.credentials import HUB, Credentials
from schemas.bus.hub import serve
from tests.support import in_process
from tests.support.ports import free_port
from tests.support.processes import wait_for

NORTH = identity.site("north")
ANN, EVE = identity.person("ann"), identity.person("eve")


class Sites:
    """The first site with ann and red, the second one with eve and blue."""

    def __init__(self) -> None:
        self.first = f"tls/127.0.0.1:{free_port()}"
        self.second_port = free_port()
        self.store = ensure_hub_here(self.first, ["red"], listens=(self.first,))
        self._ended: dict[str, threading.Event] = {}
        self._threads: list[threading.Thread] = []
        self.second = self.join(NORTH)
        for each in (EVE, identity.car("blue")):
            assert self.join(each) == self.second

    def join(self, invited: str) -> str:
        self.store.reserve(invited)
        port = int(self.first.rpartition(":")[2])
        invitation = Invitation(self.store, invited, hub_port=port, address="127.0.0.1", port=free_port())
        try:
            joined = join("127.0.0.1", invitation.code, invitation.port, addresses=["127.0.0.1"])
        finally:
            invitation.close()
        return store_joined("127.0.0.1", joined, "127.0.0.1", self.second_port)

    def start(self, endpoint: str) -> None:
        stop = self._ended[endpoint] = threading.Event()
        self._threads.append(threading.Thread(target=serve, args=(endpoint, 3600.0, stop)))
        self._threads[-1].start()
        wait_for(lambda: self.is_up(endpoint), f"{endpoint} is up")

    def is_up(self, endpoint: str) -> bool:
        try:
            Bus.open(endpoint, identity=ANN if endpoint == self.first else EVE).close()
        except BusError:
            return False
        return True

    def stop(self, endpoint: str) -> None:
        self._ended[endpoint].set()

    def close(self) -> None:
        for each in self._ended.values():
            each.set()
        for thread in self._threads:
            thread.join()


@contextmanager
def gateway(endpoint: str, car: str) -> Iterator[None]:
    """Answer the commands to one car."""
    with Bus.open(endpoint, identity=identity.car(car)) as bus:
        for expression in keys.command_keys("fleet", car):
            session, own = bus._session, keys.command_key("fleet", car, "stop", identity.car(car))

            def answer(query: zenoh.Query, own: str = own) -> None:
                with query:
                    query.reply(own, car)

            session.declare_queryable(expression, answer)
        yield


@pytest.fixture
def sites(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Iterator[Sites]:
    monkeypatch.setenv("FLEET_STATE_DIR", str(tmp_path))
    monkeypatch.setenv("FLEET_AS", "ann")
    monkeypatch.setattr(hub, "RULES_POLL_S", 0.2)
    made = Sites()
    yield made
    made.close()


def reached(bus: Bus, key: str) -> list[str]:
    replies = bus._session.get(
        key,
        target=zenoh.QueryTarget.ALL,
        consolidation=zenoh.ConsolidationMode.NONE,
        accept_replies=zenoh.ReplyKeyExpr.ANY,
        timeout=1.0,
    )
    return sorted(reply.ok.payload.to_string() for reply in replies if reply.ok is not None)


def test_sites_go_on_alone_and_are_one_fleet_when_linked(sites: Sites) -> None:
    sites.start(sites.first)
    sites.start(sites.second)
    with ExitStack() as stack:
        stack.enter_context(gateway(sites.first, "red"))
        stack.enter_context(gateway(sites.second, "blue"))
        people = {
            name: stack.enter_context(Bus.open(endpoint, identity=name))
            for name, endpoint in ((ANN, sites.first), (EVE, sites.second))
        }
        everyone = {name: keys.command_key("fleet", "*", "stop", name) for name in people}
        for name, bus in people.items():
            wait_for(lambda bus=bus, name=name: reached(bus, everyone[name]) == ["blue", "red"], f"{name} has both")
            for other in people.keys() - {name}:
                assert reached(bus, everyone[other]) == [], "nobody speaks as another one, on either side"
            assert reached(bus, keys.HUB_RULES) == [], "the rules are for hubs"
        sites.stop(sites.first)
        wait_for(lambda: reached(people[EVE], everyone[EVE]) == ["blue"], "the second site goes on, cut off")
        sites.start(sites.first)
        for name, bus in people.items():
            wait_for(
                lambda bus=bus, name=name: reached(bus, everyone[name]) == ["blue", "red"], f"{name} has both again"
            )


def test_rules_of_first_hub_apply_at_every_site(sites: Sites) -> None:
    sites.start(sites.first)
    sites.start(sites.second)
    with gateway(sites.second, "blue"), Bus.open(sites.second, identity=EVE) as eve:
        own = keys.command_key("fleet", "*", "stop", EVE)
        wait_for(lambda: reached(eve, own) == ["blue"], "eve stops blue")
        assert sites.store.revoke(EVE)
        wait_for(lambda: reached(eve, own) == [], "eve stops nothing any more")
    assert sites.join(identity.person("mia")) == sites.second
    with gateway(sites.second, "blue"):
        own = keys.command_key("fleet", "*", "stop", identity.person("mia"))

        def mia_stops() -> bool:
            try:
                with Bus.open(sites.second, identity=identity.person("mia")) as bus:
                    return reached(bus, own) == ["blue"]
            except BusError:  # the hub takes the new rules just now
                return False

        wait_for(mia_stops, "mia does")


def test_hub_show_tells_who_is_connected_at_another_site(sites: Sites, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("FLEET_ENDPOINT", sites.first)
    sites.start(sites.first)
    sites.start(sites.second)

    def shown() -> dict[str, str]:
        lines = in_process.fleet("hub", "show", "--json").stdout.splitlines()
        return {row["identity"]: row["from"] for row in map(json.loads, lines) if row["state"] == "connected"}

    with gateway(sites.second, "blue"), Bus.open(sites.first, identity=ANN):
        wait_for(lambda: {ANN, NORTH, identity.car("blue")} <= shown().keys(), "all are shown")
        found = shown()
        assert found[identity.car("blue")].endswith(" (north)")
        assert "(" not in found[ANN]


def test_site_invites_nobody(sites: Sites) -> None:
    assert not HubStore.of(sites.second).is_hub


def test_hub_and_the_people_of_the_other_site_are_renewed_by_the_first_one(
    sites: Sites, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(hub_renewals, "OWN_CHECK_INTERVAL_S", 0.2)
    there = Credentials.of(sites.second)
    ca = certificate_authority.KeyPair(*((sites.store.directory / name).read_bytes() for name in ("ca.pem", "ca.key")))
    now = datetime.now(UTC)
    for file, name, names in ((HUB, NORTH, ["127.0.0.1", "localhost"]), (EVE, EVE, [])):
        key, request = certificate_authority.new_request(name)
        made = certificate_authority.sign_request(ca, request, name, now - timedelta(days=300), names)
        (there.directory / f"{file}.key").write_bytes(key)
        (there.directory / f"{file}.pem").write_bytes(made)
    sites.start(sites.first)
    sites.start(sites.second)

    def is_renewed(file: str) -> bool:
        dates = there.dates(file)
        return dates is not None and not dates.is_due(now)

    with Bus.open(sites.second, identity=EVE):
        wait_for(lambda: is_renewed(HUB), "that of the hub")
    made = (there.directory / f"{HUB}.pem").read_bytes()
    assert certificate_authority.names_of(made) == ["127.0.0.1", "localhost"]

    def eves() -> bool:
        with suppress(BusError), Bus.open(sites.second, identity=EVE):
            return is_renewed(EVE)
        return False

    wait_for(eves, "that of eve, through both hubs")
