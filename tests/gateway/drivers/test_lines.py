"""Lines come out of bytes in any pieces."""

from hypothesis import given
from hypothesis import strategies as st

from gateway.drivers.lines import LineSplitter


@given(st.lists(st.binary(max_size=40), max_size=12), st.integers(1, 20))
def test_line_splitter_ignores_pieces_and_bounds_lines(pieces: list[bytes], top: int) -> None:
    lines, whole = LineSplitter(top), LineSplitter(top)
    found = [line for piece in pieces for line in lines.feed(piece)]
    assert found == whole.feed(b"".join(pieces))
    assert lines.take_rest() == whole.take_rest()
    assert all(line and len(line) <= top and b"\n" not in line for line in found)


@given(st.lists(st.binary(max_size=20), max_size=8))
def test_objects_end_at_their_mark_in_any_pieces(pieces: list[bytes]) -> None:
    parts, whole = LineSplitter(end=b"}"), LineSplitter(end=b"}")
    assert [line for piece in pieces for line in parts.feed(piece)] == whole.feed(b"".join(pieces))
    assert LineSplitter(end=b"}").feed(b'{"a":1}{_ok}\r\n{"b"') == [b'{"a":1}', b"{_ok}"]


def test_unfinished_line_waits_and_is_taken_once() -> None:
    lines = LineSplitter()
    assert lines.feed(b'{"a":1}\r\n\r\n{"b"') == [b'{"a":1}']
    assert lines.take_rest() == b'{"b"'
    assert lines.feed(b":2}\n") == [b":2}"]
