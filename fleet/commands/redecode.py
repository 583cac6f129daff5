"""`fleet sessions redecode` decodes recorded frames again. `fleet sessions vector` makes a test vector of them."""

import json
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from fleet.commands.car_names import car_option
from fleet.commands.options import from_option, json_option, to_option
from fleet.commands.output import echo_safely, with_progress
from fleet.commands.params import session_argument
from fleet.commands.session_part import part_of
from schemas import keys

if TYPE_CHECKING:
    from fleet.recording.reading.session import Session
    from fleet.replay.analysis.recorded_frames import Item
    from fleet.replay.analysis.redecode import Counts, ReadingDifference


@click.command(
    epilog="""\b
examples:
  fleet sessions redecode
  fleet sessions redecode tests/vectors/recorded/tracking.jsonl

Exit codes: 0 no differences, 1 differences, or nothing to decode."""
)
@session_argument
@car_option
@click.option(
    "--platform",
    metavar="PLATFORM",
    help="Use this platform instead of the recorded one: arduino, raspberry_pi, stm32+imu.",
)
@json_option
def redecode(session: Path, cars: tuple[str, ...], platform: str | None, *, as_json: bool) -> None:
    """Decode the recorded raw bytes with this version, and list the differences from the recorded readings.

    SESSION may also be a vector that `fleet sessions vector` made. Decoding uses the recorded platform and mode.
    """
    from fleet.recording.reading.session import NoSession
    from fleet.replay.analysis.redecode import NoPlatform
    from fleet.replay.analysis.vector_file import ENDING, BadVector
    from gateway import drivers

    if platform is not None:
        try:
            decodes = drivers.family_name(platform) == drivers.YAHBOOM
            drivers.profile_of(platform)
        except ValueError as error:
            raise click.UsageError(f"--platform: {error}") from None
        if not decodes:
            raise click.UsageError(f"--platform: frames of {platform} cars are not decoded again, only `$...#` frames")
    try:
        found = _RedecodeReport(session, cars, platform)
        if session.suffix == ENDING:
            found.of_vector()
        else:
            found.of_session()
        differences = 0
        for each in found.differences():
            differences += 1
            echo_safely(json.dumps(_fields(each, found.start_ns)) if as_json else _line(each, found.start_ns))
    except (NoSession, NoPlatform, BadVector) as error:
        raise click.ClickException(str(error)) from None
    except OSError as error:
        raise click.ClickException(f"{session} cannot be read: {error.strerror or error}") from None
    found.report(differences, as_json=as_json)
    raise SystemExit(1 if differences else 0)


class _RedecodeReport:
    """One run of `fleet sessions redecode`: the source of the frames, and the result."""

    def __init__(self, path: Path, cars: tuple[str, ...], platform: str | None) -> None:
        from fleet.replay.analysis.recorded_frames import SkippedMessages

        self._path = path
        self._cars = cars
        self._platform = platform
        self._items: Iterable[tuple[str, Item]] = ()
        self._session: Session | None = None
        self._unread: SkippedMessages = SkippedMessages()
        self.counts: dict[str, Counts] = {}
        self.start_ns = 0

    def of_vector(self) -> None:
        """Read frames from a vector. Raises BadVector, OSError."""
        from fleet.replay.analysis.vector_file import read

        car, items = read(self._path)
        self._items = ((car, item) for item in items)

    def of_session(self) -> None:
        """Read frames from a session. Raises NoSession."""
        from fleet.recording.reading.session import Session
        from fleet.recording.tools.summary import of_session as overview
        from fleet.replay.analysis.recorded_frames import FRAME_KEYS, of_session

        self._session = session = Session(self._path)
        part_of(session, None, None, self._cars)  # raises for unknown cars
        self.start_ns = overview(session).start_ns
        expressions = [f"*/{car}/{key.split('/', 2)[2]}" for car in self._cars or ("*",) for key in FRAME_KEYS]
        self._items = of_session(with_progress("redecode", None)(session.messages(keys=expressions)), self._unread)

    def differences(self) -> Iterator["ReadingDifference"]:
        """Yield the differences. Raises NoPlatform, and ClickException if there is nothing to decode."""
        from fleet.replay.analysis.redecode import Redecoding

        running: dict[str, Redecoding] = {}
        for car, item in self._items:
            if self._cars and car not in self._cars:
                continue
            if car not in running:
                running[car] = Redecoding(car, self._platform)
            yield from running[car].take(item)
        for one in running.values():
            yield from one.end()
        self.counts = {car: one.counts for car, one in sorted(running.items()) if one.counts.frames}
        if not self.counts:
            whose = f" of {', '.join(self._cars)}" if self._cars else ""
            damage = f" ({self._session.damage_words})" if self._session is not None and self._session.damage else ""
            raise click.ClickException(
                f"{self._path} has no raw frames{whose} (keys FLEET/CAR/frame/rx): nothing to decode{damage}"
            )

    def report(self, differences: int, *, as_json: bool) -> None:
        """Print the numbers of compared and skipped frames and readings."""
        frames = sum(each.frames for each in self.counts.values())
        readings = sum(each.readings for each in self.counts.values())
        undecided = sum(each.undecided for each in self.counts.values())
        absent = sum(each.absent for each in self.counts.values())
        broken = sum(self._unread.broken.values())
        damage = self._session.damage_words if self._session is not None else ""
        if as_json:
            summary: dict[str, Any] = {"differences": differences, "cars": list(self.counts), "frames": frames}
            summary |= {"readings": readings, "undecided": undecided, "absent": absent}
            click.echo(json.dumps(summary | {"unframed": self._unread.unframed, "broken": broken, "damage": damage}))
            return
        found = f"{differences} differences" if differences else "no difference"
        echo_safely(f"{self._path}: {frames} frames and {readings} readings of {', '.join(self.counts)}: {found}")
        notes = {
            "frames have several possible readings; the recorded one is among them": undecided,
            "published readings are not in the recording (see fleet sessions verify): not compared": absent,
            "readings have no raw frame in the recording: not compared": self._unread.unframed,
            "messages do not match their schema: skipped": broken,
        }
        for words, count in notes.items():
            if count:
                echo_safely(f"{count} {words}", err=True)
        if damage:
            echo_safely(f"only the intact part was decoded: {damage}", err=True)


def _line(each: "ReadingDifference", start_ns: int) -> str:
    text = each.data.decode("latin-1").encode("unicode_escape").decode("ascii")
    at = f"{(each.at_ns - start_ns) / 1e9:+.3f}s"
    return f"{each.car} {at} {text}: {each.what} was {_format_value(each.then)}, is now {_format_value(each.now)}"


def _format_value(value: Any) -> str:
    if isinstance(value, tuple):
        return " ".join(map(str, value)) or "nothing"
    return "not measured" if value is None else str(value)


def _fields(each: "ReadingDifference", start_ns: int) -> dict[str, Any]:
    return {
        "car": each.car,
        "at_s": (each.at_ns - start_ns) / 1e9,
        "frame": each.data.decode("latin-1"),
        "what": each.what,
        "then": each.then,
        "now": each.now,
    }


@click.command(epilog="\b\nexample:\n  fleet sessions vector --car red --from 10s --to 20s --out tracking.jsonl\n")
@session_argument
@click.option(
    "--car",
    required=True,
    metavar="CAR",
    callback=lambda _ctx, _param, value: keys.check_name(value),
    help="Use the frames of this car.",
)
@from_option
@to_option
@click.option(
    "-o",
    "--out",
    required=True,
    type=click.Path(path_type=Path, dir_okay=False),
    metavar="FILE.jsonl",
    help="Write the vector to this file, which must not exist.",
)
@click.option("--source", metavar="WORDS", help="Say where the frames are from (default: the session and the car).")
def vector(session: Path, car: str, start: str | None, end: str | None, out: Path, source: str | None) -> None:
    """Write a part of a session as a test vector: raw frames with their times, and the decoded readings.

    `fleet sessions redecode FILE.jsonl` compares the vector with this version's decoder.
    """
    from fleet.recording.reading.session import NoSession, Session
    from fleet.recording.tools.summary import of_session as overview
    from fleet.replay.analysis import vector_file
    from fleet.replay.analysis.recorded_frames import FRAME_KEYS, Rx, SkippedMessages, of_session

    if out.suffix != vector_file.ENDING:
        raise click.UsageError(f"--out {out}: a vector's name ends in {vector_file.ENDING}")
    try:
        found = Session(session)
        part = part_of(found, start, end, (car,))
        about = overview(found)
    except NoSession as error:
        raise click.ClickException(str(error)) from None
    expressions = [f"*/{car}/{key.split('/', 2)[2]}" for key in FRAME_KEYS]
    before_ns = None if part.start_ns is None else part.start_ns - vector_file.BEFORE_NS
    after_ns = None if part.end_ns is None else part.end_ns + vector_file.BEFORE_NS
    recorded = of_session(found.messages(expressions, before_ns, after_ns), SkippedMessages())
    items = [*vector_file.select_range((item for _, item in recorded), part.start_ns or 0, part.end_ns)]
    frames = sum(isinstance(item, Rx) for item in items)
    if not frames:
        raise click.ClickException(f"{session} has no raw frames of {car} there: a vector would be empty")
    try:
        with out.open("x", encoding="utf-8") as file:
            file.writelines(
                f"{line}\n"
                for line in vector_file.lines(
                    items, part.start_ns or about.start_ns, car, source or f"{found.name}, {car}"
                )
            )
    except FileExistsError:
        raise click.UsageError(f"--out {out} exists already. Name a new file.") from None
    except OSError as error:
        raise click.ClickException(f"{out} cannot be written: {error.strerror}") from None
    echo_safely(f"{out}: {frames} frames")
    if found.damage:
        echo_safely(f"only the intact part was used: {found.damage_words}", err=True)
