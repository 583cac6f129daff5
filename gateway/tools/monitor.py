"""`gateway monitor`: prints a car's bytes beside their decoded readings, live or from a file. Sends nothing.

`MonitorOutput` prints the events; `link_statistics` describes and counts them.
"""

import argparse
import asyncio
import json
import sys
import time
from collections.abc import Iterator, Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Final

from gateway import capture
from gateway.control.driver import Rejected
from gateway.drivers.yahboom.protocol.frame_splitter import FrameSplitter
from gateway.drivers.yahboom.protocol.platforms import Profile
from gateway.drivers.yahboom.protocol.wire_events import Event
from gateway.link import Link, LinkLost, LinkUrl, open_link, parse_url
from gateway.tools import cli_support
from gateway.tools.link_statistics import LinkStatistics, describe
from schemas.links import LINK_HELP
from schemas.words import FrameVerdict, Platform

DESCRIPTION: Final = "Show what a car sends until Ctrl-C: the decoded readings beside the raw bytes. Send nothing."
EPILOG: Final = """\
examples:
  gateway monitor --link /dev/ttyUSB0 --platform arduino
  gateway monitor --link /dev/ttyUSB0 --raw morning.jsonl       save the bytes with their times
  gateway monitor --from morning.jsonl --json                   show them again

A line shows only the values that the car measures in the mode of the frame. The other values of a frame are filler.
Times are seconds since the start. Opening a serial port can reset an Arduino that is on a USB cable. It sends again
after about three seconds."""

_RAW_WIDTH: Final = 46  # a sensors frame in its longest observed spelling


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    cli_support.describe(parser, DESCRIPTION, EPILOG)
    source = parser.add_mutually_exclusive_group(required=True)
    source.add_argument("--link", metavar="URL", help=LINK_HELP)
    source.add_argument("--from", dest="file", type=Path, metavar="FILE", help="show a file that --raw wrote")
    parser.add_argument(
        "--platform", default=Platform.UNKNOWN, help=cli_support.PLATFORM_HELP + ". It decides which values are filler"
    )
    parser.add_argument("--raw", type=Path, metavar="FILE", help="save the bytes with their times in a new file")
    parser.add_argument("--json", action="store_true", help="print one JSON object per event, and a summary at the end")


def run(arguments: argparse.Namespace) -> int:
    """Listen until Ctrl-C, or read the file, and return the exit code."""
    return cli_support.run_command("gateway monitor", lambda: _run(arguments))


def _run(arguments: argparse.Namespace) -> None:
    lines = MonitorOutput(cli_support.profile_of(arguments.platform), as_json=arguments.json)
    if arguments.file is None:
        _run_live(parse_url(arguments.link), arguments.raw, lines)
        return
    if arguments.raw is not None:
        raise cli_support.WrongUse("--raw saves the bytes of a --link. The bytes of --from are in a file already.")
    lines.begin(0.0)
    for piece in _pieces(arguments.file):
        lines.feed(piece)
    lines.end()


def _pieces(path: Path) -> Iterator[capture.CapturedBytes]:
    pieces = capture.read(path)
    while True:
        try:
            piece = next(pieces, None)
        except OSError as error:
            raise cli_support.WrongUse(f"{path}: the file cannot be read: {error.strerror}") from None
        if piece is None:
            return
        yield piece


def _run_live(url: LinkUrl, raw: Path | None, lines: "MonitorOutput") -> None:
    writer = None if raw is None else _new_capture(raw, url)
    cli_support.warn_before_opening(url)
    origin = time.monotonic()
    try:
        cli_support.run_until_interrupted(_live(url, lines, writer, origin))
    except (LinkLost, cli_support.Failed, KeyboardInterrupt):
        lines.end(time.monotonic() - origin)
        raise
    finally:
        if writer is not None and lines.statistics.since is None:
            writer.discard()
        elif writer is not None:
            writer.close()
            cli_support.print_note(f"the bytes are in {writer.path}")


def _new_capture(path: Path, url: LinkUrl) -> capture.CaptureWriter:
    try:
        return capture.CaptureWriter(path, str(url), datetime.now(UTC).isoformat(timespec="milliseconds"))
    except FileExistsError:
        raise cli_support.WrongUse(f"{path} exists already and is not overwritten: name another file") from None
    except OSError as error:
        raise cli_support.WrongUse(f"{path}: the file cannot be made: {error.strerror}") from None


async def _live(url: LinkUrl, lines: "MonitorOutput", writer: capture.CaptureWriter | None, origin: float) -> None:
    link = await open_link(url)
    try:
        lines.begin(time.monotonic() - origin)
        await _listen(link, lines, writer, origin)
    finally:
        await link.close()


async def _listen(link: Link, lines: "MonitorOutput", writer: capture.CaptureWriter | None, origin: float) -> None:
    reading = asyncio.ensure_future(link.read())
    try:
        while True:
            deadline = lines.deadline()
            timeout = None if deadline is None else max(0.0, deadline - (time.monotonic() - origin))
            done, _ = await asyncio.wait([reading], timeout=timeout)
            # Round as in the file, so that the file is decoded in the same way.
            now = round(time.monotonic() - origin, 6)
            if not done:
                lines.flush(now)
                continue
            piece = capture.CapturedBytes(now, reading.result())
            reading = asyncio.ensure_future(link.read())
            if writer is not None:
                _add(writer, piece)
            lines.feed(piece)
    finally:
        reading.cancel()


def _add(writer: capture.CaptureWriter, piece: capture.CapturedBytes) -> None:
    try:
        writer.add(piece)
    except OSError as error:
        raise cli_support.Failed(f"{writer.path}: the file cannot be written: {error.strerror}") from None


class MonitorOutput:
    """Prints a line for each event of one link's bytes, as text or JSON, and a summary at the end."""

    def __init__(self, profile: Profile, *, as_json: bool) -> None:
        self._profile = profile
        self._as_json = as_json
        self._decoder = FrameSplitter(head=profile.dialect.head)
        self._paint = cli_support.Paint(sys.stdout)
        self.statistics = LinkStatistics()

    def begin(self, at: float) -> None:
        """Start the statistics when the link is open. Times are seconds since the start."""
        self.statistics.since = at

    def feed(self, piece: capture.CapturedBytes) -> None:
        """Print the events that these bytes complete. Raises OSError if the output is closed."""
        self.statistics.bytes += len(piece.data)
        self.statistics.until = piece.at
        self._print(self._decoder.feed(piece.data, piece.at))

    def flush(self, now: float) -> None:
        """Print the events that silence completes."""
        self._print(self._decoder.flush(now))

    def deadline(self) -> float | None:
        """Return the time at which to call `flush`."""
        return self._decoder.deadline()

    def end(self, at: float | None = None) -> None:
        """Print the last events and the summary. Print nothing if the link was never open."""
        if self.statistics.since is None:
            return
        self._print(self._decoder.end())
        if at is not None:
            self.statistics.until = at
        if self._as_json:
            sys.stdout.write(json.dumps({"kind": "summary", **self.statistics.fields()}) + "\n")
            sys.stdout.flush()
        else:
            sys.stderr.write(self.statistics.words() + "\n")

    def _print(self, events: Sequence[Event]) -> None:
        for event in events:
            self.statistics.count(event, self._profile)
            fields = describe(event, self._profile)
            line = self._json(event, fields) if self._as_json else self._text(event, fields)
            sys.stdout.write(line + "\n")
        if events:
            sys.stdout.flush()

    def _json(self, event: Event, fields: dict[str, Any]) -> str:
        return json.dumps({"t": round(event.at, 6), **fields, "raw": event.raw.decode("latin-1")})

    def _text(self, event: Event, fields: dict[str, Any]) -> str:
        raw = cli_support.printable(event.raw)
        at = self._paint("dim", f"{event.at:9.3f}")
        # Bytes that do not fit their column get a line of their own and are never truncated.
        gap = " " * (_RAW_WIDTH - len(raw)) if len(raw) <= _RAW_WIDTH else "\n" + " " * (_RAW_WIDTH + 11)
        color = (
            "red" if isinstance(event, Rejected) else "yellow" if {"rejected", "contradicts"} & fields.keys() else ""
        )
        words = "  ".join(_words(fields))
        return f"{at}  {raw}{gap}  {self._paint(color, words) if color else words}"


def _words(fields: dict[str, Any]) -> Iterator[str]:
    """Yield the fields for a person, without the kind of a sensors frame."""
    for name, value in fields.items():
        match name:
            case "kind":
                if value not in (FrameVerdict.SENSORS, "rejected"):
                    yield value
            case "no_echo":
                yield "no echo"
            case "range_m":
                yield f"{value:.2f} m"
            case "voltage_v":
                yield f"{value:.2f} V"
            case "modes":
                yield f"({' or '.join(value)})"
            case "cause":
                yield f"rejected, {value}:"
            case "detail":
                yield value
            case "rejected":
                yield "rejected: " + ", ".join(word + text for word, text in value.items())
            case "contradicts":
                yield "contradicts the platform"
            case _:
                yield f"{name} {' '.join(f'{item:g}' for item in value) if isinstance(value, list) else value}"
