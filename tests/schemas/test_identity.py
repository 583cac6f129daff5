"""Identities, and in whose name each may send a command."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from schemas.commands import COMMANDS, STOPS, Verb
from schemas.identity import (
    ANONYMOUS,
    IdentityRole,
    NotTheSender,
    Service,
    car,
    parse,
    person,
    sender_for,
    service,
    speaks_for,
)
from schemas.words import Rank

FORWARDED = {Verb.ESTOP, Verb.RESUME, Verb.PAUSE, Verb.UNPAUSE}
MIA = "mia@host-1"


@pytest.mark.parametrize(
    ("identity", "parsed"),
    [
        (person("mia"), (IdentityRole.PERSON, "mia")),
        (car("red"), (IdentityRole.CAR, "red")),
        (service(Service.RECORDER), (IdentityRole.SERVICE, "recorder")),
        (service(Service.RECORDER, "north"), (IdentityRole.SERVICE, "recorder")),
        ("service.recorder@North", None),
        ("service.recorder@", None),
        ("service.mia", None),
        ("service.mia@north", None),
        ("person.mia@north", None),
        ("person.Mia", None),
        ("person.", None),
        ("person", None),
        ("hub", None),
        ("", None),
        ("person.mia.2", None),
        ("lead.ann", None),
    ],
)
def test_identities(identity: str, parsed: tuple[IdentityRole, str] | None) -> None:
    assert parse(identity) == parsed


@pytest.mark.parametrize("verb", COMMANDS)
def test_in_whose_name(verb: str) -> None:
    for kind in (Rank.SCRIPT, Rank.PERSON):
        assert speaks_for(person("mia"), MIA, kind, verb)
        assert not speaks_for(person("eve"), MIA, kind, verb)
        assert speaks_for(service(Service.CONSOLE), MIA, kind, verb)
        assert not speaks_for(service(Service.COORDINATOR), MIA, kind, verb)
    assert not speaks_for(person("mia"), MIA, Rank.COORDINATOR, verb)
    assert not speaks_for(service(Service.CONSOLE), MIA, Rank.COORDINATOR, verb)
    assert speaks_for(service(Service.COORDINATOR), "coordinator-1", Rank.COORDINATOR, verb)
    for kind in Rank:
        assert speaks_for(car("red"), MIA, kind, verb) == (verb in FORWARDED)
        assert speaks_for(service(Service.SUPERVISOR), MIA, kind, verb) == (verb in STOPS)
        for silent in (service(Service.RECORDER), service(Service.SIMULATOR), "hub", ""):
            assert not speaks_for(silent, MIA, kind, verb)


@given(st.text(max_size=40), st.text(max_size=40), st.sampled_from(list(Rank)), st.sampled_from(list(COMMANDS)))
def test_invalid_identity_speaks_for_nobody(identity: str, sender: str, kind: Rank, verb: str) -> None:
    if parse(identity) is None:
        assert not speaks_for(identity, sender, kind, verb)


@pytest.mark.parametrize(
    ("identity", "sender", "expected"),
    [
        ("", "", ANONYMOUS),
        ("", MIA, MIA),
        (person("mia"), "", "mia"),
        (person("mia"), MIA, MIA),
        (service(Service.CONSOLE), MIA, MIA),
    ],
)
def test_service_knows_who_asks(identity: str, sender: str, expected: str) -> None:
    assert sender_for(identity, sender, "plan") == expected


@pytest.mark.parametrize("identity", [person("eve"), car("red"), service(Service.RECORDER), "junk"])
def test_nobody_asks_in_the_name_of_another(identity: str) -> None:
    with pytest.raises(NotTheSender):
        sender_for(identity, MIA, "plan")
