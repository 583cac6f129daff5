"""A hub with certificates, real gateways, and plain Zenoh clients with every identity: what each may, and nothing else.

The people table: ann is a lead, mia drives red, eve is in no table: she may watch and stop.
"""

import json
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import pytest
import zenoh

from fleet.client.client import Fleet as Client
from fleet.client.refused_by_hub import why_refused
from fleet.commands import hub
from fleet.hub import certificate_authority
from fleet.hub.certificate_parts import LIFETIME
from fleet.hub.hub_store import HubStore
from schemas import keys
from schemas.bus import Bus, BusError
from schemas.commands import COMMANDS, STOPPING_VERBS, STOPS, Verb
from schemas.identity import Service, car, person, service
from schemas.words import Rank
from tests.support import in_process
from tests.support.ports import free_port
from tests.support.processes import PATIENCE_S, TAKEN, FleetProcesses, GatewayProcess, driving, wait_for
from tests.support.secure import FIELDS, ask, client_of, secure_fleet, sender_of, shapes, stranger

pytestmark = pytest.mark.xdist_group("secure-bus")

ANN, MIA, EVE, RED, BLUE = person("ann"), person("mia"), person("eve"), car("red"), car("blue")
PEOPLE = ("--people-only", "--person", "ann:lead", "--person")
TARGETS = {"red": ["red"], "blue": ["blue"], "*": ["blue", "red"]}


class SecureStage:
    """Two simulated cars with gateways, and the files of their hub."""

    def __init__(self, fleet: FleetProcesses, store: HubStore) -> None:
        self.fleet, self.store = fleet, store
        self.sim, (self.red, blue) = fleet.simulate("red:arduino:tcp", "blue:arduino:tcp")
        self.gateways: dict[str, GatewayProcess] = {
            "red": fleet.gateway(self.red, *PEOPLE, "mia"),
            "blue": fleet.gateway(blue, *PEOPLE, "mia:other", car="blue"),
        }
        for name in self.gateways:
            self.fleet.ready(name)

    def free(self, *names: str) -> None:
        """End e-stops, pauses, holds and loans of these cars, or of all, as a lead."""
        with self.client(ANN) as ann:
            for name in names or ("red", "blue"):
                self.command(ann, ANN, name, Verb.RESUME, all=True)
                self.command(ann, ANN, name, Verb.UNPAUSE)
                self.command(ann, ANN, name, Verb.LEND, end=True)
                wait_for(lambda name=name: not self.fleet.state("safety", name).estops, "free")

    def track(self, *names: str) -> None:
        """Bring cars into mode tracking, as a lead, until they drive. On a busy machine one command may expire."""
        with self.client(ANN) as ann:
            for name in names:

                def drives(name: str = name) -> bool:
                    (answer,) = self.command(ann, ANN, name, Verb.MODE, mode="tracking") or ({"status": ""},)
                    return answer["status"] in TAKEN and driving(self.sim, name)

                wait_for(drives, f"{name} drives")

    def client(self, identity: str) -> Any:
        """Return a plain Zenoh client, to be used with `with`."""
        return client_of(self.store.credentials, identity)

    @staticmethod
    def command(session: zenoh.Session, identity: str, target: str, verb: str, **fields: Any) -> list[dict[str, Any]]:
        """Send a command under one's own identity."""
        key = keys.command_key("fleet", target, verb, identity)
        return ask(session, key, **{"sender": sender_of(identity), "kind": "person", **fields})


@pytest.fixture(scope="module")
def stage(tmp_path_factory: pytest.TempPathFactory) -> Iterator[SecureStage]:
    with secure_fleet(tmp_path_factory.mktemp("secure"), ANN, [MIA, EVE, RED, BLUE]) as (fleet, store):
        yield SecureStage(fleet, store)


@pytest.mark.parametrize("identity", [ANN, MIA, EVE, RED, BLUE, *map(service, Service)])
def test_secure_command_counts_under_own_identity_only(identity: str, stage: SecureStage) -> None:
    others = [each for each in (ANN, MIA, RED, service(Service.COORDINATOR)) if each != identity]
    got: list[str] = []
    with stage.client(identity) as client:
        for target in TARGETS:
            for verb in COMMANDS:
                for name, key in shapes(target, verb, identity, others).items():
                    if name != "own":
                        fields = {"sender": sender_of(ANN), "kind": "person", **FIELDS.get(verb, {})}
                        got += [f"{key}: {each}" for each in ask(client, key, **fields)]
    assert got == []


def may(identity: str, verb: str, target: str) -> bool:
    """Return True if the people table lets an identity do this, apart from stops."""
    of_leads = (Verb.PAUSE, Verb.UNPAUSE, Verb.LEND)
    return identity == ANN or (identity == MIA and target == "red" and verb not in of_leads)


@pytest.mark.parametrize("identity", [ANN, MIA, EVE, RED, BLUE, service(Service.RECORDER)])
def test_verb_rights_follow_people_table(identity: str, stage: SecureStage) -> None:
    """The verbs that stop come last, since they hold and e-stop the cars. `arm` is refused before anybody is asked."""
    stage.free()
    wrong: list[str] = []
    asked = [each for each in COMMANDS if each not in (Verb.ARM, Verb.RESUME)]
    verbs = sorted(asked, key=lambda verb: verb in STOPPING_VERBS)
    with stage.client(identity) as client:
        for verb in verbs:
            for target, cars in TARGETS.items():
                if target == "*" and not COMMANDS[verb].wildcard:
                    continue
                answers = stage.command(client, identity, target, verb, **FIELDS.get(verb, {}))
                assert sorted(each["car"] for each in answers) == cars, (verb, target, answers)
                for answer in answers:
                    refused = answer["reason"] == "not_allowed"
                    allowed = verb in STOPS or may(identity, verb, answer["car"])
                    if refused == allowed or (verb in STOPS and answer["status"] not in TAKEN):
                        wrong.append(f"{identity} {verb} {target}: {answer}")
    assert wrong == []


def test_command_under_another_name_is_refused_but_stop_holds(stage: SecureStage) -> None:
    stage.free()
    with stage.client(MIA) as mia:
        for kind, sender in (("person", sender_of(ANN)), ("coordinator", sender_of(MIA)), ("script", "anonymous")):
            fields = {"sender": sender, "kind": kind}
            (answer,) = stage.command(mia, MIA, "red", Verb.DRIVE, **FIELDS["drive"], **fields)
            assert (answer["status"], answer["reason"]) == ("rejected", "not_allowed")
            (answer,) = stage.command(mia, MIA, "red", Verb.STOP, **fields)
            assert answer["status"] in TAKEN
            assert stage.fleet.state("safety").hold.by == "mia"


def test_secure_bus_refuses_foreign_publications_and_answers(stage: SecureStage) -> None:
    stage.free()
    heard: list[str] = []
    asked: list[str] = []
    with stage.client(EVE) as eve, stage.client(BLUE) as blue, stage.client(MIA) as mia:

        def hear(sample: zenoh.Sample) -> None:
            heard.append(f"{sample.key_expr} {sample.payload.to_string()}")

        eve.declare_subscriber("fleet/**", hear)
        for session in (blue, mia):
            for expression in keys.command_keys("fleet", "red"):
                session.declare_queryable(expression, lambda query: asked.append(str(query.key_expr)))
            session.liveliness().declare_token("fleet/green")
            session.liveliness().declare_token(keys.operator_token("fleet", sender_of(ANN)))
            session.put("fleet/red/sensor/range", b"false")
            session.put("fleet/@supervisor/status", b"false")
            session.put(keys.command_key("fleet", "red", Verb.DRIVE, RED), b"false")
            session.delete("fleet/red/state/mode")
        blue.put("fleet/blue/sensor/false", b"its own")
        wait_for(lambda: any("its own" in each for each in heard), "what was published before is here")
        assert not [each for each in heard if each.endswith(" false")]
        (answer,) = stage.command(eve, EVE, "red", Verb.STOP)
        assert answer["car"] == "red"
        assert asked == []
        found = [*eve.liveliness().get("fleet/**"), *eve.liveliness().get("fleet/@operator/*")]
        tokens = [str(reply.ok.key_expr) for reply in found if reply.ok is not None]
    assert "fleet/green" not in tokens
    assert not [token for token in tokens if "/ann@" in token]


def test_locator_publishes_poses_and_person_does_not(stage: SecureStage) -> None:
    locator = service(Service.LOCATOR)
    with Client(stage.fleet.endpoint, identity=locator) as outside, Client(stage.fleet.endpoint, identity=MIA) as mia:

        def place(x_m: float) -> None:
            outside.publish_pose("red", x_m=x_m, y_m=0.0, heading_rad=0.0)
            wait_for(lambda: [each["x_m"] for each in mia.get("red/sensor/pose")] == [x_m], "red's gateway has it")

        place(1.0)
        with pytest.raises(BusError, match="hub invite --service locator"):
            mia.publish_pose("red", x_m=5.0, y_m=0.0, heading_rad=0.0)
        mia.bus.put_command("fleet/red/sensor/pose", b'{"x_m": 7}', "application/json")
        place(2.0)
        assert [each["x_m"] for each in mia.history("red/sensor/pose", last=9)] == [1.0, 2.0]


def test_secure_stream_drives_own_car_only(stage: SecureStage) -> None:
    stage.free()
    stage.fleet.ready("red")  # a stream that begins during a stop is held until it pauses
    with stage.client(MIA) as mia:

        def drive(car_name: str, identity: str) -> None:
            mia.put(
                keys.command_key("fleet", car_name, Verb.DRIVE, identity),
                f'{{"motion": "forward", "duration_s": 0.5, "sender": "{sender_of(MIA)}", "kind": "person"}}',
                encoding="application/json",
            )

        def red_drives() -> bool:
            drive("red", MIA)
            drive("blue", MIA)
            drive("blue", ANN)
            return driving(stage.sim)

        wait_for(red_drives, "red drives")
        assert not driving(stage.sim, "blue")
    wait_for(lambda: not driving(stage.sim), "its drive is over")


def test_our_own_client_is_who_its_certificate_says(stage: SecureStage) -> None:
    stage.free()
    with Client(stage.fleet.endpoint, kind=Rank.PERSON) as ann:
        assert ann.sender.startswith("ann@")
        assert ann.bus.identity == ANN
        ann.car("red").led(1, 2, 3).check()
        assert all(each.ok for each in ann.stop())
    with pytest.raises(keys.BadKey, match="by the certificate"):
        Client(stage.fleet.endpoint, person="mia")
    with pytest.raises(keys.BadKey, match="by the certificate"):
        Client(stage.fleet.endpoint, sender="mia@here")
    with Bus.open(stage.fleet.endpoint, identity=RED) as bus:
        assert bus.identity == RED


def foreign(directory: Path) -> dict[str, dict[str, Any]]:
    """Return the settings of clients that the hub must refuse, and why."""
    now = datetime.now(UTC)
    own = {name: (directory / f"{name}.pem").read_bytes() for name in ("ca", EVE)}
    ca = certificate_authority.KeyPair(own["ca"], (directory / "ca.key").read_bytes())
    made = {
        "another authority": certificate_authority.issue(certificate_authority.make_authority(now), ANN, now),
        "expired": certificate_authority.issue(ca, ANN, now - LIFETIME - timedelta(days=2)),
        "not yet": certificate_authority.issue(ca, ANN, now + timedelta(days=30)),
    }
    found: dict[str, dict[str, Any]] = {"no certificate": {}}
    for why, pair in made.items():
        name = why.replace(" ", "-")
        for ending, data in (("pem", pair.certificate), ("key", pair.key)):
            (directory.parent / f"{name}.{ending}").write_bytes(data)
        paths = {"certificate": f"{directory.parent / name}.pem", "private_key": f"{directory.parent / name}.key"}
        found[why] = {f"connect_{each}": path for each, path in paths.items()}
    ca_file = str(directory / "ca.pem")
    return {why: {"root_ca_certificate": ca_file, "enable_mtls": bool(each), **each} for why, each in found.items()}


@pytest.mark.parametrize("why", ["no certificate", "another authority", "expired", "not yet"])
def test_stranger_without_certificate_gets_no_link(why: str, stage: SecureStage) -> None:
    settings = foreign(stage.store.directory)[why]
    with pytest.raises(zenoh.ZError), stranger(stage.store.credentials, **settings):
        pass


@pytest.mark.parametrize(
    ("begins", "words"), [(-LIFETIME - timedelta(days=2), "ended on"), (timedelta(9), "begins on")]
)
def test_whose_certificate_has_ended_reads_so(begins: timedelta, words: str, stage: SecureStage) -> None:
    directory = stage.store.directory
    ca = certificate_authority.KeyPair((directory / "ca.pem").read_bytes(), (directory / "ca.key").read_bytes())
    late = person("late")
    pair = certificate_authority.issue(ca, late, datetime.now(UTC) + begins)
    for ending, data in (("pem", pair.certificate), ("key", pair.key)):
        (directory / f"{late}.{ending}").write_bytes(data)
    with pytest.raises(BusError, match=f"{late} {words}"):
        Bus.open(stage.store.credentials.endpoint, timeout_s=0.5, identity=late)


def test_certificate_without_access_rule_gets_nothing(stage: SecureStage) -> None:
    """Somebody has the authority's key, or the hub's list was restored from an old copy."""
    directory = stage.store.directory
    ca = certificate_authority.KeyPair((directory / "ca.pem").read_bytes(), (directory / "ca.key").read_bytes())
    pair = certificate_authority.issue(ca, "person.zoe", datetime.now(UTC))
    (directory / "person.zoe.pem").write_bytes(pair.certificate)
    (directory / "person.zoe.key").write_bytes(pair.key)
    with stage.client("person.zoe") as zoe:
        assert ask(zoe, "fleet/red/state/mode") == []
        assert stage.command(zoe, "person.zoe", "*", Verb.STOP) == []


def test_false_hub_gets_no_client(stage: SecureStage, tmp_path: Path) -> None:
    """Whoever has joined has a certificate of the same authority, and cannot be the hub with it."""
    settings = stage.store.credentials.of_client(MIA)["tls"]
    port = free_port()
    listen = {
        "mode": "router",
        "listen": {"endpoints": [f"tls/127.0.0.1:{port}"]},
        "transport": {
            "link": {
                "protocols": ["tls"],
                "tls": {
                    "root_ca_certificate": settings["root_ca_certificate"],
                    "listen_certificate": settings["connect_certificate"],
                    "listen_private_key": settings["connect_private_key"],
                },
            }
        },
        "scouting": {"multicast": {"enabled": False}},
    }
    with zenoh.open(zenoh.Config.from_json5(json.dumps(listen))):
        elsewhere = type(stage.store.credentials)(stage.store.directory, f"tls/127.0.0.1:{port}")
        with pytest.raises(zenoh.ZError), client_of(elsewhere, ANN):
            pass


def test_gateway_stops_its_car_when_its_certificate_is_revoked_elsewhere(
    stage: SecureStage, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It keeps its key and its certificate, as on a computer that nobody reaches in this moment."""
    monkeypatch.setenv("FLEET_ENDPOINT", stage.store.credentials.endpoint)
    stage.free()
    stage.track("red", "blue")
    kept = [(path := stage.store.directory / f"{BLUE}{ending}", path.read_bytes()) for ending in (".key", ".pem")]
    assert HubStore.load(stage.store.credentials).revoke(BLUE)
    for path, data in kept:
        path.write_bytes(data)
    wait_for(lambda: not driving(stage.sim, "blue"), "blue stands")
    assert "[revoked]" in stage.gateways["blue"].stderr
    assert driving(stage.sim, "red")
    assert "[revoked]" not in stage.gateways["red"].stderr
    told = [json.loads(line) for line in in_process.fleet("doctor", "--json").stdout.splitlines()]
    assert {each["car"]: each["findings"][0]["code"] for each in told if each["findings"]}["blue"] == "gateway_unheard"


@pytest.mark.parametrize("identity", [ANN, RED, service(Service.RECORDER)])
def test_nobody_with_a_valid_certificate_is_called_revoked(stage: SecureStage, identity: str) -> None:
    """A person who has joined as a car also looks who is there, before the first gateway runs."""
    with Client(stage.store.credentials.endpoint, kind="person", identity=identity) as client:
        assert why_refused(client) == ""


def test_revoked_person_gets_nothing_and_others_reconnect(stage: SecureStage) -> None:
    """One of the last in this file: eve is gone after it."""

    def refused() -> str:
        with Client(stage.store.credentials.endpoint, kind="person", identity=EVE) as client:
            return why_refused(client)

    with stage.client(EVE) as eve, stage.client(MIA) as mia:
        assert stage.command(eve, EVE, "red", Verb.STOP)
        assert refused() == ""
        key, pem = ((stage.store.directory / f"{EVE}{ending}").read_bytes() for ending in (".key", ".pem"))
        began = time.monotonic()
        assert HubStore.load(stage.store.credentials).revoke(EVE)
        wait_for(lambda: not stage.command(eve, EVE, "red", Verb.STOP), "eve gets nothing")
        wait_for(lambda: stage.command(mia, MIA, "red", Verb.STOP), "mia is back")
        assert time.monotonic() - began < 20
        assert stage.command(eve, EVE, "*", Verb.STOP) == []
        assert ask(eve, "fleet/red/state/mode") == []
    for ending, data in ((".key", key), (".pem", pem)):
        (stage.store.directory / f"{EVE}{ending}").write_bytes(data)
    with stage.client(EVE) as eve:
        assert stage.command(eve, EVE, "*", Verb.STOP) == [], "nor over a new link"
        assert EVE in refused(), "and our own programs say why"


def test_revoke_of_car_stops_it_first_while_hub_restarts(stage: SecureStage, monkeypatch: pytest.MonkeyPatch) -> None:
    """Nearly last in this file: red is gone after it."""
    monkeypatch.setenv("FLEET_ENDPOINT", stage.store.credentials.endpoint)
    monkeypatch.setattr(hub, "HUB_RESTART_S", PATIENCE_S)  # a busy machine takes long to start one
    stage.free("red")
    stage.track("red")
    stage.fleet.hub.kill()
    with ThreadPoolExecutor() as pool:
        revoking = pool.submit(in_process.fleet, "hub", "revoke", RED)
        stage.fleet.hub = stage.fleet.start_hub()
        done = revoking.result()
    assert done.returncode == 0, done.stderr
    assert not driving(stage.sim, "red")
    assert "NOT STOPPED" not in done.stderr
    assert "red was stopped first" in done.stderr


def test_invitation_of_car_elsewhere_stops_it_first(stage: SecureStage) -> None:
    """Last in this file. The test before it has revoked red, so red begins again on the hub's computer."""
    stage.gateways["red"].end()
    HubStore.load(stage.store.credentials).ensure([RED], ANN, addresses=["127.0.0.1"])
    stage.gateways["red"] = stage.fleet.gateway(stage.red, *PEOPLE, "mia")
    stage.fleet.ready("red")
    stage.free("red")
    stage.track("red")
    where = ("--as-hub", "127.0.0.1", "--port", str(free_port()))
    invitation = stage.fleet.start("-m", "fleet.cli", "hub", "invite", "--car", "red", "--json", *where)
    assert invitation.line()["identity"] == RED
    assert not driving(stage.sim, "red"), (invitation.stderr, stage.gateways["red"].stderr[-1500:])
    assert "NOT STOPPED" not in invitation.stderr
    assert "[revoked]" not in stage.gateways["red"].stderr, "it is stopped before"
    assert not (stage.store.directory / f"{RED}.key").exists()
