"""Runs `gateway scan` as a process, and writes a fleet file from its results."""

import json
import re
import subprocess
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final

from fleet.fleetfile.fleet_file import default_color
from fleet.links import parse_fleet_link
from gateway.protocol.platforms import AUTO, Platform
from schemas.links import SerialUrl, UsbUrl

LIKELY_VERDICTS: Final = ("car", "ble", "given")
POSSIBLE_VERDICTS: Final = (*LIKELY_VERDICTS, "silent", "busy")
"""Verdicts on links that may be a car's: a scan receives nothing from a car that is off, silent or served already.

`ble`: a Bluetooth device with the service of a car's module. `given`: typed by the user and not scanned."""
SCHEMA_URL: Final = "https://raw.githubusercontent.com/zenoh-car-fleet/zenoh-car-fleet/main/deploy/{}.schema.json"


class ScanFailed(Exception):
    """`gateway scan` failed; the text says why."""


@dataclass(frozen=True, slots=True)
class FoundLink:
    """A link that may be a car's. verdict: one of POSSIBLE_VERDICTS. platform: detected from readings, or `auto`."""

    url: str
    verdict: str
    words: str
    platform: str = AUTO


@dataclass(frozen=True, slots=True)
class NewCar:
    """A car in a new fleet file."""

    name: str
    link: str
    platform: str
    color: str
    words: str = ""


def scan(links: Sequence[str], seconds: float | None) -> list[FoundLink]:
    """Scan these links, or all ports and Bluetooth devices, for cars; raises ScanFailed.

    Typed TCP and Bluetooth links are not scanned: closing a TCP connection may end the car's program.
    """
    given = [link for link in links if not isinstance(parse_fleet_link(link), SerialUrl | UsbUrl)]
    taken = [FoundLink(link, "given", "not listened to") for link in dict.fromkeys(given)]
    links = [link for link in links if link not in given]
    if taken and not links:
        return taken
    command = [sys.executable, "-m", "gateway.cli", "scan", "--json"]
    command += [word for link in links for word in ("--link", link)]
    command += [] if seconds is None else ["--for", f"{seconds:g}s"]
    done = subprocess.run(command, stdout=subprocess.PIPE, stderr=None, text=True, check=False)
    if done.returncode == 130:
        raise KeyboardInterrupt
    if done.returncode and not (links and done.returncode == 1):  # 1: one of the links could not be listened to
        raise ScanFailed("`fleet scan` could not look, see above")
    found = [_found(json.loads(line)) for line in done.stdout.splitlines()]
    return [*(each for each in found if each.verdict in POSSIBLE_VERDICTS), *taken]


def _found(fields: Mapping[str, Any]) -> FoundLink:
    if fields["kind"] == "ble":
        words = f"Bluetooth device {_printable(fields['name']) or 'without a name'}, {fields['rssi']} dBm"
        return FoundLink(fields["url"], "ble" if fields["uart"] else "other", words)
    settled = fields["platform"] if fields["platform"] in set(Platform) - {Platform.UNKNOWN} else AUTO
    return FoundLink(fields["url"], fields["verdict"], _printable(fields["words"]), settled)


def _printable(text: str | None) -> str:
    """Return a device's text without control characters, for one line of a terminal or a file."""
    return "".join(each for each in text or "" if each.isprintable())


def quote(text: str) -> str:
    """Format any text as a YAML scalar."""
    return json.dumps(text, ensure_ascii=False)


def format_key(name: str) -> str:
    """Format a car's name as a YAML key, in quotes where YAML would read a number (`10`) or nothing (`null`)."""
    return name if name[0].isalpha() and name not in ("null", "true", "false") else quote(name)


def format_new_file(cars: Sequence[NewCar]) -> str:
    """Return the text of a fleet file with these cars."""
    lines = [
        f"# yaml-language-server: $schema={SCHEMA_URL.format('fleet')}",
        "# Your cars. `fleet check` looks for mistakes, `fleet up` connects them all.",
        "cars:",
    ]
    for index, car in enumerate(cars):
        about = car.words.partition(":")[0]
        key = f"  {format_key(car.name)}:"
        lines.append(key if index else f"{key:<28}# the name that you use in commands")
        lines.append(f"    link: {_scalar(car.link)}" + (f"  # {about}" if about else ""))
        if car.platform != AUTO:
            lines.append(f"    platform: {car.platform}")
        if car.color != default_color(car.name, index):
            lines.append(f"    color: {quote(car.color)}")
    lines += [
        "",
        "defaults:                   # for every car",
        "  limits:",
        "    longest_drive_s: 5      # no command drives longer than this",
        "    on_battery_low: warn    # below 7.0 V: warn, refuse or stop",
        "",
        "# groups: {a: [red, blue]}  # for commands: `fleet stop @a`",
        '# people: {group_a: {drives: ["@a"]}, teacher: {rank: lead}}   # who may drive; left out: everyone',
        "# plan: plan.yaml           # what the cars do together",
        "# record: {to: sessions, quota: 20GB}   # where `fleet up` records, and how much it keeps; false: it does not",
    ]
    return "\n".join(lines) + "\n"


def _scalar(text: str) -> str:
    """Format a link as a YAML scalar, without quotes if YAML reads it as text anyway."""
    return text if re.fullmatch(r"(?!null|true|false)[A-Za-z/][\w/.:?&=-]*\w", text, re.ASCII) else quote(text)


def format_new_plan(count: int) -> str:
    """Return the text of a first plan for this number of cars."""
    lines = [
        f"# yaml-language-server: $schema={SCHEMA_URL.format('plan')}",
        "# What the cars do together. Check it with `fleet check plan.yaml`, run it with `fleet up --plan plan.yaml`.",
        "roles:",
    ]
    if count > 1:
        cars = "all others drive around and avoid" if count > 3 else "two cars drive around and avoid"
        cars = "one car drives around and avoids" if count == 2 else cars
        lines.append(f"  patrol: {{mode: obstacle_avoidance, count: {count - 1}}}  # {cars} obstacles")
    lines.append("  guide: {mode: tracking}  # one car follows the line on the floor")
    return "\n".join(lines) + "\n"
