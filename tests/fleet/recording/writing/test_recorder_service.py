"""The recorder of another site beside that of the fleet: both record, one answers, and a mark is in both."""

import contextlib
import json
from collections.abc import Iterator
from pathlib import Path

import pytest
import zenoh

from fleet.client.services import ask_recorder, site_recordings
from fleet.recording.reading.session import Session
from fleet.recording.writing.recorder import Recorder
from fleet.recording.writing.recorder_service import AnotherRecorder, speaks_for_fleet
from schemas import messages
from schemas.bus import Bus, Sample, messages_of
from schemas.gen import fleet_v1_pb2 as pb
from schemas.words import RecorderState, RecorderVerb
from tests.support import in_process
from tests.support.processes import wait_for


@pytest.mark.parametrize(
    ("site", "others", "speaks"),
    [
        ("", {"north"}, True),
        ("north", {""}, False),
        ("north", {"", "south"}, False),
        ("north", {"south"}, True),
        ("south", {"north"}, False),
        ("south", set(), True),
    ],
)
def test_one_recorder_speaks_for_fleet(site: str, others: set[str], speaks: bool) -> None:
    assert speaks_for_fleet(site, others) is speaks


@contextlib.contextmanager
def recording(endpoint: str, place: Path, site: str = "") -> Iterator[Path]:
    with Bus.open(endpoint) as own:
        recorder = Recorder(own, "fleet", place, site=site)
        session = recorder.start()
        try:
            yield session
        finally:
            recorder.close()


def session_that_answers(bus: Bus) -> str:
    found = ask_recorder(bus, "fleet", RecorderVerb.STATUS)
    return "" if found is None else str(found.session)


def marks(session: Path) -> list[str]:
    """Return the texts of the marks among the messages, and require the same in the description."""
    opened = Session(session)
    found = [
        messages.parse(each.message, each.payload, "application/protobuf").message  # type: ignore[attr-defined]
        for each in opened.messages()
        if each.key.endswith("/mark")
    ]
    assert opened.description is not None
    assert [each["text"] for each in opened.description.marks] == found
    assert opened.description.kept
    return found


def test_site_recorder_records_too_and_answers_alone(endpoint: str, bus: Bus, tmp_path: Path) -> None:
    with recording(endpoint, tmp_path / "north", "north") as north:
        wait_for(lambda: session_that_answers(bus) == str(north), "the one that is there answers")
        with recording(endpoint, tmp_path / "first") as first:
            wait_for(lambda: session_that_answers(bus) == str(first), "the recorder of the fleet answers")
            ask_recorder(bus, "fleet", RecorderVerb.MARK, text="both", by="mia")
            (answer,) = bus.query("fleet/@recorder/*/status", timeout_s=10.0)
            (own,) = messages_of([answer])
            assert (own.session, own.state) == (str(north), RecorderState.RECORDING)
            assert isinstance(answer, Sample)
            assert answer.key == "fleet/@recorder/north/status"
            with pytest.raises(AnotherRecorder, match=str(north)):
                Recorder(bus, "fleet", tmp_path / "again", site="north").start()
        wait_for(lambda: session_that_answers(bus) == str(north), "that of the site answers again")
        ask_recorder(bus, "fleet", RecorderVerb.MARK, text="alone", by="mia")
    assert marks(first) == ["both"]
    assert marks(north) == ["both", "alone"]
    for session in (first, north):
        opened = Session(session)
        opened.check()
        assert not opened.damage


def test_status_skips_foreign_answers(endpoint: str, bus: Bus, tmp_path: Path) -> None:
    odd = [
        (b"\xff", messages.encoding_of("fleet.v1.Recording")),
        (b"", messages.encoding_of("fleet.v1.Range")),
        (b"x", ""),
    ]
    with Bus.open(endpoint) as stranger, recording(endpoint, tmp_path) as session:
        for number, (payload, encoding) in enumerate(odd):

            def answer(query: zenoh.Query, payload: bytes = payload, encoding: str = encoding) -> None:
                with query:
                    query.reply(query.key_expr, payload, encoding=encoding)

            stranger._session.declare_queryable(f"fleet/@recorder/south{number}/status", answer)
        wait_for(
            lambda: len(list(bus.query("fleet/@recorder/*/status", timeout_s=10.0))) == len(odd), "strangers answer"
        )
        assert list(site_recordings(bus, "fleet")) == []
        done = in_process.fleet("record", "status", "--json", "--connect", endpoint)
    assert (done.returncode, done.stderr) == (0, "")
    (line,) = done.stdout.splitlines()
    assert json.loads(line)["session"] == str(session)


def test_status_of_stranger_sends_no_escapes_and_needs_name_of_site(endpoint: str, bus: Bus, tmp_path: Path) -> None:
    odd = pb.Recording(state="recording\x1b[2J", session="/tmp/\x1b]0;x\x07", error="\x1b[1m", drops={"\x1b[1m": 1})
    answering = ("fleet/@recorder/north/status", "fleet/@recorder/No Site/status")
    with Bus.open(endpoint) as stranger, recording(endpoint, tmp_path):
        for key in answering:

            def answer(query: zenoh.Query, key: str = key) -> None:
                with query:
                    query.reply(key, odd.SerializeToString(), encoding=messages.encoding_of("fleet.v1.Recording"))

            stranger._session.declare_queryable(key, answer)
        wait_for(
            lambda: len(list(bus.query("fleet/@recorder/*/status", timeout_s=10.0))) == len(answering), "both answer"
        )
        assert [site for site, _ in site_recordings(bus, "fleet")] == ["north"]
        done = in_process.fleet("record", "status", "--connect", endpoint)
    assert done.returncode == 0
    assert "north: recording" in done.stdout
    assert "\x1b" not in done.stdout


def test_bad_site_name_is_refused(bus: Bus, tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="site 'a/b'"):
        Recorder(bus, "fleet", tmp_path, site="a/b")
