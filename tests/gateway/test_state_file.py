"""The state file survives a restart. The gateway writes it whole, and an unreadable file counts as a hold."""

import json
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from gateway.control.people import SenderKind
from gateway.control.safety import Estop, FleetPause, Hold, Loan, PersistedSafety
from gateway.state_file import SafetyStateFile

NOW = 1_800_000_000_000_000_000


def test_a_hold_is_read_back_by_the_next_process(tmp_path: Path) -> None:
    directory = tmp_path / "not" / "yet" / "there"
    estop = Estop("e1", "mia", "smoke", NOW - 5, fleet_wide=True, rank=SenderKind.LEAD)
    kept = PersistedSafety(
        Hold("mia", NOW - 5, SenderKind.LEAD),
        (estop,),
        ("e0",),
        (FleetPause("p1", "mia", "listen", NOW - 5, SenderKind.LEAD),),
        ("p0",),
        Loan("bob", "mia", SenderKind.LEAD, NOW - 5, 60.0),
    )
    SafetyStateFile(directory, "fleet", "red").save(kept)
    assert SafetyStateFile(directory, "fleet", "red").load(NOW) == kept
    assert SafetyStateFile(directory, "fleet", "blue").load(NOW) == PersistedSafety()
    assert SafetyStateFile(directory, "other", "red").load(NOW) == PersistedSafety()
    SafetyStateFile(directory, "fleet", "red").save(PersistedSafety())
    assert SafetyStateFile(directory, "fleet", "red").load(NOW) == PersistedSafety()
    assert [path.name for path in directory.iterdir()] == ["fleet.red.json"]


def test_a_hold_from_the_future_began_now(tmp_path: Path) -> None:
    store = SafetyStateFile(tmp_path, "fleet", "red")
    store.save(PersistedSafety(Hold("mia", NOW + 10**30)))
    assert store.load(NOW) == PersistedSafety(Hold("mia", NOW))


def test_a_file_of_a_version_without_e_stops_is_read(tmp_path: Path) -> None:
    store = SafetyStateFile(tmp_path, "fleet", "red")
    store.path.write_text('{"hold": {"by": "mia", "since_ns": 7}}')
    assert store.load(NOW) == PersistedSafety(Hold("mia", 7))


def test_a_file_of_a_version_without_ranks_is_read(tmp_path: Path) -> None:
    store = SafetyStateFile(tmp_path, "fleet", "red")
    estop = {"id": "e1", "by": "mia", "why": "", "at_ns": 7, "fleet_wide": True}
    store.path.write_text(json.dumps({"hold": {"by": "mia", "since_ns": 7}, "estops": [estop], "ended": ["e0"]}))
    person = SenderKind.PERSON
    assert store.load(NOW) == PersistedSafety(
        Hold("mia", 7, person), (Estop("e1", "mia", "", 7, fleet_wide=True, rank=person),), ("e0",)
    )


def test_a_loan_that_is_over_is_forgotten(tmp_path: Path) -> None:
    store = SafetyStateFile(tmp_path, "fleet", "red")
    loan = Loan("bob", "mia", SenderKind.LEAD, NOW, 60.0)
    store.save(PersistedSafety(loan=loan))
    assert store.load(NOW + 59_000_000_000).loan == loan
    assert store.load(NOW + 60_000_000_000).loan is None
    earlier = store.load(NOW - 1).loan
    assert earlier is not None
    assert earlier.left_s(NOW - 1) == 60.0, "a clock that was set back prolongs no loan"


def test_what_cannot_be_saved_is_said_and_leaves_the_old_state(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(OSError, match="file"):
        SafetyStateFile(tmp_path / "file", "fleet", "red").save(PersistedSafety())
    assert SafetyStateFile(tmp_path / "file", "fleet", "red").load(NOW).hold is not None
    store = SafetyStateFile(tmp_path, "fleet", "red")
    store.save(PersistedSafety(Hold("mia", 1)))
    (tmp_path / ".fleet.red.json.new").mkdir()
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
        '{"hold": null, "loan": {"to": "b", "by": "a", "rank": "lead", "since_ns": 1, "duration_s": "long"}}',
        "[" * 100_000,
        '{"hold": {"by": "mia", "since_ns": ' + "9" * 5000 + "}}",
    ],
)
def test_a_broken_file_holds_the_car(tmp_path: Path, text: str) -> None:
    store = SafetyStateFile(tmp_path, "fleet", "red")
    store.path.write_text(text)
    held = store.load(NOW).hold
    assert held is not None
    assert (held.since_ns, held.by[:10]) == (NOW, "unreadable")
    held.by.encode()


@given(st.one_of(st.binary(), st.text().map(str.encode), st.integers(0, 80).map(lambda cut: SAVED[:cut])))
def test_any_bytes_are_a_hold_or_none_never_an_error(tmp_path: Path, content: bytes) -> None:
    store = SafetyStateFile(tmp_path, "fleet", "red")
    store.path.write_bytes(content)
    held = store.load(NOW).hold
    if held is None:
        assert json.loads(content)["hold"] is None
    else:
        assert 0 <= held.since_ns <= NOW


SAVED: bytes = json.dumps({"hold": {"by": "mia", "since_ns": NOW}}).encode()
