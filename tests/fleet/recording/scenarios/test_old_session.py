"""A session of an earlier version opens, verifies, replays and decodes as with that version.

`tests/vectors/session-0.1` was recorded and cut on 2026-11-22 by commit 9c9c14b, before all modules were renamed. The
expected texts are the output of that commit.
"""

import hashlib
import json
import shlex
from pathlib import Path

import pytest
import rerun.chunk as rrc

from fleet.recording import session_dir
from fleet.recording.reading.mcap_copy import McapCopy
from fleet.recording.reading.message_decoder import MessageDecoder
from fleet.recording.reading.session import Session
from tests.support.in_process import fleet

SESSION = Path(__file__).parents[3] / "vectors" / "session-0.1"
MESSAGES = 1023


def test_old_session_is_whole() -> None:
    done = fleet("sessions", "verify", SESSION)
    assert (done.returncode, done.stderr) == (0, "")
    assert f"whole, {MESSAGES} messages" in done.stdout
    session = Session(SESSION)
    assert sum(1 for _ in session.messages()) == MESSAGES
    assert len(list(session.messages(keys=["fleet/green/frame/rx"]))) == 201


@pytest.mark.parametrize(
    ("command", "words"),
    [
        ("sessions redecode", "212 frames and 287 readings of green, red: no difference"),
        ("plan try", "6 decisions from 5.2 s to 7.1 s: no difference"),
    ],
)
def test_todays_decoder_and_policy_do_with_it_as_they_did(command: str, words: str) -> None:
    done = fleet(*command.split(), SESSION)
    assert done.returncode == 0, done.stderr
    assert words in done.stdout


def test_its_cars_are_explained() -> None:
    """Its messages lack fields that the explanations read."""
    done = fleet("why", "red", "--at", "6s", "--session", SESSION)
    assert done.returncode == 0, done.stderr
    assert "stop by root complete (shown)" in done.stdout


def test_its_failed_stop_is_explained(tmp_path: Path) -> None:
    """The stop of `green` is made a failed one. Its gateway's clock is 2 h behind the recorder's."""
    decoder, count = MessageDecoder(), 0
    with McapCopy(session_dir.segment(tmp_path, 1)) as copy:
        for info, sequence, log_ns, publish_ns, payload in Session(SESSION).rows():
            data, event = payload, decoder.message(info, payload)
            if info.channel.topic == "fleet/green/event/command" and event.verb == "stop" and event.phase == "complete":
                event.phase, event.reason, event.basis = "failed", "not_shown", ""
                data = event.SerializeToString()
            copy.add((info, sequence, log_ns + 7_200_000_000_000, publish_ns, data))
            count += 1
    session_dir.SessionInfo("fleet", "2026-11-22T15:18:29Z", "", {}, closed=True, messages=count).write(tmp_path)
    (found,) = json.loads(fleet("doctor", tmp_path, "--json").stdout)["findings"]
    assert found["code"] == "not_shown"
    done = fleet(*shlex.split(found["todo"])[1:])
    assert done.returncode == 0, done.stderr
    assert done.stdout.startswith("green at "), "it is at the time that `fleet doctor` names"


def test_old_session_exports_same_tables(tmp_path: Path) -> None:
    done = fleet("sessions", "export", SESSION, "--csv", tmp_path / "tables")
    assert done.returncode == 0, done.stderr
    tables = sorted((tmp_path / "tables").iterdir())
    assert len(tables) == 22
    digest = hashlib.sha256()
    for table in tables:
        digest.update(table.name.encode() + table.read_bytes())
    assert digest.hexdigest()[:16] == "08a09590d6e1db97"


def test_rerun_shows_it(tmp_path: Path) -> None:
    out = tmp_path / "old.rrd"
    done = fleet("replay", SESSION, "--save", out)
    assert done.returncode == 0, done.stderr
    entities = {str(chunk.entity_path) for chunk in rrc.RrdReader(out).store().stream()}
    assert any("green" in each for each in entities)
    assert any("red" in each for each in entities)
