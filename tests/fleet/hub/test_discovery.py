"""A hub that waits is found by multicast DNS, over real sockets on loopback. Others are not joined."""

from collections.abc import Iterator
from contextlib import ExitStack
from itertools import islice
from pathlib import Path

import pytest
from click.testing import CliRunner

from fleet.commands.hub import join_hub
from fleet.hub.discovery import announced, hubs_found
from fleet.hub.invitation import Invitation
from fleet.hub.join import NotJoined, join_one_of
from fleet.hub.join_code import JoinCode
from schemas.identity import person
from tests.fleet.hub.test_invitation import made
from tests.support.ports import free_port
from tests.support.processes import PATIENCE_S

HERE = ["127.0.0.1"]


@pytest.fixture
def invitations(tmp_path: Path) -> Iterator[list[Invitation]]:
    """Return the announced invitations of two hubs."""
    with ExitStack() as opened:
        found = []
        for name in ("one", "two"):
            each = Invitation(
                made(tmp_path / name), person("mia"), hub_port=7447, address="127.0.0.1", port=free_port()
            )
            opened.callback(each.close)
            assert opened.enter_context(announced(each.port, each.code, HERE))
            found.append(each)
        yield found


def test_code_alone_joins_its_own_hub(invitations: list[Invitation]) -> None:
    _, mine = invitations
    host, joined = join_one_of(hubs_found(HERE, PATIENCE_S), mine.code)
    assert (host, joined.identity) == ("127.0.0.1", person("mia"))
    assert joined.ca == mine._ca
    assert [bool(each.joined_from) for each in invitations] == [False, True]


def test_no_other_hub_is_joined(invitations: list[Invitation]) -> None:
    found = list(islice(hubs_found(HERE, PATIENCE_S), len(invitations)))
    with pytest.raises(NotJoined, match="2 others did not make this code"):
        join_one_of(found, JoinCode.new(b"another authority" * 2))
    assert not any(each.joined_from for each in invitations)


@pytest.mark.parametrize(
    ("words", "line"),
    [
        ((), ""),
        (("192.168.1.2", "ABCD", "EFGH"), ""),
        (("-",), "\n"),
        (("-",), "fleet join 192.168.1.2 ABCD-EFGH"),
        (("-",), "ABCD-EFGH"),
        (("-",), "x" * 1000),
    ],
)
def test_wrong_use_of_join_exits_2(words: tuple[str, ...], line: str) -> None:
    done = CliRunner().invoke(join_hub, words, input=line)
    assert done.exit_code == 2, done.output
    assert "Traceback" not in done.output
