"""A session to an .rrd that carries its layout, by Rerun's own MCAP reader and lenses; and the count of what is in one.

Every message goes into the .rrd as it was; lenses add what the viewer draws. Nothing here looks at single messages.
"""

import os
import shutil
import sys
import tempfile
import warnings
from collections import Counter
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any, Final

import numpy as np
import pyarrow as pa  # type: ignore[import-untyped]  # it has no stubs
import pyarrow.compute as pc  # type: ignore[import-untyped]  # likewise
import rerun as rr
import rerun.chunk as rrc

from fleet.recording.session import NoSession, Session
from fleet.replay import blueprint, mapping
from schemas import keys
from schemas.topics import TOPICS

APPLICATION: Final = "zenoh-car-fleet"
MESSAGE: Final = ":message"
"""How Rerun's reader names the component that holds a protobuf message."""
TEXT: Final = "TextLog:text"

_RERUN_ENVIRONMENT: Final = {"CI": "1", "RUST_LOG": "error"}
"""CI is the only switch that keeps Rerun 0.41's program from writing analytics into the user's home."""
_ARROW_M: Final = 0.25
"""Length of the arrow that stands for a car."""


class ExportFailed(Exception):
    """The .rrd could not be written; its text says why."""


def environment() -> dict[str, str]:
    """The environment for any process of Rerun's program."""
    return {**os.environ, **_RERUN_ENVIRONMENT}


def program() -> Path:
    """Rerun's program itself: what is on PATH is a wrapper, and ending that leaves the viewer behind."""
    import rerun_cli  # type: ignore[import-untyped]  # only a wrapper around the program

    name = "rerun.exe" if sys.platform == "win32" else "rerun"
    return Path(rerun_cli.__file__).parent / name


def export(session: Session, out: Path) -> Counter[str]:
    """Write `out`; how many messages of each key it holds. Raises ExportFailed, and NoSession if there is nothing."""
    readers = [rrc.McapReader(segment, recover=True) for segment in session.segments]
    held: Counter[str] = Counter()
    for reader in readers:
        held.update({channel.topic: channel.message_count or 0 for channel in reader.info().channels})
    contents = mapping.contents(frozenset(held))
    if not contents.cars and not contents.services:
        raise NoSession(f"{session.path} holds no message of a fleet")
    ways: dict[str, list[Any]] = {}
    stream = rrc.LazyChunkStream.merge(*(reader.stream() for reader in readers))
    stream = rrc.LazyChunkStream.from_iter(_noting(ways, stream)).lenses(_lenses(), output_mode="forward_all")
    with tempfile.TemporaryDirectory(dir=out.parent, prefix=".replay-") as scratch:
        whole = Path(scratch) / "whole.rrd"
        # A recording stream, because only its file carries a layout, which comes last: the ground is known then.
        recording = rr.RecordingStream(APPLICATION, recording_id=session.name)
        recording.save(whole)
        try:
            recording.send_chunks(stream)
        except RuntimeError as error:
            words = " ".join(str(error).split())
            raise ExportFailed(f"Rerun cannot read {session.path}: {words[:200]}") from None
        lines = {key: np.concatenate(parts) for key, parts in ways.items()}
        recording.send_chunks(rrc.LazyChunkStream.from_iter(_drawn(lines, contents)))
        recording.send_blueprint(blueprint.layout(contents, _ground(lines)), make_active=False, make_default=True)
        recording.disconnect()
        try:
            # Its writer tells nobody of a full disk; a cut file has no index, of which its reader warns besides.
            with warnings.catch_warnings(action="ignore"):
                rrc.RrdReader(whole).store()
        except (RuntimeError, ValueError):
            free = shutil.disk_usage(out.parent).free
            raise ExportFailed(
                f"{out} could not be written whole: {free} bytes are free there, {session.path} may need more"
            ) from None
        whole.replace(out)
    return held


def rows(path: Path) -> Counter[str]:
    """How many messages of each key an .rrd holds, by Rerun's own reader."""
    counted: Counter[str] = Counter()
    for chunk in rrc.RrdReader(path).store().stream():
        if chunk.is_static:
            continue
        key = mapping.key_of(chunk.entity_path)
        names = chunk.to_record_batch().schema.names
        own = any(name.endswith(MESSAGE) for name in names)
        # foxglove.Log is text in Rerun; any other text was made by a lens of ours.
        if own or (TEXT in names and key.endswith("/event/log")):
            counted[key] += chunk.num_rows
    return counted


def _component(topic: str) -> str:
    return TOPICS[topic].message + MESSAGE


def _lenses() -> list[Any]:
    lenses: list[Any] = []
    lanes: dict[str, list[mapping.Lane]] = {}
    for panel in mapping.CAR_PANELS:
        for lane in panel.lanes:
            lanes.setdefault(lane.topic, []).append(lane)
    for topic, of_topic in lanes.items():
        lens = rrc.DeriveLens(_component(topic))
        for lane in of_topic:
            lens = lens.to_component(lane.name, f".{lane.field}")
        lenses.append(lens)
    for words in mapping.WORDS:
        line = rrc.Selector(".").pipe(_line(words.fields))
        lens = rrc.DeriveLens(_component(words.topic)).to_component(rr.TextLog.descriptor_text(), line, cast_to="auto")
        if words.alarm_field:
            level = rrc.Selector(f".{words.alarm_field}").pipe(_level(words.alarm_values))
            lens = lens.to_component(rr.TextLog.descriptor_level(), level, cast_to="auto")
        lenses.append(lens)
    lenses.append(
        rrc.DeriveLens(_component(mapping.TRUTH))
        .to_component(rr.Arrows3D.descriptor_origins(), rrc.Selector(".").pipe(_origins), cast_to="auto")
        .to_component(rr.Arrows3D.descriptor_vectors(), rrc.Selector(".").pipe(_vectors), cast_to="auto")
    )
    return lenses


def _line(fields: Iterable[str]) -> Callable[[Any], Any]:
    def join(messages: Any) -> Any:
        parts = [_text(messages.field(name)) for name in fields]
        joined = pc.binary_join_element_wise(*parts, "  ", null_handling="replace", null_replacement="")
        return pc.utf8_trim_whitespace(pc.replace_substring_regex(joined, r" {3,}", "  "))

    return join


def _text(values: Any) -> Any:
    """A field as text; raw frames need not be any: what is no ASCII stands as its number."""
    if pa.types.is_binary(values.type) or pa.types.is_large_binary(values.type):
        words = [None if value is None else value.decode("ascii", "backslashreplace") for value in values.to_pylist()]
        return pa.array(words, pa.string())
    return pc.cast(values, pa.string())


def _level(alarms: frozenset[str]) -> Callable[[Any], Any]:
    def level(values: Any) -> Any:
        return pc.if_else(pc.is_in(values, pa.array(sorted(alarms), pa.string())), "WARN", "INFO")

    return level


def _triples(x: Any, y: Any) -> Any:
    """Points on the ground, as the fixed-size lists that Rerun's vectors are."""
    flat = np.stack([x, y, np.zeros(len(x))], axis=1).astype("float32").ravel()
    return pa.FixedSizeListArray.from_arrays(pa.array(flat), 3)


def _origins(truths: Any) -> Any:
    return _triples(
        truths.field("x_m").to_numpy(zero_copy_only=False), truths.field("y_m").to_numpy(zero_copy_only=False)
    )


def _vectors(truths: Any) -> Any:
    heading = truths.field("heading_rad").to_numpy(zero_copy_only=False)
    return _triples(_ARROW_M * np.cos(heading), _ARROW_M * np.sin(heading))


def _noting(ways: dict[str, list[Any]], chunks: Iterable[Any]) -> Iterable[Any]:
    """Pass the chunks on, and note the true positions in them as arrays of (x, y), by key."""
    component = _component(mapping.TRUTH)
    for chunk in chunks:
        if chunk.entity_path.endswith(mapping.TRUTH):
            batch = chunk.to_record_batch()
            if component in batch.schema.names:
                truths = batch.column(component).flatten()
                xy = [truths.field(name).to_numpy(zero_copy_only=False) for name in ("x_m", "y_m")]
                ways.setdefault(mapping.key_of(chunk.entity_path), []).append(np.stack(xy, axis=1))
        yield chunk


def _ground(ways: dict[str, Any]) -> blueprint.Ground | None:
    if not ways:
        return None
    every = np.concatenate(list(ways.values()))
    low, high = every.min(axis=0), every.max(axis=0)
    middle = (low + high) / 2
    return blueprint.Ground(float(middle[0]), float(middle[1]), float((high - low).max()))


def _drawn(ways: dict[str, Any], contents: mapping.Contents) -> Iterable[Any]:
    """Each simulated car's way as one line, its colour and its name: static, so seen at any time."""
    for index, car in enumerate(contents.cars):
        key = keys.topic_key(contents.fleet, car, mapping.TRUTH)
        if key in ways:
            line = np.column_stack([ways[key], np.zeros(len(ways[key]))])
            rgb = blueprint.colour(car, index)
            strip = rr.LineStrips3D.columns(strips=[line], colors=[rgb], radii=[0.012])
            name = rr.Arrows3D.columns(colors=[rgb], radii=[0.035], labels=[car], show_labels=[True])
            yield rrc.Chunk.from_columns(f"{mapping.entity(key)}/way", indexes=[], columns=strip)
            yield rrc.Chunk.from_columns(mapping.entity(key), indexes=[], columns=name)
