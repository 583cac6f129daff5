"""Identities, and in whose name each may send a command."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from schemas.commands import COMMANDS, STOPS, Verb
from schemas.identity import IdentityRole, Service, car, parse, person, service, speaks_for
from schemas.words import Rank

FORWARDED = {Verb.ESTOP, Verb.RESUME, Verb.PAUSE, Verb.UNPAUSE}
MIA = "mia@host-1"


@pytest.mark.parametrize(
    ("identity", "parsed"),
    [
        (person("mia"), (IdentityRole.PERSON, "mia")),
        (car("red"), (IdentityRole.CAR, "red")),
        (service(Service.RECORDER), (IdentityRole.SERVICE, "recorder")),
        ("service.mia", None),
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
def test_what_is_no_identity_speaks_for_nobody(identity: str, sender: str, kind: Rank, verb: str) -> None:
    if parse(identity) is None:
        assert not speaks_for(identity, sender, kind, verb)
