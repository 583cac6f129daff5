"""What `gateway scan` finds, run as a process, and a fleet file written of it."""

import json
import subprocess
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final

from fleet.links import LinkKind, parse_link
from gateway.protocol.platforms import AUTO, Platform

LIKELY: Final = ("car", "ble", "given")
POSSIBLE: Final = (*LIKELY, "silent", "busy")
"""Verdicts of what may be a car: one that is off, in a silent mode, or served already, says nothing to a scan.

`ble`: has the service of a car's module. `given`: was not listened to."""
SCHEMA_URL: Final = "fleet.schema.json"


class ScanFailed(Exception):
    """`gateway scan` could not look; the text is what it said."""


@dataclass(frozen=True, slots=True)
class FoundLink:
    """A link that may be a car's. verdict: of `POSSIBLE`. platform: as it was told from readings, else `auto`."""

    url: str
    verdict: str
    words: str
    platform: str = AUTO


@dataclass(frozen=True, slots=True)
class NewCar:
    """A car as a new file has it."""

    name: str
    link: str
    platform: str
    colour: str
    words: str = ""


def scan(links: Sequence[str], seconds: float | None) -> list[FoundLink]:
    """What may be a car: of these links, or of all ports and Bluetooth devices; raises ScanFailed.

    TCP and Bluetooth links are taken as they are given: where a TCP connection ends, a car's program may end, too.
    """
    given = [link for link in links if parse_link(link).kind not in (LinkKind.DEVICE, LinkKind.USB)]
    taken = [FoundLink(link, "given", "not listened to") for link in dict.fromkeys(given)]
    links = [link for link in links if link not in given]
    if taken and not links:
        return taken
    command = [sys.executable, "-m", "gateway.cli", "scan", "--json"]
    command += [word for link in links for word in ("--link", link)]
    command += [] if seconds is None else ["--seconds", f"{seconds:g}"]
    done = subprocess.run(command, stdout=subprocess.PIPE, stderr=None, text=True, check=False)
    if done.returncode == 130:
        raise KeyboardInterrupt
    if done.returncode and not (links and done.returncode == 1):  # 1: one of the links could not be listened to
        raise ScanFailed("`gateway scan` could not look, see above")
    found = [_found(json.loads(line)) for line in done.stdout.splitlines()]
    return [*(each for each in found if each.verdict in POSSIBLE), *taken]


def _found(fields: Mapping[str, Any]) -> FoundLink:
    if fields["kind"] == "ble":
        words = f"Bluetooth device {_printable(fields['name']) or 'without a name'}, {fields['rssi']} dBm"
        return FoundLink(fields["url"], "ble" if fields["uart"] else "other", words)
    settled = fields["platform"] if fields["platform"] in set(Platform) - {Platform.UNKNOWN} else AUTO
    return FoundLink(fields["url"], fields["verdict"], _printable(fields["words"]), settled)


def _printable(text: str | None) -> str:
    """Text that a device has chosen, for one line of a terminal or a file."""
    return "".join(each for each in text or "" if each.isprintable())


def quoted(text: str) -> str:
    """A scalar that YAML takes back as this text, whatever is in it."""
    return json.dumps(text, ensure_ascii=False)


def key(name: str) -> str:
    """A car's name as a key that YAML takes for a word: `10` would be a number, `null` nothing."""
    return name if name[0].isalpha() and name not in ("null", "true", "false") else quoted(name)


def new_file(cars: Sequence[NewCar], name: str) -> str:
    """The text of a fleet file with these cars."""
    lines = [
        f"# yaml-language-server: $schema={SCHEMA_URL}",
        "# A fleet of cars. `fleet check` looks whether it is right and the cars are there, `fleet up` starts it,",
        "# `fleet schema > fleet.schema.json` lets an editor help.",
        f"name: {quoted(name)}",
        "# plan: plan.yaml           # what the cars shall do; `fleet plan check plan.yaml`",
        "# recordings: sessions      # where `fleet up` records; record: false to leave it",
        "",
        "defaults:                   # for every car; a car may say otherwise",
        "  limits:",
        "    longest_drive_s: 10     # a drive ends by then, whoever asked for it",
        "    # on_battery_low: warn  # or refuse, stop",
        "",
        "cars:",
    ]
    for car in cars:
        about = car.words.partition(":")[0]
        lines.append(f"  {key(car.name)}:" + (f"  # {about}" if about else ""))
        lines.append(f"    link: {quoted(car.link)}")
        lines.append(f"    platform: {car.platform}" + ("  # its gateway finds out" if car.platform == AUTO else ""))
        lines.append(f"    colour: {quoted(car.colour)}")
        lines.append("    # roles: [patrol]       # of the plan; left out: any")
    return "\n".join(lines) + "\n"
