"""Reading sessions back: whole, cut anywhere, damaged, and what is none."""

import io
from pathlib import Path

import pytest
from mcap.writer import Writer

from fleet.recording.session import NoSession, Session

CHUNKS, PER_CHUNK = 5, 20


@pytest.fixture(scope="module")
def whole() -> tuple[bytes, list[int]]:
    """A file of five chunks, and where each chunk begins."""
    out = io.BytesIO()
    writer = Writer(out)
    writer.start()
    channel = writer.register_channel("fleet/red/x", "json", 0)
    begins = []
    for chunk in range(CHUNKS):
        begins.append(out.tell())
        for number in range(PER_CHUNK):
            sequence = chunk * PER_CHUNK + number
            writer.add_message(channel, sequence, b'{"number": %d}' % sequence, sequence, sequence)
        writer.flush()
    begins.append(out.tell())
    writer.finish()
    return out.getvalue(), begins


def test_a_file_cut_anywhere_gives_every_whole_chunk_and_says_so(
    whole: tuple[bytes, list[int]], tmp_path: Path
) -> None:
    data, begins = whole
    path = tmp_path / "0001.mcap"
    for length in range(9, len(data)):
        path.write_bytes(data[:length])
        session = Session.open(tmp_path)
        numbers = [message.sequence for message in session.messages()]
        assert numbers == list(range(len(numbers)))
        # A chunk's index follows it, so a cut in the index still gives the chunk.
        chunks = sum(1 for end in begins[1:] if end <= length)
        assert len(numbers) // PER_CHUNK in (chunks, chunks + 1)
        assert len(numbers) % PER_CHUNK == 0
        assert "cut" in session.cut_words, length
    path.write_bytes(data)
    session = Session.open(path)
    assert len(list(session.messages())) == CHUNKS * PER_CHUNK
    assert not session.cut_words


def test_damage_in_the_middle_keeps_what_came_before_and_says_so(
    whole: tuple[bytes, list[int]], tmp_path: Path
) -> None:
    data, begins = whole
    # Not its first byte: a record of an unknown kind must be skipped, says the format.
    for at in range(begins[2] + 1, begins[3], 3):
        path = tmp_path / "x.mcap"
        path.write_bytes(data[:at] + bytes([data[at] ^ 0x55]) + data[at + 1 :])
        session = Session.open(path)
        numbers = [message.sequence for message in session.messages()]
        assert numbers[: 2 * PER_CHUNK] == list(range(2 * PER_CHUNK))
        assert len(numbers) == CHUNKS * PER_CHUNK or session.cut_words, at


@pytest.mark.parametrize(
    ("content", "words"),
    [(None, "there is no session at"), (b"", "is empty"), (b"not an mcap file", "is not an MCAP file")],
)
def test_what_is_no_session_says_why(content: bytes | None, words: str, tmp_path: Path) -> None:
    path = tmp_path / "0001.mcap"
    if content is not None:
        path.write_bytes(content)
    with pytest.raises(NoSession, match=words) as caught:
        Session.open(path)
    assert str(path) in str(caught.value)
    assert "\n" not in str(caught.value)


def test_an_empty_directory_and_a_newer_format_are_refused(whole: tuple[bytes, list[int]], tmp_path: Path) -> None:
    with pytest.raises(NoSession, match=r"no 0001\.mcap"):
        Session.open(tmp_path)
    (tmp_path / "0001.mcap").write_bytes(whole[0])
    (tmp_path / "session.json").write_text(
        '{"fleet": "fleet", "started": "", "host": "", "versions": {}, "format": 99}'
    )
    with pytest.raises(NoSession, match="format 99"):
        Session.open(tmp_path)
