"""A file as our recorder writes it, small enough to damage each byte, and the judge of damaged copies."""

import tracemalloc
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

from mcap.reader import make_reader

from fleet.recording.reading.mcap_index import MAX_RECORD_BYTES
from fleet.recording.reading.session import NoSession, Recorded, Session
from fleet.recording.writing.segment_writer import Segment
from schemas import messages
from schemas.gen import fleet_v1_pb2 as pb

CHUNKS, PER_CHUNK = 5, 8
MOST_MEMORY = 3 * MAX_RECORD_BYTES
"""Maximum memory: one chunk compressed, uncompressed, and as messages."""


@dataclass(frozen=True)
class Original:
    """A whole file."""

    data: bytes
    messages: tuple[Recorded, ...]
    chunks: tuple[tuple[int, int], ...]
    """Begin and end of each chunk."""

    def until(self, at: int) -> list[Recorded]:
        """Return the messages of the chunks that end before a byte."""
        return list(self.messages[: PER_CHUNK * sum(end <= at for _, end in self.chunks)])

    def chunk_of(self, message: Recorded) -> int:
        return self._numbers[message] // PER_CHUNK

    @cached_property
    def _numbers(self) -> dict[Recorded, int]:
        # A local name, because the loop compares the messages of thousands of copies.
        return {message: number for number, message in enumerate(self.messages)}


def written(path: Path) -> Original:
    """Write five chunks of three keys. The last key begins with the second chunk."""
    segment = Segment(path, {"fleet": "fleet"})
    channels: dict[str, int] = {}
    number = 0
    for chunk in range(CHUNKS):
        for _ in range(PER_CHUNK):
            number += 1
            key, payload, encoding = (
                ("fleet/red/sensor/range", pb.Range(range_m=number / 8), messages.encoding_of("fleet.v1.Range")),
                ("fleet/red/state/link", pb.Link(state="online"), messages.encoding_of("fleet.v1.Link")),
                ("fleet/blue/note", None, "application/json"),
            )[number % (2 if chunk == 0 else 3)]
            data = payload.SerializeToString() if payload is not None else b'{"number": %d}' % number
            if key not in channels:
                channels[key] = segment.channel(key, encoding)
            at_ns = 1_790_000_000_000_000_000 + number
            segment.add(channels[key], at_ns, data, at_ns, 0)
        segment.flush()
    segment.finish({})
    with path.open("rb") as file:
        summary = make_reader(file).get_summary()
    assert summary is not None
    chunks = tuple(
        (each.chunk_start_offset, each.chunk_start_offset + each.chunk_length) for each in summary.chunk_indexes
    )
    session = Session(path)
    session.check()
    assert not session.damage_words
    found = tuple(session.messages())
    assert len(found) == len(set(found)) == CHUNKS * PER_CHUNK
    assert len(chunks) == CHUNKS
    return Original(path.read_bytes(), found, chunks)


def put(path: Path, data: bytes) -> None:
    """Write a file, or overwrite it."""
    # Truncating a file takes 8 ms instead of 0.1 ms: ext4 flushes such a file when it is closed (auto_da_alloc).
    path.unlink(missing_ok=True)
    path.write_bytes(data)


def judge(original: Original, data: bytes, first: int, path: Path) -> list[Recorded]:
    """Check the messages of a damaged copy, which is the same up to byte `first`. Return them."""
    put(path, data)
    tracemalloc.start()
    try:
        session = Session(path)
        session.check()
        checked = session.damage_words
        shown = list(session.messages())
    except NoSession as refused:
        checked, shown = str(refused), []
        assert first < 8
    finally:
        _, peak = tracemalloc.get_traced_memory()
        tracemalloc.stop()
    assert peak < MOST_MEMORY
    assert set(shown) <= set(original.messages), "nothing is made up"
    assert set(original.until(first)) <= set(shown), "what comes before the damage is shown"
    if data != original.data:
        assert checked.startswith(str(path))
        assert "\n" not in checked
        if first >= 8:
            assert "byte " in checked
            assert all(0 <= at <= len(data) for at in places(checked)), checked
    else:
        assert not checked
    return shown


def places(words: str) -> list[int]:
    """Return the offsets in a report."""
    return [int(part.partition(":")[0]) for part in words.split("byte ")[1:]]
