"""`fleet play` refuses in words what Zenoh cannot carry, and plays the rest. Zenoh's library panics on some of it."""

from pathlib import Path

import pytest

from fleet.replay.player.player import MAX_ENCODING_BYTES, MAX_KEY_BYTES, is_carried
from schemas import bus
from tests.support.processes import FleetProcesses, wait_for
from tests.support.random_session import RANGE, Mixed

LONG = "E" * (MAX_ENCODING_BYTES + 1)
BAD_KEYS = (
    "fleet/red/sensor/a#b", "fleet/red/a?b", "fleet/red/a*", "fleet/red/$x", "fleet/red//x", "fleet/red/x/",
    "fleet/a#b/x", "fleet/red/" + "x" * MAX_KEY_BYTES,
)  # fmt: skip


def test_uncarriable_messages_are_refused_and_rest_is_played(fleet: FleetProcesses, tmp_path: Path) -> None:
    made = Mixed(path := tmp_path / "x.mcap")
    for key in BAD_KEYS:
        made.put(key, "", b"{}", "json")
    made.put(RANGE, "", b"x", LONG)
    made.put("fleet/red/\x1b]0;pwn\x07x", "", b"{}", "json")  # the bus carries it, a terminal must not
    made.put("/imu", "", b"{}", "json")
    made.put("fleet/red/@cmd/drive", "", b"{}", "json")
    made.own(RANGE, 3)
    made.close()
    got: list[bus.Sample] = []
    fleet.bus.subscribe("again/**", got.append)
    player = fleet.start("-m", "fleet.cli", "play", str(path), "--as", "again")
    assert player.wait() == 0, player.stderr
    wait_for(lambda: len(got) == 4, "the rest is published")
    lines = [line for line in player.stderr.splitlines() if line.startswith("not published: ")]
    assert len(lines) == len(BAD_KEYS) + 3
    assert player.stderr.isprintable() or all(each.isprintable() or each == "\n" for each in player.stderr)
    assert max(map(len, lines)) < 300


@pytest.mark.parametrize(("key", "encoding"), [(RANGE, LONG), ("fleet/red/sensor/a#b", "json")])
def test_nothing_to_play_is_an_error(fleet: FleetProcesses, tmp_path: Path, key: str, encoding: str) -> None:
    made = Mixed(path := tmp_path / "x.mcap")
    made.put(key, "", b"{}", encoding)
    made.close()
    player = fleet.start("-m", "fleet.cli", "play", str(path), "--as", "again")
    assert player.wait() == 1
    assert len(player.stderr.splitlines()) == 1


def test_rule_for_keys_is_zenohs() -> None:
    import zenoh

    for key in (*BAD_KEYS[:-1], "a/b", "@x/@y", "a b", "\x1b", "\u65e5", "a-*", "/a", "a/", "", "$*", "a$*"):
        try:
            zenoh.KeyExpr(key)
            allowed = "*" not in key  # an expression, and no key
        except zenoh.ZError:
            allowed = False
        assert is_carried(key) == allowed, key
