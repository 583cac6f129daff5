"""Time to read the last minute of a long session, and to export tables. The floors: mcap's reader, Rerun's importer."""

import os
import shutil
from pathlib import Path
from time import perf_counter
from typing import Any

from mcap.reader import make_reader
from mcap.writer import Writer

from fleet.recording.reading.session import Session
from fleet.recording.tools.table_export import export
from fleet.recording.tools.table_formats import FORMATS
from schemas import messages
from tests.bench.measured import Measured, Scale, in_turns
from tests.bench.replaying import SECONDS, SHORTEST_S, import_s, write_session
from tests.bench.stage import scratch
from tests.fleet.replay.make_session import START_NS

BYTES = 1_000_000_000
RATE = 1000
KEYS = 60
MINUTE_NS = 60_000_000_000


def _long(path: Path, size: int, rate: int) -> int:
    """Write a session of this size, flushed each second as the recorder does. Return its end, ns."""
    with path.open("wb") as file:
        writer: Any = Writer(file, enable_data_crcs=True)
        writer.start()
        schema = writer.register_schema("fleet.v1.RxFrame", "protobuf", messages.descriptor_set("fleet.v1.RxFrame"))
        channels = [writer.register_channel(f"fleet/car{n}/frame/rx", "protobuf", schema) for n in range(KEYS)]
        at_ns, number = START_NS, 0
        while file.tell() < size:
            for _ in range(rate):
                number += 1
                at_ns += 1_000_000_000 // rate
                # Field 5, bytes. Compression cannot shrink random bytes.
                payload = b"\x2a\x50" + os.urandom(80)
                writer.add_message(channels[number % KEYS], at_ns, payload, at_ns, number // KEYS)
            writer.flush()
        writer.finish()
    return at_ns


def _last_minute(directory: Path, scale: Scale) -> Measured:
    path = directory / "long.mcap"
    rate = scale.count(RATE)
    size = scale.count(BYTES) * rate // RATE
    end_ns = _long(path, size, rate)
    start_ns = end_ns - MINUTE_NS

    def ours() -> float:
        began = perf_counter()
        count = sum(1 for _ in Session(path).messages(start_ns=start_ns))
        took = perf_counter() - began
        assert count == 60 * rate + 1
        return took

    def floor() -> float:
        began = perf_counter()
        with path.open("rb") as file:
            count = sum(1 for _ in make_reader(file).iter_messages(starting_at=start_ns))
        took = perf_counter() - began
        assert count == 60 * rate + 1
        return took

    mine, least = in_turns(scale, ours, floor)
    path.unlink()
    # The goal is one second, independent of mcap's reader.
    return Measured(
        f"read the last minute of a {size / 1e9:g} GB session", tuple(mine), tuple(least), "s", 0.0, slack=1.0
    )


def _tables(directory: Path, name: str, source: Path, count: int, scale: Scale) -> Measured:
    def ours() -> float:
        out = directory / name
        shutil.rmtree(out, ignore_errors=True)
        out.mkdir()
        began = perf_counter()
        done = export(Session(source).rows(), out, FORMATS[name])
        took = perf_counter() - began
        assert sum(done.rows.values()) == count
        return took / count * 1e6

    mine, least = in_turns(scale, ours, lambda: import_s(source, directory) / count * 1e6)
    # The goal of twice the importer is that of the .rrd (replaying.py). A table has no goal.
    return Measured(f"export a message to {name}", tuple(mine), tuple(least), "us", None)


def run(scale: Scale) -> list[Measured]:
    with scratch() as directory:
        source = directory / "session.mcap"
        count = write_session(source, scale.count(SECONDS, SHORTEST_S))
        tables = [_tables(directory, name, source, count, scale) for name in FORMATS]
        return [*tables, _last_minute(directory, scale)]
