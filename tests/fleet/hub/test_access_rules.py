"""Rules of a hub, as Zenoh's key expressions judge them. tests/e2e/test_secure_bus.py asks a real hub."""

import json
from itertools import product
from typing import Any

import pytest
import zenoh

from fleet.hub.access_rules import access_control
from schemas import keys
from schemas.commands import COMMANDS
from schemas.identity import Service, car, may_locate, person, service

NORTH = service(Service.RECORDER, "north")
EVERYONE = [person("mia"), person("eve"), car("red"), car("blue"), *map(service, Service), NORTH]
RULES = access_control([(each, each) for each in EVERYONE])


def allows(identity: str, flow: str, message: str, expression: str) -> bool:
    """Return True if a rule of the identity includes the expression, as Zenoh decides it."""
    (own,) = (each["rules"] for each in RULES["policies"] if each["subjects"] == [identity])
    wanted = zenoh.KeyExpr(expression)
    expressions = [
        each
        for rule in RULES["rules"]
        if rule["id"] in own and flow in rule["flows"] and message in rule["messages"]
        for each in rule["key_exprs"]
    ]
    return any(zenoh.KeyExpr(each).includes(wanted) for each in expressions)


def test_zenoh_takes_them_and_everything_else_is_denied() -> None:
    config = zenoh.Config()
    config.insert_json5("access_control", json.dumps(RULES))
    assert RULES["default_permission"] == "deny"
    assert {each["permission"] for each in RULES["rules"]} == {"allow"}


@pytest.mark.parametrize(("identity", "verb", "target"), list(product(EVERYONE, COMMANDS, ("red", "*"))))
def test_command_is_sent_under_ones_own_identity_only(identity: str, verb: str, target: str) -> None:
    for message in ("query", "put"):
        assert allows(identity, "ingress", message, keys.command_key("fleet", target, verb, identity))
        assert not allows(identity, "ingress", message, keys.command_key("fleet", target, verb))
        assert not allows(identity, "ingress", message, keys.command_key("fleet", target, verb, "*"))
        assert not allows(identity, "ingress", message, f"fleet/{target}/@cmd/**")
        for other in EVERYONE:
            if other != identity:
                assert not allows(identity, "ingress", message, keys.command_key("fleet", target, verb, other))


OWN_CHUNK: dict[str, tuple[str, ...]] = {
    car("red"): ("red",),
    car("blue"): ("blue",),
    service(Service.SUPERVISOR): (keys.SUPERVISOR,),
    service(Service.COORDINATOR): (keys.COORDINATOR,),
    service(Service.RECORDER): (keys.RECORDER,),
    NORTH: (keys.RECORDER,),
    service(Service.SIMULATOR): (keys.SIMULATOR,),
}


@pytest.mark.parametrize("identity", EVERYONE)
def test_everyone_speaks_for_itself_only(identity: str) -> None:
    chunks = ("red", "blue", keys.SUPERVISOR, keys.COORDINATOR, keys.RECORDER, keys.SIMULATOR)
    for chunk in chunks:
        mine = chunk in OWN_CHUNK.get(identity, ())
        assert allows(identity, "ingress", "put", f"fleet/{chunk}/state/mode") == mine
        assert allows(identity, "ingress", "liveliness_token", f"fleet/{chunk}") == mine
        assert allows(identity, "ingress", "reply", f"fleet/{chunk}/state/mode") == mine
        for expression in keys.command_keys("fleet", chunk):
            assert allows(identity, "ingress", "declare_queryable", expression) == mine
    for wide in ("**", "fleet/**", "fleet/*/state/mode", "*/*/@cmd/*"):
        assert not allows(identity, "ingress", "put", wide)
        assert not allows(identity, "ingress", "declare_queryable", wide)
    assert allows(identity, "ingress", "put", "fleet/red/sim/truth") == (
        identity in (car("red"), service(Service.SIMULATOR))
    )
    for of in ("red", "blue"):
        assert allows(identity, "ingress", "put", f"fleet/{of}/sensor/pose") == may_locate(identity, of)
        caches = f"fleet/{of}/sensor/pose/@adv/pub/1/2/_"
        assert allows(identity, "ingress", "declare_queryable", caches) == may_locate(identity, of)


def test_pose_is_allowed_to_own_gateway_and_locator() -> None:
    assert {each for each in EVERYONE if may_locate(each, "red")} == {car("red"), service(Service.LOCATOR)}
    assert may_locate("", "red"), "on a hub without certificates everyone may"
    locator = service(Service.LOCATOR)
    for other in ("fleet/red/sensor/range", "fleet/red/state/mode", "fleet/red/sim/truth", "fleet/*/sensor/*"):
        assert not allows(locator, "ingress", "put", other)


@pytest.mark.parametrize("identity", EVERYONE)
def test_everyone_reads_everything(identity: str) -> None:
    expressions = ["fleet/**", "fleet/*/state/mode", "*/*", *keys.recorded_keys("fleet"), "fleet/red/**/@adv/**"]
    expressions += [f"fleet/{each}/**" for each in (keys.OPERATOR, keys.REPLAY)]
    for expression in expressions:
        assert allows(identity, "ingress", "declare_subscriber", expression), expression
    for expression in ("fleet/**", "fleet/*/sensor/*", "fleet/@supervisor/status"):
        assert allows(identity, "ingress", "query", expression)
        assert allows(identity, "egress", "reply", expression)
    for expression in (each for each in keys.recorded_keys("fleet") if "@cmd" not in each):
        caches = f"{expression}/@adv/pub/**"
        assert allows(identity, "ingress", "query", caches), f"the recorder has again what it missed: {caches}"
        assert allows(car("red"), "egress", "query", caches)
        assert allows(service(Service.SUPERVISOR), "egress", "query", caches)
    for expression in ("*/*", "*/@supervisor", "fleet/@operator/*"):
        assert allows(identity, "ingress", "liveliness_query", expression)
        assert allows(identity, "ingress", "declare_liveliness_subscriber", expression)


@pytest.mark.parametrize(
    ("identity", "token", "allowed"),
    [
        (person("mia"), "fleet/@operator/mia@host-4711", True),
        (person("mia"), "fleet/@operator/eve@host-4711", False),
        (person("mia"), "fleet/@operator/miamia@host-4711", False),
        (person("mia"), "fleet/@operator/mia", False),
        (service(Service.CONSOLE), "fleet/@operator/mia@host-4711.2", True),
        (car("red"), "fleet/@operator/red@host-1", True),
        (car("red"), "fleet/@operator/mia@host-1", False),
    ],
)
def test_whose_token(identity: str, token: str, allowed: bool) -> None:
    assert allows(identity, "ingress", "liveliness_token", token) == allowed


def test_gateway_gets_the_wildcards_of_others() -> None:
    for expression in ("fleet/**", "fleet/*/state/*", "*/*/state/mode"):
        for message in ("query", "declare_subscriber"):
            assert allows(car("red"), "egress", message, expression)
    for identity in EVERYONE:
        assert allows(car("red"), "egress", "query", keys.command_key("fleet", "*", "stop", identity))
    assert allows(car("red"), "egress", "put", keys.command_key("fleet", "red", "drive", person("mia")))


def test_unknown_identity_gets_read_rules_only() -> None:
    found: Any = access_control([("nobody", "nobody")])
    (policy,) = found["policies"]
    assert set(policy["rules"]) == {"read", "see drives", "answers"}
