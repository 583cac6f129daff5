"""The state file survives a restart. The gateway writes it whole, and an unreadable file counts as a hold."""

import json
import os
import sys
import threading
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from gateway.control.safety_state import PersistedSafety
from gateway.safety_state_file import MAX_OTHER_LINKS, SafetyStateFile
from schemas.links import car_link, parse_link
from schemas.rights import Estop, FleetPause, Hold, Loan
from schemas.state_dir import directory_of
from schemas.words import Rank
from tests.support.ports import free_endpoint
from tests.support.processes import FleetProcesses, wait_for

LINK, OTHER = "serial:///dev/ttyUSB0", "serial:///dev/pts/7"
NOW = 1_800_000_000_000_000_000


def test_safety_state_is_restored(tmp_path: Path) -> None:
    directory = tmp_path / "not" / "yet" / "there"
    estop = Estop("e1", "mia", "smoke", NOW - 5, fleet_wide=True, rank=Rank.LEAD)
    kept = PersistedSafety(
        Hold("mia", NOW - 5, Rank.LEAD),
        (estop,),
        ("e0",),
        (FleetPause("p1", "mia", "listen", NOW - 5, Rank.LEAD),),
        ("p0",),
        Loan("bob", "mia", Rank.LEAD, NOW - 5, 60.0),
    )
    SafetyStateFile(directory, "fleet", "red", LINK).save(kept)
    assert SafetyStateFile(directory, "fleet", "red", LINK).load(NOW) == kept
    assert SafetyStateFile(directory, "fleet", "blue", LINK).load(NOW) == PersistedSafety()
    assert SafetyStateFile(directory, "other", "red", LINK).load(NOW) == PersistedSafety()
    SafetyStateFile(directory, "fleet", "red", LINK).save(PersistedSafety())
    assert SafetyStateFile(directory, "fleet", "red", LINK).load(NOW) == PersistedSafety()
    assert [path.name for path in directory.iterdir()] == ["fleet.red.json"]


def test_safety_state_of_other_link_is_kept_apart(tmp_path: Path) -> None:
    """A simulated red, held in one folder, kept a red on the table out of its plan, and the other way round."""
    own = Estop("e1", "mia", "smoke", NOW - 5, fleet_wide=False)
    everybody = Estop("e2", "mia", "fire", NOW - 5, fleet_wide=True)
    pause = FleetPause("p1", "mia", "listen", NOW - 5)
    loan = Loan("bob", "mia", Rank.LEAD, NOW - 5, 60.0)
    kept = PersistedSafety(Hold("mia", NOW - 5), (own, everybody), ("e0",), (pause,), ("p0",), loan)
    SafetyStateFile(tmp_path, "fleet", "red", LINK).save(kept)
    simulated = SafetyStateFile(tmp_path, "fleet", "red", OTHER)
    of_fleet = PersistedSafety(None, (everybody,), ("e0",), (pause,), ("p0",))
    assert simulated.load(NOW) == of_fleet
    words = f"the hold of mia and the e-stop of mia and the loan to bob belong to the car at {LINK}, not to the one at"
    assert simulated.other_link_words == f"{words} {OTHER}"
    simulated.save(PersistedSafety(Hold("bob", NOW)))
    back = SafetyStateFile(tmp_path, "fleet", "red", LINK)
    assert back.load(NOW) == PersistedSafety(Hold("mia", NOW - 5), (own,), loan=loan), "kept; the fleet's have ended"
    assert back.other_link_words.startswith("the hold of bob ")
    assert OTHER in back.other_link_words
    assert back.other_link_words.endswith(LINK)
    back.save(PersistedSafety())
    assert SafetyStateFile(tmp_path, "fleet", "red", OTHER).load(NOW) == PersistedSafety(Hold("bob", NOW))


def test_links_of_a_car_are_bounded(tmp_path: Path) -> None:
    for number in range(3 * MAX_OTHER_LINKS):
        store = SafetyStateFile(tmp_path, "fleet", "red", f"tcp://127.0.0.1:{number}")
        store.load(NOW)
        store.save(PersistedSafety(Hold("mia", NOW)))
    store = SafetyStateFile(tmp_path, "fleet", "red", LINK)
    assert store.load(NOW) == PersistedSafety()
    assert f" {MAX_OTHER_LINKS - 1} more " in store.other_link_words
    assert len(json.loads(store.path.read_text())["others"]) == MAX_OTHER_LINKS
    SafetyStateFile(tmp_path / "new", "fleet", "red", LINK).save(PersistedSafety())
    again = SafetyStateFile(tmp_path / "new", "fleet", "red", OTHER)
    assert (again.load(NOW), again.other_link_words) == (PersistedSafety(), "")


def test_irrelevant_link_options_do_not_tell_cars_apart() -> None:
    def links(*texts: str) -> set[str]:
        return {car_link(parse_link(text)) for text in texts}

    assert links("/dev/ttyUSB0", "serial:///dev/ttyUSB0?baud=115200") == {LINK}
    assert len(links("ble://AA:BB:CC:DD:EE:FF", "ble://aa:bb:cc:dd:ee:ff?adapter=hci1")) == 1
    assert len(links("ble://name=A?adapter=auto", "ble://name=A")) == 1
    assert len(links("tcp://a:1", "tcp://a:2", "serial://?vid=1a86", "serial://?vid=1a87")) == 4


def test_hold_from_future_begins_now(tmp_path: Path) -> None:
    store = SafetyStateFile(tmp_path, "fleet", "red", LINK)
    store.save(PersistedSafety(Hold("mia", NOW + 10**30)))
    assert store.load(NOW) == PersistedSafety(Hold("mia", NOW))


def test_safety_file_without_estops_is_read(tmp_path: Path) -> None:
    store = SafetyStateFile(tmp_path, "fleet", "red", LINK)
    store.path.write_text('{"hold": {"by": "mia", "since_ns": 7}}')
    assert store.load(NOW) == PersistedSafety(Hold("mia", 7))


def test_safety_file_without_ranks_is_read(tmp_path: Path) -> None:
    store = SafetyStateFile(tmp_path, "fleet", "red", LINK)
    estop = {"id": "e1", "by": "mia", "why": "", "at_ns": 7, "fleet_wide": True}
    store.path.write_text(json.dumps({"hold": {"by": "mia", "since_ns": 7}, "estops": [estop], "ended": ["e0"]}))
    person = Rank.PERSON
    assert store.load(NOW) == PersistedSafety(
        Hold("mia", 7, person), (Estop("e1", "mia", "", 7, fleet_wide=True, rank=person),), ("e0",)
    )


def test_expired_loan_is_forgotten(tmp_path: Path) -> None:
    store = SafetyStateFile(tmp_path, "fleet", "red", LINK)
    loan = Loan("bob", "mia", Rank.LEAD, NOW, 60.0)
    store.save(PersistedSafety(loan=loan))
    assert store.load(NOW + 59_000_000_000).loan == loan
    assert store.load(NOW + 60_000_000_000).loan is None
    earlier = store.load(NOW - 1).loan
    assert earlier is not None
    assert earlier.left_s(NOW - 1) == 60.0, "a clock that was set back prolongs no loan"


def test_failed_save_is_told_and_keeps_old_state(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(OSError, match="file"):
        SafetyStateFile(tmp_path / "file", "fleet", "red", LINK).save(PersistedSafety())
    assert SafetyStateFile(tmp_path / "file", "fleet", "red", LINK).load(NOW).hold is not None
    store = SafetyStateFile(tmp_path, "fleet", "red", LINK)
    store.save(PersistedSafety(Hold("mia", 1)))
    (tmp_path / f".fleet.red.json.{os.getpid()}-{threading.get_ident()}.new").mkdir()
    with pytest.raises(OSError, match="fleet"):
        store.save(PersistedSafety())
    assert store.load(NOW) == PersistedSafety(Hold("mia", 1))


@pytest.mark.parametrize(
    "text",
    [
        "",
        "{",
        "[]",
        "null",
        "3",
        "{}",
        '{"hold": 3}',
        '{"hold": {"by": "mia"}}',
        '{"hold": {"since_ns": 3}}',
        '{"hold": {"by": "mia", "since_ns": "soon"}}',
        '{"hold": {"by": "mia", "since_ns": Infinity}}',
        '{"hold": {"by": "mia", "since_ns": NaN}}',
        '{"hold": {"by": "\\ud800", "since_ns": 3}}',
        '{"hold": null, "estops": 3}',
        '{"hold": null, "estops": [3]}',
        '{"hold": null, "estops": [{"id": "e"}]}',
        '{"hold": null, "ended": 3}',
        '{"hold": {"by": "mia", "since_ns": 3, "rank": "king"}}',
        '{"hold": null, "pauses": [{"id": "p"}]}',
        '{"hold": null, "loan": {"to": "bob"}}',
        '{"hold": null, "others": 3}',
        '{"hold": null, "others": [{"link": "a"}]}',
        '{"hold": null, "link": "\\ud800"}',
        '{"hold": null, "loan": {"to": "b", "by": "a", "rank": "lead", "since_ns": 1, "duration_s": "long"}}',
        "[" * 100_000,
        '{"hold": {"by": "mia", "since_ns": ' + "9" * 5000 + "}}",
    ],
)
def test_unreadable_safety_file_holds_car(tmp_path: Path, text: str) -> None:
    store = SafetyStateFile(tmp_path, "fleet", "red", LINK)
    store.path.write_text(text)
    held = store.load(NOW).hold
    assert held is not None
    assert (held.since_ns, held.by[:10]) == (NOW, "unreadable")
    assert f"{store.path} is unreadable" in store.damage
    assert "\n" not in store.damage
    held.by.encode()


@given(st.one_of(st.binary(), st.text().map(str.encode), st.integers(0, 80).map(lambda cut: SAVED[:cut])))
def test_any_bytes_are_a_hold_or_none_never_an_error(tmp_path: Path, content: bytes) -> None:
    store = SafetyStateFile(tmp_path, "fleet", "red", LINK)
    store.path.write_bytes(content)
    held = store.load(NOW).hold
    if held is None:
        assert json.loads(content)["hold"] is None
    else:
        assert 0 <= held.since_ns <= NOW


@pytest.mark.skipif(sys.platform == "win32", reason="the car is on a pseudo terminal")
def test_gateway_tells_unclaimed_state_and_damaged_file_holds_car(tmp_path: Path) -> None:
    from tests.gateway.link.peers import PtyPeer

    peer, started = PtyPeer(tmp_path), FleetProcesses(free_endpoint(), tmp_path)
    directory = directory_of(started.endpoint, Path(started.environment["FLEET_STATE_DIR"]))
    try:
        SafetyStateFile(directory, "fleet", "red", OTHER).save(PersistedSafety(Hold("mia", 7)))
        gateway = started.gateway(str(peer.url))
        words = f"the hold of mia belongs to the car at {OTHER}, not to the one at {peer.url} [other_link]"
        wait_for(lambda: words in gateway.stderr, "it is said")
        wait_for(lambda: started.state("safety") is not None, "it is on the bus")
        assert not started.state("safety").HasField("hold")
        gateway.kill()
        gateway.wait()
        (directory / "fleet.red.json").write_text("{")
        gateway = started.gateway(str(peer.url))
        words = (
            f"the state file {directory / 'fleet.red.json'} is unreadable: the car is on hold until somebody resumes"
        )
        wait_for(lambda: words in gateway.stderr, "it is said")
        wait_for(lambda: (safety := started.state("safety")) and safety.HasField("hold"), "it is on hold")
    finally:
        started.close()
        peer.close()


SAVED: bytes = json.dumps({"hold": {"by": "mia", "since_ns": NOW}}).encode()
