"""Writes a session for other programs, and prints what was written and what was left out: `fleet sessions export`.

Each function raises Exists, NoSession, FormatMissing or OSError. It then leaves no files behind.
"""

from pathlib import Path

import click

from fleet.commands.output import echo_safely, with_progress
from fleet.recording.reading.session import NoSession, Session
from fleet.recording.tools import one_schema, table_export
from fleet.recording.tools.merge_cut_recover import atomic_directory
from fleet.recording.tools.summary import total
from fleet.recording.tools.table_formats import FORMATS, ParquetNsSink
from fleet.replay.foxglove_layout import layout_text


def export_tables(session: Session, out: Path, form: str, *, nanoseconds: bool = False) -> None:
    """Write tables in the format `csv` or `parquet`."""
    sink = ParquetNsSink if nanoseconds else FORMATS[form]
    with atomic_directory(out) as new:
        done = table_export.export(with_progress(f"export {form}", total(session))(session.rows()), new, sink)
        if not done.rows:
            raise NoSession(f"{session.path} has no intact message: {session.damage_words or 'it is empty'}")
    click.echo(f"{out}: {sum(done.rows.values())} messages in {len(done.rows)} tables")
    if done.undecoded:
        click.echo(f"{done.undecoded} messages do not fit their schema: they are in `other`, as bytes", err=True)
    for line in done.left_out.words():
        echo_safely(f"in another table than its key says: {line}", err=True)
    for table, count in done.undated.items():
        echo_safely(f"{table}: {form} cannot hold {count} of the times: they are empty", err=True)
    _say_damage(session)


def export_ros2(session: Session, out: Path) -> None:
    """Write a ROS 2 bag."""
    from fleet.recording.tools.ros2 import write_bag  # raises FormatMissing without rosbags

    with atomic_directory(out) as new:
        new.rmdir()  # the writer creates the directory itself
        bag = write_bag(with_progress("export ros2", total(session))(session.rows()), new)
        if not bag.messages:
            why = session.damage_words or "it is empty, or nothing in it is protobuf"
            raise NoSession(f"{session.path} has no message for a bag: {why}")
    click.echo(f"{out}: {bag.messages} messages on {len(bag.topics)} topics")
    for line in bag.left_out.words():
        echo_safely(f"not in the bag: {line}", err=True)
    _say_damage(session)


def export_foxglove(session: Session, out: Path) -> None:
    """Write one MCAP file with one schema per topic, and a layout for the cars of the session."""
    with atomic_directory(out) as new:
        rows = with_progress("export foxglove", total(session))(session.rows())
        done = one_schema.write(rows, session.extras(), new / f"{session.name.removesuffix('.mcap')}.mcap")
        if not done.messages:
            raise NoSession(f"{session.path} has no intact message: {session.damage_words or 'it is empty'}")
        (new / "layout.json").write_text(layout_text(done.cars, done.fleet), encoding="utf-8")
    click.echo(f"{out}: {done.messages} messages on {len(done.schemas)} topics, and a layout to import")
    for line in done.strays.words():
        echo_safely(f"moved to a topic stray/KEY/TYPE: {line}", err=True)
    _say_damage(session)


def _say_damage(session: Session) -> None:
    if session.damage:
        echo_safely(f"only the intact part was exported: {session.damage_words}", err=True)
