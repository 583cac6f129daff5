"""Reads of a part of a session by key and time, with and without an index. Only needed chunks are uncompressed."""

from pathlib import Path

import pytest
from mcap.writer import Writer

from fleet.recording.reading.session import Session
from fleet.recording.selection import matches

CHUNKS, PER_CHUNK = 20, 50
KEYS = ("fleet/red/sensor/range", "fleet/red/state/link", "fleet/blue/sensor/range", "fleet/@recorder/status")


def write(path: Path, first: int = 0) -> None:
    """Write chunks of 50 ns with all keys. Chunk 7 also has a key of its own."""
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start()
        channels = [writer.register_channel(key, "json", 0) for key in KEYS]
        for number in range(CHUNKS * PER_CHUNK):
            writer.add_message(channels[number % len(channels)], first + number, b"%d" % number, number, number)
            if number == 7 * PER_CHUNK:
                rare = writer.register_channel("fleet/green/event/log", "json", 0)
                writer.add_message(rare, first + number, b"rare", number, 1)
            if number % PER_CHUNK == PER_CHUNK - 1:
                writer.flush()  # type: ignore[no-untyped-call]
        writer.finish()  # type: ignore[no-untyped-call]  # it has no return type


@pytest.fixture(params=["whole", "cut", "no index", "several"])
def session(request: pytest.FixtureRequest, tmp_path: Path) -> Session:
    path = tmp_path / "0001.mcap"
    write(path)
    if request.param == "cut":
        path.write_bytes(path.read_bytes()[:-8])
    if request.param == "no index":
        data = path.read_bytes()
        path.write_bytes(data[:-40] + b"\xff" * 8 + data[-32:])
    if request.param == "several":
        write(tmp_path / "0002.mcap", first=CHUNKS * PER_CHUNK)
    return Session(tmp_path)


@pytest.mark.parametrize(
    ("keys", "start_ns", "end_ns"),
    [
        (None, None, None),
        (None, 120, 130),
        (None, None, 51),
        (None, 999, None),
        (None, 5000, None),
        (None, 130, 120),
        ("fleet/red/**", 100, 400),
        (["fleet/*/sensor/range"], None, None),
        (["fleet/@recorder/status", "fleet/blue/**"], 10, 900),
        (["fleet/green/event/log"], None, None),
        (["fleet/nobody/**"], None, None),
        ([], None, None),
    ],
)
def test_part_is_what_a_filter_of_the_whole_gives(
    session: Session, keys: list[str] | None, start_ns: int | None, end_ns: int | None
) -> None:
    expressions = [keys] if isinstance(keys, str) else keys
    expected = [
        one
        for one in session.messages()
        if (start_ns is None or one.recorded_ns >= start_ns)
        and (end_ns is None or one.recorded_ns < end_ns)
        and (expressions is None or any(matches(expression, one.key) for expression in expressions))
    ]
    assert list(session.messages(keys=keys, start_ns=start_ns, end_ns=end_ns)) == expected


def test_selection_reads_only_needed_chunks(tmp_path: Path) -> None:
    """All other chunks are damaged, so a reader that reads one reports it."""
    path = tmp_path / "0001.mcap"
    write(path)
    index = next(iter(Session(tmp_path).indexes().values()))
    assert index is not None
    data = bytearray(path.read_bytes())
    for number, place in enumerate(index.chunks):
        if number != 7:
            data[place.at + place.length - 3] ^= 1
    path.write_bytes(data)
    session = Session(tmp_path)
    assert len(list(session.messages(start_ns=7 * PER_CHUNK, end_ns=8 * PER_CHUNK))) == PER_CHUNK + 1
    assert [one.payload for one in session.messages(keys=["fleet/green/event/log"])] == [b"rare"]
    assert not session.damage
    assert len(list(session.messages())) == PER_CHUNK + 1
    assert "0001.mcap is damaged" in session.damage_words


@pytest.mark.parametrize(
    ("expression", "key", "does"),
    [
        ("fleet/red/sensor/range", "fleet/red/sensor/range", True),
        ("fleet/red/**", "fleet/red/sensor/range", True),
        ("fleet/red/**", "fleet/red", True),
        ("fleet/red/**", "fleet/reddish/x", False),
        ("fleet/*/sensor/*", "fleet/red/sensor/range", True),
        ("fleet/*", "fleet/red/sensor", False),
        ("fleet/**", "fleet/@recorder/status", False),
        ("fleet/@recorder/**", "fleet/@recorder/status", True),
        ("fleet/*/@cmd/drive", "fleet/red/@cmd/drive", True),
        ("**/range", "fleet/red/sensor/range", True),
        ("fleet/r$*/x", "fleet/red/x", True),
        ("fleet/r$*/x", "fleet/blue/x", False),
        ("fleet/$*d/x", "fleet/red/x", True),
        ("fleet/$*/x", "fleet/@red/x", False),
        ("fleet/@$*/x", "fleet/@red/x", True),
        ("/camera/image", "/camera/image", True),
        ("fleet/a.c/*", "fleet/abc/x", False),
    ],
)
def test_key_expression_matches_as_on_the_bus(expression: str, key: str, does: bool) -> None:
    assert matches(expression, key) is does
