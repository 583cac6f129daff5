"""`gateway scan`: what there is that could be a car, and which of it speaks as a car does.

It opens serial ports and listens; it sends nothing unless asked to (`--probe`). What there is, `candidates` lists.
"""

import argparse
import asyncio
import json
import sys
import time
from collections.abc import Coroutine, Iterator, Sequence
from dataclasses import asdict
from typing import Any, Final

from gateway.control.stops.sequences import STOP_REPORT_TIMEOUT_S, UNKNOWN
from gateway.link import parse_url
from gateway.protocol.frames import encode
from gateway.tools import cli_support
from gateway.tools.discovery import BleDevice, NoBluetooth, ble_devices, serial_ports
from gateway.tools.probe import LinkProbe, LinkVerdict

DESCRIPTION: Final = "The serial ports and Bluetooth LE devices there are, and which of them speak as a car does."
EPILOG: Final = """\
examples:
  gateway scan                              list and listen; nothing is sent
  gateway scan --json                       one JSON object a line
  gateway scan --link /dev/ttyUSB0 --probe  stop what is there, and ask it if it is silent

Opening a serial port can reset an Arduino that is on a USB cable. A port that another program has is left alone.
Bluetooth devices are only listed, not connected to. A TCP car is never looked for: the connection ends its program.
--probe stops every car that it finds and closes whatever mode it is in. Ports that send something else are not
probed."""

SECONDS: Final = 6.0
"""An Arduino that was reset by opening its port has started after two; in mode 0 a car reports once in one, and three
readings show its platform."""
_LEAST_S, _MOST_S = 0.5, 120.0
_TICK_S: Final = 0.5


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    cli_support.describe(parser, DESCRIPTION, EPILOG)
    parser.add_argument(
        "--link", action="append", metavar="URL", help=f"look at this link, and at no other; {cli_support.LINK_HELP}"
    )
    parser.add_argument(
        "--seconds", type=float, default=SECONDS, metavar="S", help=f"how long to listen (default {SECONDS:g})"
    )
    parser.add_argument("--probe", action="store_true", help="send cars and silent ones an unknown car's stop")
    parser.add_argument("--json", action="store_true", help="one JSON object a line")


def run(arguments: argparse.Namespace) -> int:
    """Look, listen, tell; the exit code."""
    return cli_support.explained("gateway scan", lambda: _run(arguments))


def _run(arguments: argparse.Namespace) -> None:
    if not _LEAST_S <= arguments.seconds <= _MOST_S:
        raise cli_support.WrongUse(f"--seconds {arguments.seconds:g}: a number from {_LEAST_S:g} to {_MOST_S:g}")
    if arguments.link:
        ears = [LinkProbe(url) for url in dict.fromkeys(map(parse_url, arguments.link))]
    else:
        ears = [LinkProbe(parse_url(port.device), port) for port in serial_ports()]
    for ear in ears:
        cli_support.warn_of(ear.url)
    scan = _Scan(ears, arguments.seconds, probe=arguments.probe, bluetooth=not arguments.link)
    cli_support.run_until_interrupted(scan.run())
    if arguments.json:
        for fields in scan.fields():
            sys.stdout.write(json.dumps(fields) + "\n")
    else:
        for line in scan.lines(cli_support.Paint(sys.stdout)):
            sys.stdout.write(line + "\n")
    failed = [ear for ear in ears if ear.verdict is LinkVerdict.FAILED]
    if arguments.link and failed:
        sys.stdout.flush()
        raise cli_support.Failed(f"could not listen to {', '.join(str(ear.url) for ear in failed)}")


class _Scan:
    """All links at once, and Bluetooth meanwhile."""

    def __init__(self, ears: Sequence[LinkProbe], seconds: float, *, probe: bool, bluetooth: bool) -> None:
        self._ears = ears
        self._seconds = seconds
        self._probe = probe
        self._bluetooth = bluetooth
        self._devices: list[BleDevice] = []

    async def run(self) -> None:
        """Open, listen, probe, close."""
        try:
            await self._with_progress(self._look(), "opening and listening", self._seconds)
            if self._probe:
                await self._probe_silent()
        finally:
            await asyncio.gather(*(ear.link.close() for ear in self._ears if ear.link is not None))
        for ear in self._ears:
            ear.end()

    async def _look(self) -> None:
        async with asyncio.TaskGroup() as tasks:
            for ear in self._ears:
                tasks.create_task(self._hear(ear))
            if self._bluetooth:
                tasks.create_task(self._look_for_devices())

    async def _hear(self, ear: LinkProbe) -> None:
        await ear.open()
        if ear.link is not None:
            await ear.listen(self._seconds)

    async def _look_for_devices(self) -> None:
        try:
            self._devices = await ble_devices(self._seconds)
        except NoBluetooth as error:
            cli_support.note(str(error))

    async def _probe_silent(self) -> None:
        # A car in mode 0, too: its readings do not tell whether it drives.
        asked = [
            ear for ear in self._ears if ear.trouble is None and ear.verdict in (LinkVerdict.SILENT, LinkVerdict.CAR)
        ]
        if not asked:
            cli_support.note("nothing to probe: nothing is open, or what is sends something else")
            return
        frames = ", ".join(encode(step.frame).decode() for step in UNKNOWN.steps)
        where = ", ".join(str(ear.url) for ear in asked)
        seconds = f"{UNKNOWN.length_s:g} s"
        cli_support.note(f"sending {frames} within {seconds} to {where}: a car there stops, and goes to mode 0")
        probing = asyncio.gather(*(ear.probe() for ear in asked))
        await self._with_progress(_all(probing), "probing", UNKNOWN.length_s + STOP_REPORT_TIMEOUT_S)

    async def _with_progress(self, work: Coroutine[Any, Any, None], what: str, seconds: float) -> None:
        """Tell a person at a terminal how long it may still take."""
        showing = asyncio.ensure_future(self._show(what, seconds)) if sys.stderr.isatty() and seconds > 1 else None
        try:
            await work
        finally:
            if showing is not None:
                showing.cancel()
                sys.stderr.write("\r\x1b[K")
                sys.stderr.flush()

    async def _show(self, what: str, seconds: float) -> None:
        end = time.monotonic() + seconds
        while True:
            links = f"{len(self._ears)} link{'' if len(self._ears) == 1 else 's'}"
            sys.stderr.write(f"\r\x1b[K{what}: {links}, {max(0.0, end - time.monotonic()):.0f} s left")
            sys.stderr.flush()
            await asyncio.sleep(_TICK_S)

    def fields(self) -> Iterator[dict[str, Any]]:
        """One object for each link and device."""
        for ear in self._ears:
            named = {"device": None} if ear.port is None else asdict(ear.port)
            url = str(ear.url) if ear.port is None else ear.port.url
            yield {
                "kind": "link" if ear.port is None else "serial",
                **named,
                "url": url,
                "verdict": ear.verdict,
                "words": _words(ear),
                "probed": ear.probed,
                **ear.tally.fields(),
            }
        for device in self._devices:
            yield {"kind": "ble", **asdict(device)}

    def lines(self, paint: cli_support.Paint) -> Iterator[str]:
        """For a person."""
        if not self._ears:
            yield "no serial port is plugged in"
        for ear in self._ears:
            yield f"{paint('cyan', _name(ear))}"
            yield f"  {_words(ear)}"
            if ear.port is not None:
                yield f"  --link '{ear.port.url}'"
        likely = [device for device in self._devices if device.uart is not None]
        for device in likely:
            yield f"{paint('cyan', device.address)}  {_safe(device.name) or 'no name'}, {device.rssi} dBm"
            yield f"  likely a car: it has the Bluetooth service {device.uart}; not connected to"
            yield f"  --link '{device.url}'"
        if others := len(self._devices) - len(likely):
            yield f"{others} other Bluetooth device{'' if others == 1 else 's'} (--json lists them)"


async def _all(probing: "asyncio.Future[list[None]]") -> None:
    await probing


def _name(ear: LinkProbe) -> str:
    if ear.port is None:
        return str(ear.url)
    usb = f"{ear.port.vid}:{ear.port.pid}" if ear.port.vid else ""
    number = f"serial number {_safe(ear.port.serial_number)}" if ear.port.serial_number else ""
    about = ", ".join(part for part in (_safe(ear.port.description), usb, number) if part)
    return f"{ear.port.device}  {about}".rstrip()


def _safe(text: str | None) -> str:
    """Text that a device has chosen, without what would change a terminal."""
    return "".join(each for each in text or "" if each.isprintable())


def _words(ear: LinkProbe) -> str:
    """What a link is, for a person."""
    match ear.verdict:
        case LinkVerdict.CAR:
            after = "; it answered the probe in mode 0" if ear.probed and ear.answered else ""
            gone = f"; then: {ear.trouble}" if ear.trouble else ""
            return f"a car: {ear.tally.words()}{after}{gone}"
        case LinkVerdict.OTHER:
            return f"no car: {ear.tally.words()}"
        case LinkVerdict.SILENT if ear.probed:
            return "silent, also when probed: no car, one that is off or wedged, or its fan runs"
        case LinkVerdict.SILENT:
            return "silent: no car, one that is off, in a silent mode, or with its fan on (--probe asks it)"
        case LinkVerdict.BUSY:
            return "in use by another program (its gateway?): not listened to"
        case LinkVerdict.FAILED:
            return str(ear.trouble)
