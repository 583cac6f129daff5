"""A stock Zenoh router in the place of our hub, with the configuration of `fleet hub config`: the same rules hold."""

from collections.abc import Iterator
from pathlib import Path

import pytest

from schemas.identity import Service, service
from tests.e2e import test_secure_bus
from tests.e2e.test_secure_bus import ANN, BLUE, EVE, MIA, RED, SecureStage
from tests.support.secure import secure_fleet

IDENTITIES = (ANN, MIA, EVE, RED, BLUE, *map(service, Service))


@pytest.fixture(scope="module")
def stage(zenohd: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[SecureStage]:
    with secure_fleet(tmp_path_factory.mktemp("zenohd"), ANN, [MIA, EVE, RED, BLUE], zenohd) as (fleet, store):
        yield SecureStage(fleet, store)


@pytest.mark.soak
@pytest.mark.timeout(3600)
@pytest.mark.parametrize("identity", IDENTITIES)
def test_secure_command_counts_under_own_identity_only(identity: str, stage: SecureStage) -> None:
    test_secure_bus.test_secure_command_counts_under_own_identity_only(identity, stage)


@pytest.mark.soak
@pytest.mark.parametrize("identity", [ANN, MIA, EVE, RED])
def test_verb_rights_follow_people_table(identity: str, stage: SecureStage) -> None:
    test_secure_bus.test_verb_rights_follow_people_table(identity, stage)


@pytest.mark.soak
def test_secure_bus_refuses_foreign_publications_and_answers(stage: SecureStage) -> None:
    test_secure_bus.test_secure_bus_refuses_foreign_publications_and_answers(stage)


@pytest.mark.soak
@pytest.mark.parametrize("why", ["no certificate", "another authority", "expired", "not yet"])
def test_stranger_without_certificate_gets_no_link(why: str, stage: SecureStage) -> None:
    test_secure_bus.test_stranger_without_certificate_gets_no_link(why, stage)
