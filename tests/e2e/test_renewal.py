"""Certificates that are renewed by themselves: a real hub signs, real programs ask, and a drive goes on.

A certificate that was made 300 days ago is due. Nobody sleeps for 265 days here.
"""

import contextlib
from collections.abc import Iterator
from datetime import UTC, datetime, timedelta

import pytest

from fleet.client.client import Fleet as Client
from fleet.hub import certificate_authority
from fleet.hub.certificate_authority import BadRequestForCertificate
from fleet.hub.certificate_parts import LIFETIME
from fleet.hub.hub_store import HubStore
from schemas import keys
from schemas.bus import Bus, Sample
from schemas.bus.certificate_request import renew
from schemas.identity import car, person
from schemas.words import Rank
from tests.support.processes import FleetProcesses, driving, wait_for
from tests.support.secure import client_of, secure_fleet

ANN, MIA, EVE, RED, BLUE = person("ann"), person("mia"), person("eve"), car("red"), car("blue")
DUE = timedelta(days=300)
ENDS_SOON_S = 12
"""Life of a certificate that ends in the test: it is renewed at once, and its session goes on after 5 s."""
ENDS_LATER_S = 25
"""Life of a certificate that nobody renews: before its end, the car shows its first stop (within 9 s), and drives."""
AFTER_S = 1.0
"""Time after its end for which the drive is watched."""

pytestmark = pytest.mark.xdist_group("renewal")


def age(store: HubStore, identity: str, by: timedelta) -> None:
    """Make the certificate of an identity older, for the same key."""
    directory = store.directory
    ca = certificate_authority.KeyPair((directory / "ca.pem").read_bytes(), (directory / "ca.key").read_bytes())
    made = certificate_authority.issue(ca, identity, datetime.now(UTC) - by)
    (directory / f"{identity}.key").write_bytes(made.key)
    (directory / f"{identity}.pem").write_bytes(made.certificate)


def is_due(store: HubStore, identity: str) -> bool:
    dates = store.credentials.dates(identity)
    assert dates is not None
    return dates.is_due(datetime.now(UTC))


@pytest.fixture(scope="module")
def secured(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[FleetProcesses, HubStore]]:
    with secure_fleet(tmp_path_factory.mktemp("renewal"), ANN, [MIA, EVE, RED, BLUE]) as made:
        yield made


def test_drive_goes_on_while_both_are_renewed_and_their_first_certificates_end(
    secured: tuple[FleetProcesses, HubStore],
) -> None:
    """Zenoh closes a link when its certificate ends: a session that had not moved would lose its tokens then."""
    fleet, store = secured
    sim, (link,) = fleet.simulate("red:arduino:tcp")
    tokens: list[tuple[str, bool]] = []
    samples: list[Sample] = []
    with Bus.open(store.credentials.endpoint, identity=EVE) as watcher:
        for each in ("*", f"{keys.OPERATOR}/*"):
            watcher.watch_tokens(f"fleet/{each}", lambda key, alive: tokens.append((key, alive)))
        watcher.subscribe("fleet/red/**", samples.append)
        ends = datetime.now(UTC) + timedelta(seconds=ENDS_SOON_S)
        for identity in (RED, ANN):
            age(store, identity, LIFETIME - timedelta(seconds=ENDS_SOON_S))
        fleet.gateway(link, "--longest-drive", "60")
        with Client(store.credentials.endpoint, kind=Rank.PERSON, identity=ANN) as ann:
            fleet.ready()
            ann.car("red").drive("spin_left", 60.0, wait=False)
            wait_for(lambda: driving(sim), "red drives")
            while datetime.now(UTC) < ends + timedelta(seconds=AFTER_S):
                assert driving(sim)
            assert [key for key, alive in tokens if not alive] == []
            ann.stop()
        wait_for(lambda: not driving(sim), "it stops as ever")
    assert not any(is_due(store, identity) for identity in (RED, ANN))
    numbers: dict[str, list[int]] = {}
    for message, sample in ((each.message(), each) for each in samples):
        if number := getattr(message, "seq", 0):
            numbers.setdefault(sample.key, []).append(number)
    assert "fleet/red/state/safety" in numbers
    assert {
        key: each for key, each in numbers.items() if sorted(each) != list(range(each[0], each[0] + len(each)))
    } == {}


def test_gateway_stops_its_car_when_its_certificate_ends(secured: tuple[FleetProcesses, HubStore]) -> None:
    """Nothing renews it, as on a hub that cannot sign. Nobody can command the car then, and a mode has no end."""
    fleet, store = secured
    sim, (link,) = fleet.simulate("blue:arduino:tcp")
    age(store, BLUE, LIFETIME - timedelta(seconds=ENDS_LATER_S))
    dates = store.credentials.dates(BLUE)
    assert dates is not None
    authority = store.directory / "ca.key"
    hidden = authority.rename(authority.with_suffix(".hidden"))
    try:
        gateway = fleet.gateway(link, car="blue")
        with Client(store.credentials.endpoint, kind=Rank.PERSON, identity=ANN) as ann:
            fleet.ready("blue")
            ann.car("blue").mode("tracking")
            wait_for(lambda: driving(sim, "blue"), "blue drives")
            wait_for(lambda: not driving(sim, "blue"), "blue stands")
            assert datetime.now(UTC) >= dates.ends
            assert "[certificate_ended]" in gateway.stderr
            hidden.rename(authority)
            age(store, BLUE, timedelta())
            wait_for(lambda: "blue" in ann.cars(), "the gateway uses the new certificate")
            ann.car("blue").mode("manual")
    finally:
        with contextlib.suppress(FileNotFoundError):
            hidden.rename(authority)


def test_command_alone_renews_too(secured: tuple[FleetProcesses, HubStore]) -> None:
    """On the computer of a person, often only commands run. The key stays, the common name, too."""
    _, store = secured
    age(store, MIA, DUE)
    key = (store.directory / f"{MIA}.key").read_bytes()
    with Bus.open(store.credentials.endpoint, identity=MIA):
        wait_for(lambda: not is_due(store, MIA), "the next one is stored")
    assert (store.directory / f"{MIA}.key").read_bytes() == key
    assert (store.directory / f"{MIA}.pem").stat().st_mode & 0o777 == 0o600
    assert HubStore.load(store.credentials).known[MIA].until[:10] == f"{datetime.now(UTC) + LIFETIME:%Y-%m-%d}"
    with Bus.open(store.credentials.endpoint, identity=MIA) as bus:
        assert bus.connected


def test_nobody_gets_the_certificate_of_another_one_and_whoever_is_revoked_gets_none(
    secured: tuple[FleetProcesses, HubStore],
) -> None:
    _, store = secured

    def ask(key: str) -> list[str]:
        """Ask as eve, with her own certificate. Return the answers."""
        asked: list[bytes] = []
        renew(store.credentials, EVE, EVE, datetime.now(UTC), lambda request: asked.append(request) or b"")
        with client_of(store.credentials, EVE) as client:
            replies = client.get(key, payload=asked[0], timeout=10.0)
            return ["a certificate" if each.ok is not None else each.err.payload.to_string() for each in replies]

    assert ["last third" in each for each in ask(keys.renewal_key(EVE))] == [True], "it is not due"
    age(store, EVE, DUE)
    for key in (keys.renewal_key(ANN), keys.renewal_key("*"), f"{keys.HUB_RENEWAL}/**"):
        assert ask(key) == [], key
    assert ask(keys.renewal_key(EVE)) == ["a certificate"]
    files = {ending: (store.directory / f"{EVE}{ending}").read_bytes() for ending in (".pem", ".key")}
    assert HubStore.load(store.credentials).revoke(EVE)
    for ending, data in files.items():
        (store.directory / f"{EVE}{ending}").write_bytes(data)
    wait_for(lambda: ask(keys.renewal_key(EVE)) == [], "she gets nothing any more")
    _, request = certificate_authority.new_request(EVE)
    now, read = datetime.now(UTC), HubStore.load(store.credentials)
    with pytest.raises(BadRequestForCertificate, match="revoked"):
        read.renew(files[".pem"], request, EVE, now)
