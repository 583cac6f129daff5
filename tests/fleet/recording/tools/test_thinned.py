"""A session of which the quota has taken files: listed, verified, recovered and cut, with real quotas and no bus."""

import json
import os
from pathlib import Path
from typing import Any

import pytest
import zenoh

from fleet.quota import QUOTA_SEGMENT_S, Quota
from fleet.recording.pins import minute_of
from fleet.recording.reading.session import Session
from fleet.recording.session_dir import REMOVED_FILE, SESSION_FILE
from fleet.recording.time_spec import iso
from fleet.recording.writing.quota_removal import enforce
from fleet.recording.writing.session_writer import Options, SessionWriter
from schemas.words import PinCause
from tests.support import in_process

BEGUN_NS = 1_790_000_000_000_000_000
SECOND_NS = 1_000_000_000
MINUTES = 6
MINUTE_NS = 60 * SECOND_NS
PINNED = 2
"""The minute in whose middle there is an e-stop."""
LIST_BYTES = 1000
"""More than what session.json grows by the list of two files."""
JSON = zenoh.Encoding("application/json")


def record(root: Path, begun_ns: int) -> Path:
    """Write a session of six files: a message a second, and a pin that lies in the third file alone."""
    tape = SessionWriter(root, "fleet", Options(segment_s=QUOTA_SEGMENT_S), begun_ns)
    for second in range(MINUTES * 60):
        now = begun_ns + second * SECOND_NS
        tape.tick(now)
        tape.add("fleet/red/note", b"%04d" % second + os.urandom(100), JSON, None, None, now)
    tape.pin(minute_of(begun_ns + PINNED * MINUTE_NS + MINUTE_NS // 2, PinCause.ESTOP, "estop by mia", ["red"]))
    tape.close(begun_ns + MINUTES * MINUTE_NS)
    return tape.path


def size(root: Path) -> int:
    return sum(each.stat().st_size for each in root.rglob("*") if each.is_file())


@pytest.fixture
def thinned(tmp_path: Path) -> Path:
    """Record two sessions, and let a quota take the first two files of the older one."""
    root = tmp_path / "all"
    path, newest = record(root, BEGUN_NS), record(root, BEGUN_NS + 3600 * SECOND_NS)
    over = sum((path / f"{number:04d}.mcap").stat().st_size for number in (1, 2))
    done = enforce(Quota(size(root) - over + LIST_BYTES), root, newest)
    assert (done.removed, done.warning) == ([], "")
    assert not (path / "0001.mcap").exists()
    assert not (path / "0002.mcap").exists()
    return path


def sessions(*arguments: object) -> tuple[int, list[dict[str, Any]]]:
    """Return the exit code of `fleet sessions`, and its lines of JSON."""
    done = in_process.fleet("sessions", *arguments, "--json")
    return done.returncode, [json.loads(line) for line in done.stdout.splitlines()]


def description(path: Path) -> dict[str, Any]:
    found: dict[str, Any] = json.loads((path / SESSION_FILE).read_text())
    return found


def test_quota_removal_is_no_damage_and_names_files(thinned: Path) -> None:
    code, listed = sessions(thinned.parent)
    assert code == 0
    assert {one["name"]: (one["state"], one["lost"]) for one in listed} == {
        thinned.name: ("thinned", 0),
        max(each.name for each in thinned.parent.iterdir() if each.is_dir()): ("whole", 0),
    }
    code, (info,) = sessions("info", thinned)
    assert (code, info["state"], info["messages"]) == (0, "thinned", (MINUTES - 2) * 60)
    assert [each["file"] for each in info["gone"]] == ["0001.mcap", "0002.mcap"]
    assert {each["pinned"] for each in info["gone"]} == {False}
    assert sum(each["messages"] for each in info["gone"]) == 120
    assert info["gone"][0]["from"] == iso(BEGUN_NS)
    assert [(each["cause"], each["cars"]) for each in info["pins"]] == [("estop", ["red"])]
    code, (verdict,) = sessions("verify", thinned)
    assert (code, verdict["damage"], verdict["lost"], verdict["gone"]) == (1, {}, "", info["gone"])
    words = (
        in_process.fleet("sessions", "info", thinned).stdout + in_process.fleet("sessions", "verify", thinned).stdout
    )
    assert words.count("0001.mcap") == words.count("0002.mcap") == 2


def test_file_that_the_quota_did_not_take_is_damage(thinned: Path) -> None:
    (thinned / "0005.mcap").unlink()
    _, (info,) = sessions("info", thinned)
    assert info["state"] == "damaged"
    _, (verdict,) = sessions("verify", thinned)
    assert list(verdict["damage"]) == [thinned.name, SESSION_FILE]
    _, made = recovered(thinned)
    assert made["origin"]["missing"] == 3 * 60, "no message is counted twice"


def test_list_of_removed_sessions_is_none_itself(thinned: Path) -> None:
    root = thinned.parent
    (newest,) = (each for each in root.iterdir() if each != thinned)
    done = enforce(Quota(LIST_BYTES), root, newest)  # half of it is less than the pinned minute
    assert done.removed == [thinned]
    (removed,) = json.loads((root / REMOVED_FILE).read_text())["sessions"]
    assert (removed["session"], removed["fleet"], removed["messages"]) == (thinned.name, "fleet", MINUTES * 60)
    assert (removed["from"], removed["pins"]) == (iso(BEGUN_NS), 1)
    assert [one["name"] for one in sessions(root)[1]] == [newest.name]
    (line,) = in_process.fleet("sessions", root).stderr.splitlines()
    assert str(root / REMOVED_FILE) in line
    for text in ("", "[]", '{"sessions": [3]}', '{"sessions": 3}'):
        (root / REMOVED_FILE).write_text(text)
        assert [one["name"] for one in sessions(root)[1]] == [newest.name]


def recovered(path: Path) -> tuple[Path, dict[str, Any]]:
    done = in_process.fleet("sessions", "recover", path)
    assert done.returncode == 0, done.stderr
    out = path.with_name(f"{path.name}-recovered")
    return out, description(out)


def test_recovered_session_says_what_the_quota_had_taken(thinned: Path) -> None:
    out, made = recovered(thinned)
    assert list(Session(out).messages()) == list(Session(thinned).messages())
    assert (made["gone"], made["origin"]["missing"]) == ([], 120)
    assert made["pins"] == description(thinned)["pins"]
    _, (info,) = sessions("info", out)
    assert (info["state"], info["lost"]) == ("recovered", 120)


def cut(path: Path, start_s: int, end_s: int) -> tuple[Path, dict[str, Any]]:
    """Cut from one second of the recording to another."""
    out = path.parent / f"part{start_s}"
    at = [iso(BEGUN_NS + second * SECOND_NS) for second in (start_s, end_s)]
    done = in_process.fleet("sessions", "cut", path, "--from", at[0], "--to", at[1], "--out", out)
    assert done.returncode == 0, done.stderr
    return out, description(out)


def test_cut_says_what_the_quota_had_taken_of_it(thinned: Path) -> None:
    out, made = cut(thinned, 125, 185)
    assert [int(each.payload[:4]) for each in Session(out).messages()] == [*range(125, 185)]
    assert (made["gone"], made["origin"]["lost"], len(made["pins"])) == ([], "", 1)
    _, (info,) = sessions("info", out)
    assert info["state"] == "whole"
    out, made = cut(thinned, 90, 125)
    assert [int(each.payload[:4]) for each in Session(out).messages()] == [*range(120, 125)]
    assert made["origin"]["lost"]
    assert len(made["pins"]) == 1, "it begins with the third minute"
    _, (info,) = sessions("info", out)
    assert info["state"] == "recovered"
    _, made = cut(thinned, 240, 300)
    assert made["pins"] == []


def test_cut_keeps_marks_inside_and_kept_only_with_mark(tmp_path: Path) -> None:
    path = record(tmp_path, BEGUN_NS)
    about = description(path)
    about["marks"] = [
        {"time": time, "text": str(number), "by": "mia"}
        for number, time in enumerate(
            [iso(BEGUN_NS + 10 * SECOND_NS), iso(BEGUN_NS + 70 * SECOND_NS), "2026-09-21T14:14:40Z", "once"]
        )
    ]
    assert iso(BEGUN_NS + 80 * SECOND_NS) == "2026-09-21T14:14:40.000Z", "the third mark, as people write it"
    (path / SESSION_FILE).write_text(json.dumps({**about, "kept": True}))
    for start_s, end_s, marks in ((10, 70, "03"), (60, 80, "13"), (75, 81, "23"), (0, 360, "0123"), (90, 100, "3")):
        out, made = cut(path, start_s, end_s)
        assert "".join(mark["text"] for mark in made["marks"]) == marks
        assert made["kept"]
        assert out.is_dir()
    (path / SESSION_FILE).write_text(json.dumps({**about, "marks": about["marks"][:3], "kept": True}))
    _, made = cut(path, 91, 100)
    assert (made["marks"], made["kept"]) == ([], False)
