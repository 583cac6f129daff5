"""A capture returns the bytes that it saved. A truncated or corrupted file yields whole pieces or names the line."""

import json
import os
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from gateway.capture import FORMAT, MAX_LINE_BYTES, BadCapture, CapturedBytes, CaptureWriter, read

MICROSECONDS = st.integers(0, 10**13)
PIECES = st.lists(st.tuples(MICROSECONDS, st.binary(max_size=300)), max_size=12).map(
    lambda found: [CapturedBytes(at / 1e6, data) for at, data in sorted(found)]
)


def _kept(path: Path, pieces: list[CapturedBytes]) -> bytes:
    path.unlink(missing_ok=True)
    writer = CaptureWriter(path, "serial:///dev/ttyUSB0", "2026-01-01T00:00:00.000+00:00")
    for piece in pieces:
        writer.add(piece)
    writer.close()
    return path.read_bytes()


@given(PIECES)
def test_any_bytes_are_given_back(tmp_path: Path, pieces: list[CapturedBytes]) -> None:
    path = tmp_path / "kept"
    _kept(path, pieces)
    assert list(read(path)) == pieces


@given(PIECES, st.data())
def test_truncated_capture_gives_whole_pieces(tmp_path: Path, pieces: list[CapturedBytes], data: st.DataObject) -> None:
    path = tmp_path / "kept"
    whole = _kept(path, pieces)
    cut = whole[: data.draw(st.integers(0, len(whole)))]
    path.write_bytes(cut)
    lines = cut.count(b"\n")
    if lines:
        assert list(read(path)) == pieces[: lines - 1]
    elif cut + b"\n" == whole[: len(cut) + 1]:
        assert list(read(path)) == []
    else:
        with pytest.raises(BadCapture, match="kept"):
            list(read(path))


@given(PIECES, st.integers(0, 10**6), st.binary(min_size=1, max_size=20))
def test_damaged_capture_is_refused_or_gives_pieces(
    tmp_path: Path, pieces: list[CapturedBytes], place: int, damage: bytes
) -> None:
    path = tmp_path / "kept"
    whole = _kept(path, pieces)
    place %= len(whole)
    path.write_bytes(whole[:place] + damage + whole[place + len(damage) :])
    try:
        found, refusal = list(read(path)), f"{path}:"
    except BadCapture as error:
        found, refusal = [], str(error)
    assert all(isinstance(piece.data, bytes) and piece.at >= 0 for piece in found)
    assert refusal.startswith(f"{path}:")
    assert "\n" not in refusal


@given(st.binary(max_size=200))
def test_any_other_file_is_refused(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "other"
    path.write_bytes(content)
    with pytest.raises(BadCapture, match="other"):
        list(read(path))


HEAD = json.dumps({"format": FORMAT}) + "\n"


@pytest.mark.parametrize(
    "line",
    [
        "",
        "[]",
        "3",
        "[" * 100_000,
        '{"t": 1}',
        '{"rx": "a"}',
        '{"t": "1", "rx": "a"}',
        '{"t": true, "rx": "a"}',
        '{"t": -1, "rx": "a"}',
        '{"t": NaN, "rx": "a"}',
        '{"t": Infinity, "rx": "a"}',
        '{"t": 1e999, "rx": "a"}',
        '{"t": ' + "9" * 400 + ', "rx": "a"}',
        '{"t": ' + "9" * 9000 + ', "rx": "a"}',
        '{"t": 1, "rx": 3}',
        '{"t": 1, "rx": "\\u0100"}',
        '{"t": 1, "rx": "\\ud800"}',
    ],
)
def test_bad_capture_line_is_named(tmp_path: Path, line: str) -> None:
    path = tmp_path / "kept"
    path.write_text(HEAD + '{"t": 0, "rx": "a"}\n' + line + "\n")
    pieces = read(path)
    assert next(pieces) == CapturedBytes(0.0, b"a")
    with pytest.raises(BadCapture, match="kept:3: "):
        next(pieces)


def test_time_does_not_go_back(tmp_path: Path) -> None:
    path = tmp_path / "kept"
    path.write_text(HEAD + '{"t": 2, "rx": "a"}\n{"t": 1, "rx": "b"}\n')
    with pytest.raises(BadCapture, match="kept:3: t is 1, less than the 2 before it"):
        list(read(path))


@pytest.mark.parametrize(
    ("path", "kind"), [(Path("/dev/zero"), "device"), (Path("/dev/null"), "device"), (Path("/"), "directory")]
)
def test_capture_refuses_non_regular_file(path: Path, kind: str) -> None:
    with pytest.raises(BadCapture, match=f"this is a {kind}"):
        list(read(path))


def test_overlong_capture_line_is_not_read_whole(tmp_path: Path) -> None:
    path = tmp_path / "kept"
    with path.open("w") as file:
        file.write(HEAD)
        file.write('{"t": 0, "rx": "')
        file.seek(MAX_LINE_BYTES * 2)
        file.write('"}')
    with pytest.raises(BadCapture, match="kept:2: not a JSON object"):
        list(read(path))


def test_capture_is_not_overwritten_and_appears_at_once(tmp_path: Path) -> None:
    path = tmp_path / "kept"
    writer = CaptureWriter(path, "link", "now")
    writer.add(CapturedBytes(0.5, b"\x00\xff$#"))
    assert list(read(path)) == [CapturedBytes(0.5, b"\x00\xff$#")]
    with pytest.raises(FileExistsError):
        CaptureWriter(path, "link", "now")
    writer.close()


def test_capture_is_read_from_pipe(tmp_path: Path) -> None:
    content = _kept(tmp_path / "kept", [CapturedBytes(0.5, b"abc")])
    end, other = os.pipe()
    os.write(other, content)
    os.close(other)
    try:
        assert list(read(Path(f"/dev/fd/{end}"))) == [CapturedBytes(0.5, b"abc")]
    finally:
        os.close(end)
