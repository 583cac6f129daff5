"""Files of our recorder, truncated and damaged in every place. The reader returns whole messages, and names damage."""

import io
import os
import random
import struct
import time
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import lz4.frame  # type: ignore[import-untyped]  # it has no types
import pytest
import zstandard
from hypothesis import given, settings
from hypothesis import strategies as st
from mcap.opcode import Opcode
from mcap.writer import CompressionType, Writer

from fleet.recording.reading.mcap_index import MAX_RECORD_BYTES
from fleet.recording.reading.mcap_reader import McapReader, NotMcap
from fleet.recording.reading.session import NoSession, Session
from fleet.recording.writing.recorder import MAX_QUEUED_BYTES
from fleet.recording.writing.segment_writer import Segment
from schemas.local_time import exact
from tests.fleet.recording.damaged import CHUNKS, PER_CHUNK, Original, judge, places, put, written
from tests.support.no_superuser import no_superuser
from tests.support.soaks import only_in_soak

ABSURD = (0, 1, 21, 2**16, MAX_RECORD_BYTES, MAX_RECORD_BYTES + 1, 2**31 - 1, 2**32, 2**62, 2**63 - 1, 2**63, 2**64 - 1)


@pytest.fixture(scope="module")
def original(tmp_path_factory: pytest.TempPathFactory) -> Original:
    return written(tmp_path_factory.mktemp("original") / "0001.mcap")


def record(opcode: int, body: bytes) -> bytes:
    return struct.pack("<BQ", opcode, len(body)) + body


def flipped(data: bytes, at: int, bit: int) -> bytes:
    return data[:at] + bytes([data[at] ^ 1 << bit]) + data[at + 1 :]


def sampled(original: Original) -> list[int]:
    """Return offsets: many in messages and footer, and a few in the index, which has one checksum."""
    end, size = original.chunks[-1][1], len(original.data)
    first = original.chunks[0]
    return [
        *range(first[0] + 60),
        *range(first[0] + 60, first[1] - 10, 97),
        *range(first[1] - 10, end + 100, 3),
        *range(end + 100, size - 60, 401),
        *range(size - 60, size),
    ]


def cut_it_shows_every_whole_chunk(original: Original, lengths: Iterable[int], path: Path) -> None:
    for length in lengths:
        shown = judge(original, original.data[:length], length, path)
        assert shown == original.until(length), length
        assert ("is empty" if length == 0 else "is cut") in report(path), length


def test_cut_anywhere_it_shows_every_whole_chunk(original: Original, tmp_path: Path) -> None:
    cut_it_shows_every_whole_chunk(original, sampled(original)[::5], tmp_path / "x.mcap")


@pytest.mark.soak
@pytest.mark.timeout(3600)
def test_cut_at_every_byte_it_shows_every_whole_chunk(original: Original, tmp_path: Path) -> None:
    cut_it_shows_every_whole_chunk(original, range(len(original.data)), tmp_path / "x.mcap")


def report(path: Path) -> str:
    try:
        salvage = McapReader(path)
    except NotMcap as error:
        return str(error)
    salvage.check()
    return salvage.words


def test_bit_flip_is_told_and_loses_one_chunk_at_most(original: Original, tmp_path: Path) -> None:
    for at in sampled(original)[::5]:
        flipped_it_loses_its_own_chunk_at_most(original, at, [at % 8], tmp_path)


@pytest.mark.soak
@pytest.mark.timeout(3600)
def test_bit_flip_is_reported_and_loses_one_chunk_at_most(original: Original, tmp_path: Path) -> None:
    for at in range(len(original.data)):
        flipped_it_loses_its_own_chunk_at_most(original, at, range(8), tmp_path)


def flipped_it_loses_its_own_chunk_at_most(original: Original, at: int, bits: Iterable[int], tmp_path: Path) -> None:
    hit = {number for number, (begin, end) in enumerate(original.chunks) if begin <= at < end}
    for bit in bits:
        shown = judge(original, flipped(original.data, at, bit), at, tmp_path / "x.mcap")
        there = set(shown)
        assert {original.chunk_of(message) for message in set(original.messages) - there} <= hit, (at, bit)
        assert [message for message in original.messages if message in there] == shown, (at, bit)


def without_an_index_it_loses_its_own_chunk_at_most(original: Original, step: int, path: Path) -> None:
    """Cut between chunks and within one. A lost chunk also loses the channels that only it describes."""
    described = {0: {"fleet/red/sensor/range", "fleet/red/state/link"}, 1: {"fleet/blue/note"}}
    heads = [at for begin, end in original.chunks for at in (*range(begin, begin + 60), *range(end, end + 40))]
    lengths = (original.chunks[-1][1], original.chunks[-1][1] - 30, len(original.data) - 9)
    for first, length in enumerate(lengths):
        whole = original.until(length)
        for at in sorted({*range(8, length, 97), *heads} & {*range(length)})[first::step]:
            hit = {number for number, (begin, end) in enumerate(original.chunks) if begin <= at < end}
            keys = {key for number in hit for key in described.get(number, ())}
            data = flipped(original.data[:length], at, chance(at))
            shown = judge(original, data, at, path)
            expected = [one for one in whole if original.chunk_of(one) not in hit and one.key not in keys]
            known = set(expected)
            assert [one for one in shown if one in known] == expected, (length, at, report(path))


def test_bit_flip_without_index_loses_one_chunk_at_most(original: Original, tmp_path: Path) -> None:
    without_an_index_it_loses_its_own_chunk_at_most(original, 9, tmp_path / "x.mcap")


@pytest.mark.soak
def test_damage_without_index_loses_own_chunk_at_most(original: Original, tmp_path: Path) -> None:
    without_an_index_it_loses_its_own_chunk_at_most(original, 1, tmp_path / "x.mcap")


def chance(at: int) -> int:
    """Return a bit for the byte."""
    return random.Random(at).randrange(8)


def test_bad_length_is_told_and_hides_no_whole_chunk(original: Original, tmp_path: Path) -> None:
    begin, end = original.chunks[1][0], original.chunks[2][0]
    data = flipped(original.data[: original.chunks[-1][1]], begin + 1 + 5, 3)
    shown = judge(original, data, begin, tmp_path / "x.mcap")
    assert {original.chunk_of(message) for message in shown} == {0, 2, 3, 4}
    words = report(tmp_path / "x.mcap")
    assert "is cut (" in words
    assert "and damaged: " in words
    assert f"byte {begin}: " in words
    assert f" {end - begin} bytes" in words


@pytest.mark.parametrize("at", range(8))
@pytest.mark.parametrize("cut", [0, 8, 900])
def test_damaged_magic_is_still_an_mcap_file(original: Original, tmp_path: Path, at: int, cut: int) -> None:
    path = tmp_path / "x.mcap"
    length = len(original.data) - cut
    put(path, flipped(original.data, at, chance(at))[:length])
    session = Session(path)
    assert list(session.messages()) == original.until(length)
    assert "byte 0: " in session.damage_words
    assert "magic bytes" in session.damage_words
    put(path, bytes(60) + original.data[60:length])  # nor if more than those are
    assert list(Session(path).messages()) == original.until(length)


def test_false_chunk_headers_are_scanned_fast(tmp_path: Path) -> None:
    """The file has the head of a chunk every 57 bytes, each with a length almost to the end of the file."""
    path = tmp_path / "x.mcap"
    size = 2_000_000
    parts = [b"\x89MCAP0\r\n"]
    for at in range(8, size - 200_000, 57):
        length = size - 100_000 - at
        parts.append(struct.pack("<BQQQQII4sQ", 6, length, 1, 2, 2**20, 7, 4, b"zstd", length - 44) + bytes(4))
    path.write_bytes(b"".join(parts).ljust(size, b"x"))
    began = time.process_time()
    assert list(Session(path).messages()) == []
    assert time.process_time() - began < 20


def test_reader_reads_largest_recorded_messages(tmp_path: Path) -> None:
    chance = random.Random(1)
    path = tmp_path / "0001.mcap"
    segment = Segment(path, {})
    channel = segment.channel("fleet/red/big", "application/octet-stream")
    sizes = (2**20 - 100, MAX_QUEUED_BYTES, 10, 20_000_000, 5)
    for number, size in enumerate(sizes):
        segment.add(channel, number, chance.randbytes(size), number, 0)
    segment.finish({})
    cut = tmp_path / "cut.mcap"
    cut.write_bytes(path.read_bytes()[:-8])
    for each in (path, cut):
        salvage = McapReader(each)
        assert [len(row[4]) for row in salvage.messages()] == list(sizes)
        assert salvage.only_cut or not salvage.damage
        salvage.check()
        assert salvage.only_cut or not salvage.damage


def test_empty_recording_is_whole(tmp_path: Path) -> None:
    path = tmp_path / "0001.mcap"
    Segment(path, {}).finish({})
    salvage = McapReader(path)
    index = salvage.index()
    assert index is not None
    assert index.has_all_chunks
    assert list(salvage.messages()) == []
    assert not salvage.damage


def test_damaged_chunk_is_named_with_place_time_and_cause(original: Original, tmp_path: Path) -> None:
    begin, end = original.chunks[2]
    shown = judge(original, flipped(original.data, end - 2, 0), end - 2, tmp_path / "x.mcap")
    assert len(shown) == (CHUNKS - 1) * PER_CHUNK
    words = report(tmp_path / "x.mcap")
    assert places(words) == [begin]
    assert "is damaged: " in words
    times_ns = [one.recorded_ns for one in original.messages[2 * PER_CHUNK : 3 * PER_CHUNK]]
    assert "checksum" in words or "cannot be parsed" in words
    assert f"{exact(min(times_ns))} to {exact(max(times_ns))}, " in words


@pytest.mark.parametrize("field", ["length of the record", "size of the records", "length of the data"])
def test_absurd_chunk_length_is_not_believed(original: Original, tmp_path: Path, field: str) -> None:
    begin, _ = original.chunks[2]
    at = (
        begin + {"length of the record": 1, "size of the records": 9 + 16, "length of the data": 9 + 16 + 12 + 8}[field]
    )
    for length in ABSURD:
        data = original.data[:at] + struct.pack("<Q", length) + original.data[at + 8 :]
        judge(original, data, at, tmp_path / "x.mcap")
        # Without its end, the file has no index.
        judge(original, data[:-8], at, tmp_path / "x.mcap")


@pytest.mark.parametrize("step", [3, *only_in_soak([1])])
def test_absurd_record_length_is_not_believed(original: Original, tmp_path: Path, step: int) -> None:
    at = 8
    while at < len(original.data) - 8:
        (length,) = struct.unpack_from("<Q", original.data, at + 1)
        for number, absurd in enumerate(ABSURD[at % step :: step]):
            data = original.data[: at + 1] + struct.pack("<Q", absurd) + original.data[at + 9 :]
            # Every second file has no end, and so no index.
            judge(original, data[:-8] if (number + at) % 2 else data, at + 1, tmp_path / "x.mcap")
        at += 9 + length


def test_chunk_with_huge_uncompressed_size_is_skipped(tmp_path: Path) -> None:
    for compression in (CompressionType.ZSTD, CompressionType.LZ4, CompressionType.NONE):
        out = io.BytesIO()
        writer = Writer(out, compression=compression)
        writer.start()
        channel = writer.register_channel("fleet/red/x", "json", 0)
        writer.add_message(channel, 1, b"small", 1, 1)
        writer.flush()  # type: ignore[no-untyped-call]
        at = out.tell()
        writer.add_message(channel, 2, bytes(2 * MAX_RECORD_BYTES), 2, 2)
        writer.finish()  # type: ignore[no-untyped-call]  # it has no return type
        path = tmp_path / f"{compression.name}.mcap"
        for data in (out.getvalue(), out.getvalue()[:-8]):
            path.write_bytes(data)
            salvage = McapReader(path)
            assert [row[1] for row in salvage.messages()] == [1]
            assert f"byte {at}: " in salvage.words
            assert str(MAX_RECORD_BYTES) in salvage.words


def test_lz4_and_no_compression_and_no_chunks_are_read_too(tmp_path: Path) -> None:
    path = tmp_path / "x.mcap"
    for options in (
        {"compression": CompressionType.LZ4},
        {"compression": CompressionType.NONE},
        {"use_chunking": False},
        {"enable_crcs": False},
        {"use_statistics": False},
    ):
        with path.open("wb") as file:
            writer = Writer(file, **options)
            writer.start()
            channel = writer.register_channel("fleet/red/x", "json", 0)
            for number in range(100):
                writer.add_message(channel, number, b"{}", number, number)
            writer.finish()  # type: ignore[no-untyped-call]  # it has no return type
        salvage = McapReader(path)
        salvage.check()
        assert [row[1] for row in salvage.messages()] == list(range(100)), options
        assert not salvage.words, options
        whole = path.read_bytes()
        for length in range(8, len(whole), 7):
            put(path, whole[:length])
            cut = McapReader(path)
            list(cut.messages())
            assert "is cut" in cut.words


@pytest.mark.parametrize("compression", ["zstd", "lz4"])
def test_chunk_of_several_compression_frames_is_read(compression: str, tmp_path: Path) -> None:
    """Both formats allow it. A writer that compresses in parallel makes such chunks."""
    schema = b""
    messages = b"".join(record(5, struct.pack("<HIQQ", 1, number, number, number) + b"x" * 50) for number in range(9))
    channel = record(4, struct.pack("<HHI", 1, 0, 1) + b"k" + struct.pack("<I", 4) + b"json" + struct.pack("<I", 0))
    plain = channel + messages
    compress = zstandard.ZstdCompressor().compress if compression == "zstd" else lz4.frame.compress
    packed = compress(plain[:200]) + compress(plain[200:])
    named = struct.pack("<I", len(compression)) + compression.encode()
    body = struct.pack("<QQQI", 0, 8, len(plain), 0) + named + struct.pack("<Q", len(packed)) + packed
    magic = b"\x89MCAP0\r\n"
    head = record(1, struct.pack("<I", 0) + struct.pack("<I", 0))
    end = record(15, struct.pack("<I", 0)) + record(2, bytes(20))
    path = tmp_path / "a.mcap"
    path.write_bytes(magic + head + schema + record(6, body) + end + magic)
    assert [each.sequence for each in Session(path).messages()] == list(range(9))
    assert not Session(path).damage


def test_oversized_chunk_is_read_unless_it_is_a_bomb(tmp_path: Path) -> None:
    count = MAX_RECORD_BYTES // 2**20 + 4
    for name, is_read in (("real", True), ("bomb", False)):
        path = tmp_path / f"{name}.mcap"
        with path.open("wb") as file:
            writer: Any = Writer(file, chunk_size=2**30)
            writer.start()
            channel = writer.register_channel("k", "json", 0)
            for number in range(count):
                payload = os.urandom(2**17) * 8 if is_read else bytes(2**20)
                writer.add_message(channel, number, payload, number)
            writer.finish()
        found = Session(path)
        assert len(list(found.messages())) == (count if is_read else 0)
        assert ("may be intact" in found.damage_words) is not is_read


@pytest.mark.parametrize("count", [1, 7, 8, 9, 37, 4096, 100_000])
@pytest.mark.parametrize("filling", [b"\0", b"\xff", b"\x06"])
def test_bytes_after_mcap_end_are_reported(original: Original, tmp_path: Path, count: int, filling: bytes) -> None:
    """After a power failure, a file may end with zeros."""
    data = original.data + filling * count
    assert judge(original, data, len(original.data), tmp_path / "x.mcap") == list(original.messages)
    assert f"byte {len(original.data)}: {count} bytes " in report(tmp_path / "x.mcap")
    end = original.chunks[2][1]
    shown = judge(original, original.data[:end] + filling * count, end, tmp_path / "x.mcap")
    assert shown == original.until(end)


def test_damaged_index_hides_no_chunk(original: Original, tmp_path: Path) -> None:
    footer = len(original.data) - 37
    for at in [*range(original.chunks[-1][1] + 600, footer, 401), *range(footer, footer + 29)]:
        shown = judge(original, flipped(original.data, at, 3), at, tmp_path / "x.mcap")
        assert shown == list(original.messages), at


def test_channels_of_lost_chunk_are_reported(original: Original, tmp_path: Path) -> None:
    """The file is cut, so no index repeats the channels. The first chunk describes two of the three."""
    begin, end = original.chunks[0]
    data = flipped(original.data, end - 2, 0)[: original.chunks[-1][1]]
    path = tmp_path / "x.mcap"
    shown = judge(original, data, begin, path)
    assert shown
    assert {message.key for message in shown} == {"fleet/blue/note"}
    session = Session(path)
    session.check()
    list(session.messages())
    assert "description is lost" in session.damage_words


def test_many_damages_are_one_short_line(original: Original, tmp_path: Path) -> None:
    data = original.data
    for _, end in original.chunks:
        data = flipped(data, end - 2, 0)
    assert judge(original, data, original.chunks[0][0], tmp_path / "x.mcap") == []
    words = report(tmp_path / "x.mcap")
    assert words.endswith("and in 2 other places")
    assert len(words) < 500


def spliced(original: Original, seed: int) -> tuple[bytes, int]:
    """Cut out, insert or copy bytes, once or a few times. Return the data and the first byte that may differ."""
    chance = random.Random(seed)
    data, first = original.data, len(original.data)
    for _ in range(chance.randint(1, 4)):
        at, end = sorted(chance.randrange(len(data) + 1) for _ in range(2))
        begin = chance.randrange(len(data) + 1)
        piece = chance.choice(
            [b"", bytes(end - at), chance.randbytes(end - at), data[begin : begin + end - at], data[begin:]]
        )
        data = data[:at] + piece + data[end if chance.random() < 0.7 else at :]
        first = min(first, at)
        if len(data) > 50_000:
            data = data[:50_000]
    return data, first


def test_spliced_file_invents_no_messages(original: Original, tmp_path: Path) -> None:
    for seed in range(200):
        data, first = spliced(original, seed)
        judge(original, data, first, tmp_path / "x.mcap")


@pytest.mark.soak
@pytest.mark.timeout(3600)
def test_any_spliced_file_makes_nothing_up(original: Original, tmp_path: Path) -> None:
    for seed in range(200, 100_000):
        data, first = spliced(original, seed)
        judge(original, data, first, tmp_path / "x.mcap")


@given(opcode=st.sampled_from([*Opcode, 0, 0x20, 0x80, 0xFF]), body=st.binary(max_size=200), data=st.data())
@settings(max_examples=300)
def test_any_record_anywhere_gives_no_surprise(
    original: Original, tmp_path: Path, opcode: int, body: bytes, data: st.DataObject
) -> None:
    at = data.draw(st.sampled_from([8, *(begin for begin, _ in original.chunks), len(original.data) - 37]))
    length = data.draw(st.sampled_from([len(body), *ABSURD]))
    record = struct.pack("<BQ", opcode, length) + body
    path = tmp_path / "x.mcap"
    for tail in (b"", original.data[at:]):
        put(path, original.data[:at] + record + tail)
        salvage = McapReader(path)
        salvage.check()
        assert salvage.words
        before = original.until(at)
        shown = list(Session(path).messages())
        assert set(before) <= set(shown)


def test_non_regular_file_is_refused(tmp_path: Path) -> None:
    (tmp_path / "directory.mcap").mkdir()
    os.mkfifo(tmp_path / "fifo.mcap")
    (tmp_path / "loop.mcap").symlink_to("loop.mcap")
    for path in (tmp_path / "directory.mcap", tmp_path / "fifo.mcap", Path(os.devnull), Path("/dev/zero")):
        with pytest.raises(NotMcap, match="regular file"):
            McapReader(path)
    for path in (tmp_path / "fifo.mcap", tmp_path / "loop.mcap", Path(os.devnull), tmp_path / ("n" * 300)):
        with pytest.raises(NoSession) as caught:
            Session(path)
        assert str(path) in str(caught.value)
    for name in ("0001.mcap", "0002.mcap"):
        os.mkfifo(tmp_path / name)
    with pytest.raises(NoSession, match=r"0001\.mcap .*; .*0002\.mcap "):
        Session(tmp_path)


def test_unreadable_file_is_reported(original: Original, tmp_path: Path) -> None:
    locked = tmp_path / "locked"
    locked.mkdir()
    file = tmp_path / "x.mcap"
    file.write_bytes(original.data)
    (locked / "0001.mcap").write_bytes(original.data)
    file.chmod(0)
    locked.chmod(0)
    try:
        with no_superuser(tmp_path):
            for path in (file, locked, locked / "0001.mcap"):
                with pytest.raises(NoSession, match="Permission denied") as caught:
                    Session(path)
                assert str(path) in str(caught.value)
    finally:
        locked.chmod(0o700)
