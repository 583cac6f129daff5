"""Writes MCAP files as a bus full of strangers would fill them: stray types, junk, odd keys, broken chunks."""

import random
from collections import Counter
from pathlib import Path
from typing import Any

from foxglove_schemas_protobuf.Log_pb2 import Log
from google.protobuf.message import Message
from mcap.writer import CompressionType, IndexType, Writer

from schemas import messages
from schemas.gen import fleet_v1_pb2 as pb

START_NS = 1_790_000_000_000_000_000
RANGE, LINK, LOG = "fleet/red/sensor/range", "fleet/red/state/link", "fleet/red/event/log"
OWN: dict[str, Message] = {
    RANGE: pb.Range(car="red", range_m=1.5),
    LINK: pb.Link(car="red", state="online", rx_bytes=35),
    LOG: Log(level=2, message="connected"),  # type: ignore[arg-type]  # an enum is a number here
    "fleet/blue/state/mode": pb.Mode(car="blue", inferred="manual"),
    "fleet/@coordinator/plan": pb.Plan(text="red: tracking", version="1"),
}
ODD_KEYS = (
    "/imu/data", "a//b", "a/b", "a/", "fleet/red/\x1b]0;pwn\x07x", "fleet/red/sensor/a#b", "fleet/red/" + "x" * 3000,
    "fleet", "fleet/red/a\\b", "fleet/red/ab", "日/本",
)  # fmt: skip
UNKNOWN_LEVEL = b"\x10\x4d"  # 77
PLAIN = IndexType.CHUNK | IndexType.ATTACHMENT | IndexType.METADATA


class Mixed:
    """A file with any message on any key."""

    def __init__(self, path: Path, **options: Any) -> None:
        self._file = path.open("wb")
        self.writer: Any = Writer(self._file, **options)
        self.writer.start()
        self._schemas: dict[tuple[str, str], int] = {}
        self._channels: dict[tuple[str, str, str], int] = {}
        self.counts: Counter[str] = Counter()

    def put(self, key: str, name: str, payload: bytes, encoding: str = "protobuf") -> None:
        """Write a message. name: the name of its type; empty for none."""
        if name and (name, encoding) not in self._schemas:
            data = messages.descriptor_set(name) if encoding == "protobuf" else b"{}"
            kind = "protobuf" if encoding == "protobuf" else "jsonschema"
            self._schemas[name, encoding] = self.writer.register_schema(name, kind, data)
        if (key, name, encoding) not in self._channels:
            schema = self._schemas[name, encoding] if name else 0
            self._channels[key, name, encoding] = self.writer.register_channel(key, encoding, schema)
        self.counts[key] += 1
        at_ns = START_NS + self.counts.total() * 1_000_000
        self.writer.add_message(self._channels[key, name, encoding], at_ns, payload, at_ns, self.counts[key])

    def own(self, key: str, count: int = 1) -> None:
        """Write messages of the own type of a key."""
        for _ in range(count):
            self.put(key, OWN[key].DESCRIPTOR.full_name, OWN[key].SerializeToString())

    def stray(self, key: str, of: str) -> None:
        """Write a message of the type of another key."""
        self.put(key, OWN[of].DESCRIPTOR.full_name, OWN[of].SerializeToString())

    def close(self) -> Counter[str]:
        self.writer.finish()
        self._file.close()
        return self.counts


def make(path: Path, seed: int) -> None:
    """Write a random file. One in four is damaged."""
    chance = random.Random(seed)
    options: dict[str, Any] = {
        "chunk_size": chance.choice([200, 2000, 1 << 20]),
        "use_chunking": chance.random() < 0.8,
        "compression": chance.choice([CompressionType.NONE, CompressionType.ZSTD, CompressionType.LZ4]),
        "index_types": chance.choice([IndexType.ALL, IndexType.ALL, PLAIN, IndexType.NONE]),
        "repeat_channels": chance.random() < 0.9,
        "use_summary_offsets": chance.random() < 0.9,
    }
    made = Mixed(path, **options)
    for _ in range(chance.randrange(3, 40)):
        key = chance.choice([*OWN])
        match chance.randrange(12):
            case 0:
                made.stray(key, chance.choice([*OWN]))
            case 1:
                made.put(key, "", b"{}", "json")
            case 2:
                made.put(key, OWN[key].DESCRIPTOR.full_name, chance.randbytes(chance.randrange(1, 9)))
            case 3:
                made.put(LOG, "foxglove.Log", UNKNOWN_LEVEL)
            case 4:
                made.stray(chance.choice(ODD_KEYS), key)
            case 5:
                made.put(chance.choice(ODD_KEYS), "", b"{}", "json")
            case _:
                made.own(key)
    made.close()
    if chance.random() < 0.25:
        data = bytearray(path.read_bytes())
        if chance.random() < 0.5:
            del data[chance.randrange(len(data) // 2, len(data)) :]
        else:
            data[chance.randrange(len(data) // 4, len(data))] ^= 0xFF
        path.write_bytes(data)
