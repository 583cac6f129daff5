"""Runs `gateway scan` as a process, to find links that may be cars."""

import json
import subprocess
import sys
from collections.abc import Mapping, Sequence
from typing import Any, Final

from msgspec import Struct

from fleet.fleet_links import parse_fleet_link
from schemas.links import SerialUrl, UsbUrl
from schemas.platform_name import AUTO
from schemas.process.stdio import printable
from schemas.words import LinkVerdict, Platform

LIKELY_VERDICTS: Final = (LinkVerdict.CAR, "ble", "given")
POSSIBLE_VERDICTS: Final = (*LIKELY_VERDICTS, LinkVerdict.SILENT, LinkVerdict.BUSY)
"""Verdicts on links that may be cars. A scan receives nothing from a car that is off or silent, or that has a
gateway. `ble`: a Bluetooth device with the service of a car's module. `given`: typed by the user and not scanned."""


class ScanFailed(Exception):
    """`gateway scan` failed, and has said why on stderr."""


class FoundLink(Struct, frozen=True):
    """A link that may be a car. `verdict` is one of POSSIBLE_VERDICTS. `platform` is detected, or `auto`."""

    url: str
    verdict: str
    words: str
    platform: str = AUTO


def scan(links: Sequence[str], seconds: float | None) -> list[FoundLink]:
    """Scan these links, or all ports and Bluetooth devices, for cars. Raises ScanFailed if the scan cannot run.

    Typed TCP and Bluetooth links are not scanned, because closing a TCP connection may end the car's program.
    """
    given = [link for link in links if not isinstance(parse_fleet_link(link), SerialUrl | UsbUrl)]
    taken = [FoundLink(link, "given", "not listened to") for link in dict.fromkeys(given)]
    links = [link for link in links if link not in given]
    if taken and not links:
        return taken
    command = [sys.executable, "-m", "gateway.cli", "scan", "--json"]
    command += [word for link in links for word in ("--link", link)]
    if seconds is not None:
        command += ["--for", f"{seconds:g}s"]
    done = subprocess.run(command, stdout=subprocess.PIPE, stderr=None, text=True, check=False)
    if done.returncode == 130:
        raise KeyboardInterrupt
    if done.returncode and not (links and done.returncode == 1):  # 1: one of the links could not be listened to
        raise ScanFailed("`fleet scan` could not look, see above")
    found = [_found(json.loads(line)) for line in done.stdout.splitlines()]
    return [*(each for each in found if each.verdict in POSSIBLE_VERDICTS), *taken]


def _found(fields: Mapping[str, Any]) -> FoundLink:
    if "verdict" not in fields:  # a device that advertises itself, and is not listened to
        words = f"Bluetooth device {printable(fields['name']) or 'without a name'}, {fields['rssi']} dBm"
        return FoundLink(fields["url"], "ble" if fields["uart"] else LinkVerdict.OTHER, words)
    settled = fields["platform"] if fields["platform"] in set(Platform) - {Platform.UNKNOWN} else AUTO
    return FoundLink(fields["url"], fields["verdict"], printable(fields["words"]), settled)
