"""Exports a session to an .rrd with its layout. Rerun's own reader counts the rows."""

import math
import os
import shutil
import signal
import subprocess
import sys
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import rerun.chunk as rrc
from click.testing import CliRunner

from fleet.commands.replay import replay
from fleet.recording.reading.mcap_copy import McapCopy
from fleet.recording.reading.mcap_reader import McapReader
from fleet.recording.reading.session import NoSession, Session
from fleet.recording.session_dir import FLEET_FILE
from fleet.replay import panels
from fleet.replay.rerun import lenses, rrd_export
from fleet.replay.rerun.prepare import MIN_RUNS
from schemas.messages import message_class
from schemas.topics import TOPICS
from tests.fleet.replay.make_session import CARS, START_NS, make


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Counter[str]]:
    path = tmp_path_factory.mktemp("session") / "0001.mcap"
    return path, make(path)


def test_made_session_has_every_message_type(made: tuple[Path, Counter[str]]) -> None:
    topics = {key.split("/", 2)[2] if "@" not in key else key.split("/", 1)[1] for key in made[1]}
    assert topics == set(TOPICS)


def test_rrd_has_every_message_and_layout(made: tuple[Path, Counter[str]], tmp_path: Path) -> None:
    path, counts = made
    out = tmp_path / "out.rrd"
    assert rrd_export.export(Session(path), out).shown == counts
    assert rrd_export.rows(out) == counts
    reader = rrc.RrdReader(out)
    (recording,), (layout,) = reader.recordings(), reader.blueprints()
    assert recording.application_id == layout.application_id == rrd_export.APPLICATION
    assert recording.recording_id == Session(path).name
    assert list(tmp_path.iterdir()) == [out]


def test_session_with_one_message_in_each_chunk_makes_large_chunks(
    made: tuple[Path, Counter[str]], tmp_path: Path
) -> None:
    """The recorder ends a chunk each second, so it has few messages of each key in it."""
    path, counts = made
    with McapCopy(tmp_path / "0001.mcap", chunk_ns=1) as copy:
        for row in Session(path).rows():
            copy.add(row)
    index = McapReader(tmp_path / "0001.mcap").index()
    assert index is not None
    assert len(index.chunks) > MIN_RUNS
    out, whole = tmp_path / "out.rrd", tmp_path / "whole.rrd"
    assert rrd_export.export(Session(tmp_path / "0001.mcap"), out).shown == counts
    assert rrd_export.rows(out) == counts
    rrd_export.export(Session(path), whole)
    found, wanted = (len(list(rrc.RrdReader(each).store().stream())) for each in (out, whole))
    assert found < 2 * wanted


def test_cars_have_the_colors_of_the_fleet_file(made: tuple[Path, Counter[str]], tmp_path: Path) -> None:
    shutil.copy(made[0], tmp_path)
    cars = "cars: {red: {link: COM1, color: '#010203'}, blue: {link: COM2}}\n"
    (tmp_path / FLEET_FILE).write_text(cars, encoding="utf-8")
    rrd_export.export(Session(tmp_path), tmp_path / "out.rrd")
    found = set()
    for chunk in rrc.RrdReader(tmp_path / "out.rrd").store().stream():
        batch = chunk.to_record_batch()
        if "Arrows3D:colors" in batch.schema.names:
            found |= {f"{each:08x}" for row in batch.column("Arrows3D:colors").to_pylist() for each in row or ()}
    assert found >= {"010203ff"}, found


def test_rrd_texts_and_lanes_match_messages(made: tuple[Path, Counter[str]], tmp_path: Path) -> None:
    out = tmp_path / "out.rrd"
    rrd_export.export(Session(made[0]), out)
    texts: list[str] = []
    lanes: dict[str, list[object]] = {}
    for chunk in rrc.RrdReader(out).store().stream():
        batch = chunk.to_record_batch()
        if panels.key_of(chunk.entity_path) == "fleet/red/event/command" and lenses.TEXT in batch.schema.names:
            texts += [row[0] for row in batch.column(lenses.TEXT).to_pylist()]
        if panels.key_of(chunk.entity_path) == "fleet/red/state/mode":
            for name in ("mode asked", "mode inferred"):
                if name in batch.schema.names:
                    lanes.setdefault(name, []).extend(row[0] for row in batch.column(name).to_pylist())
    assert "red  drive  asked  forward for 3 s  by ann" in texts
    assert "red  drive  sent  by ann" in texts
    messages = [m for m in Session(made[0]).messages() if m.key == "fleet/red/state/mode"]
    assert len(lanes["mode asked"]) == len(lanes["mode inferred"]) == len(messages)
    assert set(lanes["mode inferred"]) == {"manual", "tracking", "unknown"}


@pytest.mark.parametrize("topic", ["sim/truth", "sensor/pose"])
def test_pose_is_drawn_as_arrow_with_path(topic: str, made: tuple[Path, Counter[str]], tmp_path: Path) -> None:
    out = tmp_path / "out.rrd"
    rrd_export.export(Session(made[0]), out)
    key = f"fleet/red/{topic}"
    places, vectors, ways = [], [], []
    for chunk in rrc.RrdReader(out).store().stream():
        batch, entity = chunk.to_record_batch(), panels.key_of(chunk.entity_path)
        if entity == key and "Arrows3D:origins" in batch.schema.names:
            places += [tuple(row[0]) for row in batch.column("Arrows3D:origins").to_pylist()]
            vectors += [tuple(row[0]) for row in batch.column("Arrows3D:vectors").to_pylist()]
        if entity == f"{key}/way" and "LineStrips3D:strips" in batch.schema.names:
            ways += [[tuple(point) for point in row[0]] for row in batch.column("LineStrips3D:strips").to_pylist()]
    kind = message_class(TOPICS[topic].message)
    told: list[Any] = [kind.FromString(m.payload) for m in Session(made[0]).messages() if m.key == key]
    np.testing.assert_allclose(places, [(each.x_m, each.y_m, 0.0) for each in told], atol=1e-6)
    headings = [math.atan2(y, x) - each.heading_rad for (x, y, _), each in zip(vectors, told, strict=True)]
    np.testing.assert_allclose([math.remainder(each, math.tau) for each in headings], 0.0, atol=1e-5)
    (way,) = ways
    np.testing.assert_allclose(way, places)


def test_lanes_say_what_was_so_and_for_how_long(made: tuple[Path, Counter[str]], tmp_path: Path) -> None:
    out = tmp_path / "out.rrd"
    rrd_export.export(Session(made[0]), out)
    lanes: dict[tuple[str, str], list[tuple[float, object]]] = {}
    for chunk in rrc.RrdReader(out).store().stream():
        batch = chunk.to_record_batch()
        for name in ("LED asked", "light left", "mode inferred"):
            if name in batch.schema.names:
                times = batch.column("message_publish_time").cast("int64").to_pylist()
                lane = lanes.setdefault((panels.key_of(chunk.entity_path), name), [])
                for at, row in zip(times, batch.column(name).to_pylist(), strict=True):
                    lane.append(((at - START_NS) / 1e9, row[0]))
    assert lanes["fleet/red/event/command", "LED asked"] == [(4.2, "#ff0010")]
    *light, (end, nothing) = sorted(lanes["fleet/red/sensor/light", "light left"])
    assert [state for _, state in light] == [second % 2 == 0 for second in range(7)], "as long as mode manual"
    assert (end, nothing) == (9.06, None), "stale 3 s after the last"
    assert None not in [state for _, state in lanes["fleet/red/state/mode", "mode inferred"]]


def test_panel_parts_are_fields_of_their_messages() -> None:
    from schemas.messages import message_class

    for part in panels.parts():
        fields = message_class(TOPICS[part.topic].message).DESCRIPTOR.fields_by_name
        names = part.field.rstrip("!").partition("[")[0].split(".")
        assert names[0] in fields, part
        assert len(names) == 1 or names[1] in fields[names[0]].message_type.fields_by_name, part
        # A missing value must not be drawn as zero.
        assert not isinstance(part, panels.Curve) or fields[names[0]].has_presence == part.field.endswith("!"), part
    for words in panels.TEXT_LINES:
        fields = message_class(TOPICS[words.topic].message).DESCRIPTOR.fields_by_name
        assert {*words.fields, *words.before} <= set(fields)


def test_topics_are_all_drawn() -> None:
    drawn = {part.topic for part in panels.parts()} | {words.topic for words in panels.TEXT_LINES}
    drawn |= {topic for panel in panels.CAR_PANELS for topic in panel.topics}
    drawn |= {topic for _, ours, theirs in panels.FLEET_TEXTS for topic in (*ours, *theirs)}
    assert set(TOPICS) - drawn == {panels.PLAN_TOPIC, panels.WORLD}


@pytest.mark.parametrize("key", ["fleet/red/sensor/range", "fleet/@recorder/status", "my-fleet/car_1/state/mode"])
def test_entities_are_named_as_reruns_reader_names_them(key: str) -> None:
    assert panels.key_of(panels.entity(key)) == key


def test_rerun_names_entities_as_we_do(made: tuple[Path, Counter[str]]) -> None:
    found = {chunk.entity_path for chunk in rrc.McapReader(made[0]).stream() if not chunk.is_static}
    assert found == {panels.entity(key) for key in made[1]}


def test_truncated_session_replays_whole_part(tmp_path: Path) -> None:
    from mcap.writer import Writer

    class Flushing(Writer):
        """A writer with one chunk for every hundred messages."""

        def add_message(self, *arguments: object, **named: object) -> None:
            super().add_message(*arguments, **named)  # type: ignore[arg-type]
            self.count = getattr(self, "count", 0) + 1
            if self.count % 100 == 0:
                self.flush()  # type: ignore[no-untyped-call]

    path = tmp_path / "0001.mcap"
    make(path, writer=Flushing)
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    session = Session(tmp_path)
    whole = Counter(message.key for message in session.messages())
    assert sum(whole.values()) > 100
    out = tmp_path / "out.rrd"
    result = CliRunner().invoke(replay, [str(tmp_path), "--save", str(out)])
    assert result.exit_code == 0
    assert "is cut" in result.stderr
    assert rrd_export.rows(out) == whole


def test_bad_input_is_one_line(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("DISPLAY", raising=False)
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    foreign = tmp_path / "foreign.mcap"
    foreign.write_bytes(b"something else")
    out = str(tmp_path / "out.rrd")
    for arguments, words in (
        ([str(tmp_path / "none"), "--save", out], "There is no session at"),
        ([str(tmp_path), "--save", out], "no 0001.mcap in it"),
        ([str(foreign), "--save", out], "is not an MCAP file"),
    ):
        result = CliRunner().invoke(replay, arguments)
        assert (result.exit_code, len(result.stderr.splitlines())) == (1, 1), result.stderr
        assert words in result.stderr
    if sys.platform == "linux":
        missing = CliRunner().invoke(replay, [str(tmp_path / "none")])
        assert "no session" in missing.stderr, "what is missing comes before a missing display"


def test_without_a_display_a_file_is_proposed(
    made: tuple[Path, Counter[str]], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sys, "platform", "linux")
    monkeypatch.delenv("DISPLAY", raising=False)
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    session = Path(shutil.copy(made[0], tmp_path / "my session.mcap"))
    result = CliRunner().invoke(replay, [str(session)])
    assert result.exit_code == 1
    assert f"fleet replay '{session}' --save out.rrd" in result.stderr, "it can be typed as it is"


@pytest.mark.parametrize("size", [8, 9, 20, 30, 200, 1000])
def test_recording_without_intact_message_is_refused(
    made: tuple[Path, Counter[str]], tmp_path: Path, size: int
) -> None:
    cut = tmp_path / "0001.mcap"
    cut.write_bytes(made[0].read_bytes()[:size])
    result = CliRunner().invoke(replay, [str(cut), "--save", str(tmp_path / "out.rrd")])
    assert result.exit_code == 1
    assert isinstance(result.exception, SystemExit)
    assert len(result.stderr.splitlines()) == 1
    assert "no intact message" in result.stderr
    assert str(cut) in result.stderr
    assert "byte " in result.stderr


def test_export_tells_damage_and_shows_whole_part(made: tuple[Path, Counter[str]], tmp_path: Path) -> None:
    whole = made[0].read_bytes()
    for share in (0.3, 0.6, 0.9):
        damaged = bytearray(whole)
        at = int(len(whole) * share)
        damaged[at : at + 50] = bytes(byte ^ 0x5A for byte in damaged[at : at + 50])
        path, out = tmp_path / f"{share}.mcap", tmp_path / f"{share}.rrd"
        path.write_bytes(damaged)
        result = CliRunner().invoke(replay, [str(path), "--save", str(out)])
        assert result.exit_code == 0, result.stderr
        assert "damaged" in result.stderr
        shown = rrd_export.rows(out)
        assert f"{shown.total()} messages" in result.stdout
        assert all(count <= made[1][key] for key, count in shown.items())


def test_export_overwrites_no_recording_or_device(made: tuple[Path, Counter[str]], tmp_path: Path) -> None:
    before = made[0].read_bytes()
    link = tmp_path / "link.rrd"
    link.symlink_to(made[0])
    fifo = tmp_path / "fifo.rrd"
    os.mkfifo(fifo)
    for target in (made[0], link, fifo, Path(os.devnull)):
        result = CliRunner().invoke(replay, [str(made[0]), "--save", str(target)])
        assert result.exit_code == 2, target
    assert made[0].read_bytes() == before


# Now and then, Rerun waits for ever for its writer, which has stopped.
NEVER_CLOSED = (
    "import os; os.environ['RUST_LOG'] = 'off';"
    "import threading, rerun, fleet.replay.rerun.rrd_export as export; export.STALLED_S = 0.2;"
    "rerun.RecordingStream.disconnect = lambda self: threading.Event().wait(); "
)


@pytest.mark.parametrize(("damaged", "first"), [(False, ""), (True, ""), (False, NEVER_CLOSED)])
def test_export_on_full_disk_fails_in_our_words(
    made: tuple[Path, Counter[str]], tmp_path: Path, *, damaged: bool, first: str
) -> None:
    source, out = tmp_path / "x.mcap", tmp_path / "out.rrd"
    data = made[0].read_bytes()
    source.write_bytes(data[:-20] if damaged else data)
    code = (
        f"{first}import resource; from fleet.cli import main;"
        f"resource.setrlimit(resource.RLIMIT_FSIZE, ({2 * len(data)}, {2 * len(data)})); main()"
    )
    command = [sys.executable, "-c", code, "replay", str(source), "--save", str(out)]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 1
    said = done.stderr.splitlines()
    assert len(said) == 1 + damaged, done.stderr
    assert ("is cut" in said[0]) == damaged
    assert f"{out} is incomplete" in said[-1]
    assert "bytes are free" in said[-1]
    assert list(tmp_path.iterdir()) == [source], "nothing is left behind"


@pytest.mark.parametrize("where", ["between chunks", "in a lens"])
def test_ctrl_c_does_not_blame_the_recording(
    made: tuple[Path, Counter[str]], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, where: str
) -> None:
    def interrupt(*_: object) -> None:
        signal.raise_signal(signal.SIGINT)

    if where == "in a lens":
        monkeypatch.setattr(lenses, "_words", interrupt)
    with pytest.raises(KeyboardInterrupt):
        rrd_export.export(
            Session(made[0]), tmp_path / "out.rrd", on_read=interrupt if where == "between chunks" else lambda _: None
        )
    assert list(tmp_path.iterdir()) == []


def test_export_of_empty_session_is_refused(tmp_path: Path) -> None:
    from mcap.writer import Writer

    with (tmp_path / "0001.mcap").open("wb") as file:
        writer = Writer(file)
        writer.start()
        writer.finish()  # type: ignore[no-untyped-call]
    with pytest.raises(NoSession, match="has no message"):
        rrd_export.export(Session(tmp_path), tmp_path / "out.rrd")


def test_export_writes_nothing_outside_target(made: tuple[Path, Counter[str]], tmp_path: Path) -> None:
    home, work = tmp_path / "home", tmp_path / "work"
    home.mkdir()
    work.mkdir()
    names = ("HOME", "XDG_CONFIG_HOME", "XDG_CACHE_HOME", "XDG_DATA_HOME", "XDG_STATE_HOME", "TMPDIR")
    environment = {**os.environ, **dict.fromkeys(names, str(home))}
    environment.pop("CI", None)
    code = "from fleet.commands.replay import replay; replay()"
    command = [sys.executable, "-c", code, str(made[0]), "--save", str(work / "out.rrd")]
    subprocess.run(command, env=environment, check=True, capture_output=True)
    assert list(home.rglob("*")) == []
    assert list(work.iterdir()) == [work / "out.rrd"]


def test_export_takes_cars_from_keys_and_ignores_foreign_ones() -> None:
    keys = frozenset(
        {"fleet/red/sensor/range", "fleet/@recorder/status", "fleet/red/@cmd/drive", "x", "fleet/blue/other"}
    )
    found = panels.contents(keys)
    assert dict(found.cars) == {"red": frozenset({"sensor/range"})}
    assert found.services == {"@recorder/status"}
    assert tuple(sorted(CARS)) == CARS
