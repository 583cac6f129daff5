"""`gateway scan`: lists ports and Bluetooth devices, and listens for cars on the ports.

Sends nothing without `--probe`. `gateway.link` lists the ports, `probe` listens to one.
"""

import argparse
import asyncio
import json
import sys
import time
from collections.abc import Coroutine, Iterator, Sequence
from typing import Any, Final

from msgspec import to_builtins

from gateway.drivers.yahboom.protocol.frames import encode
from gateway.drivers.yahboom.stops.sequences import GENERAL, STOP_REPORT_TIMEOUT_S
from gateway.link import CannotList, Device, kind_of, parse_url
from gateway.tools import cli_support
from gateway.tools.probe import LinkProbe
from schemas.links import KINDS, LINK_HELP, LinkUrl
from schemas.process.stdio import printable
from schemas.process.usb_bus import explain_missing_port
from schemas.suggestion import how_to_install
from schemas.words import LinkVerdict

DESCRIPTION: Final = "List the serial ports and Bluetooth LE devices, and find the cars among them."
EPILOG: Final = """\
examples:
  gateway scan                              list and listen, but send nothing
  gateway scan --json                       print one JSON object per line
  gateway scan --link /dev/ttyUSB0 --probe  also stop the car there, if it is in mode 0

Opening a serial port can reset an Arduino that is on a USB cable. `gateway scan` skips ports that another program uses.
It lists Bluetooth devices without a connection to them. It never searches for TCP cars, because the end of a connection
ends their program. With --probe it sends general stops to every car that it finds and to silent ports. They stop a car
in mode 0. They close no mode: in another mode, most cars ignore them, and a silent car stays silent. It sends nothing
to ports that send other data."""

# Opening its port resets an Arduino, which starts within 2 s. In mode 0 a car reports once a second, and three readings
# show its platform.
DEFAULT_LISTEN_S: Final = 6.0
_MIN_LISTEN_S, _MAX_LISTEN_S = 0.5, 120.0
PROGRESS_INTERVAL_S: Final = 0.5


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    cli_support.describe(parser, DESCRIPTION, EPILOG)
    parser.add_argument("--link", action="append", metavar="URL", help=f"check only this link, such as {LINK_HELP}")
    parser.add_argument(
        "--for",
        dest="listen",
        default=f"{DEFAULT_LISTEN_S:g}s",
        metavar="DURATION",
        help=f"how long to listen (default: {DEFAULT_LISTEN_S:g}s)",
    )
    parser.add_argument(
        "--probe", action="store_true", help="send a stop to cars and to silent ports; it stops cars in mode 0"
    )
    parser.add_argument("--json", action="store_true", help="print one JSON object per line")


def run(arguments: argparse.Namespace) -> int:
    """List the ports and devices, listen to the ports, print the result, and return the exit code."""
    return cli_support.run_command("gateway scan", lambda: _run(arguments))


def _run(arguments: argparse.Namespace) -> None:
    listen_s = cli_support.duration("--for", arguments.listen, _MIN_LISTEN_S, _MAX_LISTEN_S)
    if arguments.link:
        probes = [LinkProbe(url) for url in dict.fromkeys(map(parse_url, arguments.link))]
    else:
        ports = [port for kind in _kinds() if not kind.module for port in kind_of(kind.scheme).ports()]
        probes = [LinkProbe(parse_url(port.device), port) for port in ports]
    for probe in probes:
        cli_support.warn_before_opening(probe.url)
    scan = _Scan(probes, listen_s, probe=arguments.probe, devices=not arguments.link)
    cli_support.run_until_interrupted(scan.run())
    if arguments.json:
        for fields in scan.fields():
            sys.stdout.write(json.dumps(fields) + "\n")
    else:
        for line in scan.lines(cli_support.Paint(sys.stdout)):
            sys.stdout.write(line + "\n")
    failed = [probe for probe in probes if probe.verdict is LinkVerdict.FAILED]
    if arguments.link and failed:
        sys.stdout.flush()
        raise cli_support.Failed(f"could not listen to {', '.join(str(probe.url) for probe in failed)}")


class _Scan:
    """Scans all links and Bluetooth at once."""

    def __init__(self, probes: Sequence[LinkProbe], seconds: float, *, probe: bool, devices: bool) -> None:
        self._probes = probes
        self._seconds = seconds
        self._probe = probe
        self._looks_for_devices = devices
        self._devices: list[tuple[type[LinkUrl], Device]] = []

    async def run(self) -> None:
        """Open, listen, probe and close."""
        try:
            await self._with_progress(self._look(), "opening and listening", self._seconds)
            if self._probe:
                await self._probe_silent()
        finally:
            await asyncio.gather(*(probe.link.close() for probe in self._probes if probe.link is not None))
        for probe in self._probes:
            probe.end()

    async def _look(self) -> None:
        async with asyncio.TaskGroup() as tasks:
            for probe in self._probes:
                tasks.create_task(self._hear(probe))
            for kind in _kinds() if self._looks_for_devices else ():
                tasks.create_task(self._look_for_devices(kind))

    async def _hear(self, probe: LinkProbe) -> None:
        await probe.open()
        if probe.link is not None:
            await probe.listen(self._seconds)

    async def _look_for_devices(self, kind: type[LinkUrl]) -> None:
        try:
            self._devices += [(kind, device) for device in await kind_of(kind.scheme).devices(self._seconds)]
        except ImportError:
            cli_support.print_note(f"{kind.needs} was not searched. Type: {how_to_install(kind.extra)}")
        except CannotList as error:
            cli_support.print_note(str(error))

    async def _probe_silent(self) -> None:
        # Probe also a car that sends readings of mode 0, because they do not show whether it drives.
        probed = [
            probe
            for probe in self._probes
            if probe.trouble is None and probe.verdict in (LinkVerdict.SILENT, LinkVerdict.CAR)
        ]
        if not probed:
            cli_support.print_note("nothing to probe: no open port has a car or is silent")
            return
        frames = ", ".join(encode(step.frame).decode() for step in GENERAL.steps)
        where = ", ".join(str(probe.url) for probe in probed)
        seconds = f"{GENERAL.length_s:g} s"
        cli_support.print_note(f"sending {frames} within {seconds} to {where}: a car there stops if it is in mode 0")
        probing = asyncio.gather(*(probe.probe() for probe in probed))
        await self._with_progress(_all(probing), "probing", GENERAL.length_s + STOP_REPORT_TIMEOUT_S)

    async def _with_progress(self, work: Coroutine[Any, Any, None], what: str, seconds: float) -> None:
        """Run the work. At a terminal, show the remaining time."""
        progress = None
        if sys.stderr.isatty() and seconds > 1:
            progress = asyncio.ensure_future(self._show_progress(what, seconds))
        try:
            await work
        finally:
            if progress is not None:
                progress.cancel()
                sys.stderr.write("\r\x1b[K")
                sys.stderr.flush()

    async def _show_progress(self, what: str, seconds: float) -> None:
        end = time.monotonic() + seconds
        while True:
            links = f"{len(self._probes)} link{'' if len(self._probes) == 1 else 's'}"
            sys.stderr.write(f"\r\x1b[K{what}: {links}, {max(0.0, end - time.monotonic()):.0f} s left")
            sys.stderr.flush()
            await asyncio.sleep(PROGRESS_INTERVAL_S)

    def fields(self) -> Iterator[dict[str, Any]]:
        """Yield one object for each link and device."""
        for probe in self._probes:
            named = {"device": None} if probe.port is None else to_builtins(probe.port)
            url = str(probe.url) if probe.port is None else probe.port.url
            yield {
                "kind": "link" if probe.port is None else "serial",
                **named,
                "url": url,
                "verdict": probe.verdict,
                "words": _words(probe),
                "probed": probe.probed,
                **probe.statistics.fields(),
            }
        for kind, device in self._devices:
            yield {"kind": kind.scheme, **device.fields()}

    def lines(self, paint: cli_support.Paint) -> Iterator[str]:
        """Yield the result as text for a person."""
        if not self._probes:
            yield explain_missing_port() or "no serial port is plugged in"
        for probe in self._probes:
            yield f"{paint('cyan', _name(probe))}"
            yield f"  {_words(probe)}"
            if probe.port is not None:
                yield f"  --link '{probe.port.url}'"
        likely = [device for _, device in self._devices if device.likely]
        for device in likely:
            address, about = device.heading
            yield f"{paint('cyan', address)}  {about}"
            yield f"  likely a car: {device.likely}; not connected to"
            yield f"  --link '{device.url}'"
        if others := len(self._devices) - len(likely):
            yield f"{others} other Bluetooth device{'' if others == 1 else 's'} (--json lists them)"


def _kinds() -> Iterator[type[LinkUrl]]:
    """Yield one kind of link of each scheme."""
    yield from {kind.scheme: kind for kind in KINDS}.values()


async def _all(probing: "asyncio.Future[list[None]]") -> None:
    await probing


def _name(probe: LinkProbe) -> str:
    if probe.port is None:
        return str(probe.url)
    usb = f"{probe.port.vid}:{probe.port.pid}" if probe.port.vid else ""
    number = f"serial number {printable(probe.port.serial_number)}" if probe.port.serial_number else ""
    about = ", ".join(part for part in (printable(probe.port.description), usb, number) if part)
    return f"{probe.port.device}  {about}".rstrip()


def _words(probe: LinkProbe) -> str:
    """Return the verdict on a link for a person."""
    match probe.verdict:
        case LinkVerdict.CAR:
            after = "; it answered the probe in mode 0" if probe.probed and probe.answered else ""
            gone = f"; then: {probe.trouble}" if probe.trouble else ""
            return f"a car: {probe.statistics.words()}{after}{gone}"
        case LinkVerdict.OTHER:
            return f"no car: {probe.statistics.words()}"
        case LinkVerdict.SILENT if probe.probed:
            return "silent, even after the probe: no car, or the car is off, hangs, is in a silent mode or runs its fan"
        case LinkVerdict.SILENT:
            return "silent: no car, or the car is off or in a silent mode, or its fan runs"
        case LinkVerdict.BUSY:
            return "in use by another program (its gateway?), so it was not listened to"
        case LinkVerdict.FAILED:
            return str(probe.trouble)
