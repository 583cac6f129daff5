"""Records for three hours of a virtual clock with a quota that holds a tenth, and looks for the pinned minutes."""

import json
import os
import random
from pathlib import Path

import pytest
import zenoh

from fleet.quota import QUOTA_SEGMENT_S, Quota
from fleet.recording.pins import PIN_AFTER_NS, PIN_BEFORE_NS, minute_of
from fleet.recording.reading.session import Session
from fleet.recording.session_dir import SessionInfo, gone_of
from fleet.recording.writing.session_writer import Options, SessionWriter
from schemas.words import PinCause

BEGUN_NS = 1_790_000_000_000_000_000
SECOND_NS = 1_000_000_000
HOURS = 3
BYTES_A_SECOND = 10_000
QUOTA = HOURS * 3600 * BYTES_A_SECOND // 10
PINS = 3
"""Each pins at most three files of a minute: 9 of 180, half of a tenth, which is the share of pins."""
JSON = zenoh.Encoding("application/octet-stream")


@pytest.mark.soak
@pytest.mark.parametrize("seed", range(3))
def test_quota_that_holds_a_tenth_loses_no_pinned_minute(seed: int, tmp_path: Path) -> None:
    rng = random.Random(seed)
    options = Options(segment_s=QUOTA_SEGMENT_S, quota=Quota(QUOTA))
    pinned = sorted(rng.sample(range(60, HOURS * 3600 - 60, 40), PINS))
    tape = SessionWriter(tmp_path, "fleet", options, BEGUN_NS)
    killed = 0
    for second in range(HOURS * 3600):
        now = BEGUN_NS + second * SECOND_NS
        tape.add("fleet/red/note", second.to_bytes(4, "big") + os.urandom(BYTES_A_SECOND - 4), JSON, None, None, now)
        if second in pinned:
            tape.pin(minute_of(now, PinCause.ESTOP, "estop by mia", ["red"]))
        tape.tick(now)
        if tape.over or rng.random() < 0.0005:
            before, tape = tape, SessionWriter(tmp_path, "fleet", options, now)
            if rng.random() < 0.3 and second not in pinned:
                killed += 1
                before.abandon("killed", now)
                for file in before.path.iterdir():  # the quota leaves one alone that is written to
                    os.utime(file, ns=(now, now))
            else:
                before.close(now)
    tape.close(BEGUN_NS + HOURS * 3600 * SECOND_NS)
    here: set[int] = set()
    size = 0
    for path in sorted(tmp_path.iterdir()):
        if not path.is_dir():
            continue
        session = Session(path)
        here |= {int.from_bytes(each.payload[:4], "big") for each in session.messages()}
        assert session.path not in session.damage, "a file lacks that is not listed as gone"
        size += sum(each.stat().st_size for each in path.iterdir())
    wanted = {
        each
        for second in pinned
        for each in range(second - PIN_BEFORE_NS // SECOND_NS, second + PIN_AFTER_NS // SECOND_NS + 1)
    }
    assert wanted - here == set()
    assert size <= QUOTA * 1.05
    assert len(here) < HOURS * 3600 / 8, "the quota took nothing: the test tries nothing"
    listed = sum(len(gone_of(info)) for each in tmp_path.iterdir() if (info := SessionInfo.read(each)) is not None)
    removed = json.loads((tmp_path / "removed.json").read_text())["sessions"]
    assert listed
    assert removed
    kept = f"{len(here)} of {HOURS * 3600} s are here, all {len(wanted)} pinned ones"
    print(f"\n{kept}; {listed} files and {len(removed)} sessions gone; {killed} killed")
